"""WebSocket clients beyond loopback: admitted by token with its role, or by address in the legacy protocol."""

import itertools
import json
import logging
import time

import pytest
from pydantic import ValidationError
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from sightline.protocol.channels import ACK, DETECTIONS, FRAME, REQUEST, STATUS, TWIST
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.log import start_log
from sightline.protocol.transports.endpoints import parse_websocket_endpoint, with_allowed
from sightline.protocol.transports.security import (
    NO_TOKEN,
    NOT_LISTED,
    check_listening,
    client_address_problem,
    grants_of_role,
    own_token,
    read_tokens,
    role_of_token,
)
from sightline.protocol.transports.websocket.legacy import DRIVER_SLOT_US, DriverSlot
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.peer import NOT_GRANTED
from sightline.robot_side.config import RobotConfig
from tests.fixtures.links import claim, until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.websocket import V1

TOKENS = {"vision": "vision-0123456789abcdef", "operator": "operator_0123456789abc", "viewer": "viewerviewerviewer"}


def everywhere(scheme: str = "ws") -> tuple[str, str]:
    """An endpoint on all addresses of this machine, and how it is reached from here."""
    here = free_endpoint(f"{scheme}://")
    return here.replace("127.0.0.1", "0.0.0.0"), here


# --- beyond loopback -------------------------------------------------------------------------------------------------

LOOPBACK = ("ws://127.0.0.1:9090", "ws://localhost:9090", "ws://[::1]:9090", "wss://127.0.0.7:1", "ws-legacy://127.0.0.1:1")
BEYOND = ("ws://0.0.0.0:9090", "ws://[::]:9090", "wss://192.168.1.7:9090", "ws://robot.local:9090", "ws://127.0.0.1.x:1")


@pytest.mark.parametrize("text", LOOPBACK)
def test_loopback_endpoint_needs_no_token(text):
    check_listening(parse_websocket_endpoint(text), {})


@pytest.mark.parametrize("text", BEYOND)
def test_beyond_loopback_a_token_is_demanded_in_one_line(text):
    with pytest.raises(ConfigError, match="accepts network clients without a token; pass --secure") as why:
        open_websocket("r1", listen=text)
    assert "\n" not in str(why.value)
    assert text in str(why.value)
    check_listening(parse_websocket_endpoint(text), {"a" * 16: "vision"})


def test_beyond_loopback_the_legacy_protocol_demands_a_list_in_one_line():
    here = "ws-legacy://0.0.0.0:9091?oneline"
    with pytest.raises(ConfigError, match="network clients without a token") as why:
        open_websocket("r1", listen=here)
    assert f'legacy.allow_from = ["192.168.1.7"] or {here}&from=192.168.1.7' in str(why.value)
    check_listening(parse_websocket_endpoint(f"{here}&from=192.168.1.7"), {})


# --- the list --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "listed", "may"),
    [
        ("10.0.0.7", ["10.0.0.7"], True), ("10.0.0.8", ["10.0.0.7"], False), ("10.0.0.8", ["10.0.0.0/24"], True),
        ("10.0.1.8", ["10.0.0.0/24"], False), ("10.0.1.8", ["10.0.0.0/24", "10.0.1.8/32"], True), ("1.2.3.4", [], True),
        ("::ffff:10.0.0.7", ["10.0.0.7"], True), ("fe80::1%eth0", ["fe80::/10"], True), ("::1", ["127.0.0.1"], False),
    ],
)  # fmt: skip
def test_addresses_and_networks(address, listed, may):
    assert (client_address_problem(address, listed) == "") is may


def test_allow_list_is_read_from_the_endpoint():
    end = parse_websocket_endpoint("ws-legacy://0.0.0.0:9091?dashed&from=192.168.1.7,10.0.0.1/8")
    assert end.allow_from == ("192.168.1.7/32", "10.0.0.0/8")
    assert end.legacy.dashed
    assert with_allowed("ws-legacy://h:1", ["a", "b"]) == "ws-legacy://h:1?from=a,b"
    assert with_allowed("ws-legacy://h:1?oneline", ["a"]) == "ws-legacy://h:1?oneline&from=a"
    for same in ("ws://h:1", "tcp/h:1", "ws-legacy://h:1?from=b"):
        assert with_allowed(same, ["a"]) == same
    assert with_allowed("ws-legacy://h:1", []) == "ws-legacy://h:1"


