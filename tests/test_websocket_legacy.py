"""The older text dialect over real sockets: the write-up's client, and vision against the write-up's robot."""

import base64
import threading
import time
from contextlib import contextmanager, suppress

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.sync.server import serve

from protocol.channels import ACK, CAMERA, FRAME, STATUS, TWIST
from protocol.codec import decode, encode
from protocol.messages import AnswerHeader, FrameHeader
from protocol.refusals import Refusal
from protocol.transports.link import Message
from protocol.transports.link_rules import OVERSIZE
from protocol.transports.websocket import open_websocket
from protocol.transports.websocket_dialects import BAD_FRAMING
from protocol.transports.websocket_endpoints import parse_endpoint
from protocol.transports.websocket_listen import CROSS_SITE
from tests.link_rigs import free_endpoint, until

JPEG = bytes(range(256)) * 40
TEXT = base64.encodebytes(JPEG).decode("ascii")
OLD = {"compression": None, "legacy": True}


def free_legacy() -> str:
    return free_endpoint().replace("tcp/", "ws-legacy://")


def plain(endpoint: str) -> str:
    return endpoint.replace("ws-legacy://", "ws://").partition("?")[0]


def header_of(seq: int) -> FrameHeader:
    return FrameHeader(session="0a1b2c3d", seq=seq, t_us=1000 * seq)


@contextmanager
def robot_and_client(options: str = ""):
    """A robot that listens for the older dialect, and one client that offers no sub-protocol."""
    endpoint = free_legacy() + options
    with open_websocket("r1", listen=endpoint, role="robot") as robot, connect(plain(endpoint), **OLD) as client:
        assert until(lambda: robot.connected)
        yield robot, client


# --- the robot's end -------------------------------------------------------------------------------------------------


def test_a_picture_goes_out_as_base64_lines_and_a_twist_comes_in_as_a_guests():
    with robot_and_client() as (robot, client):
        twists = robot.latest(TWIST)
        assert robot.has_listener(FRAME)
        assert not robot.has_listener(STATUS)
        robot.publish(STATUS, b"", b"{}")  # nothing but pictures goes to such a client
        robot.publish(FRAME, encode(header_of(1)), JPEG)
        text = client.recv(2)
        assert text == base64.encodebytes(JPEG).decode("ascii")
        client.send("2.3028209556706964|0")
        assert twists.take(2) == Message(TWIST, "guest", b"", b"2.3028209556706964|0")


def test_the_text_costs_at_most_1_36_times_the_picture():
    with robot_and_client() as (robot, client):
        robot.publish(FRAME, encode(header_of(1)), bytes(46_000))
        assert len(client.recv(2)) <= 1.36 * 46_000


def test_one_line_and_dashed_twists_are_opt_in():
    with robot_and_client("?oneline&dashed") as (robot, client):
        twists = robot.latest(TWIST)
        robot.publish(FRAME, b"", JPEG)
        assert client.recv(2) == base64.b64encode(JPEG).decode("ascii")
        for sent, got in (("0.2--0.35", b"0.2000|-0.3500"), ("0.2|-0.35", b"0.2|-0.35"), ("left", b"left")):
            client.send(sent)
            assert twists.take(2).payload == got


def test_each_twist_also_acknowledges_the_newest_picture_once():
    with robot_and_client() as (robot, client):
        acks, twists = robot.latest(ACK), robot.latest(TWIST)
        client.send("0|0")  # before any picture: answers nothing
        assert twists.take(2)
        assert acks.take() is None
        for seq in (7, 8):
            robot.publish(FRAME, encode(header_of(seq)), JPEG)
            client.recv(2)
        time.sleep(0.02)
        client.send("0.1|0")
        client.send("0.2|0")
        ack = acks.take(2)
        answer = decode(AnswerHeader, ack.header)
        assert (ack.source, answer.source, answer.session) == ("guest", "guest", "00000000")
        assert (answer.echo.session, answer.echo.seq, answer.echo.t_us) == ("0a1b2c3d", 8, 8000)
        assert answer.compute_us >= 20_000  # all of it, so that none counts as the link's delay
        assert until(lambda: (twist := twists.take()) and twist.payload == b"0.2|0")
        assert acks.take() is None


