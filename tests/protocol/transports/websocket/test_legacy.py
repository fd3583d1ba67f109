"""The legacy text protocol over real sockets: the legacy client, and the vision service against the legacy robot."""

import base64
import random
import socket
import threading
import time
from contextlib import contextmanager, suppress

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.server import ServerProtocol
from websockets.sync.client import connect
from websockets.sync.server import serve

from sightline.protocol.channels import ACK, CAMERA, DETECTIONS, FRAME, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import AnswerHeader, DetectedBox, Detections, DetectionsHeader, FrameHeader
from sightline.protocol.transports.endpoints import parse_websocket_endpoint
from sightline.protocol.transports.link import OVERSIZE, Message
from sightline.protocol.transports.websocket.framing import BAD_FRAMING, PeerError
from sightline.protocol.transports.websocket.legacy import LegacyCommands, LegacyToRobot
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.server import CROSS_SITE
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import JPEG as SMALL_JPEG
from tests.fixtures.websocket import address_of, received, upgrade

JPEG = bytes(range(256)) * 40
TEXT = base64.encodebytes(JPEG).decode("ascii")
OLD = {"compression": None, "legacy": True}


def plain(endpoint: str) -> str:
    return endpoint.replace("ws-legacy://", "ws://").partition("?")[0]


def header_of(seq: int) -> FrameHeader:
    return FrameHeader(session="0a1b2c3d", seq=seq, t_us=1000 * seq)


@contextmanager
def robot_and_client(options: str = ""):
    """Open a robot that listens for the legacy protocol, and one client that offers no sub-protocol."""
    endpoint = free_endpoint("ws-legacy://") + options
    with open_websocket("r1", listen=endpoint, role="robot") as robot, connect(plain(endpoint), **OLD) as client:
        assert until(lambda: robot.connected)
        yield robot, client


# --- the robot's end -------------------------------------------------------------------------------------------------


def test_an_image_goes_out_as_base64_lines_and_a_twist_comes_in_as_a_guests():
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


@pytest.mark.parametrize("picture_bytes", [12_000, 46_000])
def test_on_the_socket_an_image_costs_at_most_1_36_times_its_bytes(picture_bytes):
    endpoint = free_endpoint("ws-legacy://")
    with open_websocket("r1", listen=endpoint) as robot, socket.create_connection(address_of(endpoint)) as near:
        near.sendall(upgrade("127.0.0.1").replace(b"Sec-WebSocket-Protocol: sightline.v1\r\n", b""))
        assert received(near).startswith(b"HTTP/1.1 101 ")
        got = 0
        for seq in range(5):
            robot.publish(FRAME, encode(header_of(seq)), random.Random(seq).randbytes(picture_bytes))
            got += len(received(near, 0.1))
    assert 1.33 < got / (5 * picture_bytes) <= 1.36


def test_one_line_and_dashed_twists_are_opt_in():
    with robot_and_client("?oneline&dashed") as (robot, client):
        twists = robot.latest(TWIST)
        robot.publish(FRAME, b"", JPEG)
        assert client.recv(2) == base64.b64encode(JPEG).decode("ascii")
        for sent, got in (("0.2--0.35", b"0.2000|-0.3500"), ("0.2|-0.35", b"0.2|-0.35"), ("left", b"left")):
            client.send(sent)
            assert twists.take(2).payload == got


def test_swapped_axes_are_another_option():
    with robot_and_client("?dashed&swapped") as (robot, client):
        twists = robot.latest(TWIST)
        for sent, got in (("0.2--0.35", b"-0.3500|0.2000"), ("-1e-1-+2.5E-1", b"0.2500|-0.1000"), ("1|2", b"1|2")):
            client.send(sent)
            assert twists.take(2).payload == got


