"""What is said only while watched crosses a robot with two transports, in both directions, and only while watched."""

from contextlib import ExitStack

import pytest

from sightline.protocol.channels import OVERLAY, PREVIEW
from sightline.protocol.transports.open import open_link
from tests.fixtures.links import free_endpoint, until
from tests.fixtures.robot_process import RobotProcess

pytestmark = pytest.mark.slow
JPEG = b"\xff\xd8" + bytes(100_000)


@pytest.fixture(scope="module")
def ends(tmp_path_factory):
    """Where a robot listens, on both transports."""
    ends = {"zenoh": free_endpoint(), "web": free_endpoint().replace("tcp/", "ws://")}
    with RobotProcess(tmp_path_factory.mktemp("robot"), listen=[*ends.values()]) as robot:
        assert until(lambda: ends["web"] in robot.output(), 20.0), robot.output()
        yield ends


@pytest.mark.parametrize("far", ["zenoh", "web"])
@pytest.mark.parametrize("near", ["zenoh", "web"])
def test_an_overlay_reaches_who_watches_once_and_only_then(ends, near, far):
    with ExitStack() as ending:
        vision = ending.enter_context(open_link("r1", connect=[ends[near]], role="vision", timeout_s=10))
        viewer = ending.enter_context(open_link("r1", connect=[ends[far]], role="viewer", timeout_s=10))
        assert not until(lambda: vision.has_listener(OVERLAY) or vision.has_listener(PREVIEW), 0.5)
        heard = []
        viewer.subscribe(OVERLAY, heard.append)
        assert until(lambda: vision.has_listener(OVERLAY), 5.0)
        assert not vision.has_listener(PREVIEW)
        for number in range(1, 4):
            vision.publish(OVERLAY, b'{"seq":%d}' % number, JPEG)
            assert until(lambda number=number: len(heard) == number, 5.0), heard
        assert [message.header for message in heard] == [b'{"seq":%d}' % number for number in range(1, 4)]
        assert heard[0].payload == JPEG and heard[0].source == "vision"
        viewer.ignore(OVERLAY)
        assert until(lambda: not vision.has_listener(OVERLAY), 5.0)


@pytest.mark.parametrize("far", ["zenoh", "web"])
def test_a_viewer_that_goes_away_is_noticed(ends, far):
    with ExitStack() as ending:
        vision = ending.enter_context(open_link("r1", connect=[ends["zenoh"]], role="vision", timeout_s=10))
        with open_link("r1", connect=[ends[far]], role="viewer", timeout_s=10) as viewer:
            viewer.latest(PREVIEW)
            assert until(lambda: vision.has_listener(PREVIEW), 5.0)
        assert until(lambda: not vision.has_listener(PREVIEW), 5.0)
