"""The latency estimate and the prediction, with numbers from the equations of motion."""

import math

import pytest

from sightline.protocol.messages import Twist
from sightline.vision_side.config import LatencyConfig
from sightline.vision_side.tracking.prediction import LatencyEstimator, MotionPredictor

HERE = (0.0, 0.0, 0.0)
AT_ONCE = {"actuation_s": 0.0, "linear_acceleration_mps2": 50.0, "angular_acceleration_rad_s2": 200.0}
"""A robot that reaches what is commanded within one step of the prediction."""


def twist(linear_mps, angular_rad_s=0.0):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def predictor_of(latency_s, sent=(), **config):
    """Return a predictor that knows this latency; `sent` are (time in us, m/s, rad/s)."""
    made = MotionPredictor(LatencyConfig(first_guess_s=latency_s, **{"actuation_s": 0.0, **config}))
    for t_us, linear, angular in sent:
        made.sent(t_us, twist(linear, angular))
    return made


# --- the latency -------------------------------------------------------------------------------------------------


def test_latency_is_the_measured_one_up_to_its_bound_and_the_time_of_the_wheels():
    assert LatencyEstimator(LatencyConfig(first_guess_s=0.1, actuation_s=0.03)).total_s == pytest.approx(0.13)
    bounded = LatencyConfig(first_guess_s=0.5, max_s=0.4, actuation_s=0.03)
    assert LatencyEstimator(bounded).total_s == pytest.approx(0.43)
    assert MotionPredictor(LatencyConfig(first_guess_s=0.1, actuation_s=0.03)).latency_s == pytest.approx(0.13)


@pytest.mark.parametrize(("latency_us", "dt_s", "expected_s"), [
    (None, 0.1, 0.1), (200_000, 0.125, 0.125), (200_000, 0.25, 0.15), (200_000, 0.5, 0.2), (200_000, 0.9, 0.2),
    (20_000, 0.25, 0.06), (900_000, 0.25, 0.25), (0, 0.25, 0.05),
])  # fmt: skip
def test_latency_approaches_the_measured_one_per_elapsed_time(latency_us, dt_s, expected_s):
    """From 0.1 s, with a smoothing time of 0.5 s; a measured one counts up to 0.4 s."""
    config = LatencyConfig(first_guess_s=0.1, smoothing_s=0.5, max_s=0.4, actuation_s=0.0)
    for measured in (LatencyEstimator(config), MotionPredictor(config)):
        measured.measure(latency_us, dt_s)
        total_s = measured.total_s if isinstance(measured, LatencyEstimator) else measured.latency_s
        assert total_s == pytest.approx(expected_s)


# --- what the robot should apply ---------------------------------------------------------------------------------


def test_command_is_expected_on_the_wheels_from_its_latency_on_and_not_before():
    """The latency is in seconds, the times are in microseconds: 0.1 s after the capture at 5 s."""
    predictor = MotionPredictor(LatencyConfig(first_guess_s=0.1))
    predictor.sent(4_000_000, twist(0.1, 0.5))
    predictor.sent(5_000_000, twist(0.2, -0.5))
    assert predictor.expected(4_099_999) is None
    assert predictor.expected(4_100_000) == (0.1, 0.5)
    assert predictor.expected(5_099_999) == (0.1, 0.5)
    assert predictor.expected(5_100_000) == (0.2, -0.5)


def test_the_last_64_commands_are_remembered():
    predictor = predictor_of(0.1, [(seq * 30_000, 0.01 * seq, 0.0) for seq in range(65)])
    assert predictor.expected(129_999) is None, "the first one is forgotten"
    assert predictor.expected(130_000) == (0.01, 0.0)


# --- where the robot will be -------------------------------------------------------------------------------------


def motion(predictor, t_us, *, pose=HERE, moving=(0.0, 0.0), applied=(0.1, 0.0)):
    found = predictor.motion(t_us, pose, moving, applied)
    return found.pose, (found.linear_mps, found.angular_rad_s)


def test_without_commands_the_robot_goes_on_as_it_moves():
    """0.2 s at 0.5 m/s, from a robot that looks left."""
    pose, moving = motion(predictor_of(0.2), 1_000_000, pose=(1.0, 2.0, math.pi / 2), moving=(0.5, 0.0))
    assert pose == pytest.approx((1.0, 2.1, math.pi / 2)) and moving == pytest.approx((0.5, 0.0))


def test_robot_on_a_curve_follows_its_arc():
    """A quarter of a circle of 0.5 m, at 0.5 m/s and 1 rad/s."""
    predictor = predictor_of(0.5, max_s=1.0)
    pose, _ = motion(predictor, 0, pose=(1.0, -1.0, 0.3), moving=(0.5, 1.0))
    arc = (1.0 + 0.5 * (math.sin(0.8) - math.sin(0.3)), -1.0 + 0.5 * (math.cos(0.3) - math.cos(0.8)), 0.8)
    assert pose == pytest.approx(arc, abs=1e-5)


def test_commands_in_flight_act_one_after_the_other():
    """At 1 s, with 0.3 s of latency: 0.05 s of the first, 0.15 s of the second, 0.1 s of the third."""
    predictor = predictor_of(0.3, [(500_000, 0.6, 0.0), (750_000, 0.4, 0.0), (900_000, 0.2, 0.0)], **AT_ONCE)
    pose, moving = motion(predictor, 1_000_000, moving=(0.6, 0.0))
    assert pose == pytest.approx((0.6 * 0.05 + 0.4 * 0.15 + 0.2 * 0.1, 0.0, 0.0))
    assert moving == pytest.approx((0.2, 0.0))


