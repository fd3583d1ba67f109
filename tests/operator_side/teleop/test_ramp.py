"""The speeds of teleop and their ramp, command by command: up slowly, down at once, and no leap after a stall."""

import pytest

from sightline.operator_side.teleop.control import Speeds, SpeedUp
from sightline.protocol.messages import STILL, State, Status, Twist

START_US = 7_000_000


def twist(linear_mps=0.0, angular_rad_s=0.0):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def steps(*goals, every_us=50_000):
    """Return (m/s, rad/s) of each command, one for each goal."""
    ramp, found = SpeedUp(), []
    for number, goal in enumerate(goals):
        step = ramp.step(twist(*goal), START_US + number * every_us)
        assert step is ramp.twist
        found.append((step.linear_mps, step.angular_rad_s))
    return found


def near(*expected):
    return [pytest.approx(one) for one in expected]


# --- the ramp ----------------------------------------------------------------------------------------------------


def test_command_after_a_stall_of_the_operators_machine_is_one_bounded_step():
    """The ramp counts 100 ms of a stall: 0.8 m/s2 and 5 rad/s2 give 0.08 m/s and 0.5 rad/s more, not the goal."""
    ramp = SpeedUp()
    first = ramp.step(twist(1.0, 3.0), START_US)
    after = ramp.step(twist(1.0, 3.0), START_US + 2_000_000)
    assert after.linear_mps - first.linear_mps == pytest.approx(0.08)
    assert after.angular_rad_s - first.angular_rad_s == pytest.approx(0.5)


def test_it_begins_at_rest_and_its_first_step_counts_30_ms():
    assert SpeedUp().twist == STILL
    assert steps((1.0, 3.0)) == near((0.024, 0.15))
    assert steps((-1.0, -3.0)) == near((-0.024, -0.15))


def test_each_step_counts_the_time_since_the_one_before_it_up_to_100_ms():
    assert steps((1.0, 3.0), (1.0, 3.0), (1.0, 3.0)) == near((0.024, 0.15), (0.064, 0.4), (0.104, 0.65))
    assert steps((1.0, 3.0), (1.0, 3.0), every_us=100_000)[1] == pytest.approx((0.104, 0.65))
    assert steps((1.0, 3.0), (1.0, 3.0), every_us=100_001)[1] == pytest.approx((0.104, 0.65), abs=1e-9)


def test_time_passes_for_the_ramp_at_rest_too():
    """A key that is pressed after a pause does not leap."""
    assert steps((0.0, 0.0), (1.0, 3.0), every_us=20_000)[1] == pytest.approx((0.016, 0.1))


@pytest.mark.parametrize(("goal", "expected"), [
    ((0.05, 0.3), (0.05, 0.3)),  # slower in the same direction: at once
    ((0.0, 0.0), (0.0, 0.0)),
    ((0.104, 0.65), (0.104, 0.65)),  # the same
    ((0.12, 0.7), (0.12, 0.7)),  # less than one step of 0.04 m/s and 0.25 rad/s
    ((0.144, 0.9), (0.144, 0.9)), ((0.2, 1.2), (0.144, 0.9)),
    ((-0.02, -0.1), (-0.02, -0.1)), ((-1.0, -3.0), (-0.04, -0.25)),  # a reversal starts at zero
])  # fmt: skip
@pytest.mark.parametrize("side", [1, -1])
def test_slower_is_reached_at_once_and_faster_by_steps(goal, expected, side):
    """After three steps it moves at 0.104 m/s and 0.65 rad/s."""
    way = [(side * 1.0, side * 3.0)] * 3
    last = steps(*way, (side * goal[0], side * goal[1]))[-1]
    assert last == pytest.approx((side * expected[0], side * expected[1]))


def test_both_speeds_ramp_on_their_own():
    assert steps((1.0, 0.0), (1.0, 3.0), (0.0, 3.0)) == near((0.024, 0.0), (0.064, 0.25), (0.0, 0.5))


# --- the top speeds ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("change", "expected"), [
    ((1, 0), (0.22, 1.0)), ((-1, 0), (0.2 / 1.1, 1.0)), ((0, 1), (0.2, 1.1)), ((0, -1), (0.2, 1.0 / 1.1)),
    ((1, 1), (0.22, 1.1)), ((0, 0), (0.2, 1.0)),
])  # fmt: skip
def test_a_key_changes_a_speed_by_ten_percent(change, expected):
    speeds = Speeds(0.2, 1.0)
    speeds.change(*change)
    assert (speeds.linear_mps, speeds.angular_rad_s) == pytest.approx(expected)


def test_speeds_stay_between_the_least_and_the_most():
    speeds = Speeds(0.2, 1.0)
    for _ in range(100):
        speeds.change(1, 1)
    assert (speeds.linear_mps, speeds.angular_rad_s) == (3.0, 10.0)
    for _ in range(100):
        speeds.change(-1, -1)
    assert (speeds.linear_mps, speeds.angular_rad_s) == (0.02, 0.1)


def status(max_linear_mps, max_angular_rad_s):
    return Status(
        state=State.HOLD, reason="", max_linear_mps=max_linear_mps, max_angular_rad_s=max_angular_rad_s
    )  # fmt: skip


def test_limits_of_the_robot_lower_the_speeds_and_a_zero_leaves_the_old_limit():
    speeds = Speeds(0.2, 1.0)
    speeds.limit(status(0.15, 0.5))
    assert (speeds.linear_mps, speeds.angular_rad_s) == (0.15, 0.5)
    speeds.limit(status(0.0, 0.0))
    for _ in range(9):
        speeds.change(1, 1)
    assert (speeds.linear_mps, speeds.angular_rad_s) == (0.15, 0.5)
    speeds.limit(status(0.2, 0.0))
    speeds.change(1, 1)
    assert (speeds.linear_mps, speeds.angular_rad_s) == pytest.approx((0.165, 0.5))


def test_limit_below_the_least_speed_is_applied():
    speeds = Speeds(0.2, 1.0)
    speeds.limit(status(0.01, 0.05))
    assert (speeds.linear_mps, speeds.angular_rad_s) == (0.01, 0.05)
    speeds.change(-1, -1)
    assert (speeds.linear_mps, speeds.angular_rad_s) == (0.01, 0.05)
