"""The dry run: it prints its detections, acknowledges, and never publishes a twist."""

import pytest

from sightline.operator_side.calibrate.local_camera import local_camera
from sightline.protocol.channels import ACK, CAMERA, FRAME, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.messages import AnswerHeader, FrameHeader, Stamp, Twist
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.robot_side.ports import Picture
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.pipeline import Observation, PipelineAnswer
from sightline.vision_side.serving.dry_run import AckingService, ProgressPrinter, watch_camera, watch_robot
from tests.fixtures.robot_process import RobotProcess
from tests.fixtures.vision.vision import camera, jpeg_of, scene

MODEL = camera()
COLOR = VisionConfig(detector=DetectorConfig(kind="hsv"))
BALL = jpeg_of(scene(MODEL, 1.0, 0.2, shaded=True))
PICTURES = [BALL, BALL, b"no picture", BALL, jpeg_of(scene(MODEL, 3.0, -0.2, shaded=True)), BALL]


class Scripted:
    """A camera that gives, or raises, what is on its list, then ends the run as Ctrl-C does."""

    model = MODEL

    def __init__(self, script):
        self.script, self.t_us = list(script), 0

    def read(self, timeout_s):
        if not self.script:
            raise KeyboardInterrupt
        self.t_us += 33_333
        one = self.script.pop(0)
        if isinstance(one, Exception):
            raise one
        return one and Picture(one, self.t_us)


def watch(script):
    said = []
    assert watch_camera(COLOR, Scripted(script), said.append) == 0
    return said


def test_a_robot_gets_acknowledgements_and_never_a_twist():
    network = MemoryNetwork(seed=1)
    robot, said = network.link("r1"), []
    acks, twists = [], []
    robot.subscribe(ACK, acks.append)
    robot.subscribe(TWIST, twists.append)
    service = AckingService(COLOR, network.link("r1", role="vision"), said.append)
    robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=1, t_us=0)), encode(MODEL))
    for seq, jpeg in enumerate(PICTURES):
        header = FrameHeader(session="0000abcd", seq=seq, t_us=(seq + 1) * 33_333)
        robot.publish(FRAME, encode(header), jpeg)
        network.advance((seq + 1) * 50_000)
        service.turn(0.0)
        network.advance((seq + 1) * 50_000)
    assert [decode(AnswerHeader, ack.header).echo.seq for ack in acks] == list(range(len(PICTURES)))
    assert not twists
    assert any(line.startswith("tracking: bearing") for line in said)


def test_a_camera_needs_no_robot():
    said = watch(PICTURES)
    assert "320x240, calibrated; nothing is driven" in said[0]
    assert said[1].startswith("tracking: bearing +12.1 ")
    assert "distance 0.99 m; would steer" in said[1]


def test_unplugged_camera_is_logged_once_and_awaited(monkeypatch):
    monkeypatch.setattr("sightline.vision_side.serving.dry_run._RETRY_S", 0.0)
    gone = HardwareError("camera /dev/video0 was unplugged; plug it in again")
    said = watch([BALL, gone, gone, None, BALL])
    assert said[2:] == ["camera: camera /dev/video0 was unplugged; plug it in again", "camera: back"]


def test_reports_are_limited_to_two_per_second():
    said = []
    telling = ProgressPrinter(said.append)
    for picture in range(301):
        telling.step(PipelineAnswer(None, Observation("lost")), 100 + picture / 30)
    assert len(said) == 21
    assert said[0] == "lost: no target"
    assert said[-1] == "lost: no target (30 images/s)"


def test_dry_run_prints_the_sign_of_a_bearing_and_the_twist():
    said = []
    seen = Observation("tracking", bearing_rad=-0.1, distance_m=1.234)
    ProgressPrinter(said.append).step(PipelineAnswer(Twist(linear_mps=0.2, angular_rad_s=-0.5), seen), 0.0)
    assert said == ["tracking: bearing -5.7 degrees, distance 1.23 m; would steer +0.20 m/s, -0.50 rad/s"]


def test_dry_run_ends_after_its_time():
    assert watch_camera(VisionConfig(), Scripted([BALL] * 1000), lambda _: None, seconds=0.05) == 0


def test_a_local_camera_is_opened_by_kind_and_options_and_closed(tmp_path):
    (tmp_path / "a.jpg").write_bytes(BALL)
    said = []

    def report(line):
        said.append(line)
        if len(said) == 2:
            raise KeyboardInterrupt

    with local_camera("still", [f"path={tmp_path / 'a.jpg'}", "fps=100", "hfov_deg=80"]) as still:
        assert watch_camera(COLOR, still, report, seconds=5.0) == 0
    assert "not calibrated" in said[0]
    assert said[1].startswith("tracking: bearing +12.1 ")


@pytest.mark.parametrize("text", ["path", "=3", " =3"])
def test_an_option_that_is_invalid_is_reported(text):
    with pytest.raises(ConfigError, match="expected KEY=VALUE"), local_camera("still", [text]):
        pass


def test_dry_run_does_not_move_an_armed_robot(tmp_path):
    (tmp_path / "a.jpg").write_bytes(BALL)
    camera = {"kind": "still", "options": {"path": str(tmp_path / "a.jpg"), "hfov_deg": 80}}
    said = []
    with RobotProcess(tmp_path, camera=camera) as robot:
        robot.wait_until_on("on tcp")
        assert watch_robot(VisionConfig(connect=(robot.endpoint,)), said.append, seconds=2.0) == 0
        assert {row[1:] for row in robot.motor_rows()} <= {(0.0, 0.0)}
    told = [line for line in said if line.startswith("tracking: bearing +12.1 ")]
    assert len(told) >= 2
    assert "images/s" in told[-1]
