"""The example programs that containers run: a detector whose boxes arrive, an older client whose text steers."""

import base64
import os
import subprocess
import sys
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

from examples.compose.older_client import steer
from examples.detector_service import boxes_of, look
from sightline.protocol.channels import DETECTIONS
from sightline.protocol.codec import decode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import Detections, DetectionsHeader
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.zenoh.link import open_zenoh
from tests.e2e.compose.fixture import ROOT
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess

YELLOW_BGR = (13, 199, 242)


def picture(x_px=None, radius_px=20):
    """A grey room of 320x240, with a yellow ball at `x_px` unless it is None."""
    bgr = np.full((240, 320, 3), 120, np.uint8)
    if x_px is not None:
        cv2.circle(bgr, (x_px, 130), radius_px, YELLOW_BGR, -1)
    return bgr


def jpeg(*ball):
    return cv2.imencode(".jpg", picture(*ball))[1].tobytes()


@pytest.mark.parametrize("x_px", [40, 160, 291])
def test_the_detector_boxes_the_ball(x_px):
    (box,) = look(picture(x_px))
    assert box.label == "ball"
    edges = (box.x1_px, box.y1_px, box.x2_px, box.y2_px)
    assert all(abs(edge - true) <= 1 for edge, true in zip(edges, (x_px - 20, 110, x_px + 21, 151), strict=True))


def test_empty_image_and_speck_give_an_answer_without_a_ball():
    for seen in (picture(), picture(100, 2)):
        assert look(seen) == ()
    found = boxes_of(jpeg())
    assert (found.width_px, found.height_px, found.boxes) == (320, 240, ())


@pytest.mark.parametrize("bytes_", [b"", b"no picture", jpeg(100)[:400], b"\xff\xd8" + b"\xff" * 500])
def test_invalid_image_is_rejected_with_its_cause(bytes_):
    with pytest.raises(WireError, match="MALFORMED"):
        boxes_of(bytes_)


def answered(*ball):
    twist = parse_twist(steer(base64.encodebytes(jpeg(*ball)).decode()).encode())
    return twist.linear_mps, twist.angular_rad_s


def test_legacy_client_turns_to_the_ball_and_keeps_its_distance():
    assert answered(80)[1] > 0.5
    assert answered(240)[1] < -0.5
    assert abs(answered(160)[1]) < 0.05
    far, near = answered(160, 12)[0], answered(160, 45)[0]
    assert far > 0.3
    assert near < 0
    forward, turn = answered()
    assert forward == 0.0 and 0.5 <= turn < 0.51, "turns to find it"


@contextmanager
def program(name, *arguments):
    """An example as a process of its own; ended with SIGTERM."""
    command = [sys.executable, str(ROOT / "examples" / name), *arguments]
    environment, pipe = {**os.environ, "PYTHONPATH": str(ROOT)}, subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.terminate()


def wait_for(robot):
    """A robot's endpoint, once it listens."""
    robot.wait_until_on()
    return robot.endpoint


@pytest.mark.slow
def test_boxes_reach_subscribers_and_name_a_frame_of_the_robot(tmp_path):
    robot = RobotProcess(tmp_path)
    (tmp_path / "pictures" / "0.jpg").write_bytes(jpeg(160))
    with robot, program("detector_service.py", wait_for(robot)) as detector:
        assert detector.stdout.readline().startswith("detector: detecting in the images of r1")
        with open_zenoh("r1", connect=[robot.endpoint], role="vision") as vision:
            heard = vision.latest(DETECTIONS)
            message = heard.take(8.0)
            header = decode(DetectionsHeader, message.header)
            assert message.source == header.source == "detector" and header.echo.channel == "frame"
            (box,) = decode(Detections, message.payload, DETECTIONS.max_payload_bytes).boxes
            assert abs((box.x1_px + box.x2_px) / 2 - 160) < 2
            assert until(lambda: decode(DetectionsHeader, heard.take(2.0).header).seq > header.seq)


@pytest.mark.waits
def test_programs_without_a_robot_print_an_error():
    with (
        program("detector_service.py", free_endpoint()) as detector,
        program("compose/older_client.py", free_endpoint("ws://")) as client,
    ):
        assert "refused" in client.stdout.readline()
        assert detector.stderr.readline().startswith("error: no answer from tcp/127.0.0.1:")
        assert detector.wait(5) == 4


@pytest.mark.parametrize("name", ["detector_service.py", "compose/older_client.py"])
def test_program_without_an_endpoint_prints_an_error(name):
    with program(name) as process:
        assert process.stderr.read().startswith("error: which robot?")