def test_a_robots_list_is_written_into_its_endpoints():
    given = {"listen": ["tcp/0.0.0.0:7447", "ws-legacy://0.0.0.0:9091"], "legacy": {"allow_from": ["10.0.0.7"]}}
    config = RobotConfig.model_validate_json(json.dumps(given))
    assert config.doors == ("tcp/0.0.0.0:7447", "ws-legacy://0.0.0.0:9091?from=10.0.0.7")
    with pytest.raises(ValidationError, match="invalid address 'robot'"):
        RobotConfig.model_validate_json(json.dumps({"legacy": {"allow_from": ["robot"]}}))


@pytest.mark.parametrize(
    "text", ["from=", "from=robot", "from=1.2.3", "from=10.0.0.0/33", "from=1.2.3.4,", "swapped", "loud"]
)
def test_a_bad_option_is_rejected(text):
    with pytest.raises(ConfigError):
        parse_websocket_endpoint(f"ws-legacy://127.0.0.1:9091?{text}")


def test_unlisted_client_receives_the_reason_and_the_log_is_limited(caplog):
    endpoint, here = everywhere("ws-legacy")
    plain = here.replace("ws-legacy", "ws")
    with open_websocket("r1", listen=f"{endpoint}?from=10.1.2.3") as robot:
        begin_s = time.monotonic()
        for _ in range(40):
            with pytest.raises(InvalidStatus) as refusal:
                connect(plain, compression=None)
            assert refusal.value.response.status_code == 403
        assert refusal.value.response.body == (
            b"127.0.0.1 is not listed in legacy.allow_from of the robot\n"
        )
        spent_s = time.monotonic() - begin_s
        assert robot.rejected == {NOT_LISTED: 40}
    lines = caplog.messages
    assert 1 <= len(lines) <= 10 * (1 + int(spent_s))
    assert "rejected 127.0.0.1 (127.0.0.1 is not listed" in lines[0]


def test_the_library_logs_nothing_of_a_connection_that_is_rejected(caplog, monkeypatch):
    """A line for each would let a flood of connections fill the log, whatever level ours has."""
    start_log("text", "robot")
    caplog.set_level(logging.DEBUG)
    endpoint, here = everywhere("ws-legacy")
    with open_websocket("r1", listen=f"{endpoint}?from=10.1.2.3"):
        for _ in range(40):
            with pytest.raises(InvalidStatus):
                connect(here.replace("ws-legacy", "ws"), compression=None)
    assert len([one for one in caplog.records if one.name.startswith("sightline")]) <= 10
    assert not [one for one in caplog.records if one.name.startswith("websockets.s")]


def test_listed_client_connects():
    endpoint, here = everywhere("ws-legacy")
    with open_websocket("r1", listen=f"{endpoint}?from=10.1.2.3,127.0.0.0/8") as robot:
        twists = robot.latest(TWIST)
        with connect(here.replace("ws-legacy", "ws"), compression=None) as client:
            client.send("0.1|0")
            assert twists.take(2).payload == b"0.1|0"


# --- tokens ----------------------------------------------------------------------------------------------------------


def test_tokens_are_read_from_a_folder_and_each_role_has_its_own(keys, tmp_path):
    assert read_tokens(keys) == {token: role for role, token in TOKENS.items()}
    assert read_tokens("") == {}
    sources = {"vision": "vision", "teleop": "operator", "operator": "operator", "metrics": "viewer"}
    assert {source: own_token(keys, source) for source in sources} == {s: TOKENS[r] for s, r in sources.items()}
    assert own_token(keys, "robot") == own_token("", "vision") == ""
    (tmp_path / "robot.token").write_text(TOKENS["vision"])
    with pytest.raises(ConfigError, match="the same token for two roles"):
        read_tokens(keys)


