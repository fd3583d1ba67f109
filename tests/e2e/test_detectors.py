"""Detectors in real processes: `sightline vision` drives a real robot by one, another is compared with it."""

import json
import os
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from sightline.evaluation.processes import SIGHTLINE, Processes
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.color.hsv import HsvDetector
from tests.fixtures.commands import sightline
from tests.fixtures.links import START_S, until
from tests.fixtures.robot_process import RobotProcess
from tests.fixtures.vision.onnx import brightness_model
from tests.fixtures.vision.remote import Server, box, http_reply, said
from tests.fixtures.vision.vision import camera, jpeg_of, scene

RIGHT = [[250.0, 100.0, 300.0, 150.0]]


class VisionProcess:
    """`sightline vision`, ended at the end."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._log = (folder / "vision.log").open("w")
        self._arguments = arguments

    def __enter__(self) -> "VisionProcess":
        command = [*SIGHTLINE, "vision", *self._arguments]
        self.process = subprocess.Popen(command, stdout=self._log, stderr=subprocess.STDOUT)
        return self

    def __exit__(self, *_: object) -> None:
        self.process.send_signal(signal.SIGTERM)
        try:
            assert self.process.wait(10) == 0, self.output()
        finally:
            self.process.kill()
            self._log.close()

    def output(self) -> str:
        return Path(self._log.name).read_text()


def turning(robot: RobotProcess) -> float:
    """Left positive, in rad/s of the wheels."""
    rows = robot.motor_rows() if robot.drive_log.exists() else []
    return rows[-1][2] - rows[-1][1] if rows else 0.0


def ball_on_the_left(folder: Path) -> dict:
    path = folder / "ball"
    path.mkdir()
    (path / "0.jpg").write_bytes(jpeg_of(scene(camera(), 0.9, 0.35)))
    return {"kind": "folder", "options": {"path": str(path)}}


@pytest.mark.slow
def test_a_shadow_is_compared_and_never_steers(tmp_path: Path) -> None:
    """The hsv detector finds the ball on the left; the model reports a ball on the right."""
    model = brightness_model(tmp_path / "right.onnx", RIGHT, [0])
    both = ("--detector", "hsv", "--shadow", f"onnx:{model}")
    with (
        RobotProcess(tmp_path, camera=ball_on_the_left(tmp_path)) as robot,
        VisionProcess(tmp_path, "--connect", robot.endpoint, *both) as vision,
    ):
        connect = ("--connect", robot.endpoint)
        assert until(lambda: turning(robot) > 0.5, START_S), vision.output()
        assert until(lambda: "onnx:right.onnx ball at" in vision.output(), 5), "they disagree"
        assert turning(robot) > 0.5, "the shadow steers nothing"
        state = json.loads(sightline("status", "r1", "--json", *connect).stdout)["mission"]
        assert state["detector"].startswith("hsv, shadow 0% agree") and state["device"] == "cpu"
        told = sightline("status", "r1", "--verbose", *connect).stdout
        assert "detector  hsv, shadow" in told and " ms per image" in told


# A real robot, steered by a real vision service whose detector is remote; the detector is killed while it drives.


FAR_BALL = jpeg_of(scene(camera(), 2.2, 0.0))
ZERO_US = 700_000
"""From the last valid command, docs/explanation/safety.md; the detector's own deadline comes before it."""
DEADLINE_US = 100_000


def _corners():
    """Return the corners of the box that a good detector finds in the image."""
    one = HsvDetector(HsvConfig()).detect(Decoder(320, 240, 320 * 240).decode(FAR_BALL))[0]
    return one.x1_px, one.y1_px, one.x2_px, one.y2_px


def _answer(_request):
    return http_reply(said(box(*_corners())))