def test_boxes_become_guest_detections_of_the_sent_image_and_are_passed_on():
    modern, older = free_endpoint("ws://"), free_endpoint("ws-legacy://") + "?boxes"
    with open_websocket("r1", listen=[modern, older]) as robot, open_websocket("r1", connect=modern) as vision:
        found, passed_on = robot.latest(DETECTIONS), vision.latest(DETECTIONS)
        twists, acks = robot.latest(TWIST), robot.latest(ACK)
        with connect(plain(older), **OLD) as client:
            assert until(lambda: robot.has_listener(FRAME) and robot.has_listener(DETECTIONS))
            for seq in (7, 8):  # which of the two was looked at is not known: the older one
                robot.publish(FRAME, encode(header_of(seq)), SMALL_JPEG)
                client.recv(2)
            client.send("0.25,0.5,0.75,1.0-0,0,1,0.5")
            message = found.take(2)
            assert passed_on.take(2) == message
            assert message.source == "guest"
            header = decode(DetectionsHeader, message.header)
            assert (header.source, header.session, header.echo.seq) == ("guest", "00000000", 7)
            boxes = decode(Detections, message.payload, DETECTIONS.max_payload_bytes)
            corners = [(box.x1_px, box.y1_px, box.x2_px, box.y2_px) for box in boxes.boxes]
            assert (boxes.width_px, boxes.height_px, corners) == (16, 16, [(8, 4, 16, 12), (0, 0, 8, 16)])
            assert decode(AnswerHeader, acks.take(2).header).echo.seq == 8
            client.send("0.1,0,0.2,1")  # an answer to nothing
            assert until(lambda: robot.rejected == {RejectReason.UNKNOWN_FRAME: 1})
            robot.publish(FRAME, encode(header_of(9)), SMALL_JPEG)
            client.recv(2)
            client.send("0.1,0,0.2,7")
            assert until(lambda: robot.rejected[RejectReason.MALFORMED] == 1)
            robot.publish(FRAME, encode(header_of(10)), SMALL_JPEG)
            client.recv(2)
            client.send("")  # looked, and saw nothing
            nothing = found.take(2)
            assert decode(Detections, nothing.payload, DETECTIONS.max_payload_bytes).boxes == ()
            assert decode(DetectionsHeader, nothing.header).echo.seq == 10
            client.send("0.1|0")
            assert twists.take(2).payload == b"0.1|0"


def test_boxes_without_the_option_are_rejected():
    with robot_and_client() as (robot, client):
        twists, found = robot.latest(TWIST), robot.latest(DETECTIONS)
        robot.publish(FRAME, encode(header_of(1)), SMALL_JPEG)
        client.recv(2)
        client.send("0.25,0.5,0.75,1.0")
        assert twists.take(2).payload == b"0.25,0.5,0.75,1.0"  # the robot rejects it and reports why
        assert found.take() is None


def test_each_twist_also_acknowledges_the_newest_image_once():
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
        (b"0.1|0", 1003, "binary message; this port expects text", BAD_FRAMING),
        ("0" * 257, 1009, "", OVERSIZE),
        (bytes(10_000_000), 1009, "", OVERSIZE),
    ],
)
def test_long_or_binary_message_ends_only_its_client(message, code, said, counted):
    with robot_and_client() as (robot, client), connect(plain(endpoint_of(client)), **OLD) as other:
        twists = robot.latest(TWIST)
        with pytest.raises(ConnectionClosed) as closed:
            client.send(message)
            client.recv(2)
        if closed.value.rcvd is not None:
            assert (closed.value.rcvd.code, closed.value.rcvd.reason[: len(said)]) == (code, said)
        assert until(lambda: robot.rejected == {counted: 1})
        other.send("0.3|0")
        assert twists.take(2).payload == b"0.3|0"


def endpoint_of(client) -> str:
    host, port = client.remote_address
    return f"ws://{host}:{port}"


@pytest.mark.parametrize("text", ["nan|inf", "1|2|3", "1_0|2", "stop", "", "\u0661|0", "\0"])
def test_invalid_text_reaches_the_robot_which_reports_the_reason(text):
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
        assert robot.rejected == {OVERSIZE: 1}


def test_a_client_silent_for_its_first_second_gets_the_newest_image():
    with robot_and_client() as (robot, client):
        for number in range(30):
            robot.publish(FRAME, b"", b"%02d" % number + JPEG)
            time.sleep(1 / 30)
        got = []
        while not got or got[-1] != b"29":
            got.append(base64.b64decode(client.recv(2))[:2])
        assert got == sorted(got)