def test_a_frame_without_a_header_is_answered_by_a_twist_alone():
    with robot_and_client() as (robot, client):
        acks, twists = robot.latest(ACK), robot.latest(TWIST)
        robot.publish(FRAME, b"", JPEG)
        client.recv(2)
        client.send("0|0")
        assert twists.take(2)
        assert acks.take() is None


@pytest.mark.parametrize(
    ("message", "code", "said", "counted"),
    [
        (b"0.1|0", 1003, "binary message; this port speaks text", BAD_FRAMING),
        ("0" * 257, 1009, "", OVERSIZE),
        (bytes(10_000_000), 1009, "", OVERSIZE),
    ],
)
def test_what_is_no_short_text_ends_that_client_only(message, code, said, counted):
    with robot_and_client() as (robot, client), connect(plain(endpoint_of(client)), **OLD) as other:
        twists = robot.latest(TWIST)
        with pytest.raises(ConnectionClosed) as closed:
            client.send(message)
            client.recv(2)
        if closed.value.rcvd is not None:
            assert (closed.value.rcvd.code, closed.value.rcvd.reason[: len(said)]) == (code, said)
        assert until(lambda: robot.refused == {counted: 1})
        other.send("0.3|0")
        assert twists.take(2).payload == b"0.3|0"


def endpoint_of(client) -> str:
    host, port = client.remote_address
    return f"ws://{host}:{port}"


@pytest.mark.parametrize("text", ["nan|inf", "1|2|3", "1_0|2", "stop", "", "\u0661|0", "\0"])
def test_nonsense_reaches_the_robot_that_says_why_it_is_refused(text):
    with robot_and_client() as (robot, client):
        twists = robot.latest(TWIST)
        client.send(text)
        assert twists.take(2) == Message(TWIST, "guest", b"", text.encode())


def test_a_twist_over_64_bytes_is_counted_and_the_client_stays():
    with robot_and_client() as (robot, client):
        twists = robot.latest(TWIST)
        client.send("0" * 65)
        client.send("0|0")
        assert twists.take(2).payload == b"0|0"
        assert robot.refused == {OVERSIZE: 1}


def test_a_client_silent_for_its_first_second_gets_the_newest_picture():
    with robot_and_client() as (robot, client):
        for number in range(30):
            robot.publish(FRAME, b"", b"%02d" % number + JPEG)
            time.sleep(1 / 30)
        got = []
        while not got or got[-1] != b"29":
            got.append(base64.b64decode(client.recv(2))[:2])
        assert got == sorted(got)


def test_another_sites_page_cannot_drive_through_the_older_port():
    endpoint = free_legacy()
    with open_websocket("r1", listen=endpoint) as robot:
        with pytest.raises(InvalidStatus):
            connect(plain(endpoint), origin="http://evil.example", **OLD)
        assert robot.refused == {CROSS_SITE: 1}
        # What `websocket-client` sends by itself is the robot's own site.
        connect(plain(endpoint), origin=plain(endpoint).replace("ws:", "http:"), **OLD).close()


def test_both_dialects_may_be_listened_for_at_once():
    modern, older = free_endpoint().replace("tcp/", "ws://"), free_legacy()
    with open_websocket("r1", listen=[modern, older]) as robot, open_websocket("r1", connect=modern) as peer:
        frames = peer.latest(FRAME)
        with connect(plain(older), **OLD) as client:
            assert until(lambda: len(robot._peers) == 2 and robot.has_listener(FRAME) and peer.connected)
            assert until(lambda: robot.publish(FRAME, b"{}", JPEG) and frames.take(0.05))
            assert base64.b64decode(client.recv(2)) == JPEG


# --- vision's end ----------------------------------------------------------------------------------------------------


