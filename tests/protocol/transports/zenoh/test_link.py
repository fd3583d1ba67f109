"""Zenoh in one process: errors in words, bounds, what a frame costs on the wire, the newest statuses."""

import gc
import re
import socket
import sys
import threading
import time
from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path

import pytest

from sightline.protocol.channels import DETECTIONS, FRAME, STATUS, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.messages import FrameHeader
from sightline.protocol.transports.diagnosis import port_owner
from sightline.protocol.transports.endpoints import parse_zenoh_endpoint, with_send_buffer
from sightline.protocol.transports.link import NOT_A_PUT
from sightline.protocol.transports.zenoh.discovery import discover
from sightline.protocol.transports.zenoh.link import MAX_KEPT_PUBLISHERS, ZenohLink, open_fleet, open_zenoh
from sightline.protocol.transports.zenoh.session import open_session, session_config
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint, free_port

NO_ENDPOINTS = (
    "", "foo", "tcp", "tcp:/x", "tcp/", "tcp/127.0.0.1", "tcp/:7447", "tcp/127.0.0.1:", "tcp/127.0.0.1:0",
    "tcp/127.0.0.1:99999", "tcp/127.0.0.1:65536", "tcp/127.0.0.1:-1", "tcp/127.0.0.1:7447 ", "http://127.0.0.1:7447",
    "TCP/127.0.0.1:7447", "tcp/a b:7447", "tcp/127.0.0.1:7447/x", "127.0.0.1:7447", "tcp/::1:7447", "tcp/127.0.0.1:٧",
    f"tcp/{'a' * 64}:7447", f"tcp/{'a' * 64}.b:7447", "tcp/a..b:7447", f"tcp/{'é' * 60}:7447", "tcp/[fe80::1%]:1",
)  # fmt: skip


@pytest.mark.parametrize("endpoint", NO_ENDPOINTS)
@pytest.mark.parametrize("end", ["listen", "connect"])
def test_an_endpoint_that_is_invalid_is_rejected_with_the_right_form(endpoint, end):
    with pytest.raises(ConfigError, match=re.escape("e.g. tcp/127.0.0.1:7447")) as refusal:
        open_zenoh("r1", **{end: [endpoint]})
    assert repr(endpoint) in str(refusal.value)


def test_well_formed_endpoints_and_their_send_buffer():
    assert parse_zenoh_endpoint("tcp/[::1]:7447") == ("tcp", "::1", 7447)
    assert parse_zenoh_endpoint("tls/robot.local:1#so_sndbuf=1") == ("tls", "robot.local", 1)
    longest = f"{'a' * 63}.{'b' * 63}"
    for host in (longest, f"{longest}.", "bücher.example"):
        assert parse_zenoh_endpoint(f"tcp/{host}:1") == ("tcp", host, 1)
    assert with_send_buffer("tcp/h:1") == "tcp/h:1#so_sndbuf=262144"
    assert with_send_buffer("tcp/h:1#iface=wlan0") == "tcp/h:1#iface=wlan0"
    assert with_send_buffer("udp/h:1") == "udp/h:1"


@pytest.mark.parametrize(("given", "for_zenoh"), [
    ("tcp/[fe80::1%wlan0]:7447", "tcp/[fe80::1%7]:7447#so_sndbuf=262144"),
    ("udp/[fe80::1%wlan0.2]:7447#a=%", "udp/[fe80::1%7]:7447#a=%"),
    ("tcp/[fe80::1%3]:7447#a", "tcp/[fe80::1%3]:7447#a"), ("tcp/a%b:7447#a", "tcp/a%b:7447#a"),
])  # fmt: skip
@pytest.mark.parametrize("end", ["listen", "connect"])
def test_interface_of_a_link_local_address_is_a_number_for_zenoh(monkeypatch, given, for_zenoh, end):
    monkeypatch.setattr(socket, "if_nametoindex", {"wlan0": 7, "wlan0.2": 7}.__getitem__)
    config = session_config(**{"listen": (), "connect": (), "timeout_s": 1.0, end: (given,)})
    assert config[end]["endpoints"] == [for_zenoh] and parse_zenoh_endpoint(given)[1] in given


def test_interface_that_is_absent_is_one_line():
    with pytest.raises(ConfigError, match=r"tcp/\[fe80::1%none0\]:1: no interface 'none0' on this machine; `ip"):
        open_session((), ["tcp/[fe80::1%none0]:1"], 1.0)


def test_free_port_has_no_owner():
    assert port_owner(parse_zenoh_endpoint(free_endpoint())[2]) == ""


