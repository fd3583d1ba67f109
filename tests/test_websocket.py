"""`sightline.v1` over real sockets: every bad peer is counted, told why and dropped; the others notice nothing."""

import gc
import json
import os
import re
import socket
import statistics
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from protocol.channels import ACK, FRAME, REPLY, REQUEST, SCAN, STATUS, TWIST
from protocol.codec import encode
from protocol.errors import ConfigError, LinkError
from protocol.messages import FrameHeader
from protocol.transports.link import Message
from protocol.transports.link_rules import OVERSIZE
from protocol.transports.websocket import open_websocket
from protocol.transports.websocket_dialects import BAD_FRAMING, BAD_HELLO, OTHER_ROBOT
from protocol.transports.websocket_endpoints import host_problem, origin_problem, parse_endpoint
from protocol.transports.websocket_listen import (
    CROSS_SITE,
    MAX_CLIENTS,
    MAX_HANDSHAKES,
    TOO_MANY_CLIENTS,
    WRONG_SUBPROTOCOL,
)
from protocol.transports.websocket_peer import SILENT, Outbox
from tests.link_rigs import claim, free_endpoint, hail, until

V1 = {"subprotocols": ["sightline.v1"], "compression": None, "legacy": True}
TWIST_KEY = "sightline/r1/twist/vision"


def free_ws(scheme: str = "ws") -> str:
    return free_endpoint().replace("tcp/", f"{scheme}://")


class Robot:
    """A listening robot that hears twists, with a healthy peer beside whoever misbehaves."""

    def __init__(self) -> None:
        self.endpoint = free_ws()
        self.address = parse_endpoint(self.endpoint).host, parse_endpoint(self.endpoint).port
        self.link = open_websocket("r1", listen=self.endpoint)
        self.twists = self.link.latest(TWIST)
        self.peer = open_websocket("r1", connect=self.endpoint, role="vision")
        self.frames = self.peer.latest(FRAME)
        assert until(lambda: self.link.has_listener(FRAME) and self.peer.has_listener(TWIST))

    @property
    def refused(self):
        return self.link.refused

    def still_serves(self) -> None:
        """The healthy peer hears and is heard, on the connection that it had."""
        self.frames.take()
        assert self.link.publish(FRAME, b"{}", b"still here")
        assert self.frames.take(2).payload == b"still here"
        assert self.peer.publish(TWIST, b"", b"0.5|0")
        assert until(lambda: (got := self.twists.take()) and got.payload == b"0.5|0")
        assert not self.link.callback_errors

    def close(self) -> None:
        self.peer.close()
        self.link.close()


@pytest.fixture
def robot():
    robot = Robot()
    yield robot
    robot.close()


