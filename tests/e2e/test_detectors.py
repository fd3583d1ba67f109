"""Detectors in real processes: `sightline vision` drives a real robot by one, another looks on and is promoted live."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fixtures.links import until
from tests.fixtures.vision.onnx import brightness_model
from tests.fixtures.robot_process import RobotProcess
from tests.fixtures.vision.vision import camera, jpeg_of, scene

pytestmark = pytest.mark.slow
RIGHT = [[250.0, 100.0, 300.0, 150.0]]


class VisionProcess:
    """`sightline vision`, ended at the end."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._log = (folder / "vision.log").open("w")
        self._arguments = arguments

    def __enter__(self) -> "VisionProcess":
        command = [sys.executable, "-m", "sightline.operator_side.cli.app", "vision", *self._arguments]
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


def sightline(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "sightline.operator_side.cli.app", *arguments], capture_output=True, text=True,
                          timeout=30, check=False)


def turning(robot: RobotProcess) -> float:
    """Left positive, in rad/s of the wheels."""
    rows = robot.motor_rows() if robot.drive_log.exists() else []
    return rows[-1][2] - rows[-1][1] if rows else 0.0


def ball_on_the_left(folder: Path) -> dict:
    path = folder / "ball"
    path.mkdir()
    (path / "0.jpg").write_bytes(jpeg_of(scene(camera(), 0.9, 0.35)))
    return {"kind": "folder", "options": {"path": str(path)}}


def test_a_shadow_looks_on_and_drives_once_it_is_promoted(tmp_path: Path) -> None:
    """Hsv sees the ball, to the left; the model says that there is one to the right."""
    model = brightness_model(tmp_path / "right.onnx", RIGHT, [0])
    with (
        RobotProcess(tmp_path, camera=ball_on_the_left(tmp_path)) as robot,
        VisionProcess(tmp_path, "--connect", robot.endpoint, "--shadow", f"onnx:{model}") as vision,
    ):
        connect = ("--connect", robot.endpoint)
        assert until(lambda: turning(robot) > 0.5, 20), vision.output()
        assert until(lambda: "onnx:right.onnx ball at" in vision.output(), 5), "they disagree"
        assert turning(robot) > 0.5, "the shadow steers nothing"
        state = json.loads(sightline("status", "r1", "--json", *connect).stdout)["mission"]
        assert state["detector"].startswith("hsv, shadow 0% agree") and state["device"] == "cpu"
        promoted = sightline("detector", "promote", "r1", *connect)
        assert (promoted.returncode, promoted.stderr) == (0, ""), promoted
        assert until(lambda: turning(robot) < -0.5, 10), "now it does"
        told = sightline("status", "r1", *connect).stdout
        assert "detector  onnx:right.onnx, promoted; shadow" in told
        assert "on cpu, model " in told and " ms a picture" in told
        assert sightline("detector", "promote", "r1", "--back", *connect).returncode == 0
        assert until(lambda: turning(robot) > 0.5, 10)


def test_without_a_shadow_nobody_is_promoted(tmp_path: Path) -> None:
    with (
        RobotProcess(tmp_path, camera=ball_on_the_left(tmp_path)) as robot,
        VisionProcess(tmp_path, "--connect", robot.endpoint, "--detector", "adaptive") as vision,
    ):
        assert until(lambda: turning(robot) > 0.5, 20), vision.output()
        refused = sightline("detector", "promote", "r1", "--connect", robot.endpoint)
        assert refused.returncode == 5 and "--shadow NAME" in refused.stderr
        assert len(refused.stderr.splitlines()) == 1