@contextmanager
def _driving(tmp_path, detector, *options, beside=None):
    """Yield the robot and the vision service's log once the wheels turn; `beside(endpoint)` starts anything else."""
    robot = RobotProcess(tmp_path)
    (tmp_path / "pictures" / "0.jpg").write_bytes(FAR_BALL)
    log = tmp_path / "vision.log"
    command = [
        *SIGHTLINE, "vision", "--connect", robot.endpoint, "--detector", detector, "--set", "boxes.height_m=0.2",
        *options,
    ]
    with robot, log.open("wb") as out:
        robot.wait_until_on("on")
        if beside is not None:
            beside(robot.endpoint)
        vision = subprocess.Popen(command, stdout=out, stderr=out)
        try:
            assert until(lambda: robot.drive_log.exists() and robot.speed() > 0.5, START_S), log.read_text()
            yield robot, log
        finally:
            vision.terminate()
            vision.wait(5)


def _at(server):
    return f"http+jpeg://127.0.0.1:{server.port}/"


def _wheels_us(robot, since_us):
    """When the wheels were first at zero after `since_us`; None if they were not."""
    return next((t_us for t_us, left, right in robot.motor_rows() if t_us > since_us and left == right == 0), None)


@pytest.mark.slow
def test_robot_holds_after_a_detector_is_killed_and_recovers_within_three_seconds(tmp_path):
    with Server(_answer) as server, _driving(tmp_path, _at(server)) as (robot, log):
        port, killed_us = server.port, time.monotonic_ns() // 1000
        server.kill()
        assert until(lambda: _wheels_us(robot, killed_us), 3)
        assert _wheels_us(robot, killed_us) - killed_us <= ZERO_US + DEADLINE_US
        assert "searching" not in log.read_text(), "no answer is not saw nothing"
        server.start(port)
        assert until(lambda: robot.speed() > 0.5, 3.0), log.read_text()
        assert "answers again" in log.read_text()


@pytest.mark.slow
def test_local_fallback_continues_without_a_stop_and_returns(tmp_path):
    with Server(_answer) as server, _driving(tmp_path, _at(server), "--set", "detector.fallback=hsv") as (robot, log):
        port, killed_us = server.port, time.monotonic_ns() // 1000
        server.kill()
        assert until(lambda: "the fallback drives on" in log.read_text(), 2)
        assert not until(lambda: _wheels_us(robot, killed_us), 1.5), "the wheels never stopped"
        server.start(port)
        assert until(lambda: "drives again" in log.read_text(), 3.0)
        asked = len(server.requests)
        assert until(lambda: len(server.requests) > asked + 10, 2) and not _wheels_us(robot, killed_us)
        assert robot.speed() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("hostile", [b"<html>", b"\0" * 100_000, None])
def test_hostile_answers_do_not_move_the_robot(tmp_path, hostile):
    with Server(_answer) as server, _driving(tmp_path, _at(server)) as (robot, log):
        turned_us = time.monotonic_ns() // 1000
        server.answer = lambda request: None if hostile is None else http_reply(hostile)
        assert until(lambda: _wheels_us(robot, turned_us), 3)
        still_us = _wheels_us(robot, turned_us)
        assert until(lambda: robot.motor_rows()[-1][0] >= still_us + 500_000), "the driver goes on"
        assert not [row for row in robot.motor_rows() if row[0] > still_us and (row[1] or row[2])]
        assert "no answer" in log.read_text()


@pytest.mark.slow
def test_robot_recovers_after_a_zenoh_detector_service_is_killed(tmp_path):
    with Processes(tmp_path) as processes:
        def serve(endpoint):
            processes.start("detector", ["detector", "--serve", "hsv", "--connect", endpoint])

        with _driving(tmp_path, "zenoh", beside=serve) as (robot, log):
            killed_us = time.monotonic_ns() // 1000
            os.kill(processes.pid("detector"), signal.SIGKILL)
            assert until(lambda: _wheels_us(robot, killed_us), 3)
            assert _wheels_us(robot, killed_us) - killed_us <= ZERO_US + DEADLINE_US
            serve(robot.endpoint)
            processes.wait_line("detector", "receives the frames", 15)
            assert until(lambda: robot.speed() > 0.5, 3.0), log.read_text()
            assert "searching" not in log.read_text()
