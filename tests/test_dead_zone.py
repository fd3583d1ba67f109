"""A range sensor that is blind beyond the guard's stop zone is refused, in words, and nothing moves."""

import array
import math
import time
from pathlib import Path

import pytest

from sightline.evaluation.scenario_config import robot_config
from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError
from sightline.robot_side.safety.guard import BlindZoneError, check_blind_zone
from sightline.robot_side.safety.guard import GuardConfig
from sightline.robot_side.ports import Ranges
from sightline.sim.robot import load_robot
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess

# Binary fractions: front 0.5, rear 1, half as wide 0.25, so that "just" is just.
BLIND_BOX = {"front_m": 0.5, "rear_m": 1.0, "half_width_m": 0.25, "sensor_x_m": 0.0, "stop_m": 0.25}


def blind_scan(least_m, first_rad=0.0, each_rad=0.0, rays=1):
    return Ranges(0, first_rad, each_rad, least_m, 8.0, array.array("f", [math.inf] * rays))


def is_refused(sees, **guard):
    try:
        check_blind_zone(GuardConfig(**{**BLIND_BOX, **guard}), sees)
    except BlindZoneError:
        return True
    return False


@pytest.mark.parametrize(("looks_rad", "edge_m"), [
    (0.0, 0.5 + 0.25), (math.pi, 1.0 + 0.25), (math.pi / 2, 0.25 + 0.25), (-math.pi / 2, 0.25 + 0.25),
])  # fmt: skip
def test_in_each_direction_the_dead_zone_ends_within_the_stop_zone(looks_rad, edge_m):
    assert not is_refused(blind_scan(edge_m - 1e-6, looks_rad))
    assert is_refused(blind_scan(edge_m + 1e-6, looks_rad))


def test_as_far_as_the_stop_zone_is_too_far():
    assert is_refused(blind_scan(0.75)) and not is_refused(blind_scan(0.75), stop_m=0.25001)


@pytest.mark.parametrize(("sensor_x_m", "refused"), [(-0.2, False), (0.2, True)])
def test_where_the_sensor_sits_counts(sensor_x_m, refused):
    assert is_refused(blind_scan(0.6), sensor_x_m=sensor_x_m) == refused


def test_what_is_between_the_robot_and_a_sensor_ahead_of_it_is_not_seen_either():
    assert is_refused(blind_scan(0.0), sensor_x_m=0.76) and not is_refused(blind_scan(0.0), sensor_x_m=0.74)


@pytest.mark.parametrize(("first_rad", "each_rad", "refused"), [
    (-math.pi, math.pi / 2, True), (-math.pi, math.pi, False), (math.pi / 4, math.pi / 4, True),
])  # fmt: skip
def test_it_is_judged_only_where_the_sensor_looks(first_rad, each_rad, refused):
    """0.6 is too much to the sides, not ahead and behind."""
    assert is_refused(blind_scan(0.6, first_rad, each_rad, rays=2), stop_m=0.3) == refused


@pytest.mark.parametrize("least_m", [math.nan, math.inf])
def test_a_minimum_that_is_no_number_is_a_bad_reading(least_m):
    with pytest.raises(ValueError, match="no numbers") as caught:
        check_blind_zone(GuardConfig(**BLIND_BOX), blind_scan(least_m))
    assert not isinstance(caught.value, BlindZoneError)


def test_the_words_say_what_to_set():
    with pytest.raises(BlindZoneError, match=r"guard.stop_m = 0.25: .* nearer than 1 m, .* 0.500 m beyond .* outline"):
        check_blind_zone(GuardConfig(**BLIND_BOX), blind_scan(1.0))


def test_a_simulated_robot_is_refused_with_its_name():
    model = load_robot("gazebo-raspi").model_copy(update={"settings": {"guard": {"stop_m": 0.08}}})
    with pytest.raises(ConfigError, match=r"^robot gazebo-raspi: \[settings\] guard.stop_m = 0.08: .* than 0.1 m.*$"):
        robot_config(model)


class Settings(Config):
    """`fog`: once this file is there the sensor is blinder than it was."""

    least_m: float = 0.13
    fog: Path = Path("/nonexistent")


class NearSighted:
    """A range sensor with nothing about it, at 10 Hz."""

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


def test_a_robot_with_such_a_sensor_does_not_start(tmp_path):
    """The default stop zone is 0.08 m, its sensor's 0.055 + 0.13 is 0.115 beyond the front."""
    with RobotProcess(tmp_path, range_sensor={"kind": f"{__name__}:NearSighted"}) as robot:
        assert robot.process.wait(10) == 2
        said = [line for line in robot.output().splitlines() if "error" in line]
        assert len(said) == 1 and "guard.stop_m = 0.08" in said[0] and "Traceback" not in robot.output()
        assert robot.speed() == 0.0 and robot.motor_rows(), "the motors were told zero"


def test_with_a_larger_stop_zone_it_does_and_a_sensor_that_turns_blind_ends_it(tmp_path):
    fog = tmp_path / "fog"
    sensor = {"kind": f"{__name__}:NearSighted", "options": {"fog": str(fog)}}
    with RobotProcess(tmp_path, range_sensor=sensor, guard={"stop_m": 0.13}) as robot:
        assert until(lambda: "robot r1: on" in robot.output(), 8)
        fog.touch()
        assert robot.process.wait(10) == 2
        assert "nearer than 1.13 m" in robot.output() and robot.speed() == 0.0