def test_missing_answer_raises_in_time():
    endpoint, begin_s = free_endpoint(), time.monotonic()
    said = f"no answer from {endpoint} after 0.4 s; start the robot or router, or check the address"
    with pytest.raises(LinkError, match=re.escape(said)):
        open_zenoh("r1", connect=[endpoint], timeout_s=0.4)
    assert 0.3 < time.monotonic() - begin_s < 2
    with socket.create_server(("127.0.0.1", parse_zenoh_endpoint(endpoint)[2])):
        more = f"{said}. Something listens there, but it is not Zenoh, or has its limit of 64 sessions (1000 at a"
        with pytest.raises(LinkError, match=re.escape(more)):
            open_zenoh("r1", connect=[endpoint], timeout_s=0.4)


def test_a_listener_with_its_limit_of_sessions_rejects_the_next_and_the_error_names_the_limit():
    endpoint = free_endpoint()
    with closing(open_session([endpoint], (), 5.0, max_sessions=2)), ExitStack() as ending:
        for _ in range(2):
            ending.callback(open_session((), [endpoint], 5.0).close)
        with pytest.raises(LinkError, match="has its limit of 64 sessions"):
            open_session((), [endpoint], 0.4)


def test_an_address_of_another_machine_cannot_be_listened_on():
    with pytest.raises(LinkError, match=r"cannot listen on tcp/192\.0\.2\.1:7447: Cannot assign requested address;"):
        open_zenoh("r1", listen=["tcp/192.0.2.1:7447"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"robot": "r/1", "listen": ["tcp/127.0.0.1:7447"]}, "robot id 'r/1'"),
        ({"robot": "*", "connect": ["tcp/127.0.0.1:7447"]}, "robot id '\\*'"),
        ({"robot": "r1"}, "no endpoint"),
        ({"robot": "r1", "listen": ["tcp/127.0.0.1:7447"] * 2}, "7447 is listed twice"),
        ({"robot": "r1", "listen": ["tcp/127.0.0.1:7447"], "max_frame_bytes": 0}, "max_frame_bytes 0"),
    ],
)
def test_bad_arguments_are_rejected_before_anything_is_opened(arguments, said):
    with pytest.raises(ConfigError, match=said):
        open_zenoh(arguments.pop("robot"), **arguments)


def test_zenoh_that_is_not_installed_is_one_line_with_the_fix(monkeypatch):
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(ConfigError, match=re.escape("pip install --editable '.[zenoh]'")):
        open_zenoh("r1", connect=["tcp/127.0.0.1:7447"])


def test_a_smaller_bound_on_frames_holds_at_both_ends():
    endpoint = free_endpoint()
    with open_zenoh("r1", listen=[endpoint]) as robot, open_zenoh("r1", connect=[endpoint], max_frame_bytes=99) as peer:
        frames = peer.latest(FRAME)
        assert until(lambda: robot.has_listener(FRAME))
        robot.publish(FRAME, b"", bytes(100))
        robot.publish(FRAME, b"", bytes(99))
        assert len(frames.take(2).payload) == 99
        assert peer.rejected["OVERSIZE"] == 1


class _Counting:
    """A TCP relay in front of `endpoint` that counts the bytes it passes on towards who connects."""

    def __init__(self, endpoint: str) -> None:
        self.to = parse_zenoh_endpoint(endpoint)[1:]
        self.passed = 0
        self._door = socket.create_server(("127.0.0.1", free_port()))
        self.endpoint = f"tcp/127.0.0.1:{self._door.getsockname()[1]}"
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        near, far = self._door.accept()[0], socket.create_connection(self.to)
        threading.Thread(target=self._pass, args=(near, far, False), daemon=True).start()
        self._pass(far, near, True)

    def _pass(self, source: socket.socket, sink: socket.socket, counted: bool) -> None:
        with suppress(OSError), source, sink:
            while data := source.recv(65_536):
                self.passed += len(data) * counted
                sink.sendall(data)


def test_a_frame_costs_at_most_320_bytes_more_than_its_image():
    endpoint, frames_sent, jpeg = free_endpoint(), 60, bytes(20_000)
    precise = (0.123456789012345, -0.123456789012345)
    header = FrameHeader(
        session="0a1b2c3d", seq=9_999_999, t_us=10**14, pose=(*precise, -3.123456789012345), moving=precise,
        applied=precise, latency_us=399_999,
    )  # fmt: skip
    with open_zenoh("r1", listen=[endpoint]) as robot:
        relay = _Counting(endpoint)
        with open_zenoh("r1", connect=[relay.endpoint]) as peer:
            frames = peer.latest(FRAME)
            assert until(lambda: robot.has_listener(FRAME))
            before, got = relay.passed, 0
            for _ in range(frames_sent):
                robot.publish(FRAME, encode(header), jpeg)
                got += frames.take(1) is not None
            overhead = (relay.passed - before) / frames_sent - len(jpeg)
    assert got == frames_sent
    assert len(encode(header)) < overhead <= 320


def test_delete_is_rejected_as_not_a_put():
    endpoint = free_endpoint()
    with open_zenoh("r1", listen=[endpoint]) as robot, open_session((), [endpoint], 5.0) as stranger:
        twists = robot.latest(TWIST)
        stranger.delete("sightline/r1/twist/vision")
        assert until(lambda: robot.rejected[NOT_A_PUT] == 1)
        assert twists.take() is None


