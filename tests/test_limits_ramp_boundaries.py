"""Every number of the gate's ramp, one axis and both: just inside, at it, just outside. Worked out by hand."""

import math

import pytest

from sightline.protocol.messages import STILL
from sightline.robot_side.safety.limits import (
    AxisRamp,
    Ramp,
    SafetyConfig,
)
from tests.limits_table import config, twist

# --- one axis ----------------------------------------------------------------------------------------------------


def steps(axis, goal, count, dt_s=0.02):
    return [axis.step(goal, dt_s) for _ in range(count)]


@pytest.mark.parametrize("sign", [1, -1])
def test_from_rest_the_acceleration_grows_by_the_jerk_up_to_its_limit(sign):
    # jerk 20 x 0.02 s = 0.4 m/s2 more each slice, to 2.0; speed gains acceleration x 0.02 s.
    gains, speeds = [0.008, 0.016, 0.024, 0.032, 0.04, 0.04, 0.04], []
    for gain in gains:
        speeds.append((speeds[-1] if speeds else 0.0) + gain)
    assert steps(AxisRamp(2.0, 20.0), sign * 5.0, len(gains)) == pytest.approx([sign * speed for speed in speeds])


def test_half_a_slice_moves_by_its_own_time():
    # jerk 20 x 0.01 s = 0.2 m/s2, x 0.01 s = 0.002 m/s.
    assert AxisRamp(2.0, 20.0).step(5.0, 0.01) == pytest.approx(0.002)
    assert steps(AxisRamp(2.0, 20.0), 5.0, 3, 0.01) == pytest.approx([0.002, 0.006, 0.012])


def test_near_the_goal_the_acceleration_is_what_jerk_can_still_take_back():
    axis = AxisRamp(2.0, 20.0)
    axis.force(0.46)
    # sqrt(2 x 20 x 0.04) = 1.265 is above what jerk allows at once: 0.4, then 0.8, then sqrt(2 x 20 x 0.016) = 0.8.
    assert steps(axis, 0.5, 2) == pytest.approx([0.468, 0.484])
    assert axis.step(0.5, 0.02) == pytest.approx(0.484 + 0.8 * 0.02)
    axis = AxisRamp(2.0, 2000.0)
    axis.force(-0.0004)
    slow = AxisRamp(0.1, 2.0)
    slow.force(0.499)
    # sqrt(2 x 2 x 0.001) = 0.0632 m/s2 is more than jerk 2 x 0.01 s = 0.02: moves 0.0002.
    assert slow.step(0.5, 0.01) == pytest.approx(0.4992)
    # Then 0.04, then sqrt(2 x 2 x 0.0004) = 0.04.
    assert steps(slow, 0.5, 2, 0.01) == pytest.approx([0.4996, 0.5])


def test_the_wanted_acceleration_is_a_square_root():
    axis = AxisRamp(100.0, 8.0)
    axis.force(0.0)
    speeds = steps(axis, 1.0, 400, 0.001)
    # With jerk both ways the speed follows an S: half the way is made when acceleration turns, at sqrt(1 / 8) s.
    half_s = math.sqrt(1 / 8)
    assert speeds[round(half_s * 1000)] == pytest.approx(0.5, abs=0.01)
    assert max(speeds) <= 1.0


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("error", "reached"), [(0.007, True), (0.008, True), (0.0081, False), (0.009, False)])
def test_a_goal_within_one_jerk_step_is_reached_at_once(sign, error, reached):
    axis = AxisRamp(2.0, 20.0)  # 20 x 0.02^2 = 0.008
    axis.force(sign * 0.1)
    goal = sign * (0.1 + error)
    assert (axis.step(goal, 0.02) == goal) == reached


@pytest.mark.parametrize("sign", [1, -1])
def test_a_goal_within_this_step_of_a_moving_axis_is_reached_without_overshoot(sign):
    axis = AxisRamp(2.0, 20.0)
    steps(axis, sign * 5.0, 6)  # at full acceleration: 0.04 in a slice, 0.032 at least with jerk against it
    goal = axis.speed + sign * 0.02
    assert axis.step(goal, 0.02) == goal
    assert axis.step(goal, 0.02) == goal, "and it stays"


def test_a_goal_is_never_reached_faster_than_the_acceleration_allows():
    axis = AxisRamp(0.125, 500.0)  # a jerk step would be 0.2 m/s, the acceleration allows 0.0025 m/s in a slice
    assert steps(axis, 0.15, 2) == pytest.approx([0.0025, 0.005])
    assert axis.step(axis.speed + 0.0024, 0.02) == pytest.approx(0.0074)


