"""`sightline.v1` after the handshake: each bad hello or message is counted, rejected with the reason and dropped."""

import json
import re
import socket
import time

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from sightline.protocol.channels import ACK, FRAME, SCAN, STATUS, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.messages import FrameHeader
from sightline.protocol.transports.link import OVERSIZE, Message
from sightline.protocol.transports.websocket.framing import BAD_FRAMING, BAD_HELLO, OTHER_ROBOT
from sightline.protocol.transports.websocket.link import open_websocket
from tests.fixtures.links import claim, hail, until
from tests.fixtures.websocket import HELLO, TWIST_KEY, V1, bare_client, closed_with, received


def test_client_without_a_hello_is_closed_with_the_reason(robot):
    stranger, begin_s = connect(robot.endpoint, **V1), time.monotonic()
    assert closed_with(stranger) == (1008, "no hello within 2 s")
    assert 1.5 < time.monotonic() - begin_s < 3
    assert robot.rejected == {BAD_HELLO: 1}


BAD_HELLOS = (
    (b"\0\2{}", 1003, "the first message must be a hello, as text", BAD_HELLO),
    ("0.1|0", 1008, "invalid hello: Hello", BAD_HELLO),
    (json.dumps(HELLO | {"v": 2}), 1008, "invalid hello: Hello has version 2; this peer uses 1", BAD_HELLO),
    (json.dumps(HELLO | {"session": "x"}), 1008, "invalid hello: Hello.session", BAD_HELLO),
    (json.dumps(HELLO | {"robot": "r2"}), 1008, "this is robot r1, not r2", OTHER_ROBOT),
    ("x" * 1025, 1009, "", OVERSIZE),
)


@pytest.mark.parametrize(("first", "code", "reason", "counted"), BAD_HELLOS)
def test_a_bad_hello_is_rejected_with_a_reason(robot, first, code, reason, counted):
    stranger = connect(robot.endpoint, **V1)
    stranger.send(first)
    got = closed_with(stranger)
    assert (got[0], got[1][: len(reason)]) == (code, reason)
    assert until(lambda: robot.rejected == {counted: 1})
    robot.still_serves()


def test_hello_is_answered_with_robot_and_wanted_channels(robot):
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


BAD_MESSAGES = (
    ("0.1|0", 1008, "invalid hello", BAD_HELLO),
    (json.dumps(HELLO | {"robot": "r2"}), 1008, "this is robot r1, not r2", OTHER_ROBOT),
    (b"", 1007, "header block of 0 bytes", BAD_FRAMING),
    (b"\xff\xff{}", 1007, "header block of 65535 bytes in a message of 4", BAD_FRAMING),
    (b"\0\2{}", 1007, "the header block is not a JSON object with a channel", BAD_FRAMING),
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
    assert until(lambda: robot.rejected == {counted: 1})
    robot.still_serves()


def test_a_twist_somewhat_too_long_is_counted_and_the_peer_stays(robot):
    stranger = hail(robot.endpoint)
    stranger.send(claim(TWIST_KEY, b"", bytes(TWIST.max_payload_bytes + 1)))
    assert until(lambda: robot.rejected == {OVERSIZE: 1})
    stranger.send(claim(TWIST_KEY, b"{}", b"0|0"))
    assert robot.twists.take(2) == Message(TWIST, "vision", b"{}", b"0|0")
    stranger.close()


def test_broken_connection_is_removed(robot):
    stranger = hail(robot.endpoint, wants=["status"])
    assert until(lambda: robot.link.has_listener(STATUS))
    stranger.socket.shutdown(socket.SHUT_RDWR)
    assert until(lambda: not robot.link.has_listener(STATUS), 1)
    robot.still_serves()


def test_a_frame_over_a_smaller_bound_is_counted_and_the_peer_stays(robot):
    with open_websocket("r1", connect=robot.endpoint, max_frame_bytes=999) as peer:
        frames = peer.latest(FRAME)
        peers = lambda: robot.link._peers  # noqa: E731
        assert until(lambda: len(peers()) == 2 and all(each.subscribes_to(FRAME) for each in peers()))
        robot.link.publish(FRAME, b"", bytes(1000))
        assert until(lambda: peer.rejected == {OVERSIZE: 1})
        robot.link.publish(FRAME, b"", bytes(999))
        assert len(frames.take(2).payload) == 999


def test_a_frame_costs_at_most_320_bytes_more_than_its_image(robot):
    precise, jpeg = (0.123456789012345, -0.123456789012345), bytes(46_000)
    header = FrameHeader(
        session="0a1b2c3d", seq=9_999_999, t_us=10**14, pose=(*precise, -3.123456789012345), moving=precise,
        applied=precise, latency_us=399_999,
    )  # fmt: skip
    with bare_client(robot.endpoint, wants=["frame"]) as near:
        assert b'"robot":"r1"' in received(near)  # its hello
        robot.link.publish(FRAME, encode(header), jpeg)
        overhead = len(received(near)) - len(jpeg)
    assert len(encode(header)) < overhead <= 320
