"""Messages between peers pass through the robot once, to every other peer of either transport, and not back."""

import itertools
import threading
from contextlib import ExitStack

import pytest

from sightline.protocol.channels import CHANNELS, DETECTIONS, MISSION, OVERLAY, PREVIEW
from sightline.protocol.transports.open import open_link
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess

PAYLOADS = {DETECTIONS.name: b'{"width_px":640,"height_px":480}', MISSION.name: b'{"id":1,"mission":"follow"}'}
QUIET_S = 0.4


@pytest.fixture(scope="module")
def ends(tmp_path_factory):
    """Endpoints of a robot that listens on both transports."""
    ends = {"zenoh": free_endpoint(), "web": free_endpoint("ws://")}
    with RobotProcess(tmp_path_factory.mktemp("robot"), listen=[*ends.values()]) as robot:
        robot.wait_until_on(ends["web"])
        yield ends


@pytest.fixture(scope="module")
def peers(ends):
    """Two peers on each transport of the robot, and the messages that each peer receives."""
    with ExitStack() as ending:
        found = {}
        for name in ("zenoh 1", "zenoh 2", "web 1", "web 2"):
            end = ends[name.partition(" ")[0]]
            link = ending.enter_context(open_link("r1", connect=[end], role="operator", timeout_s=10))
            heard = []
            for channel in (DETECTIONS, MISSION):
                link.subscribe(channel, lambda message, heard=heard: heard.append(message))
            found[name] = link, heard
        assert until(lambda: all(_arrives(found, link) for link, _ in found.values()), 10.0)
        yield found


NUMBERS = itertools.count(1)


def _said(link, channel):
    note = b'"seq":%d' % next(NUMBERS)
    link.publish(channel, b'{"source":"operator","session":"0a0b0c0d",%b}' % note, PAYLOADS[channel.name], "operator")
    return note


def _arrives(found, link):
    note = _said(link, DETECTIONS)
    return until(lambda: all(_count(heard, note) for other, heard in found.values() if other is not link), 0.5)


def _count(heard, note):
    return sum(note in message.header for message in tuple(heard))


@pytest.mark.parametrize("channel", [DETECTIONS, MISSION], ids=lambda channel: channel.name)
@pytest.mark.parametrize("speaker", ["zenoh 1", "web 1"])
def test_relay_delivers_once_to_every_other_peer(peers, speaker, channel):
    assert CHANNELS[channel.name].passed_on
    note = _said(peers[speaker][0], channel)
    others = [name for name in peers if name != speaker]
    assert until(lambda: all(_count(peers[name][1], note) for name in others), 3.0)
    threading.Event().wait(QUIET_S)  # for what should not come
    assert {name: _count(heard, note) for name, (_, heard) in peers.items()} == {
        **dict.fromkeys(others, 1), speaker: 0,
    }  # fmt: skip


# Messages sent only while watched cross a robot with two transports, in both directions, and only while watched.


JPEG = b"\xff\xd8" + bytes(100_000)


@pytest.mark.parametrize("far", ["zenoh", "web"])
@pytest.mark.parametrize("near", ["zenoh", "web"])
def test_overlay_reaches_a_viewer_once_and_only_while_it_watches(ends, near, far):
    with ExitStack() as ending:
        vision = ending.enter_context(open_link("r1", connect=[ends[near]], role="vision", timeout_s=10))
        viewer = ending.enter_context(open_link("r1", connect=[ends[far]], role="viewer", timeout_s=10))
        assert not until(lambda: vision.has_listener(OVERLAY) or vision.has_listener(PREVIEW), 0.5)
        heard = []
        viewer.subscribe(OVERLAY, heard.append)
        assert until(lambda: vision.has_listener(OVERLAY), 5.0)
        assert not vision.has_listener(PREVIEW)
        published = []
        while len(heard) < 3 and len(published) < 50:  # a busy link may drop an overlay
            published.append(b'{"seq":%d}' % len(published))
            vision.publish(OVERLAY, published[-1], JPEG)
            until(lambda: heard and heard[-1].header == published[-1], 0.5)
        received = [message.header for message in heard]
        assert len(received) >= 3 and received == sorted(set(received), key=published.index), (received, published)
        assert heard[0].payload == JPEG and heard[0].source == "vision"
        viewer.unsubscribe(OVERLAY)
        assert until(lambda: not vision.has_listener(OVERLAY), 5.0)


@pytest.mark.parametrize("far", ["zenoh", "web"])
def test_relay_stops_after_the_viewer_leaves(ends, far):
    with ExitStack() as ending:
        vision = ending.enter_context(open_link("r1", connect=[ends["zenoh"]], role="vision", timeout_s=10))
        with open_link("r1", connect=[ends[far]], role="viewer", timeout_s=10) as viewer:
            viewer.latest(PREVIEW)
            assert until(lambda: vision.has_listener(PREVIEW), 5.0)
        assert until(lambda: not vision.has_listener(PREVIEW), 5.0)
