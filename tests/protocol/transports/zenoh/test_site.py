"""Places where machines meet: every transport by the text of its endpoint, restarts of a router, no cross-talk."""

import itertools
import json
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace

import pytest
import zenoh

from sightline.operator_side.setup import keys
from sightline.protocol.channels import ACK, FRAME, REQUEST, STATUS, TWIST
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.zenoh.link import MAX_ROBOTS, open_fleet, open_zenoh
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision, driving

TRANSPORTS = ("tcp", "tls", "quic", "udp", "ws")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("keys") / "k"
    keys.make(made, [])
    return str(made)


def arrives(link, channel, payload, slot):
    """Publish until it arrives: a busy machine may hold the sending thread up until a message is dropped, by design."""
    return until(lambda: link.publish(channel, b"{}", payload) and (got := slot.take(0.5)) and got.payload == payload)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_link_has_the_transport_of_its_endpoint(transport, folder):
    endpoint, secure = free_endpoint(f"{transport}/"), folder if transport in ("tls", "quic") else ""
    with (
        open_zenoh("r1", listen=[endpoint], role="robot", secure=secure) as robot,
        open_zenoh("r1", connect=[endpoint], role="vision", secure=secure) as vision,
    ):
        frames, twists = vision.latest(FRAME), robot.latest(TWIST)
        assert until(lambda: robot.has_listener(FRAME) and vision.has_listener(TWIST))
        for number in range(10):
            assert arrives(robot, FRAME, bytes([number]) * 60_000, frames)
            assert arrives(vision, TWIST, b"0.1|%d" % number, twists)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_missing_peer_raises_in_time_with_the_endpoint(transport, folder):
    endpoint, secure = free_endpoint(f"{transport}/"), folder if transport in ("tls", "quic") else ""
    began_s = time.monotonic()
    with pytest.raises(LinkError) as refusal:
        open_zenoh("r1", connect=[endpoint], role="vision", secure=secure, timeout_s=0.5)
    assert time.monotonic() - began_s < 5.0
    said = f"no answer from {endpoint} after 0.5 s; start the robot or router, or check the address"
    assert str(refusal.value).startswith(said)
    assert (", or one end rejects" in str(refusal.value)) is (transport == "quic")


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_with_keys_no_other_transport_is_taken(transport, folder):
    with pytest.raises(ConfigError, match="has no TLS"):
        open_zenoh("r1", connect=[free_endpoint(f"{transport}/")], role="vision", secure=folder)


def test_robots_beyond_the_limit_of_a_service_are_logged_once(caplog):
    with open_fleet("r*", listen=[free_endpoint()], role="vision") as fleet:
        for number in range(MAX_ROBOTS + 3):
            fleet._note(SimpleNamespace(key_expr=f"sightline/r{number}/status"))
        assert len(fleet.robots()) == MAX_ROBOTS
    assert [one.getMessage() for one in caplog.records] == [
        "r1000 is not served: 1000 robots are present, the limit of one service; give each service a part of the "
        "robots with --robot"]


def test_several_robots_and_vision_services_at_one_router_never_cross(tmp_path):
    endpoint, robots = free_endpoint(), ("r1", "r2", "r10")
    heard = {robot: [] for robot in robots}
    with ExitStack() as ending:
        fleet = ending.enter_context(open_fleet("r*", listen=[endpoint], role="vision"))
        ends = {name: ending.enter_context(open_zenoh(name, connect=[endpoint], role="robot")) for name in robots}
        eyes = {name: ending.enter_context(open_zenoh(name, connect=[endpoint], role="vision")) for name in robots}
        for (name, end), channel in itertools.product(ends.items(), (TWIST, ACK, REQUEST)):
            end.subscribe(channel, lambda message, name=name: heard[name].append(message.payload))
        seen = {name: [eyes[name].latest(FRAME)] for name in robots}
        assert until(lambda: all(end.publish(STATUS, b"{}", b"{}") for end in ends.values())
                     and len(fleet.robots()) == 3)
        for name in robots:
            seen[name].append(fleet.link(name).latest(FRAME))
        assert until(lambda: all(end.has_listener(FRAME) for end in ends.values()))
        assert until(lambda: all(eye.has_listener(TWIST) for eye in eyes.values()))
        for name, number in itertools.product(robots, range(5)):
            said = f"{name} {number}".encode()
            ends[name].publish(FRAME, b"{}", said)
            assert [slot.take(2.0).payload for slot in seen[name]] == [said, said]
            eyes[name].publish(TWIST, b"{}", said)
        assert until(lambda: all(len(got) == 5 for got in heard.values()))
        time.sleep(0.05)  # what goes astray must have had its chance
        assert heard == {name: [f"{name} {number}".encode() for number in range(5)] for name in robots}
        assert all(slot.take() is None for slots in seen.values() for slot in slots)


def test_stock_zenoh_router_works():
    """Zenoh's own defaults, as `zenohd` has them: shared memory, gossip and a lease of 10 s."""
    endpoint, config = free_endpoint(), zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    with (
        zenoh.open(config),
        open_zenoh("r1", connect=[endpoint], role="robot") as robot,
        open_zenoh("r1", connect=[endpoint], role="vision") as vision,
    ):
        frames, twists = vision.latest(FRAME), robot.latest(TWIST)
        assert until(lambda: robot.has_listener(FRAME) and vision.has_listener(TWIST))
        assert robot.publish(FRAME, b"{}", bytes(60_000)) and len(frames.take(2.0).payload) == 60_000
        assert vision.publish(TWIST, b"{}", b"0.1|0") and twists.take(2.0).source == "vision"


@contextmanager
def _router(endpoint):
    command = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app", "router", "--listen", endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert " info router: on " in process.stdout.readline()
            yield process
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_robot_is_driven_again_when_its_router_comes_back(tmp_path, how):
    endpoint = free_endpoint()
    with ExitStack() as ending:
        first = ending.enter_context(_router(endpoint))
        robot = ending.enter_context(RobotProcess(tmp_path, listen=[], connect=[endpoint]))
        ending.enter_context(Vision(endpoint))
        robot.wait_until_on()
        assert driving(robot)
        first.send_signal(how)
        first.wait(5)
        assert until(lambda: robot.speed() == 0.0, 2.0)
        ending.enter_context(_router(endpoint))
        assert driving(robot), robot.output()


@pytest.mark.slow
def test_second_robot_with_one_id_does_not_start_and_names_the_first(tmp_path):
    endpoint = free_endpoint()
    with _router(endpoint):
        (tmp_path / "a").mkdir()
        (tmp_path / "b").mkdir()
        with RobotProcess(tmp_path / "a", listen=[], connect=[endpoint]) as first, Vision(endpoint):
            first.wait_until_on()
            assert driving(first)
            with RobotProcess(tmp_path / "b", listen=[], connect=[endpoint]) as second:
                assert second.process.wait(15) == 4
                assert "error: robot id 'r1' is in use on host " in second.output()
            assert driving(first)
            first.kill_network()  # comes back by itself, and does not count as a second robot with its id
            assert until(lambda: first.speed() == 0.0, 2.0)
            assert driving(first), first.output()