def test_reaching_the_goal_ends_the_acceleration():
    axis = AxisRamp(2.0, 20.0)
    steps(axis, 5.0, 6)
    goal = axis.speed + 0.02
    axis.step(goal, 0.02)
    assert axis.step(5.0, 0.02) == pytest.approx(goal + 0.008)
    axis.force(goal - 0.004)
    axis.step(goal, 0.02)
    assert axis.step(-5.0, 0.02) == pytest.approx(goal - 0.008)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_turned_goal_lets_go_at_once_and_brakes_from_zero_acceleration(sign):
    axis = AxisRamp(2.0, 20.0)
    steps(axis, sign * 5.0, 6)
    speed = axis.speed
    assert steps(axis, sign * -5.0, 2) == pytest.approx([speed - sign * 0.008, speed - sign * 0.024])
    little = AxisRamp(2.0, 20.0)  # however small the turn is
    steps(little, sign * 5.0, 6)
    speed = little.speed
    assert little.step(speed - sign * 0.05, 0.02) == pytest.approx(speed - sign * 0.008)


def test_an_axis_at_its_goal_stays_though_it_was_accelerating():
    axis = AxisRamp(2.0, 20.0)
    steps(axis, 5.0, 6)
    goal = axis.speed
    assert steps(axis, goal, 3) == [goal] * 3


def test_a_goal_exactly_one_jerk_step_away_is_reached_and_ends_the_acceleration():
    axis = AxisRamp(1.0, 1.0)  # in binary fractions: 1 x 0.5 x 0.5 = 0.25 to the last bit
    assert axis.step(0.25, 0.5) == 0.25
    assert axis.step(5.0, 0.5) == 0.5


def test_force_continues_from_the_speed_without_acceleration():
    axis = AxisRamp(2.0, 20.0)
    assert axis.speed == 0.0
    steps(axis, 5.0, 6)
    axis.force(0.3)
    assert axis.speed == 0.3
    assert axis.step(5.0, 0.02) == pytest.approx(0.308)


def test_at_the_goal_nothing_moves():
    axis = AxisRamp(2.0, 20.0)
    assert steps(axis, 0.0, 3) == [0.0, 0.0, 0.0]


# --- both axes, per elapsed time ---------------------------------------------------------------------------------


def test_each_axis_has_its_own_limits():
    ramp = Ramp(
        config(max_acceleration_mps2=0.3, max_jerk_mps3=10.0, max_acceleration_rad_s2=3.0, max_jerk_rad_s3=50.0)
    )
    assert_twist(ramp.step(twist(5.0, 50.0), 20_000), 0.004, 0.02)
    assert_twist(ramp.step(twist(5.0, 50.0), 20_000), 0.01, 0.06)
    assert_twist(ramp.step(twist(5.0, 50.0), 20_000), 0.016, 0.12)
    assert_twist(ramp.step(twist(5.0, 50.0), 20_000), 0.022, 0.18)


def assert_twist(got, linear_mps, angular_rad_s):
    assert (got.linear_mps, got.angular_rad_s) == pytest.approx((linear_mps, angular_rad_s), rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    ("elapsed_us", "slices_us"),
    [
        (-1, []),
        (0, []),
        (1, [1]),
        (19_999, [19_999]),
        (20_000, [20_000]),
        (20_001, [20_000, 1]),
        (50_000, [20_000, 20_000, 10_000]),
        (999_999, [20_000] * 49 + [19_999]),
        (1_000_000, [20_000] * 50),
        (1_000_001, [20_000] * 50),
        (60_000_000, [20_000] * 50),
    ],
)
def test_elapsed_time_is_cut_in_slices_and_bounded(elapsed_us, slices_us):
    settings = config(max_linear_mps=3.0)
    ramp, linear, angular = Ramp(settings), AxisRamp(2.0, 20.0), AxisRamp(12.0, 200.0)
    got = ramp.step(twist(3.0, -20.0), elapsed_us)
    for slice_us in slices_us:
        linear.step(3.0, slice_us / 1e6)
        angular.step(-20.0, slice_us / 1e6)
    assert (got.linear_mps, got.angular_rad_s) == (linear.speed, angular.speed)


def test_a_forced_ramp_continues_on_both_axes():
    ramp = Ramp(SafetyConfig())
    ramp.force(twist(0.3, -1.0))
    assert ramp.step(STILL, 0) == twist(0.3, -1.0)
    assert_twist(ramp.step(twist(5.0, 50.0), 20_000), 0.308, -0.92)
