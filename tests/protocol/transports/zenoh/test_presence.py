"""Presence: the form of an answer, robot ids in use, and the peers that are listed at a real router."""

import time
from random import Random
from types import SimpleNamespace

import pytest
import zenoh

from sightline.operator_side.cli import app as cli
from sightline.operator_side.client.discovery import as_object, lines, shared_robots
from sightline.operator_side.setup import keys
from sightline.protocol.channels import SOURCES_OF_ROLE, STATUS
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.messages import Stamp, State, Status
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.security import certificate_role
from sightline.protocol.transports.tokens import DriverToken, RobotToken, VisionToken
from sightline.protocol.transports.zenoh.discovery import Discovered, discover
from sightline.protocol.transports.zenoh.link import open_fleet, open_zenoh
from sightline.protocol.transports.zenoh.presence import (
    MAX_PEERS,
    PeerInfo,
    Presence,
    PresenceAnnouncer,
    best_round_trips,
    parse_presence_reply,
    presence_key,
    query_presence,
    robot_with_same_id,
)
from sightline.protocol.transports.zenoh.session import MAX_ROUTER_SESSIONS, open_session
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint

ROBOT = Presence(role="robot", robot="r1", session="0000abcd", software="sightline 9", host="shed", up_us=5_000_000)


def _peer(presence=ROBOT, round_trip_us=2_000, **changes):
    return PeerInfo(presence.model_copy(update=changes), round_trip_us, 0)


# --- pure ------------------------------------------------------------------------------------------------------------


def test_presence_reply_has_role_round_trip_and_clock_offset():
    said = ROBOT.model_copy(update={"clock_us": 1_000_000_000})
    peer = parse_presence_reply(presence_key("robot", "0000abcd"), encode(said), 50_000, 54_000, clock_us=999_000_000)
    assert (peer.presence, peer.round_trip_us, peer.ahead_us) == (said, 4_000, 1_002_000)


@pytest.mark.parametrize("payload", [
    b"", b"{}", b"\xff", b"[1]", encode(ROBOT) + b" " * 600, encode(ROBOT).replace(b'"shed"', b'"a\\u001b[2J"'),
    encode(ROBOT).replace(b"0000abcd", b"0000ABCD"), encode(ROBOT).replace(b'"r1"', b'"a/b"'),
])  # fmt: skip
def test_invalid_presence_is_ignored(payload):
    assert parse_presence_reply(presence_key("robot", "0000abcd"), payload, 0, 1, 2) is None


@pytest.mark.parametrize("role", ["vision", "operator", "teleop", "viewer"])
def test_presence_with_another_role_is_ignored(role):
    assert parse_presence_reply(presence_key(role, "0000abcd"), encode(ROBOT), 0, 1, 2) is None


def test_each_is_listed_once_as_it_answered_quickest_robots_first():
    vision = _peer(role="vision", session="00000002")
    rounds = [[vision, _peer(round_trip_us=900)], [_peer(round_trip_us=300), vision], [_peer(round_trip_us=400)]]
    assert best_round_trips(rounds) == [_peer(round_trip_us=300), vision]


def test_a_flood_of_names_is_bounded():
    assert len(best_round_trips([[_peer(session=f"{n:08x}") for n in range(3 * MAX_PEERS)]])) == MAX_PEERS


@pytest.mark.parametrize(("other", "is_taken"), [
    ({"session": "0000beef", "up_us": 9_000_000}, True),
    ({"session": "0000beef", "up_us": 1_000_000}, False),  # who came later gives way, not we
    ({"session": "0000abcd", "up_us": 9_000_000}, False),  # its own earlier self
    ({"session": "0000beef", "up_us": 9_000_000, "robot": "r2"}, False),
    ({"session": "0000beef", "up_us": 9_000_000, "role": "vision"}, False),
])  # fmt: skip
def test_id_belongs_to_the_robot_that_has_run_longer(other, is_taken):
    taken = robot_with_same_id(ROBOT, [_peer(robot="r7", session="00000001", up_us=9_999_999), _peer(**other)])
    assert (taken is not None) is is_taken


@pytest.mark.parametrize("seed", range(20))
def test_of_two_robots_that_start_together_one_stays(seed):
    random = Random(seed)
    delay_us, ages_us = random.randrange(200_000), [random.randrange(1_000_000) for _ in range(2)]
    robots = [_peer(session=f"0000000{at}", up_us=age_us).presence for at, age_us in enumerate(ages_us)]
    late = [_peer(one, 2 * delay_us, up_us=one.up_us + delay_us) for one in robots]
    assert [robot_with_same_id(robots[at], [late[1 - at]]) is None for at in range(2)].count(True) == 1


