"""Slow readers stay, clients that never read cost little, and missing clients are noticed: over real sockets."""

import statistics
import threading
import time
from contextlib import suppress

import pytest

from sightline.protocol.channels import FRAME, STATUS
from sightline.protocol.transports.link import OVERSIZE
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.peer import SILENT
from tests.fixtures.links import claim, until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.websocket import bare_client, never_reads, pause_until, resident_kib

pytestmark = pytest.mark.waits

FPS = 30


@pytest.mark.own_process
def test_client_that_never_reads_delays_no_peer_and_can_still_send(robot):
    took_s, heard, before_kib = [], 0, resident_kib()
    with never_reads(robot.endpoint, wants=["frame"], role="teleop") as stalled:
        assert until(lambda: len(robot.link._peers) == 2)
        for number in range(5 * FPS):
            begin_s = time.monotonic()
            robot.link.publish(FRAME, b"{}", b"%d " % number + bytes(200_000))
            assert robot.frames.take(1).payload.startswith(b"%d " % number)
            took_s.append(time.monotonic() - begin_s)
            stalled.send(claim("sightline/r1/twist/teleop", b"", b"0|%d" % number))
            heard += robot.twists.take(0.5).payload == b"0|%d" % number
            pause_until(begin_s, 1 / FPS)
        assert heard == 5 * FPS
        assert robot.link.dropped["frame"] >= 4 * FPS
        assert len(robot.link._peers) == 2
        assert robot.rejected == {}
    assert statistics.median(took_s) < 0.02
    assert resident_kib() - before_kib < 5_000
    robot.still_serves()


@pytest.mark.own_process
@pytest.mark.parametrize("picture_bytes", [3_000, 46_000, 200_000])
def test_client_that_reads_one_image_a_second_stays_and_gets_new_images(picture_bytes):
    """Such a reader answers a ping only when it comes to it: seconds late."""
    endpoint, ended, got = free_endpoint("ws://"), threading.Event(), []

    def read_slowly(message) -> None:
        got.append(int(message.payload[:4]))
        ended.wait(1)

    with open_websocket("r1", listen=endpoint) as robot, open_websocket("r1", connect=endpoint) as viewer:
        viewer.subscribe(FRAME, read_slowly)
        assert until(lambda: robot.has_listener(FRAME))
        before_kib, peer = resident_kib(), robot._peers[0]
        for number in range(8 * FPS):
            begin_s = time.monotonic()
            robot.publish(FRAME, b"", b"%04d" % number + bytes(picture_bytes - 4))
            pause_until(begin_s, 1 / FPS)
        assert robot._peers == (peer,)  # the connection that it had
        assert robot.rejected == {}
        assert viewer.rejected == {}
        assert len(got) >= 7
        assert got == sorted(set(got))
        assert resident_kib() - before_kib < 5_000
        ended.set()
        assert until(lambda: got[-1] == 8 * FPS - 1)


def test_stopped_peer_is_detected_within_three_seconds():
    endpoint = free_endpoint("ws://")
    with open_websocket("r1", listen=endpoint) as robot, bare_client(endpoint, wants=["status"]):
        assert until(lambda: robot.has_listener(STATUS))
        begin_s = time.monotonic()
        while robot.connected and time.monotonic() - begin_s < 5:
            robot.publish(STATUS, b"{}", bytes(500))  # its machine takes these, but no process reads
            time.sleep(0.1)
        assert 1.5 < time.monotonic() - begin_s < 3
        assert robot.rejected == {SILENT: 1}


@pytest.mark.own_process
def test_flood_of_pings_with_unread_answers_costs_little(robot):
    before_kib = resident_kib()
    with bare_client(robot.endpoint, receive_bytes=4096, wants=[]) as near:
        near.settimeout(1)
        with suppress(OSError):  # the robot takes no more, or hangs up
            for _ in range(250):  # 12 MB
                near.sendall((b"\x89\x80" + bytes(4)) * 8192)
        assert resident_kib() - before_kib < 5_000
        robot.still_serves()


def test_a_flood_of_empty_fragments_ends_with_a_reason(robot):
    with bare_client(robot.endpoint) as near:
        near.sendall(b"\x02\x80" + bytes(4) + (b"\x00\x80" + bytes(4)) * 3000)
        assert until(lambda: robot.rejected == {OVERSIZE: 1})
    robot.still_serves()