class OldRobot:
    """The write-up's robot: sends what it is told to each client, keeps what they say."""

    def __init__(self, endpoint: str) -> None:
        self.said: list[str | bytes] = []
        self.clients = []
        address = parse_endpoint(endpoint)
        self._server = serve(self._handle, address.host, address.port, compression=None)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _handle(self, client) -> None:
        self.clients.append(client)
        try:
            for message in client:
                self.said.append(message)
        except ConnectionClosed as closed:
            self.said.append(f"closed {closed.rcvd.code if closed.rcvd else 0}")
        self.clients.remove(client)

    def send(self, text: str | bytes) -> None:
        for client in list(self.clients):
            client.send(text)

    def close(self) -> None:
        self._server.shutdown()


@contextmanager
def old_robot_and_vision(options: str = ""):
    endpoint = free_legacy() + options
    robot = OldRobot(endpoint)
    try:
        with open_websocket("r1", connect=endpoint, role="vision", max_frame_bytes=20_000) as vision:
            assert until(lambda: robot.clients and vision.connected)
            yield robot, vision
    finally:
        robot.close()


def test_text_becomes_frames_with_a_header_of_their_own_and_twists_become_text():
    with old_robot_and_vision() as (robot, vision):
        frames, headers = vision.latest(FRAME), []
        for number in range(3):
            before_us = time.monotonic_ns() // 1000
            robot.send(base64.encodebytes(JPEG + bytes([number])).decode("ascii"))
            frame = frames.take(2)
            assert frame.payload == JPEG + bytes([number])
            headers.append(decode(FrameHeader, frame.header))
            assert before_us <= headers[-1].t_us <= time.monotonic_ns() // 1000
        assert [header.seq for header in headers] == [1, 2, 3]
        assert len({header.session for header in headers}) == 1
        assert vision.has_listener(TWIST)
        assert not vision.has_listener(ACK)
        vision.publish(ACK, b"{}", b"")
        vision.publish(TWIST, b"{}", b"0.2000|-0.3500")
        assert until(lambda: robot.said == ["0.2000|-0.3500"])
        assert vision.latest(CAMERA).take() is None


def test_dashed_twists_go_out_dashed():
    with old_robot_and_vision("?dashed") as (robot, vision):
        vision.publish(TWIST, b"{}", b"0.2000|-0.3500")
        assert until(lambda: robot.said == ["0.2000--0.3500"])


@pytest.mark.parametrize(
    ("message", "code", "counted"),
    [(JPEG, 1003, BAD_FRAMING), ("A" * 10_000_000, 1009, OVERSIZE)],
)
def test_what_is_no_picture_ends_the_connection_which_comes_back_by_itself(message, code, counted):
    with old_robot_and_vision() as (robot, vision):
        frames = vision.latest(FRAME)
        with suppress(ConnectionClosed):  # 10 MB may break on a socket that is closed already
            robot.send(message)
        assert until(lambda: vision.refused == {counted: 1})
        assert until(lambda: robot.said in ([f"closed {code}"], ["closed 0"]) and robot.clients)
        assert until(lambda: robot.send(TEXT) or frames.take(0.05))


@pytest.mark.parametrize("text", ["no base64", "AAA", "0|0", base64.b64encode(bytes(20_001)).decode("ascii")])
def test_a_text_that_is_no_picture_is_counted_and_skipped(text):
    with old_robot_and_vision() as (robot, vision):
        frames = vision.latest(FRAME)
        robot.send(text)
        robot.send(TEXT)
        assert frames.take(2).payload == JPEG
        assert frames.dropped == 0
        assert vision.refused == {Refusal.MALFORMED: 1}
        assert robot.said == []


def test_a_robot_that_restarts_is_found_again_and_has_a_new_session():
    endpoint = free_legacy()
    robot, sessions = OldRobot(endpoint), set()
    with open_websocket("r1", connect=endpoint, role="vision") as vision:
        frames = vision.latest(FRAME)
        for _ in range(2):
            assert until(lambda: robot.clients and vision.connected)  # noqa: B023
            robot.send(TEXT)
            sessions.add(decode(FrameHeader, frames.take(2).header).session)
            robot.close()
            assert until(lambda: not vision.connected)
            robot = OldRobot(endpoint)
        robot.close()
    assert len(sessions) == 2