@pytest.mark.parametrize("text", ["", "short", "a" * 15, "a" * 129, "a b" * 9, "ü" * 16, "a" * 16 + "\nb"])
def test_invalid_token_is_rejected_with_its_file(keys, tmp_path, text):
    (tmp_path / "vision.token").write_text(text)
    with pytest.raises(ConfigError, match=r"vision\.token"):
        read_tokens(keys)


TOKEN = TOKENS["vision"]


@pytest.mark.parametrize(
    ("authorizations", "offers", "role"),
    [
        ([f"Bearer {TOKEN}"], [], "vision"), ([f"bearer  {TOKEN} "], ["sightline.v1"], "vision"),
        ([], [f"sightline.v1, sightline.token.{TOKEN}"], "vision"),
        ([], ["sightline.v1", f"sightline.token.{TOKENS['viewer']}"], "viewer"),
        ([], [], None), ([f"Basic {TOKEN}"], [], None), ([TOKEN], [], None), ([f"Bearer {TOKEN}x"], [], None),
        (["Bearer "], [], None), ([], ["sightline.token."], None), ([], [f"token.{TOKEN}"], None),
        ([f"Bearer {TOKEN}"], [f"sightline.token.{TOKEN}"], None), ([f"Bearer {TOKEN}"] * 2, [], None),
        (["Bearer \xfc" * 16], [], None),
    ],
)  # fmt: skip
def test_a_token_is_shown_once_in_one_of_two_ways(authorizations, offers, role):
    assert role_of_token({token: name for name, token in TOKENS.items()}, authorizations, offers) == role


@pytest.mark.parametrize(("source", "file"), [("vision", "vision"), ("teleop", "operator"), ("metrics", "viewer")])
def test_a_folder_without_the_token_of_its_role_names_the_missing_file(keys, tmp_path, source, file):
    endpoint, here = everywhere()
    others = tmp_path / "others"
    others.mkdir()
    for role in TOKENS.keys() - {file}:
        (others / f"{role}.token").write_text(TOKENS[role])
    with open_websocket("r1", listen=endpoint, secure=keys), pytest.raises(LinkError) as raised:
        open_websocket("r1", connect=here, role=source, secure=str(others))
    missing = f"{file}.token is missing in {others}; copy it from the folder of `sightline keys init`"
    assert f": {missing}" in str(raised.value)


def test_only_the_token_permits_a_connection(keys, caplog):
    endpoint, here = everywhere()
    with open_websocket("r1", listen=endpoint, secure=keys) as robot:
        with open_websocket("r1", connect=here, role="vision", secure=keys) as peer:
            frames = peer.latest(FRAME)
            assert until(lambda: robot.has_listener(FRAME))
            robot.publish(FRAME, b"{}", b"seen")
            assert frames.take(2).payload == b"seen"
        with pytest.raises(LinkError, match="token missing or unknown; send Authorization: Bearer TOKEN, or pass"):
            open_websocket("r1", connect=here, role="vision")
        for bad in (here + f"/?token={TOKEN}", here):
            with pytest.raises(InvalidStatus) as refusal:
                connect(bad, additional_headers={"Authorization": f"Bearer {TOKEN[:-1]}"}, **V1)
            assert refusal.value.response.status_code == 401
        entries = ["sightline.v1", f"sightline.token.{TOKEN}"]
        with connect(here, subprotocols=entries, compression=None, legacy=True) as browser:
            assert browser.subprotocol == "sightline.v1"
        assert robot.rejected[NO_TOKEN] >= 3
    told = caplog.text
    assert "rejected 127.0.0.1 (token missing" in told
    assert TOKEN[:-1] not in told


# --- roles -----------------------------------------------------------------------------------------------------------


_OF_VISION = ("twist", "ack", "detections", "report", "overlay", "preview")