def closed_with(connection) -> tuple[int, str]:
    """Read until the other end closes; its code and reason."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            connection.recv(5)
    return closed.value.rcvd.code, closed.value.rcvd.reason


# --- opening ---------------------------------------------------------------------------------------------------------

NO_ENDPOINTS = (
    "", "foo", "ws", "ws://", "ws://127.0.0.1", "ws://:9090", "ws://127.0.0.1:0", "ws://127.0.0.1:65536", "wss://h:1",
    "ws://127.0.0.1:-1", "ws://127.0.0.1:9090 ", "http://127.0.0.1:9090", "WS://127.0.0.1:9090", "ws://a b:9090",
    "ws://127.0.0.1:9090/x", "127.0.0.1:9090", "ws://::1:9090", "ws://127.0.0.1:٧", "ws://me@h:1", "tcp/127.0.0.1:7447",
    "ws://h:1?dashed", "ws-legacy://h:1?loud",
)  # fmt: skip


@pytest.mark.parametrize("endpoint", NO_ENDPOINTS)
@pytest.mark.parametrize("end", ["listen", "connect"])
def test_an_endpoint_that_is_none_is_refused_with_the_right_form(endpoint, end):
    with pytest.raises(ConfigError, match=re.escape("e.g. ws://127.0.0.1:9090")) as refusal:
        open_websocket("r1", **{end: [endpoint]})
    assert repr(endpoint) in str(refusal.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"robot": "r/1", "listen": "ws://127.0.0.1:9090"}, "robot id 'r/1'"),
        ({"robot": "r1"}, "no endpoint"),
        ({"robot": "r1", "listen": "ws://127.0.0.1:9090", "max_frame_bytes": 0}, "max_frame_bytes 0"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_opened(arguments, said):
    with pytest.raises(ConfigError, match=said):
        open_websocket(arguments.pop("robot"), **arguments)


def test_websockets_that_is_not_installed_is_one_line_with_the_fix(monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(ConfigError, match=re.escape("pip install 'sightline[websocket]'")):
        open_websocket("r1", connect="ws://127.0.0.1:9090")


def test_nobody_answering_is_said_in_time():
    endpoint, begin_s = free_ws(), time.monotonic()
    said = f"nobody answers at {endpoint}; is the robot running? tried for 0.4 s"
    with pytest.raises(LinkError, match=re.escape(said)):
        open_websocket("r1", connect=endpoint, timeout_s=0.4)
    assert 0.3 < time.monotonic() - begin_s < 2


def test_an_address_of_another_machine_cannot_be_listened_on():
    with pytest.raises(LinkError, match=r"cannot listen on ws://192\.0\.2\.1:9090: Cannot assign requested address;"):
        open_websocket("r1", listen="ws://192.0.2.1:9090")


def test_a_port_in_use_is_said_with_who_has_it(robot):
    said = rf"cannot listen on {robot.endpoint}: port \d+ is in use by .*\(pid {os.getpid()}\); end it or choose"
    with pytest.raises(LinkError, match=said):
        open_websocket("r1", listen=robot.endpoint)


def test_who_answers_but_is_no_websocket_is_said():
    with socket.create_server(("127.0.0.1", 0)) as door:
        threading.Thread(target=_answer_with, args=(door, b"SSH-2.0-something\r\n"), daemon=True).start()
        with pytest.raises(LinkError, match="refused: what answers there is no Sightline WebSocket"):
            open_websocket("r1", connect=f"ws://127.0.0.1:{door.getsockname()[1]}", timeout_s=2)


def _answer_with(door: socket.socket, text: bytes) -> None:
    client = door.accept()[0]
    client.recv(4096)
    client.sendall(text)
    client.close()


def test_another_robots_listener_is_an_error_for_who_opens(robot):
    with pytest.raises(LinkError, match=f"{robot.endpoint} refused: this is robot r1, not r2"):
        open_websocket("r2", connect=robot.endpoint)
    assert robot.refused == {OTHER_ROBOT: 1}
    robot.still_serves()


def test_a_robot_may_connect_to_a_listening_vision():
    endpoint = free_ws()
    with open_websocket("r1", listen=endpoint, role="vision") as vision:
        frames = vision.latest(FRAME)
        with open_websocket("r1", connect=endpoint, role="robot") as robot:
            twists = robot.latest(TWIST)
            assert until(lambda: robot.has_listener(FRAME) and vision.has_listener(TWIST))
            for size in (0, 65_536, FRAME.max_payload_bytes):
                assert robot.publish(FRAME, b"{}", bytes(size))
                assert len(frames.take(2).payload) == size
            assert vision.publish(TWIST, b"{}", b"0|0")
            assert twists.take(2) == Message(TWIST, "vision", b"{}", b"0|0")


# --- strangers at the door -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offer", [None, ["sightline.v2"], ["chat", "graphql-ws"]])
def test_without_the_sub_protocol_nobody_comes_in(robot, offer):
    with pytest.raises(InvalidStatus) as refusal:
        connect(robot.endpoint, subprotocols=offer, legacy=True)
    assert refusal.value.response.status_code == 400
    assert b"offer the sub-protocol sightline.v1" in refusal.value.response.body
    assert robot.refused == {WRONG_SUBPROTOCOL: 1}
    robot.still_serves()


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1", "file://"])
def test_a_page_of_another_site_does_not_come_in(robot, origin):
    with pytest.raises(InvalidStatus) as refusal:
        connect(robot.endpoint, origin=origin, **V1)
    assert refusal.value.response.status_code == 403
    assert b"is another site than Host" in refusal.value.response.body
    assert robot.refused == {CROSS_SITE: 1}
    robot.still_serves()


def test_a_page_of_the_robots_own_address_comes_in(robot):
    hailed = connect(robot.endpoint, origin=robot.endpoint.replace("ws://", "http://"), **V1)
    hailed.close()
    assert robot.refused == {}


def test_a_foreign_name_that_points_here_does_not_come_in(robot):
    with socket.create_connection(robot.address) as near:
        near.sendall(_upgrade("evil.example:9090", "Origin: http://evil.example:9090\r\n"))
        answer = near.recv(4096)
    assert answer.startswith(b"HTTP/1.1 403 ")
    assert b"connect by its address or .local name" in answer
    assert robot.refused == {CROSS_SITE: 1}


def _upgrade(host: str, more: str = "") -> bytes:
    return (
        f"GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: sightline.v1\r\n{more}\r\n"
    ).encode("ascii")


@pytest.mark.parametrize("host", ["127.0.0.1:9090", "[::1]:9090", "10.0.0.7", "robot:9090", "Robot.local", "r.example"])
def test_names_that_no_foreign_site_can_own_are_hosts(host):
    assert host_problem([host], "R.example") == ""
    assert origin_problem([f"http://{host}"], host) == ""
    assert origin_problem([f"http://{host}x"], host)


@pytest.mark.parametrize("hosts", [[], ["a", "b"], ["evil.example"], ["127.0.0.1.evil.example:1"], ["a.local.example"]])
def test_other_hosts_are_a_problem(hosts):
    assert host_problem(hosts, "127.0.0.1")


def test_more_clients_than_the_limit_are_sent_away(robot):
    guests = [hail(robot.endpoint) for _ in range(MAX_CLIENTS - 1)]  # one place is the healthy peer's
    with pytest.raises(InvalidStatus) as refusal:
        connect(robot.endpoint, **V1)
    assert refusal.value.response.status_code == 503
    assert b"16 clients are connected" in refusal.value.response.body
    assert robot.refused == {TOO_MANY_CLIENTS: 1}
    robot.still_serves()
    guests.pop().close()
    assert until(lambda: _comes_in(robot))
    for guest in guests:
        guest.close()


def _comes_in(robot: Robot) -> bool:
    try:
        hail(robot.endpoint).close()
    except (InvalidHandshake, ConnectionClosed, OSError):  # no place yet
        return False
    return True


def test_connections_that_say_nothing_are_few_and_short_lived(robot):
    silent = [socket.create_connection(robot.address) for _ in range(MAX_CLIENTS + MAX_HANDSHAKES + 8)]
    robot.still_serves()
    assert until(lambda: robot.refused[TOO_MANY_CLIENTS] >= 8)
    silent[-1].settimeout(3)
    assert silent[-1].recv(1) == b""  # unheard, at once
    silent[0].settimeout(3)
    assert silent[0].recv(1) == b""  # after the two seconds of a handshake
    assert until(lambda: _comes_in(robot), 3)
    for connection in silent:
        connection.close()


def test_half_a_request_is_not_waited_for(robot):
    with socket.create_connection(robot.address) as near:
        near.sendall(_upgrade("127.0.0.1")[:60])
        near.settimeout(3)
        begin_s = time.monotonic()
        assert near.recv(1) == b""
        assert 1.5 < time.monotonic() - begin_s < 2.7
    robot.still_serves()


# --- hello -----------------------------------------------------------------------------------------------------------


def test_who_says_no_hello_is_sent_away_and_told_why(robot):
    stranger, begin_s = connect(robot.endpoint, **V1), time.monotonic()
    assert closed_with(stranger) == (1008, "no hello within 2 s")
    assert 1.5 < time.monotonic() - begin_s < 3
    assert robot.refused == {BAD_HELLO: 1}


HELLO = {"robot": "r1", "session": "0000beef"}
BAD_HELLOS = (
    (b"\0\2{}", 1003, "the first message must be a hello, as text", BAD_HELLO),
    ("0.1|0", 1008, "this text is no hello: Hello", BAD_HELLO),
    (json.dumps(HELLO | {"v": 2}), 1008, "this text is no hello: Hello is of version 2; this peer speaks 1", BAD_HELLO),
    (json.dumps(HELLO | {"session": "x"}), 1008, "this text is no hello: Hello.session", BAD_HELLO),
    (json.dumps(HELLO | {"robot": "r2"}), 1008, "this is robot r1, not r2", OTHER_ROBOT),
    ("x" * 1025, 1009, "", OVERSIZE),
)


@pytest.mark.parametrize(("first", "code", "reason", "counted"), BAD_HELLOS)
def test_a_bad_hello_is_refused_with_a_reason(robot, first, code, reason, counted):
    stranger = connect(robot.endpoint, **V1)
    stranger.send(first)
    got = closed_with(stranger)
    assert (got[0], got[1][: len(reason)]) == (code, reason)
    assert until(lambda: robot.refused == {counted: 1})
    robot.still_serves()


def test_a_hello_is_answered_with_who_listens_and_what_it_wants(robot):
    connection = connect(robot.endpoint, **V1)
    connection.send(json.dumps(HELLO))
    answer = json.loads(connection.recv(2))
    assert (answer["v"], answer["robot"], answer["role"], answer["wants"]) == (1, "r1", "", ["twist"])
    assert re.fullmatch("[0-9a-f]{8}", answer["session"])
    robot.link.latest(ACK)
    assert json.loads(connection.recv(2))["wants"] == ["twist", "ack"]
    connection.close()


def test_a_later_hello_changes_what_a_peer_wants(robot):
    viewer = hail(robot.endpoint, wants=["scan"])
    assert until(lambda: robot.link.has_listener(SCAN))
    viewer.send(json.dumps(HELLO | {"wants": ["status", "smell"]}))
    assert until(lambda: robot.link.has_listener(STATUS) and not robot.link.has_listener(SCAN))
    robot.link.publish(SCAN, b"{}", b"")
    robot.link.publish(STATUS, b'{"v":1}', b"{}")
    message = viewer.recv(2)
    size = int.from_bytes(message[:2])
    assert json.loads(message[2 : 2 + size]) == {"channel": "status", "v": 1}
    assert message[2 + size :] == b"{}"
    viewer.close()


# --- messages --------------------------------------------------------------------------------------------------------

BAD_MESSAGES = (
    ("0.1|0", 1008, "this text is no hello", BAD_HELLO),
    (json.dumps(HELLO | {"robot": "r2"}), 1008, "this is robot r1, not r2", OTHER_ROBOT),
    (b"", 1007, "header block of 0 bytes", BAD_FRAMING),
    (b"\xff\xff{}", 1007, "header block of 65535 bytes in a message of 4", BAD_FRAMING),
    (b"\0\2{}", 1007, "the header block is no JSON object that names its channel", BAD_FRAMING),
    (bytes(10_000_000), 1009, "", OVERSIZE),
    (claim(TWIST_KEY, b"", bytes(2000)), 1009, "", OVERSIZE),
)


@pytest.mark.parametrize(("message", "code", "reason", "counted"), BAD_MESSAGES, ids=range(len(BAD_MESSAGES)))
def test_a_bad_message_ends_its_own_connection_only(robot, message, code, reason, counted):
    stranger = hail(robot.endpoint)
    with pytest.raises(ConnectionClosed) as closed:
        stranger.send(message)
        while True:
            stranger.recv(5)
    if closed.value.rcvd is not None:  # 10 MB may break on a socket that is closed already
        assert (closed.value.rcvd.code, closed.value.rcvd.reason[: len(reason)]) == (code, reason)
    assert until(lambda: robot.refused == {counted: 1})
    robot.still_serves()


def test_a_twist_somewhat_too_long_is_counted_and_the_peer_stays(robot):
    stranger = hail(robot.endpoint)
    stranger.send(claim(TWIST_KEY, b"", bytes(TWIST.max_payload_bytes + 1)))
    assert until(lambda: robot.refused == {OVERSIZE: 1})
    stranger.send(claim(TWIST_KEY, b"{}", b"0|0"))
    assert robot.twists.take(2) == Message(TWIST, "vision", b"{}", b"0|0")
    stranger.close()


def test_a_connection_that_breaks_off_is_forgotten(robot):
    stranger = hail(robot.endpoint, wants=["status"])
    assert until(lambda: robot.link.has_listener(STATUS))
    stranger.socket.shutdown(socket.SHUT_RDWR)
    assert until(lambda: not robot.link.has_listener(STATUS), 1)
    robot.still_serves()


def test_a_frame_over_a_smaller_bound_is_counted_and_the_peer_stays(robot):
    with open_websocket("r1", connect=robot.endpoint, max_frame_bytes=999) as peer:
        frames = peer.latest(FRAME)
        assert until(lambda: len(robot.link._peers) == 2 and all(each.hears(FRAME) for each in robot.link._peers))
        robot.link.publish(FRAME, b"", bytes(1000))
        assert until(lambda: peer.refused == {OVERSIZE: 1})
        robot.link.publish(FRAME, b"", bytes(999))
        assert len(frames.take(2).payload) == 999


# --- who reads slowly or never ---------------------------------------------------------------------------------------


@contextmanager
def never_reads(endpoint: str, **hello: object):
    """A client whose application takes nothing: its library stops reading, and so leaves pings unanswered."""
    near = socket.socket()
    near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    near.connect((parse_endpoint(endpoint).host, parse_endpoint(endpoint).port))
    connection = connect(endpoint, sock=near, max_queue=1, ping_interval=None, close_timeout=0.1, **V1)
    connection.send(json.dumps(HELLO | hello))
    yield connection
    connection.close()


def test_who_never_reads_delays_nobody_costs_little_is_heard_and_is_sent_away(robot):
    took_s, heard, before_kib = [], 0, _resident_kib()
    with never_reads(robot.endpoint, wants=["frame"], role="teleop") as stalled:
        assert until(lambda: len(robot.link._peers) == 2)
        for number in range(40):  # 1.3 s, before its ping is missed
            begin_s = time.monotonic()
            robot.link.publish(FRAME, b"{}", b"%d " % number + bytes(200_000))
            assert robot.frames.take(1).payload.startswith(b"%d " % number)
            took_s.append(time.monotonic() - begin_s)
            stalled.send(claim("sightline/r1/twist/teleop", b"", b"0|%d" % number))
            heard += robot.twists.take(0.5).payload == b"0|%d" % number
            time.sleep(max(0.0, 1 / 30 - (time.monotonic() - begin_s)))
        assert heard == 40
        assert robot.link.dropped["frame"] >= 25
        assert until(lambda: robot.refused == {SILENT: 1}, 4)
    assert statistics.median(took_s) < 0.02
    assert _resident_kib() - before_kib < 5_000
    robot.still_serves()


def _resident_kib() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4


def test_an_end_that_stands_still_is_noticed_within_three_seconds():
    endpoint = free_ws()
    with open_websocket("r1", listen=endpoint) as robot:
        with socket.create_connection((parse_endpoint(endpoint).host, parse_endpoint(endpoint).port)) as near:
            near.sendall(_upgrade("127.0.0.1"))
            hello = json.dumps(HELLO | {"wants": ["status"]}).encode()
            near.sendall(bytes([0x81, 0x80 | len(hello)]) + bytes(4) + hello)
            assert until(lambda: robot.has_listener(STATUS))
            begin_s = time.monotonic()
            assert until(lambda: not robot.connected)
            assert 1.5 < time.monotonic() - begin_s < 3.5
        assert robot.refused == {SILENT: 1}


def test_an_outbox_gives_the_newest_and_the_most_urgent_first():
    outbox = Outbox()
    for number in b"123":
        for channel, source in ((SCAN, ""), (FRAME, ""), (REPLY, ""), (REQUEST, "teleop"), (REQUEST, "console")):
            outbox.put(Message(channel, source, b"", bytes([number])))
    outbox.put_hello("hello")
    taken = [outbox.take() for _ in range(6)]
    assert taken == ["hello"] + [
        Message(channel, source, b"", b"3")
        for channel, source in ((REQUEST, "teleop"), (REQUEST, "console"), (REPLY, ""), (FRAME, ""), (SCAN, ""))
    ]
    assert outbox.take() is None
    assert not outbox.wait(0)
    assert +outbox.dropped == {"scan": 2, "frame": 2, "reply": 2, "request": 4}


# --- cost ------------------------------------------------------------------------------------------------------------


def test_a_frame_costs_at_most_320_bytes_more_than_its_picture(robot):
    precise, jpeg = (0.123456789012345, -0.123456789012345), bytes(46_000)
    header = FrameHeader(
        session="0a1b2c3d", seq=9_999_999, t_us=10**14, pose=(*precise, -3.123456789012345), moving=precise,
        applied=precise, latency_us=399_999,
    )  # fmt: skip
    with socket.create_connection(robot.address) as near:
        near.sendall(_upgrade("127.0.0.1"))
        hello = json.dumps(HELLO | {"wants": ["frame"]}).encode()
        near.sendall(bytes([0x81, 0x80 | len(hello)]) + bytes(4) + hello)
        near.settimeout(0.3)
        assert b"sightline.v1" in _received(near)
        robot.link.publish(FRAME, encode(header), jpeg)
        overhead = len(_received(near)) - len(jpeg)
    assert len(encode(header)) < overhead <= 320


def _received(near: socket.socket) -> bytes:
    got = b""
    try:
        while piece := near.recv(65_536):
            got += piece
    except TimeoutError:
        pass
    return got


def _count(what: str) -> int:
    return len(list(Path("/proc/self", what).iterdir()))


def test_no_thread_or_descriptor_is_left_behind():
    endpoint = free_ws()

    def open_and_close() -> None:
        with open_websocket("r1", listen=endpoint) as robot, open_websocket("r1", connect=endpoint) as peer:
            peer.latest(FRAME)
            assert until(lambda: robot.has_listener(FRAME))

    open_and_close()
    gc.collect()
    before = _count("fd"), _count("task")
    for _ in range(5):
        open_and_close()
    # websockets leaves the selector of a closed server to the garbage collector.
    assert until(lambda: gc.collect() >= 0 and _count("fd") <= before[0], 3)
    assert until(lambda: _count("task") <= before[1], 3)
