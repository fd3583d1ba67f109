"""Secured Zenoh links: permissions to send and receive, by certificate, and readable causes of a mismatch."""

import datetime
import socket
import threading
import time
from contextlib import closing
from itertools import product

import pytest

from sightline.operator_side.setup import keys
from sightline.protocol.channels import (
    ACK,
    CHANNELS,
    FRAME,
    MAX_HEADER_BYTES,
    MISSION,
    REPORT,
    REQUEST,
    SOURCES_OF_ROLE,
    STATUS,
    TWIST,
    Direction,
)
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports import diagnosis
from sightline.protocol.transports.diagnosis import diagnose_tls
from sightline.protocol.transports.security import (
    CERTIFICATES,
    ROLES,
    certificate_role,
    load_role_keys,
    may_publish,
    may_subscribe,
    read_tokens,
)
from sightline.protocol.transports.tokens import RobotToken
from sightline.protocol.transports.zenoh.discovery import discover
from sightline.protocol.transports.zenoh.link import open_fleet, open_zenoh
from sightline.protocol.transports.zenoh.session import MAX_MESSAGE_BYTES, open_session
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint, free_port

pytestmark = pytest.mark.waits

SAID = (TWIST, ACK, REQUEST, MISSION, REPORT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("keys") / "k"
    keys.make(made, ["robot.local"])
    return made


@pytest.fixture
def endpoint():
    return free_endpoint("tls/")


def test_only_the_listed_may_publish():
    assert may_publish("viewer") == []
    assert "sightline/*/twist/vision" in may_publish("vision")
    assert not any("request" in key for key in may_publish("vision"))
    assert {"sightline/*/request/operator", "sightline/*/twist/teleop"} <= set(may_publish("operator"))
    assert not any(key.endswith("/vision") for key in may_publish("operator"))
    assert {"sightline/*/mission/operator", "sightline/*/mission/teleop"} <= set(may_publish("operator"))
    assert "sightline/*/report/vision" in may_publish("vision")
    assert {"sightline/*/overlay/vision", "sightline/*/preview/vision"} <= set(may_publish("vision"))
    assert not any("/overlay/" in key or "/preview/" in key for key in may_publish("operator"))
    assert not any("/report/" in key for key in may_publish("operator"))
    assert may_publish("detector") == ["sightline/*/detections/detector"], "who looks drives nothing, nor gives credit"
    assert not any("/mission/" in key for key in may_publish("vision"))
    assert not any(key.endswith("/guest") for role in ROLES for key in may_publish(role))
    assert {key.split("/")[2] for key in may_publish("robot")} == {
        name for name, channel in CHANNELS.items() if channel.direction is Direction.FROM_ROBOT
    }


def test_message_toward_the_robot_reaches_only_the_robot():
    assert all(key.endswith("/*") for key in may_subscribe("robot"))
    assert not any("twist" in key for role in SOURCES_OF_ROLE for key in may_subscribe(role))
    for passed_on in ("detections", "mission", "report", "overlay", "preview"):
        assert all(f"sightline/*/{passed_on}/*" in may_subscribe(role) for role in (*SOURCES_OF_ROLE, "robot"))


def test_a_role_that_is_invalid_is_a_viewer():
    assert [certificate_role(name) for name in ("vision", "teleop", "operator", "robot", "router", "guest", "")] == [
        "vision", "operator", "operator", "robot", "router", "viewer", "viewer",
    ]  # fmt: skip


def test_each_role_publishes_only_its_channels(folder, endpoint):
    heard = []
    with open_zenoh("r1", listen=[endpoint], role="robot", secure=str(folder)) as robot:
        for channel in SAID:
            robot.subscribe(channel, lambda message: heard.append((message.channel.name, message.source)))
        for role in SOURCES_OF_ROLE:
            with open_zenoh("r1", connect=[endpoint], role=role, secure=str(folder)) as peer:
                frames = peer.latest(FRAME)
                assert until(lambda: robot.has_listener(FRAME))
                robot.publish(FRAME, b"{}", b"jpeg")
                assert frames.take(2.0) is not None, f"{role} may watch"
                allowed = {key for key in may_publish(role) if CHANNELS[key.split("/")[2]] in SAID}
                assert until(lambda peer=peer, allowed=allowed: says_all(peer) or said(heard) >= allowed)
                heard.clear()
                # A full link drops messages, so each round repeats all. What is denied comes before a second round.
                assert until(
                    lambda peer=peer, allowed=allowed: says_all(peer) or all(count(heard, key) >= 2 for key in allowed)
                )
            assert until(lambda: not robot.has_listener(FRAME)), "the link ends after all that was published on it"
            assert said(heard) == allowed
            heard.clear()


def test_listener_drops_a_message_over_the_bound_of_its_channel(folder, endpoint):
    """At a router, so that it crosses no robot's radio; what is just within it passes."""
    heard = []
    with (
        closing(open_session([endpoint], (), 5.0, load_role_keys(str(folder), "router"))),
        open_session((), [endpoint], 5.0, load_role_keys(str(folder), "robot")) as robot,
        open_session((), [endpoint], 5.0, load_role_keys(str(folder), "vision")) as vision,
    ):
        robot.declare_subscriber("sightline/r1/twist/*", lambda sample: heard.append(len(sample.payload)))
        bound = TWIST.max_payload_bytes
        assert until(lambda: vision.put("sightline/r1/twist/vision", b"0", attachment=b"h") or heard)
        heard.clear()

        def put(size):
            vision.put("sightline/r1/twist/vision", bytes(size), attachment=bytes(MAX_HEADER_BYTES))

        put(bound + 1)
        put(MAX_MESSAGE_BYTES // 2)
        assert until(lambda: put(bound) or bound in heard), "a full link drops a message"
        assert set(heard) - {1} == {bound}


def test_two_linked_routers_pass_on_what_each_role_may(folder, endpoint):
    """The robot is at one router, its drivers at the other one."""
    other, heard, tokens, secure = free_endpoint("tls/"), [], set(), str(folder)
    router = load_role_keys(secure, "router")
    with (
        closing(open_session([endpoint], (), 5.0, router)),
        closing(open_session([other], [endpoint], 5.0, router)),
        open_zenoh("r1", connect=[endpoint], role="robot", secure=secure) as robot,
        open_zenoh("r1", connect=[other], role="vision", secure=secure) as vision,
        open_zenoh("r1", connect=[other], role="viewer", secure=secure) as viewer,
        open_fleet("*", connect=[other], role="vision", by_status=False, secure=secure) as fleet,
    ):
        frames = vision.latest(FRAME)
        robot.subscribe(TWIST, lambda message: heard.append(message.source))
        fleet.watch_tokens(lambda token, _present: tokens.add(token))
        assert until(lambda: (robot.publish(FRAME, b"{}", b"jpeg"), frames.take(0.01))[1])
        assert until(lambda: [peer.publish(TWIST, b"{}", b"0|0") for peer in (viewer, vision)] and len(heard) > 1)
        assert until(lambda: fleet.find_robots() == {"r1"} and RobotToken("r1") in tokens)
    assert set(heard) == {"vision"}


def says_all(peer):
    """Once on every key, and as every source; a peer that has just come in may not yet know who listens to what."""
    for channel, source in product(SAID, ("vision", "operator", "teleop", "guest")):
        peer.publish(channel, b"{}", b"", source)


def count(heard, key):
    return sum(f"sightline/*/{channel}/{source}" == key for channel, source in tuple(heard))


def said(heard):
    return {f"sightline/*/{channel}/{source}" for channel, source in heard}


@pytest.fixture
def broken(tmp_path, folder):
    """The folder's keys, to be spoiled."""
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def _refusal(endpoint, robot_keys, peer_keys, plain_robot=False):
    listen = endpoint.replace("tls/", "tcp/") if plain_robot else endpoint
    with (
        open_zenoh("r1", listen=[listen], role="robot", secure="" if plain_robot else str(robot_keys)) as robot,
        pytest.raises(LinkError) as refusal,
    ):
        robot.subscribe(TWIST, lambda message: None)
        target = endpoint if peer_keys else endpoint.replace("tls/", "tcp/")
        open_zenoh("r1", connect=[target], role="vision", secure=str(peer_keys or ""), timeout_s=0.5)
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


def test_keys_of_another_authority_are_rejected_with_the_cause(folder, endpoint, tmp_path):
    keys.make(tmp_path / "other", [])
    assert "of another authority" in _refusal(endpoint, folder, tmp_path / "other")


def test_an_expired_certificate_is_named(folder, endpoint, broken):
    keys.add(broken, "robot", [], days=-0.5)
    assert "its certificate has expired" in _refusal(endpoint, broken, folder)


def test_our_own_expired_certificate_is_named(folder, endpoint, broken):
    keys.add(broken, "vision", [], days=-0.5)
    assert "the certificate of this end has expired" in _refusal(endpoint, folder, broken)


@pytest.mark.parametrize(("of_robot", "of_peer", "words"), [
    ("now", "later", "the certificate of this end is not valid before 2"),
    ("later", "now", "its certificate is not valid yet; set the clock of this machine (here it is 2"),
    ("later", "later", "the certificate of this end is not valid before 2"),
])
def test_certificate_that_is_not_valid_yet_is_named(folder, endpoint, broken, monkeypatch, of_robot, of_peer, words):
    monkeypatch.setattr(keys, "_BEGUN_EARLIER", datetime.timedelta(days=-30))
    for role in ("robot", "vision"):
        keys.add(broken, role, [], days=60)
    folders = {"now": folder, "later": broken}
    assert words in _refusal(endpoint, folders[of_robot], folders[of_peer])


def test_certificate_that_only_the_clock_of_the_other_end_rejects_is_named(folder, endpoint, broken, monkeypatch):
    keys.add(broken, "vision", [], days=-0.5)
    monkeypatch.setattr(diagnosis, "date_problem", lambda *_: "")  # as if the clock there were ahead
    assert "valid here, but expired or not valid yet on the clock there; set" in _refusal(endpoint, folder, broken)


def test_a_certificate_of_another_host_is_named(folder, endpoint, broken, monkeypatch):
    monkeypatch.setattr(keys, "LOOPBACK", ())
    keys.add(broken, "robot", ["elsewhere.local"])
    assert "names other addresses" in _refusal(endpoint, broken, folder)


def test_plain_to_secured_and_secured_to_plain_are_rejected_with_the_cause(folder, endpoint):
    assert "accepts only TLS" in _refusal(endpoint, folder, None)
    assert "it is a plain link (pass --secure" in _refusal(endpoint, folder, folder, plain_robot=True)


def test_a_port_that_does_not_answer_tls_is_reported_with_both_causes(folder):
    port = free_port()
    with socket.create_server(("127.0.0.1", port)):  # silent as a plain port is, and one that others flood
        why = diagnose_tls(f"tls/127.0.0.1:{port}", load_role_keys(str(folder), "vision"))
    assert "does not answer TLS" in why and "plain link" in why and "flood" in why


def test_failed_tls_does_not_fall_back_to_a_plain_link(folder):
    with pytest.raises(ConfigError, match="has no TLS"):
        open_zenoh("r1", connect=["tcp/127.0.0.1:7447"], role="vision", secure=str(folder))


def test_missing_keys_are_named(broken):
    (broken / "vision.key").unlink()
    with pytest.raises(ConfigError, match=r"vision\.key is missing in .*copy ca\.pem, vision\.pem and vision\.key"):
        open_zenoh("r1", connect=["tls/127.0.0.1:7447"], role="vision", secure=str(broken))


@pytest.mark.parametrize("role", ["operator", "viewer"])
def test_robots_are_listed_over_a_secured_link(folder, endpoint, role, tmp_path):
    for name in ("ca.pem", f"{role}.pem", f"{role}.key"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    with open_zenoh("r1", listen=[endpoint], role="robot", secure=str(folder)) as robot:
        found = {}
        deadline_s = time.monotonic() + 5
        secure = str(tmp_path)
        listing = threading.Thread(target=lambda: found.update(discover([endpoint], 0.6, secure).statuses), daemon=True)
        listing.start()
        while listing.is_alive() and time.monotonic() < deadline_s:
            robot.publish(STATUS, b"{}", b"{}")
            time.sleep(0.02)
        listing.join()
    assert set(found) == {"r1"}


def test_keys_are_for_their_owner_only_and_never_overwritten(folder):
    kept = [file for file in folder.iterdir() if file.suffix in (".key", ".token")]
    assert len(kept) == 1 + len(CERTIFICATES) + len(ROLES)
    assert all(file.stat().st_mode & 0o077 == 0 for file in kept)
    with pytest.raises(ConfigError, match="already has keys"):
        keys.make(folder, [])


def test_new_token_differs_and_has_its_role(broken):
    before = read_tokens(str(broken))
    keys.add(broken, "operator", [])
    after = read_tokens(str(broken))
    assert sorted(before.values()) == sorted(after.values()) == sorted(ROLES)
    assert len(set(before) & set(after)) == len(ROLES) - 1


def test_certificates_are_listed_with_hosts_and_expiry(folder):
    shown = {certificate.role: certificate for certificate in keys.look(folder)}
    assert set(shown) == {"sightline authority", *CERTIFICATES}
    assert shown["robot"].hosts == ("localhost", "127.0.0.1", "robot.local")


@pytest.mark.parametrize("host", ["a b", "röbot", "http://x", ""])
def test_a_host_that_is_invalid_is_rejected(folder, host):
    with pytest.raises(ConfigError, match="expected a name or address"):
        keys.add(folder, "viewer", [host])


def test_a_host_that_is_invalid_leaves_nothing_behind(tmp_path):
    with pytest.raises(ConfigError):
        keys.make(tmp_path / "new", ["a b"])
    assert not (tmp_path / "new").exists()


def test_a_folder_without_an_authority_cannot_sign(tmp_path):
    with pytest.raises(ConfigError, match="no authority"):
        keys.add(tmp_path, "robot", [])
    with pytest.raises(ConfigError, match="no certificates"):
        keys.look(tmp_path)
    (tmp_path / "x.pem").write_text("rubbish")
    with pytest.raises(ConfigError, match="invalid certificate"):
        keys.look(tmp_path)
