"""Over WebSocket the robot wants of its vision what its viewers want, as long as they do, and no larger messages."""

from contextlib import ExitStack

import pytest
from websockets.exceptions import ConnectionClosed

from sightline.protocol.channels import DETECTIONS, OVERLAY, PREVIEW, STATUS, TWIST
from sightline.protocol.transports.websocket.link import open_websocket
from tests.fixtures.links import claim, hail, until
from tests.fixtures.ports import free_endpoint


@pytest.fixture
def site():
    """A robot's link, and how others open theirs."""
    end = free_endpoint("ws://")
    with ExitStack() as ending:
        robot = ending.enter_context(open_websocket("r1", listen=end, role="robot"))
        robot.latest(TWIST)
        yield robot, lambda role: ending.enter_context(open_websocket("r1", connect=end, role=role)), end


def test_vision_receives_the_subscriptions_of_viewers_and_their_end(site):
    _, opened, _ = site
    vision, one, two = opened("vision"), opened("viewer"), opened("viewer")
    heard, seen = one.latest(OVERLAY), two.latest(OVERLAY)
    assert until(lambda: vision.has_listener(OVERLAY))
    one.unsubscribe(OVERLAY)
    assert until(lambda: vision.publish(OVERLAY, b"{}", b"jpeg") and seen.take())
    heard.take()
    vision.publish(OVERLAY, b"{}", b"jpeg")
    assert seen.take(2.0) and heard.take(0.2) is None and vision.has_listener(OVERLAY)
    two.close()
    assert until(lambda: not vision.has_listener(OVERLAY))
    assert not vision.has_listener(PREVIEW)


def test_late_vision_receives_the_existing_subscriptions(site):
    _, opened, _ = site
    opened("viewer").latest(PREVIEW)
    vision = opened("vision")
    assert until(lambda: vision.has_listener(PREVIEW)) and not vision.has_listener(OVERLAY)


def test_drops_of_a_peer_that_leaves_change_no_counter_that_another_thread_reads(site):
    robot, opened, _ = site
    before, vision = robot.dropped, opened("vision")
    assert until(lambda: robot.connected)
    robot._peers[0].queue.dropped[OVERLAY.name] = 3
    vision.close()
    assert until(lambda: not robot.connected and robot.dropped == {OVERLAY.name: 3})
    assert before == {}


def test_vision_that_subscribes_to_itself_receives_nothing(site):
    _, opened, _ = site
    vision = opened("vision")
    own = vision.latest(OVERLAY)
    assert until(lambda: vision.has_listener(OVERLAY))
    vision.publish(OVERLAY, b"{}", b"jpeg")
    assert own.take(0.3) is None


def test_large_messages_are_accepted_only_while_subscribed(site):
    robot, opened, end = site
    large = claim("sightline/r1/overlay/vision", b"{}", bytes(OVERLAY.max_payload_bytes))
    stranger = hail(end, role="vision", wants=["status"])
    with pytest.raises(ConnectionClosed):
        stranger.send(large)
        stranger.recv(5)
    assert until(lambda: robot.rejected["OVERSIZE"] == 1)
    viewer = opened("viewer")
    seen = viewer.latest(OVERLAY)
    assert until(lambda: robot._subscriptions.announced[1:])
    stranger = hail(end, role="vision", wants=["status"])
    assert until(lambda: stranger.send(large) or seen.take(0.2))
    viewer.close()
    assert until(lambda: not robot._subscriptions.announced[1:])
    with pytest.raises(ConnectionClosed):
        stranger.send(large)
        for _ in range(20):
            stranger.recv(5)


def test_a_hello_is_sent_again_only_when_wants_change(site):
    robot, opened, end = site
    viewer = opened("viewer")
    stranger = hail(end, role="vision", wants=["status"])
    for channel in (OVERLAY, OVERLAY):
        viewer.latest(channel)
    robot.latest(DETECTIONS)
    robot.latest(DETECTIONS)
    hellos = []

    def told():
        robot.publish(STATUS, b"{}", b"end")
        hellos.append(stranger.recv(5))
        texts = [one for one in hellos if isinstance(one, str)]
        return bool(texts) and '"detections"' in texts[-1] and '"overlay"' in texts[-1]

    assert until(told)
    for _ in range(20):
        told()
    texts = [one for one in hellos if isinstance(one, str)]
    assert 1 <= len(texts) == len(set(texts)) <= 2  # one of them may have taken the other's place