def test_role_may_publish_its_channels_of_the_table():
    assert grants_of_role("vision") == {(name, "vision") for name in _OF_VISION}
    said = {("twist", "teleop"), ("request", "operator"), ("request", "teleop"), ("mission", "operator")}
    assert said < grants_of_role("operator")
    assert ("report", "operator") not in grants_of_role("operator")
    assert grants_of_role("viewer") == frozenset()
    assert {("frame",), ("status",)} < grants_of_role("robot")


@pytest.mark.parametrize("role", TOKENS)
def test_token_decides_the_role_of_a_client(keys, role, caplog):
    endpoint, here = everywhere()
    sources = ("vision", "teleop", "operator", "guest")
    heard, sent = [], [*itertools.product(["twist", "ack", "request", "detections"], sources)]
    with open_websocket("r1", listen=endpoint, secure=keys) as robot:
        for channel in (TWIST, ACK, REQUEST, DETECTIONS):
            robot.subscribe(channel, lambda message: heard.append((message.channel.name, message.source)))
        with connect(here, additional_headers={"Authorization": f"Bearer {TOKENS[role]}"}, **V1) as client:
            client.send('{"robot":"r1","session":"0000beef","role":"teleop","wants":["status"]}')
            for channel, source in sent:
                client.send(claim(f"sightline/r1/{channel}/{source}", b"", b""))
            allowed = [pair for pair in sent if pair in grants_of_role(role)]
            assert until(lambda: len(heard) == len(allowed) and robot.rejected[NOT_GRANTED] == len(sent) - len(allowed))
            assert heard == allowed
            assert robot.has_listener(STATUS)  # every client may watch
            # Logged once each, at once; an acknowledgement that returns no credit is not worth a word.
            forbidden = {"/".join(pair) for pair in sent if pair not in grants_of_role(role) and pair[0] != "ack"}

            def told():
                return [line for line in caplog.messages if line.startswith("rejected ")]

            assert until(lambda: len(told()) >= min(10, len(forbidden)))  # each line follows its count
            named = [line.split()[1] for line in told()]
            assert set(named) <= forbidden and len(set(named)) == len(named)
            assert all(" from 127.0.0.1: the role of its token does not permit it" in line for line in told())


# --- one of many -----------------------------------------------------------------------------------------------------


def test_driver_slot_belongs_to_the_first_client_until_it_leaves_or_is_silent():
    seat = DriverSlot()
    claims = ("a", 0), ("b", 1), ("a", 900_000), ("b", DRIVER_SLOT_US)
    assert [seat.claim(who, now_us) for who, now_us in claims] == ["a"] * 4
    assert seat.claim("b", 900_000 + DRIVER_SLOT_US - 1) == "a"
    assert seat.claim("b", 900_000 + DRIVER_SLOT_US) == "b"
    seat.leave("a")
    assert seat.claim("a", 900_000 + DRIVER_SLOT_US) == "b"
    seat.leave("b")
    assert seat.claim("a", 900_000 + DRIVER_SLOT_US) == "a"


def test_one_legacy_client_drives_and_the_others_watch(caplog):
    endpoint = free_endpoint("ws-legacy://")
    plain = endpoint.replace("ws-legacy", "ws")
    with open_websocket("r1", listen=endpoint) as robot, connect(plain) as viewer, connect(plain) as driver:
        twists, got = robot.latest(TWIST), []
        viewer.send("left")  # invalid: takes no seat, and the robot reports why it rejects it
        assert twists.take(2).payload == b"left"
        for number in range(5):
            driver.send(f"0.1|{number}")
            got.append(twists.take(2).payload)
            viewer.send(f"0.9|{number}")
        assert got == [b"0.1|%d" % number for number in range(5)]
        assert until(lambda: robot.rejected == {"NOT_HOLDER": 5})
        assert twists.take() is None
        assert until(lambda: robot.publish(FRAME, b"", b"jpeg") and viewer.recv(1) == driver.recv(1))
        driver.close()
        assert until(lambda: viewer.send("0.9|0") or twists.take(0.05), 0.9)  # its seat is free at once
    told = [line for line in caplog.messages if "drives" in line]
    assert len(told) == 3
    assert told[1] == f"{told[1].split()[0]} only watches: {told[0]}"