def test_operator_reads_state_version_machine_and_round_trip():
    status = encode(Status(state=State.DISARMED, reason="waiting"))
    heard = {"r1": Message(STATUS, "", encode(Stamp(session="0000abcd", seq=1, t_us=1)), status),
             "js9": Message(STATUS, "", b"{", b"")}
    peers = [_peer(session="00000009"), _peer(), _peer(role="vision", session="00000002", robot="r*")]
    assert list(lines(Discovered(heard, peers))) == [
        "robot     js9: invalid status: Stamp: Invalid JSON: EOF while parsing an object at line 1 column 1"
        "  (no version reported)",
        "robot     r1: DISARMED (waiting)  sightline 9 on shed, round trip 2.0 ms",
        "robot     r1: a second robot has this id  sightline 9 on shed, round trip 2.0 ms; end one of them",
        "vision    of r*  sightline 9 on shed, round trip 2.0 ms",
    ]
    whole = as_object(Discovered(heard, peers))
    assert [row["role"] for row in whole["peers"]] == ["robot", "robot", "vision"]
    assert whole["peers"][0]["round_trip_ms"] == 2.0 and "error" in whole["robots"][0]


def test_robots_that_services_share_are_listed_with_their_driver_and_standby():
    robots = [RobotToken("r1"), RobotToken("r2"), RobotToken("r3")]
    services = [VisionToken(name, 1.0, "0000000a") for name in ("a", "b")]
    tokens = {*robots, *services, DriverToken("r1", "a", "0" * 32), DriverToken("r2", "b", "1" * 32)}
    found = Discovered({"r2": Message(STATUS, "", b"{", b"")}, [_peer()], frozenset(tokens))
    said = list(lines(found))
    assert said[0].endswith("; service a, standby b")
    assert said[1].endswith("; service b, standby a")
    assert said[2:] == ["robot     r3: no status  (no version reported); no service drives it, standby b"]
    assert [row["robot"] for row in as_object(found)["robots"]] == ["r1", "r2", "r3"]
    assert as_object(found)["robots"][1] | {"error": ""} == {
        "robot": "r2", "error": "", "driven_by": "b", "standby": "a"
    }
    assert shared_robots({*robots, services[0]}) == dict.fromkeys(("r1", "r2", "r3"), ("", "a")), "nothing drives yet"
    assert shared_robots(robots) == {}, "no service shares"


# --- over real sessions ----------------------------------------------------------------------------------------------


@pytest.fixture
def router():
    endpoint = free_endpoint()
    session = open_session([endpoint], (), 5.0)
    yield endpoint
    session.close()


def test_every_robot_of_a_site_with_300_answers(router):
    with open_session((), [router], 5.0) as robots, open_session((), [router], 5.0) as asking:
        for number in range(300):
            PresenceAnnouncer("robot", f"r{number}", f"{number:08x}").answer_in(robots)
        assert until(lambda: len({one.presence.robot for one in query_presence(asking, 5.0)}) == 300, 20)
    assert MAX_PEERS >= 2 * MAX_ROUTER_SESSIONS


def test_every_peer_at_a_router_is_listed_within_two_seconds(router):
    with (
        open_zenoh("r1", connect=[router], role="robot") as robot,
        open_zenoh("r1", connect=[router], role="vision"),
        open_fleet("r*", connect=[router], role="vision"),
        open_zenoh("r1", connect=[router], role="detector"),
        open_zenoh("r1", connect=[router]),  # who has no role is not listed
    ):
        began_s = time.monotonic()
        peers = discover([router], 0.6).peers
        took_s = time.monotonic() - began_s
        assert {peer.presence.host for peer in robot.peers()} == {peer.presence.host for peer in peers}
    assert [(peer.presence.role, peer.presence.robot) for peer in peers] == [
        ("robot", "r1"), ("vision", "r*"), ("vision", "r1"), ("detector", "r1"),
    ]  # fmt: skip
    assert took_s < 2.0
    assert all(0 < peer.round_trip_us < 500_000 and peer.presence.software for peer in peers)
    assert all(abs(peer.ahead_us) < 500_000 for peer in peers)  # one machine has one clock


@pytest.mark.parametrize("role", ["Vision", "a b", "x" * 17, "r/1"])
def test_a_role_that_is_invalid_is_rejected_and_nothing_stays_open(router, role):
    with pytest.raises(ConfigError, match="expected 1 to 16 lower-case letters"):
        open_zenoh("r1", connect=[router], role=role)


def test_closed_peer_is_not_listed(router):
    with open_zenoh("r1", connect=[router], role="robot"):
        assert len(discover([router], 0.6).peers) == 1
    assert discover([router], 0.6).peers == []


