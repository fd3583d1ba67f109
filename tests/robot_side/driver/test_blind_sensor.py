"""A real robot process with a range sensor that does not see the stop zone: it does not start, or it stops."""

import array
import math
import time
from pathlib import Path

from sightline.operator_side.client.requests import Operator
from sightline.protocol.clock import monotonic_us
from sightline.protocol.config import Config
from sightline.protocol.messages import State
from sightline.robot_side.ports import Ranges
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess, Vision, driving


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


def test_robot_whose_sensor_turns_blind_while_it_drives_stays_in_fault(tmp_path):
    """It does not end, so an operator reads the reason. A reset lasts until the next scan."""
    fog = tmp_path / "fog"
    sensor = {"kind": f"{__name__}:NearSighted", "options": {"fog": str(fog)}}
    with RobotProcess(tmp_path, range_sensor=sensor, guard={"stop_m": 0.13}) as robot:
        robot.wait_until_on()
        with Vision(robot.endpoint) as vision:
            assert driving(robot)
            fog.touch()
            assert until(lambda: vision.status().state is State.FAULT and robot.speed() == 0.0, 5)
            seen, operator = vision.status(), Operator(vision.link)
            assert "below 1.13 m" in seen.reason and seen.faults == {"range sensor": seen.faults["range sensor"]}
            assert until(lambda: operator.reset().ok), "a request may come too late on a busy machine"
            assert until(lambda: vision.status().state is State.FAULT, 5)
            since_us = monotonic_us()
            time.sleep(0.3)
            assert not any(left or right for t_us, left, right in robot.motor_rows() if t_us > since_us)
        assert robot.process.poll() is None and robot.output().count("Traceback") == 1