def test_invented_sources_are_forwarded_with_bounded_memory():
    endpoint, heard = free_endpoint(), []
    with open_zenoh("r1", listen=[endpoint]) as robot, open_zenoh("r1", connect=[endpoint]) as peer:
        peer.subscribe(DETECTIONS, lambda message: heard.append(message.source))
        robot.publish(DETECTIONS, b"", b"{}", "vision")
        assert until(lambda: robot.publish(DETECTIONS, b"", b"{}", "vision") and heard)
        heard.clear()
        sources = [f"s{number}" for number in range(5 * MAX_KEPT_PUBLISHERS)]
        for source in (*sources, "detector"):
            assert robot.publish(DETECTIONS, b"", b"{}", source)
        assert until(lambda: set(heard) >= {*sources, "detector"})
        assert len(robot._outlets) == MAX_KEPT_PUBLISHERS + 1


def test_discovery_gives_the_newest_status_of_each_robot():
    endpoint = free_endpoint()
    with open_zenoh("r1", listen=[endpoint]) as first, open_zenoh("r2", connect=[endpoint]) as second:
        assert until(lambda: first.connected and second.connected)
        begin_s = time.monotonic()
        publisher = _Publishing([first, second])
        publisher.start()
        try:
            found = discover([endpoint], 0.6).statuses
        finally:
            publisher.stop()
        assert time.monotonic() - begin_s < 2.5
    assert {robot: message.payload[:2] for robot, message in found.items()} == {"r1": b"r1", "r2": b"r2"}
    assert all(int(message.payload[2:]) > 5 for message in found.values())


def test_discovery_without_an_answer_raises():
    with pytest.raises(LinkError, match="no answer from"):
        discover([free_endpoint()], 0.3)


class _Publishing:
    """Publishes a counted `status` on each link until `stop`."""

    def __init__(self, links) -> None:
        self._links, self._stop = links, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(0.02):
            number += 1
            for link in self._links:
                link.publish(STATUS, b"", f"{link.robot}{number}".encode())


def _count(what: str) -> int:
    return len(list(Path("/proc/self", what).iterdir()))


@pytest.mark.own_process
def test_no_thread_or_descriptor_is_left_behind():
    endpoint = free_endpoint()

    def open_and_close() -> None:
        with open_zenoh("r1", listen=[endpoint]) as robot, open_zenoh("r1", connect=[endpoint]) as peer:
            peer.latest(FRAME)
            assert until(lambda: robot.has_listener(FRAME))

    open_and_close()
    before = _count("fd"), _count("task")
    for _ in range(5):
        open_and_close()
    assert until(lambda: _count("fd") <= before[0] + 2, 3)
    assert until(lambda: _count("task") <= before[1] + 2, 3)


@pytest.mark.own_process
def test_a_close_while_others_publish_is_silent(monkeypatch):
    """A publisher in use cannot be undeclared; this prints no traceback on the terminal."""
    raised, over = [], threading.Event()
    monkeypatch.setattr(threading, "excepthook", lambda args: raised.append(args.exc_value))
    for _ in range(8):
        endpoint = free_endpoint()
        with open_zenoh("r1", listen=[endpoint]) as robot, open_zenoh("r1", connect=[endpoint], role="vision") as peer:
            peer.latest(FRAME)
            over.clear()
            for _ in range(2):
                threading.Thread(target=lambda: _publish_until(robot, over), daemon=True).start()
            time.sleep(0.1)
            robot.close()
            over.set()
    assert raised == []


def _publish_until(link, over):
    while not over.is_set():
        link.publish(FRAME, b"{}", bytes(60_000))


@pytest.mark.parametrize("opened", [partial(open_zenoh, "r1", role="robot"), partial(open_fleet, "r*", role="vision")])
def test_a_closed_link_does_nothing_and_its_session_that_listened_is_never_freed(opened):
    """To free it stops all of Python for 10 s in one of 200 tries on a busy machine: see `session.py`."""
    end = opened(listen=[free_endpoint()])
    links = [end] if isinstance(end, ZenohLink) else [end.link("r1"), end.link("r2")]
    for link in links:
        link.latest(FRAME)
        link.has_listener(TWIST)
    session = end._session
    end.close()
    assert not any(link.publish(STATUS, b"{}", b"{}") or link.has_listener(TWIST) or link.peers() for link in links)
    end.close()
    del end, links, link
    gc.collect()
    assert sys.getrefcount(session) == 3, "this test's, the question's, and one that stays"


def test_a_fleet_forgets_closed_links():
    with open_fleet("r*", listen=[free_endpoint()], role="vision") as fleet:
        open_one = fleet.link("r0")
        for number in range(1, 9):
            fleet.link(f"r{number}").close()
        assert set(fleet._links) == {"r0", "r8"}
        assert not open_one._closed