def test_listening_robot_is_listed_by_a_connecting_client():
    endpoint = free_endpoint()
    with open_zenoh("r1", listen=[endpoint], role="robot"):
        around = discover([endpoint], 0.4)
    assert [peer.presence.robot for peer in around.peers] == ["r1"] and around.statuses == {}


def test_second_robot_with_one_id_is_rejected_with_the_first(router):
    with (
        open_zenoh("r1", connect=[router], role="robot", session="0000abcd"),
        pytest.raises(LinkError, match=r"^robot id 'r1' is in use on host \S+ \(running for .* s\)"
                                       r"; pass --robot ID$"),
    ):
        open_zenoh("r1", connect=[router], role="robot")
    with open_zenoh("r1", connect=[router], role="robot"):
        assert len(discover([router], 0.6).peers) == 1


def test_other_id_and_restarted_robot_are_accepted(router):
    with (
        open_zenoh("r1", connect=[router], role="robot", session="0000abcd"),
        open_zenoh("r2", connect=[router], role="robot"),
        open_zenoh("r1", connect=[router], role="robot", session="0000abcd"),
    ):
        assert len(discover([router], 0.6).peers) == 2


def test_robot_that_ends_during_the_check_does_not_block_its_successor(router, monkeypatch):
    first = open_zenoh("r1", connect=[router], role="robot")
    monkeypatch.setattr("sightline.protocol.transports.zenoh.presence._SECOND_LOOK_S", 0.0)
    monkeypatch.setattr("sightline.protocol.transports.zenoh.presence.time.sleep", lambda _seconds: first.close())
    with open_zenoh("r1", connect=[router], role="robot") as second:
        assert second.connected


def test_secured_peers_are_listed_by_their_certificate(tmp_path):
    folder, endpoint = tmp_path / "keys", free_endpoint("tls/")
    keys.make(folder, [])
    roles = ["vision", "operator", "teleop", "detector", "viewer3"]
    with open_zenoh("r1", listen=[endpoint], role="robot", secure=str(folder)):
        links = [open_zenoh("r1", connect=[endpoint], role=role, secure=str(folder)) for role in roles]
        try:
            listed = [peer.presence.role for peer in discover([endpoint], 1.0, str(folder)).peers]
        finally:
            for link in links:
                link.close()
    assert sorted(listed) == sorted(["robot", *roles])
    assert {certificate_role(role) for role in listed} == {"robot", *SOURCES_OF_ROLE}


def test_secured_peer_with_another_certificate_is_not_listed_as_robot(tmp_path):
    """A viewer answers as robot r1, under a robot's key and under its own: neither is listed."""
    folder, endpoint = tmp_path / "keys", free_endpoint("tls/")
    keys.make(folder, [])
    with open_zenoh("r2", listen=[endpoint], role="robot", secure=str(folder)):
        from sightline.protocol.transports.security import load_role_keys

        rogue = open_session((), [endpoint], 5.0, load_role_keys(str(folder), "viewer"))
        try:
            for key in (presence_key("robot", "0000abcd"), presence_key("viewer", "0000abcd")):
                rogue.declare_queryable(key, lambda query, key=key: query.reply(key, encode(ROBOT)))
            listed = [peer.presence.robot for peer in discover([endpoint], 1.0, str(folder)).peers]
        finally:
            rogue.close()
    assert listed == ["r2"]


def test_command_lists_peers_as_text_and_json(router, capsys):
    import json

    with open_zenoh("r1", connect=[router], role="robot"), open_zenoh("r1", connect=[router], role="vision"):
        assert cli.run(["robots", "--connect", router, "--seconds", "0.5"]) == 0
        said = capsys.readouterr().out.splitlines()
        assert cli.run(["robots", "--connect", router, "--seconds", "0.5", "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
    assert [line.split()[0] for line in said] == ["robot", "vision"]
    assert "no status" in said[0] and "round trip" in said[1]
    assert [peer["role"] for peer in found["peers"]] == ["robot", "vision"] and found["places"] == [router]


def test_empty_router_is_reported(router, capsys):
    assert cli.run(["robots", "--connect", router, "--seconds", "0.3"]) == 4
    assert capsys.readouterr().err.startswith(f"error: no robot at {router} after 0.3 s")


def test_endpoint_of_one_robot_differs_from_a_router(capsys):
    assert cli.run(["robots", "--connect", "ws://127.0.0.1:9090"]) == 2
    assert "sightline status --connect ws://127.0.0.1:9090" in capsys.readouterr().err


def test_no_query_of_presence_waits_for_a_peer_that_hangs():
    """A router that waits for the room of one peer passes no message of others: robots stood for 2 to 5 s."""
    noted = []
    session = SimpleNamespace(get=lambda *_, **options: noted.append(options) or ())
    assert query_presence(session) == []
    assert [one["congestion_control"] for one in noted] == [zenoh.CongestionControl.DROP]