def test_page_of_another_site_cannot_drive_through_the_legacy_port():
    endpoint = free_endpoint("ws-legacy://")
    with open_websocket("r1", listen=endpoint) as robot:
        with pytest.raises(InvalidStatus):
            connect(plain(endpoint), origin="http://evil.example", **OLD)
        assert robot.rejected == {CROSS_SITE: 1}
        # What `websocket-client` sends by itself is the robot's own site.
        connect(plain(endpoint), origin=plain(endpoint).replace("ws:", "http:"), **OLD).close()


def test_both_protocols_are_served_in_parallel():
    modern, older = free_endpoint("ws://"), free_endpoint("ws-legacy://")
    with open_websocket("r1", listen=[modern, older]) as robot, open_websocket("r1", connect=modern) as peer:
        frames = peer.latest(FRAME)
        with connect(plain(older), **OLD) as client:
            assert until(lambda: len(robot._peers) == 2 and robot.has_listener(FRAME) and peer.connected)
            assert until(lambda: robot.publish(FRAME, b"{}", JPEG) and frames.take(0.05))
            assert base64.b64decode(client.recv(2)) == JPEG


# The vision service against a legacy robot, in the legacy text protocol, over real sockets.


class OldRobot:
    """The legacy robot: sends given text to each client, and keeps the received messages."""

    def __init__(self, endpoint: str) -> None:
        self.said: list[str | bytes] = []
        self.clients = []
        address = parse_websocket_endpoint(endpoint)
        self._server = serve(self._handle, address.host, address.port, compression=None)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _handle(self, client) -> None:
        self.clients.append(client)
        end = []
        try:
            for message in client:
                self.said.append(message)
        except ConnectionClosed as closed:
            end = [f"closed {closed.rcvd.code if closed.rcvd else 0}"]
        self.clients.remove(client)  # a test that reads the end sends to the next client
        self.said += end

    def send(self, text: str | bytes) -> None:
        for client in list(self.clients):
            client.send(text)

    def close(self) -> None:
        self._server.shutdown()


@contextmanager
def old_robot_and_vision(options: str = ""):
    endpoint = free_endpoint("ws-legacy://") + options
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
        assert until(lambda: robot.said[:1] == ["0.2000|-0.3500"])
        assert vision.latest(CAMERA).take() is None


@pytest.mark.parametrize(("options", "said"), [("?dashed", "0.2000--0.3500"), ("?dashed&swapped", "-0.3500-0.2000")])
def test_dashed_twists_go_out_dashed(options, said):
    with old_robot_and_vision(options) as (robot, vision):
        vision.publish(TWIST, b"{}", b"0.2000|-0.3500")
        assert until(lambda: robot.said[:1] == [said])


def test_nonnegative_text_has_zero_for_each_negative_number():
    with old_robot_and_vision("?dashed&nonnegative") as (robot, vision):
        for twist, said in ((b"-0.2000|0.3500", "0.0000-0.3500"), (b"0.2000|-0.3500", "0.2000-0.0000")):
            vision.publish(TWIST, b"{}", twist)
            assert until(lambda: robot.said[-1:] == [said])  # noqa: B023


def test_boxes_go_out_in_place_of_twists():
    with old_robot_and_vision("?boxes") as (robot, vision):
        box = DetectedBox(label="ball", score=0.9, x1_px=-4, y1_px=30, x2_px=80, y2_px=60)
        found = Detections(width_px=160, height_px=120, boxes=(box,))
        assert vision.has_listener(DETECTIONS)
        assert not vision.has_listener(TWIST)
        vision.publish(DETECTIONS, b"{}", encode(found))
        assert until(lambda: robot.said[:1] == ["0.2500,0.0000,0.5000,0.5000"])
        assert until(lambda: robot.said[1:] == ["", ""]), "an empty text stops it"


@pytest.mark.parametrize("count", [5, 16, 64])
def test_the_first_16_of_many_boxes_go_out(count):
    boxes = tuple(DetectedBox(label="an empty bottle", score=0.9, x1_px=one, y1_px=30.125, x2_px=80.125, y2_px=60.5)
                  for one in range(count))
    found = Detections(width_px=160, height_px=120, boxes=boxes)
    with old_robot_and_vision("?boxes") as (robot, vision):
        vision.publish(DETECTIONS, b"{}", encode(found))
        assert until(lambda: robot.said and robot.said[0].count("-") == min(count, 16) - 1)


