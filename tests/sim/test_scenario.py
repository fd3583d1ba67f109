"""Scenario, robot and look files: valid ones, rejected ones with their errors; paths and motors alone."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.protocol.errors import ConfigError
from sightline.sim.process import CaptureTimer, PeriodicTimer
from sightline.sim.robot import load_robot
from sightline.sim.scenario import ClosedPath, OnPath, PathLeg, Place, load_scenario, look_named, scenario_names
from sightline.sim.toml_file import read_table
from sightline.sim.world.world import Motor
from tests.fixtures.sim import robot_names

STEP_S = 0.004


def test_everything_shipped_loads():
    assert {"static", "circle", "eight", "pushed", "behind", "walls"} <= set(scenario_names())
    assert all(load_scenario(name).name == name for name in scenario_names())
    assert all(load_robot(name).name == name for name in robot_names())


@pytest.mark.parametrize(
    ("load", "name", "expected"),
    [
        (load_scenario, "cirlce", "did you mean 'circle'"),
        (load_scenario, "../robots/raspberry", "no scenario called"),
        (load_scenario, "/nowhere/x.toml", "no scenario file /nowhere/x.toml"),
        (load_scenario, "x" * 300 + ".toml", "no scenario file xxx"),
        (load_robot, "x" * 300 + ".toml", "no robot file xxx"),
        (load_robot, "rasberry", "did you mean 'raspberry'"),
        (look_named, "dimm", "did you mean 'dim'"),
    ],
)
def test_unknown_name_error_lists_the_nearest_and_all(load, name, expected):
    with pytest.raises(ConfigError, match="there are") as caught:
        load(name)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("seconds = 30.0", "secnds = 30.0", "secnds: unknown key, did you mean 'seconds'"),
        ("speed_mps = 0.25", "speed_mps = nan", "speed_mps"),
        ("speed_mps = 0.25", "speed_mps = -1", "speed_mps"),
        ("seconds = 30.0", 'seconds = "long"', "seconds"),
        ("seconds = 30.0", "seconds = 0.99", "seconds: Input should be greater than or equal to 1"),
        ("seconds = 30.0", 'name = "../x"', "name: the folder of a run is named so; use up to 200 bytes of printable"),
        ("seconds = 30.0", 'name = "x\\u001b[31m"', "without '/'"),
        ("seconds = 30.0", 'name = ""', "name: the folder of a run"),
        ("seconds = 30.0", f'name = "{"圆" * 67}"', "name: the folder of a run"),
        ("turn_deg = 360.0", "turn_deg = 300.0", "does not close"),
        ("distance_m = [0.7, 1.0]", "distance_m = [1.0, 0.7]", "lowest first"),
        ("distance_m = [0.7, 1.0]", "distance_m = [-0.7, 1.0]", "distance_m"),
        ("[start]", "[[walls]]\nstart_m = [1, 1]\nend_m = [1, 1]\n[start]", "no length"),
        ('look = "plain"', 'look = "plane"', "did you mean 'plain'"),
        ("[target]", "[target", "cannot be read as TOML"),
        ("seconds = 30.0", f"seconds = {'9' * 5000}", "cannot be read as TOML"),
        ("seconds = 30.0", f"seconds = {'[' * 5000}", "cannot be read as TOML"),
    ],
)
def test_bad_scenario_file_is_one_line_that_names_the_key(tmp_path, old, new, expected):
    text = (load_scenario.__globals__["SCENARIOS"] / "circle.toml").read_text()
    assert old in text
    file = tmp_path / "mine.toml"
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        load_scenario(str(file))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_shortest_scenario_and_longest_name_are_accepted(tmp_path):
    file = write(tmp_path, f'\N{BYTE ORDER MARK}extends = "static"\nseconds = 1\nname = "{"圆" * 66}"\n')
    assert (load_scenario(file).seconds, len(load_scenario(file).name)) == (1.0, 66)


def test_file_that_cannot_be_read_is_not_invalid_toml(tmp_path):
    with pytest.raises(ConfigError, match=f"cannot read {tmp_path}: Is a directory; name a TOML file that you may"):
        read_table(tmp_path)


def write(folder, text):
    file = folder / "mine.toml"
    file.write_text(text)
    return str(file)


def test_bounds_are_inherited_merged_and_dropped_one_by_one(tmp_path):
    text = 'extends = "static"\n[bounds]\nacquired_s = 2\ndistance_rms_m = "off"\nfound_s = 1.5\n'
    inherited = load_scenario("static").bounds
    assert load_scenario(write(tmp_path, 'extends = "static"')).bounds == inherited != {}
    assert load_scenario(write(tmp_path, 'extends = "static"\nbounds = {}')).bounds == {}
    mine = load_scenario(write(tmp_path, text)).bounds
    assert mine == {**{name: inherited[name] for name in inherited if name != "distance_rms_m"},
                    "acquired_s": 2.0, "found_s": 1.5}


@pytest.mark.parametrize(("extends", "bounds", "expected"), [
    ("static", "aquired_s = 2", "bounds: unknown figure 'aquired_s', did you mean 'acquired_s'?"),
    ("static", 'aquired_s = "off"', "did you mean 'acquired_s'?"),
    ("legs", "least_distance_m = 1.2\nmost_distance_m = 0.9", "least_distance_m 1.2 exceeds most_distance_m 0.9"),
    ("legs", "least_distance_m = 1.2", "least_distance_m 1.2 exceeds most_distance_m 1; no run"),
    ("legs", "least_ever_m = 1.2", "least_ever_m 1.2 exceeds most_distance_m 1; no run"),
    ("thymio", "given_up_s = 9", 'reached_s and given_up_s exclude each other; set one to "off"'),
    ("static", "reached_s = 9", "bounds.reached_s needs goals_m, which this scenario does not have"),
    ("static", "least_crossings = 1", "bounds.least_crossings needs a [light]"),
    ("static", "least_ever_m = 1", 'bounds.least_ever_m needs a target of shape "legs"'),
    ("static", "found_s = nan", "bounds.found_s"), ("static", "found_s = -1", "bounds.found_s"),
    ("static", 'found_s = "late"', "bounds.found_s"),
])
def test_bounds_that_cannot_be_checked_are_one_line(tmp_path, extends, bounds, expected):
    with pytest.raises(ConfigError) as caught:
        load_scenario(write(tmp_path, f'extends = "{extends}"\n[bounds]\n{bounds}\n'))
    assert expected in str(caught.value) and "Value error" not in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_a_scenario_may_write_its_own_look(tmp_path):
    text = (load_scenario.__globals__["SCENARIOS"] / "static.toml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("look")]
    file = tmp_path / "mine.toml"
    file.write_text("\n".join([*lines, "[look]", "exposure = 0.25"]))
    scenario = load_scenario(str(file))
    assert scenario.name == "mine"
    assert scenario.look.exposure == 0.25


@given(st.floats(0, 100), st.floats(0, 0.05))
def test_a_target_on_a_path_never_jumps(distance_m, ahead_m):
    for name in ("circle", "eight", "walls"):
        target = load_scenario(name).target
        assert isinstance(target, OnPath)
        path = target.closed_path()
        here, there = path.at(distance_m), path.at(distance_m + ahead_m)
        assert math.hypot(there.x_m - here.x_m, there.y_m - here.y_m) <= ahead_m + 1e-5


@given(st.floats(0.1, 5), st.floats(-3, 3))
def test_a_circle_ends_where_it_began(radius_m, heading_rad):
    path = ClosedPath(Place(1.0, 2.0, heading_rad), (PathLeg(length_m=math.tau * radius_m, turn_deg=360),))
    half = path.at(path.length_m / 2)
    assert math.hypot(half.x_m - 1.0, half.y_m - 2.0) == pytest.approx(2 * radius_m)
    assert path.at(path.length_m * 3)[:2] == pytest.approx((1.0, 2.0), abs=1e-6)


@given(st.lists(st.floats(-200, 200), min_size=1, max_size=20))
def test_a_motor_keeps_its_acceleration_and_speed_limits(wanted):
    wheels = load_robot("raspberry").wheels
    motor, before = Motor(wheels, STEP_S, "1"), 0.0
    most_change = wheels.max_accel_mps2 / wheels.radius_m * STEP_S
    for speed in wanted:
        motor.set(speed)
        for _ in range(10):
            now = motor.step()
            assert abs(now - before) <= most_change + 1e-9
            assert abs(now) <= wheels.max_rad_s + 1e-9
            before = now


def test_a_motor_reaches_and_keeps_what_it_was_given():
    motor = Motor(load_robot("raspberry").wheels, STEP_S, "1")
    motor.set(10.0)
    speeds = [motor.step() for _ in range(500)]
    assert speeds[-1] == pytest.approx(10.0, abs=1e-3)
    assert speeds == sorted(speeds)


@pytest.mark.parametrize("speed", [math.nan, math.inf, -math.inf])
def test_motor_rejects_a_speed_that_is_not_finite(speed):
    with pytest.raises(ValueError, match="wheel speed"):
        Motor(load_robot("raspberry").wheels, STEP_S, "1").set(speed)


@given(st.floats(-100, 100))
def test_an_encoder_counts_whole_steps_and_is_less_than_one_off(turned_rad):
    wheels = load_robot("raspberry").wheels
    motor = Motor(wheels, STEP_S, "1")
    motor.rolled(turned_rad)
    step_rad = math.tau / wheels.encoder_steps
    assert motor.angle_rad / step_rad == pytest.approx(round(motor.angle_rad / step_rad), abs=1e-6)
    assert -1e-9 <= turned_rad - motor.angle_rad < step_rad + 1e-9


@pytest.mark.parametrize(("rate_hz", "seconds"), [(30, 10), (10, 10), (100, 3), (7, 10)])
def test_a_cadence_keeps_its_rate_on_average(rate_hz, seconds):
    cadence = PeriodicTimer(1e6 / rate_hz)
    due = [now_us for now_us in range(4000, seconds * 1_000_000 + 4000, 4000) if cadence.due(now_us)]
    assert abs(len(due) - rate_hz * seconds) <= 1
    gaps_us = [b - a for a, b in pairwise(due)]
    assert max(gaps_us) - min(gaps_us) <= 4000


def captures(waits_us, seconds):
    """Return the times of the images of a camera that requests each one a wait after the one before."""
    timer, requested_us, drawn_us = CaptureTimer(1e6 / 30), 0, []
    for now_us in range(4000, seconds * 1_000_000 + 4000, 4000):
        if timer.due(now_us, requested=now_us >= requested_us):
            requested_us = now_us + waits_us[len(drawn_us) % len(waits_us)]
            drawn_us.append(now_us)
    return drawn_us


@pytest.mark.parametrize("wait_us", range(32_000, 40_001, 1000))
def test_a_camera_that_is_slightly_late_does_not_lose_every_second_image(wait_us):
    assert len(captures([wait_us], 10)) >= 200, "every second image: 150"


@given(st.lists(st.integers(0, 120_000), min_size=1))
def test_a_capture_is_of_the_begin_of_its_period_and_the_only_one_of_it(waits_us):
    drawn_us = captures(waits_us, 3)
    periods = [int(now_us * 30 / 1e6) for now_us in drawn_us]
    assert len(set(periods)) == len(periods)
    late_us = [now_us - period * 1e6 / 30 for now_us, period in zip(drawn_us, periods, strict=True)]
    assert max(late_us) <= 8_000 + 4_000, "a step of the physics is 4 ms"