@pytest.mark.parametrize("before_s", [0.2, 0.005])
def test_robot_moves_on_until_the_first_command_acts(before_s):
    predictor = predictor_of(0.3, [(700_000 + round(before_s * 1e6), 0.2, 0.0)], **AT_ONCE)
    pose, moving = motion(predictor, 1_000_000, moving=(0.6, 0.0))
    assert pose == pytest.approx((0.6 * before_s + 0.2 * (0.3 - before_s), 0.0, 0.0))
    assert moving == pytest.approx((0.2, 0.0))


def test_the_oldest_command_of_the_latency_fills_its_whole_time():
    """Sent 0.4 s ago with a latency of 0.3 s: it acts already."""
    predictor = predictor_of(0.3, [(100_000, 5.0, 0.0), (600_000, 0.4, 0.0)], **AT_ONCE)
    assert motion(predictor, 1_000_000, moving=(0.4, 0.0))[0] == pytest.approx((0.12, 0.0, 0.0))


def test_command_of_this_very_moment_does_not_act_within_the_latency():
    for latency_s in (0.3, 0.01):
        predictor = predictor_of(latency_s, [(600_000, 0.4, 0.0), (1_000_000, 9.0, 0.0)], **AT_ONCE)
        pose, moving = motion(predictor, 1_000_000, moving=(0.3, 0.0))
        assert pose == pytest.approx((0.4 * latency_s, 0.0, 0.0)) and moving == pytest.approx((0.4, 0.0))


@pytest.mark.parametrize(("goal", "speed", "way"), [
    # 20 steps of 15 ms, each 0.015 m/s more: the sum of 1 to 20 times 0.015 m/s times 15 ms
    ((9.0, 0.0), 0.3, 210 * 0.015 * 0.015), ((-9.0, 0.0), -0.3, -210 * 0.015 * 0.015),
    # reached after 10 steps
    ((0.15, 0.0), 0.15, (55 + 100) * 0.015 * 0.015),
])  # fmt: skip
def test_speed_changes_by_the_acceleration_of_the_robot(goal, speed, way):
    predictor = predictor_of(0.3, [(0, *goal)], linear_acceleration_mps2=1.0)
    pose, moving = motion(predictor, 1_000_000)
    assert moving[0] == pytest.approx(speed) and pose[0] == pytest.approx(way)


@pytest.mark.parametrize(("goal_rad_s", "rate", "yaw"), [
    (9.0, 0.6, 210 * 0.03 * 0.015), (-9.0, -0.6, -210 * 0.03 * 0.015), (0.3, 0.3, 155 * 0.03 * 0.015),
])  # fmt: skip
def test_turn_rate_changes_by_the_angular_acceleration_of_the_robot(goal_rad_s, rate, yaw):
    predictor = predictor_of(0.3, [(0, 0.0, goal_rad_s)], angular_acceleration_rad_s2=2.0)
    pose, moving = motion(predictor, 1_000_000)
    assert moving[1] == pytest.approx(rate) and pose[2] == pytest.approx(yaw)


@pytest.mark.parametrize(("length_s", "steps"), [(0.0001, 1), (0.0224, 1), (0.0226, 2), (0.0374, 2), (0.0376, 3)])
def test_prediction_steps_by_about_15_ms(length_s, steps):
    """At 1 m/s2 from rest, `steps` steps go (1 + ... + steps) times the square of one."""
    predictor = predictor_of(length_s, [(0, 9.0, 0.0)], linear_acceleration_mps2=1.0)
    pose, _ = motion(predictor, 1_000_000)
    assert pose[0] == pytest.approx(steps * (steps + 1) / 2 * (length_s / steps) ** 2)


@pytest.mark.parametrize(("commanded", "applied", "held"), [
    ((0.3, 0.0), (0.0, 0.0), True), ((0.0, -0.3), (0.0, 0.0), True), ((0.3, 0.0), (1e-6, -1e-6), True),
    ((0.3, 0.0), (1.005e-6, 0.0), False), ((0.3, 0.0), (0.0, -1.005e-6), False),
    ((1e-6, -1e-6), (0.0, 0.0), False), ((0.0, -1.005e-6), (0.0, 0.0), True), ((0.0, 0.0), (0.0, 0.0), False),
])  # fmt: skip
def test_robot_that_applies_nothing_of_what_it_should_stays_where_it_is(commanded, applied, held):
    """HOLD and DISARMED apply no command in flight. Beyond a millionth counts as motion."""
    predictor = predictor_of(0.1, [(0, *commanded), (990_000, 0.5, 0.5)], **AT_ONCE)
    here = (1.0, 2.0, 0.5)
    pose, moving = motion(predictor, 1_000_000, pose=here, moving=(0.4, 0.2), applied=applied)
    assert ((pose, moving) == (here, (0.0, 0.0))) == held


def test_robot_without_a_command_that_should_act_is_not_held():
    pose, _ = motion(predictor_of(0.1), 1_000_000, moving=(0.5, 0.0), applied=(0.0, 0.0))
    assert pose == pytest.approx((0.05, 0.0, 0.0))