# --- a legacy robot is never left driving ----------------------------------------------------------------------------

ZEROS = [("", "0.0000|0.0000"), ("?dashed", "0.0000-0.0000"), ("?dashed&swapped", "0.0000-0.0000")]


@pytest.mark.parametrize(("options", "zero"), ZEROS)
def test_a_link_that_closes_leaves_two_zeros(options, zero):
    with old_robot_and_vision(options) as (robot, vision):
        vision.publish(TWIST, b"{}", b"0.2000|0.3500")
        assert until(lambda: robot.said)
    assert until(lambda: not robot.clients)
    assert robot.said[1:] == [zero, zero]


def test_a_link_that_closes_at_once_sends_a_command_with_two_zeros_or_not_at_all():
    with old_robot_and_vision() as (robot, vision):
        vision.publish(TWIST, b"{}", b"0.2000|0.3500")
    assert until(lambda: not robot.clients)
    assert robot.said in ([], ["0.2000|0.3500", "0.0000|0.0000", "0.0000|0.0000"])


def test_a_link_that_never_drove_sends_nothing():
    with old_robot_and_vision() as (robot, _):
        time.sleep(0.4)
    assert until(lambda: not robot.clients)
    assert robot.said == []


def test_silence_after_a_motion_brings_two_zeros():
    with old_robot_and_vision() as (robot, vision):
        sent_s = time.monotonic()
        vision.publish(TWIST, b"{}", b"0.2000|-0.3500")
        assert until(lambda: len(robot.said) > 1)
        assert time.monotonic() - sent_s >= 0.3
        assert until(lambda: robot.said[1:] == ["0.0000|0.0000"] * 2)
        time.sleep(0.4)
        assert len(robot.said) == 3


def test_a_robot_whose_connection_was_lost_while_driving_is_stopped_at_the_next():
    with old_robot_and_vision() as (robot, vision):
        vision.publish(TWIST, b"{}", b"0.2000|-0.3500")
        assert until(lambda: robot.said)
        robot.clients[0].socket.shutdown(socket.SHUT_RDWR)
        assert until(lambda: sorted(robot.said[1:]) == ["0.0000|0.0000", "0.0000|0.0000", "closed 0"]), "by two threads"


OPTIONS = {one: parse_websocket_endpoint(f"ws-legacy://robot:9091{one}").legacy
           for one in ("", "?dashed", "?dashed&swapped", "?dashed&nonnegative", "?boxes")}


@pytest.mark.parametrize(("options", "last", "better"), [
    ("", b"0.2000|0.0000", "?dashed"),
    ("?dashed", b"0.2000--0.3500", "?dashed&nonnegative"),
    ("?dashed&swapped", b"-0.3500-0.2000", "?dashed&swapped&nonnegative"),
    ("?dashed", b"0.2000-0.3500", ""),
    ("?dashed&nonnegative", b"0.2000-0.0000", ""),
    ("?boxes", b"", ""),
])
def test_three_connections_that_end_after_a_text_are_reported_with_another_format(options, last, better):
    told = []
    commands = LegacyCommands(f"ws-legacy://robot:9091{options}", OPTIONS[options], told.append)
    for number in range(3):
        assert told == []
        commands.sent(last, number * 1_000_000)
        commands.closed(number * 1_000_000 + 100_000)
    assert told == [
        f"robot at ws-legacy://robot:9091{options} closed 3 connections within 100 ms after '{last.decode()}'; "
        f"use the text format that it reads, probably ws-legacy://robot:9091{better}"
    ]


