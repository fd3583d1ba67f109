"""A real robot process with a range sensor that does not see the stop zone: it does not start, or it ends."""

import array
import math
import time
from pathlib import Path

from sightline.protocol.config import Config
from sightline.robot_side.ports import Ranges
from tests.fixtures.robot_process import RobotProcess


class Settings(Config):
    """`fog`: once this file is there the sensor is blinder than it was."""

    least_m: float = 0.13
    fog: Path = Path("/nonexistent")


class NearSighted:
    """A range sensor with no obstacle near it, at 10 Hz."""

    Config = Settings

    def __init__(self, config):
        self._config, self._due_s = config, 0.0

    def read(self):
        now_s = time.monotonic()
        if now_s < self._due_s:
            return None
        self._due_s = now_s + 0.1
        least_m = self._config.least_m + self._config.fog.exists()
        return Ranges(round(now_s * 1e6), 0.0, 0.1, least_m, 8.0, array.array("f", [math.inf] * 3))

    def close(self):
        pass


def test_robot_with_a_blind_sensor_does_not_start(tmp_path):
    """The default stop zone is 0.08 m, its sensor's 0.055 + 0.13 is 0.115 beyond the front."""
    with RobotProcess(tmp_path, range_sensor={"kind": f"{__name__}:NearSighted"}) as robot:
        assert robot.process.wait(10) == 2
        lines = [line for line in robot.output().splitlines() if "error" in line]
        assert len(lines) == 1 and "guard.stop_m = 0.08" in lines[0] and "Traceback" not in robot.output()
        assert robot.speed() == 0.0 and robot.motor_rows(), "the motors were set to zero"


def test_robot_ends_when_its_sensor_turns_blind(tmp_path):
    fog = tmp_path / "fog"
    sensor = {"kind": f"{__name__}:NearSighted", "options": {"fog": str(fog)}}
    with RobotProcess(tmp_path, range_sensor=sensor, guard={"stop_m": 0.13}) as robot:
        robot.wait_until_on()
        fog.touch()
        assert robot.process.wait(10) == 2
        assert "below 1.13 m" in robot.output() and robot.speed() == 0.0
