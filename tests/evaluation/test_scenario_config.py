"""The configuration of each scenario: it loads, it fits the robot, and another mission starts clean."""

import pytest

from sightline.evaluation.scenario_config import robot_config, robot_of, vision_config, vision_table
from sightline.operator_side.cli import app as cli
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.safety.limits import stop_bound
from sightline.sim.robot import load_robot, outline
from sightline.sim.scenario import load_scenario, scenario_names
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.missions.registry import configured_mission
from tests.fixtures.sim import robot_names


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_configures_a_vision_service_with_its_mission(name):
    scenario = load_scenario(name)
    config = vision_config(scenario, robot_of(scenario), 3)
    assert configured_mission(config).name == scenario.mission
    assert config.target.stand_off_m == scenario.stand_off_m


def test_all_required_services_are_listed(tmp_path, capsys):
    assert cli.run(["scenarios", "circle", "--out", str(tmp_path / "circle")]) == 0
    assert "labels" not in capsys.readouterr().out
    assert cli.run(["scenarios", "legs", "--out", str(tmp_path / "legs")]) == 0
    assert capsys.readouterr().out.endswith("sightline labels r1\n")


def test_written_scenario_replaces_no_other_configuration(tmp_path, capsys):
    assert [cli.run(["scenarios", "circle", "--out", str(tmp_path)]) for _ in range(2)] == [0, 0]
    (tmp_path / "robot.toml").write_text("robot = 'mine'\n")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    assert cli.run(["scenarios", "legs", "--out", str(tmp_path)]) == 2
    assert "exists with other content; choose another --out" in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_plain_scenarios_use_the_plain_detector():
    for name in ("static", "circle", "eight", "pushed", "behind", "walls", "occluder"):
        config = vision_config(load_scenario(name), load_robot("raspberry"))
        same = config.model_copy(update={"target": VisionConfig().target})
        # What is searched for is one ball of several.
        expected = {"detector": DetectorConfig(only_color=True)} if name == "behind" else {}
        assert same == VisionConfig().model_copy(update=expected)


def test_the_raspberry_is_the_robot_that_robot_side_is_by_default():
    assert robot_config(load_robot("raspberry")) == RobotConfig()


@pytest.mark.parametrize("name", robot_names())
def test_the_guard_knows_the_robots_outline_and_its_sensors_dead_zone(name):
    model = load_robot(name)
    guard, reach = robot_config(model).guard, outline(model)
    assert guard.front_m >= reach.front_m - 1e-9
    assert guard.rear_m >= reach.rear_m - 1e-9
    assert guard.half_width_m >= reach.half_width_m - 1e-9
    if not model.lidar.sensors:  # the blind zone must end before the stand-off of the robot
        assert guard.stop_m > model.lidar.x_m + model.lidar.range_min_m - guard.front_m + 2 * model.lidar.noise_m


def test_a_robot_that_brakes_slowly_is_steered_as_slowly():
    model = load_robot("chaser")
    limits, config = robot_config(model).safety, vision_config(load_scenario("chaser"), model)
    assert limits.max_acceleration_mps2 + limits.max_acceleration_rad_s2 * model.wheels.track_m / 2 <= 0.7 + 1e-9
    assert stop_bound(limits).zero_us <= 700_000
    assert config.steer.max_linear_mps == limits.max_linear_mps > load_scenario("chaser-circle").target.speed_mps
    assert config.latency.angular_acceleration_rad_s2 == limits.max_acceleration_rad_s2


def test_another_mission_keeps_the_waypoints_and_none_of_the_options():
    scenario = load_scenario("thymio")
    model = load_robot("thymio")
    own, other = (vision_table(scenario, model, 4, mission)["mission"] for mission in (None, "goto-baseline"))
    assert own["kind"] == "goto" and set(own["options"]) == {"waypoints", "sensor_x_m", "body"}
    assert other == {"kind": "goto-baseline", "options": {"waypoints": own["options"]["waypoints"]}}


@pytest.mark.parametrize(("old", "new", "expected"), [
    ("hue_low_deg = 40", "hue_low_deg = 400", "scenario mine: [vision] hsv.ranges.0.hue_low_deg"),
    ("[[vision.hsv.ranges]]", "[vision.hsw]\n[[vision.hsv.ranges]]", "scenario mine: [vision] unknown key 'hsw'"),
])
def test_a_scenario_with_a_wrong_setting_is_one_line(tmp_path, old, new, expected):
    text = (load_scenario.__globals__["SCENARIOS"] / "ball.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        vision_config(load_scenario(str(tmp_path / "mine.toml")), load_robot("raspberry"))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_robot_whose_settings_would_not_stop_in_time_is_rejected():
    model = load_robot("chaser").model_copy(update={"settings": {"safety": {"max_acceleration_mps2": 0.2}}})
    with pytest.raises(ConfigError, match=r"robot chaser: \[settings\].*allowed are 700 ms"):
        robot_config(model)