@pytest.mark.parametrize(("message", "fault"), [
    (JPEG, "its message is binary"),
    (f"data:image/jpeg;base64,{TEXT}", "image text is not base64: "),
    ("hello", "image text is not base64: "),
])
def test_robot_whose_messages_are_not_images_is_reported_once_until_an_image_comes(message, fault):
    told = []
    commands = LegacyCommands("ws-legacy://robot:9091", OPTIONS[""], told.append)
    for count in (1, 2):
        for _ in range(3):  # each connection has a codec of its own
            codec = LegacyToRobot("r1", commands, lambda: 1, "0a1b2c3d", 100_000)
            with pytest.raises((WireError, PeerError)):
                codec.read(message)
        assert len(told) == count
        assert told[-1].startswith(f"robot at ws-legacy://robot:9091: {fault}")
        assert told[-1].endswith("; it must send each image as base64 text and nothing else")
        codec.read("/9j/")


def test_a_later_end_of_a_connection_is_not_blamed_on_the_text():
    told = []
    commands = LegacyCommands("ws-legacy://robot:9091", OPTIONS[""], told.append)
    for number in range(9):
        commands.sent(b"0.2000|0.0000", number * 1_000_000)
        commands.closed(number * 1_000_000 + (100_001 if number % 3 == 2 else 0))
    assert told == []


@pytest.mark.parametrize(
    ("message", "code", "counted"),
    [(JPEG, 1003, BAD_FRAMING), ("A" * 10_000_000, 1009, OVERSIZE)],
)
def test_invalid_image_ends_the_connection_which_recovers(message, code, counted):
    with old_robot_and_vision() as (robot, vision):
        frames = vision.latest(FRAME)
        with suppress(ConnectionClosed):  # 10 MB may break on a socket that is closed already
            robot.send(message)
        assert until(lambda: vision.rejected == {counted: 1})
        assert until(lambda: robot.said in ([f"closed {code}"], ["closed 0"]) and robot.clients)
        assert until(lambda: robot.send(TEXT) or frames.take(0.05))


def test_robot_whose_images_are_too_large_is_reported_once(caplog):
    """Before, the vision service only reported that no frames come."""
    with old_robot_and_vision() as (robot, vision):
        for count in (1, 2):
            (client,) = robot.clients
            with suppress(ConnectionClosed):
                robot.send("A" * 10_000_000)
            assert until(lambda expected=count: vision.rejected == {OVERSIZE: expected})
            assert until(lambda closed=client: robot.clients and closed not in robot.clients)
        lines = [one.getMessage() for one in caplog.records]
    assert len(lines) == 1 and "a message is too large: " in lines[0]
    assert lines[0].startswith("robot at ws-legacy://") and lines[0].endswith("or raise max_frame_bytes")


def test_a_robot_may_send_an_image_with_its_answer_to_the_handshake():
    endpoint, connections, images = free_endpoint("ws-legacy://"), [], []

    def answer(server):
        with suppress(OSError):
            while True:
                connections.append(server.accept()[0])
                protocol = ServerProtocol()
                while not (requests := protocol.events_received()):
                    protocol.receive_data(connections[-1].recv(4096))
                protocol.send_response(protocol.accept(requests[0]))
                protocol.send_text(TEXT.encode())
                answered = b"".join(protocol.data_to_send())
                images.append(answered[answered.index(b"\r\n\r\n") + 4:])
                connections[-1].sendall(answered)

    with socket.create_server(("127.0.0.1", parse_websocket_endpoint(endpoint).port)) as server:
        threading.Thread(target=answer, args=(server,), daemon=True).start()
        with open_websocket("r1", connect=endpoint, role="vision", max_frame_bytes=20_000) as vision:
            frames = vision.latest(FRAME)
            assert until(lambda: connections[0].sendall(images[0]) or frames.take(0.05))
            assert vision.rejected == {} and len(connections) == 1
            connections[0].close()


@pytest.mark.parametrize("text", ["no base64", "AAA", "0|0", base64.b64encode(bytes(20_001)).decode("ascii")])
def test_a_text_that_is_not_an_image_is_counted_and_skipped(text):
    with old_robot_and_vision() as (robot, vision):
        frames = vision.latest(FRAME)
        robot.send(text)
        robot.send(TEXT)
        assert frames.take(2).payload == JPEG
        assert frames.dropped == 0
        assert vision.rejected == {RejectReason.MALFORMED: 1}
        assert robot.said == []


def test_a_robot_that_restarts_is_found_again_and_has_a_new_session():
    endpoint = free_endpoint("ws-legacy://")
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
