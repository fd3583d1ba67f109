"""Vision against an older robot, in its own text dialect, over real sockets."""

import base64
import threading
import time
from contextlib import contextmanager, suppress

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

from sightline.protocol.channels import ACK, CAMERA, FRAME, TWIST
from sightline.protocol.codec import decode
from sightline.protocol.messages import FrameHeader
from sightline.protocol.errors import RejectReason
from sightline.protocol.transports.link import OVERSIZE
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.framing import BAD_FRAMING
from sightline.protocol.transports.endpoints import parse_websocket_endpoint
from tests.fixtures.links import until
from tests.protocol.transports.websocket.test_legacy import JPEG, TEXT, free_legacy


class OldRobot:
    """The write-up's robot: sends what it is told to each client, keeps what they say."""

    def __init__(self, endpoint: str) -> None:
        self.said: list[str | bytes] = []
        self.clients = []
        address = parse_websocket_endpoint(endpoint)
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


@pytest.mark.parametrize(("options", "said"), [("?dashed", "0.2000--0.3500"), ("?dashed&swapped", "-0.3500-0.2000")])
def test_dashed_twists_go_out_dashed(options, said):
    with old_robot_and_vision(options) as (robot, vision):
        vision.publish(TWIST, b"{}", b"0.2000|-0.3500")
        assert until(lambda: robot.said == [said])


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
        assert vision.refused == {RejectReason.MALFORMED: 1}
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
