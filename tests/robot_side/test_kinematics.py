"""Differential drive and odometry: exact on arcs, the curve kept under saturation."""

import math
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sightline.protocol.messages import Twist
from sightline.robot_side.kinematics import (
    DiffDriveConfig,
    EncoderMonitor,
    Odometer,
    WheelMonitor,
    twist_of,
    wheel_speeds,
)
from sightline.robot_side.ports import WheelAngles

DRIVE = DiffDriveConfig()


@given(linear=st.floats(-0.3, 0.3), angular=st.floats(-3, 3))
def test_wheel_speeds_and_back(linear, angular):
    back = twist_of(DRIVE, *wheel_speeds(DRIVE, Twist(linear_mps=linear, angular_rad_s=angular)))
    assert back.linear_mps == pytest.approx(linear, abs=1e-12)
    assert back.angular_rad_s == pytest.approx(angular, abs=1e-12)


@given(linear=st.floats(-50, 50), angular=st.floats(-50, 50))
def test_saturation_keeps_the_curve(linear, angular):
    left, right = wheel_speeds(DRIVE, Twist(linear_mps=linear, angular_rad_s=angular))
    assert max(abs(left), abs(right)) <= DRIVE.max_wheel_rad_s * (1 + 1e-12)
    back = twist_of(DRIVE, left, right)
    assert back.linear_mps * angular == pytest.approx(back.angular_rad_s * linear, abs=1e-6)


@given(linear=st.floats(-0.5, 0.5), angular=st.floats(-2, 2), steps=st.integers(1, 50))
def test_odometry_is_exact_on_an_arc(linear, angular, steps):
    left, right = wheel_speeds(DRIVE, Twist(linear_mps=linear, angular_rad_s=angular))
    odometer, seconds = Odometer(DRIVE), 3.0
    for step in range(steps + 1):
        t = seconds * step / steps
        odometer.update(WheelAngles(left * t, right * t, round(t * 1e6)))
    turned = angular * seconds
    half = turned / 2  # divided by itself, not by `turned`: halving a denormal rounds
    way = linear * seconds * (math.sin(half) / half if half else 1.0)
    x, y, yaw = odometer.pose
    assert x == pytest.approx(way * math.cos(turned / 2), abs=1e-9)
    assert y == pytest.approx(way * math.sin(turned / 2), abs=1e-9)
    assert math.remainder(yaw - turned, math.tau) == pytest.approx(0, abs=1e-9)


def test_readings_that_are_not_newer_are_ignored_and_the_rate_is_measured():
    odometer = Odometer(DRIVE)
    for step in range(20):
        odometer.update(WheelAngles(step * 0.1, step * 0.1, step * 10_000))
        odometer.update(WheelAngles(-99.0, 99.0, step * 10_000 - 1))
    linear, angular = odometer.moving
    assert linear == pytest.approx(10 * DRIVE.wheel_radius_m) and angular == 0
    assert odometer.pose[0] == pytest.approx(1.9 * DRIVE.wheel_radius_m)


@pytest.mark.parametrize("broken", [(math.nan, 0.0), (0.0, math.inf), (math.inf, -math.inf)])
@pytest.mark.parametrize("before", [0, 1, 2])
def test_angle_that_is_not_finite_is_rejected_and_not_stored(broken, before):
    odometer = Odometer(DRIVE)
    for step in range(before):
        odometer.update(WheelAngles(0.1 * step, 0.1 * step, step * 20_000))
    with pytest.raises(ValueError, match="not finite"):
        odometer.update(WheelAngles(*broken, before * 20_000))
    for step in range(before, 6):
        odometer.update(WheelAngles(0.1 * step, 0.1 * step, step * 20_000))
    assert odometer.pose[0] == pytest.approx(DRIVE.wheel_radius_m * 0.1 * 5)
    assert odometer.moving[0] == pytest.approx(5 * DRIVE.wheel_radius_m)


# Every number of the wheels' arithmetic, worked out by hand.


# In binary fractions, so that every expected value is exact.
EXACT_DRIVE = DiffDriveConfig(wheel_radius_m=0.125, track_width_m=0.5, max_wheel_rad_s=8.0)


def twist(linear_mps, angular_rad_s):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def test_the_defaults_are_the_raspberry_pi_class_robot():
    assert DiffDriveConfig().model_dump() == {"wheel_radius_m": 0.035, "track_width_m": 0.174, "max_wheel_rad_s": 22.0}


@pytest.mark.parametrize(
    ("field", "lower", "upper"),
    [("wheel_radius_m", 0.005, 1.0), ("track_width_m", 0.02, 3.0), ("max_wheel_rad_s", 0.1, 500.0)],
)
def test_each_field_is_bounded(field, lower, upper):
    inside, outside = (lower + 1e-6, upper - 1e-6), (lower - 1e-6, lower, upper, upper + 1e-6)
    for value in inside:
        assert getattr(DiffDriveConfig(**{field: value}), field) == value
    for value in outside:
        with pytest.raises(ValidationError):
            DiffDriveConfig(**{field: value})


@pytest.mark.parametrize(
    ("asked", "wheels"),
    [
        ((0.0, 0.0), (0.0, 0.0)),
        ((0.5, 0.0), (4.0, 4.0)),
        ((0.0, 1.0), (-2.0, 2.0)),
        ((0.5, 1.0), (2.0, 6.0)),
        ((-0.25, 0.5), (-3.0, -1.0)),
        ((1.0, 0.0), (8.0, 8.0)),
        ((0.75, 1.0), (4.0, 8.0)),
        ((1.0, 2.0), (8.0 / 3, 8.0)),
        ((2.0, 0.0), (8.0, 8.0)),
        ((-2.0, 4.0), (-8.0, -8.0 / 3)),
        ((0.0, 8.0), (-8.0, 8.0)),
        ((0.0, -8.0), (8.0, -8.0)),
        ((-2.0, -4.0), (-8.0 / 3, -8.0)),
    ],
)
def test_a_twist_turns_the_wheels_within_their_limit(asked, wheels):
    assert wheel_speeds(EXACT_DRIVE, twist(*asked)) == pytest.approx(wheels, rel=1e-14)


def test_just_over_the_limit_is_cut_to_it():
    assert max(wheel_speeds(EXACT_DRIVE, twist(0.999, 0.0))) == pytest.approx(7.992)
    assert max(wheel_speeds(EXACT_DRIVE, twist(1.001, 0.0))) == pytest.approx(8.0, rel=1e-14)


@pytest.mark.parametrize(
    ("wheels", "got"),
    [((4.0, 4.0), (0.5, 0.0)), ((-2.0, 2.0), (0.0, 1.0)), ((2.0, 6.0), (0.5, 1.0)), ((80.0, 0.0), (5.0, -20.0))],
)
def test_and_back_without_a_limit(wheels, got):
    assert twist_of(EXACT_DRIVE, *wheels) == twist(*got)


# --- odometry ----------------------------------------------------------------------------------------------------


def odometer(*readings):
    reckoned = Odometer(EXACT_DRIVE)
    for reading in readings:
        reckoned.update(WheelAngles(*reading))
    return reckoned


def test_nothing_is_known_before_the_second_reading():
    assert odometer().pose == (0.0, 0.0, 0.0) and odometer().moving == (0.0, 0.0)
    one = odometer((5.0, 9.0, 0))
    assert one.pose == (0.0, 0.0, 0.0) and one.moving == (0.0, 0.0)


def test_straight_on():
    assert odometer((0.0, 0.0, 0), (2.0, 2.0, 10)).pose == (0.25, 0.0, 0.0)
    assert odometer((1.0, 1.0, 0), (-1.0, -1.0, 10)).pose == (-0.25, 0.0, 0.0)


def test_on_the_spot():
    assert odometer((0.0, 0.0, 0), (-2.0, 2.0, 10)).pose == (0.0, 0.0, 1.0)


def test_an_arc_ends_on_its_circle():
    # Left wheel still, right one 8 rad: 1 m of arc at 0.5 m track, so 2 rad about a centre 0.25 m to the left.
    x_m, y_m, yaw_rad = odometer((0.0, 0.0, 0), (0.0, 8.0, 10)).pose
    assert (x_m, y_m) == pytest.approx((0.25 * math.sin(2), 0.25 * (1 - math.cos(2))), rel=1e-12)
    assert yaw_rad == 2.0


def test_two_arcs_follow_each_other():
    x_m, y_m, yaw_rad = odometer((0.0, 0.0, 0), (0.0, 4.0, 10), (2.0, 8.0, 20)).pose
    first = (0.25 * math.sin(1), 0.25 * (1 - math.cos(1)))
    # Then 0.375 m of arc over 0.5 rad: radius 0.75, from heading 1 to 1.5.
    second = (0.75 * (math.sin(1.5) - math.sin(1)), 0.75 * (math.cos(1) - math.cos(1.5)))
    assert (x_m, y_m) == pytest.approx((first[0] + second[0], first[1] + second[1]), rel=1e-12)
    assert yaw_rad == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("turned", "yaw"), [(3.125, 3.125), (3.25, 3.25 - math.tau), (-3.25, math.tau - 3.25), (6.25, 6.25 - math.tau)]
)
def test_yaw_stays_within_half_a_turn(turned, yaw):
    assert odometer((0.0, 0.0, 0), (-2 * turned, 2 * turned, 10)).pose[2] == pytest.approx(yaw, rel=1e-12)


@pytest.mark.parametrize(("t_us", "taken"), [(99, False), (100, False), (101, True)])
def test_only_newer_readings_count(t_us, taken):
    reckoned = odometer((0.0, 0.0, 100), (2.0, 2.0, t_us))
    assert (reckoned.pose[0] == 0.25) == taken
    reckoned.update(WheelAngles(4.0, 4.0, 102))
    assert reckoned.pose[0] == 0.5
    again = odometer((0.0, 0.0, 100), (2.0, 2.0, 200), (6.0, 6.0, 100 + t_us))
    assert (again.pose[0] == 0.75) == taken


@pytest.mark.parametrize(("window_us", "known"), [(39_999, False), (40_000, True), (40_001, True)])
def test_the_rate_is_taken_over_40_ms_at_least(window_us, known):
    reckoned = odometer((0.0, 0.0, 1_000), (0.25, 0.75, 1_000 + window_us // 2), (0.5, 1.5, 1_000 + window_us))
    seconds = window_us / 1e6
    expected = (0.125 / seconds, 0.25 / seconds) if known else (0.0, 0.0)
    assert reckoned.moving == pytest.approx(expected, rel=1e-12)


def test_the_next_rate_is_taken_from_where_the_last_ended():
    reckoned = odometer((0.0, 0.0, 0), (1.0, 3.0, 50_000), (2.0, 5.0, 100_000))
    # 1 and 2 rad in 50 ms: 20 and 40 rad/s; at 0.125 m 2.5 and 5 m/s.
    assert reckoned.moving == pytest.approx((3.75, 5.0), rel=1e-12)
    reckoned.update(WheelAngles(9.0, 9.0, 120_000))
    assert reckoned.moving == pytest.approx((3.75, 5.0), rel=1e-12), "20 ms are too short"
    assert odometer((0.0, 0.0, 0), (1.0, 1.0, 50_000), (1.0, 1.0, 100_000)).moving == (0.0, 0.0)


def test_restart_continues_at_the_same_pose_and_rate_from_another_reading():
    for left_rad, right_rad in ((1000.0, -1000.0), (0.0, 0.0), (-5.0, 1e6)):
        jumped, straight = odometer((0.0, 0.0, 0), (1.0, 3.0, 50_000)), odometer((0.0, 0.0, 0), (1.0, 3.0, 50_000))
        jumped.restart(WheelAngles(left_rad, right_rad, 100_000))
        assert (jumped.pose, jumped.moving) == (straight.pose, straight.moving)
        jumped.update(WheelAngles(left_rad + 1.0, right_rad + 2.0, 150_000))
        straight.update(WheelAngles(2.0, 5.0, 100_000))
        assert jumped.pose == pytest.approx(straight.pose) and jumped.moving == pytest.approx(straight.moving)


# --- encoders that contradict the commands -----------------------------------------------------------------------


def doubts_of(speed_of, angle_of, drive=DRIVE, seconds=12.0, read_s=0.02, own_time=True, side=0):
    """All that the monitor finds at 50 Hz; `angle_of` maps the true angle and the time to that of the encoder."""
    monitor, true, speed, found, reading = EncoderMonitor(drive), [0.0, 0.0], 0.0, [], None
    for now_us in range(0, round(seconds * 1e6), 20_000):
        for wheel in (0, 1):
            true[wheel] += speed * 0.02
        if reading is None or now_us >= reading[1] + read_s * 1e6:
            angles = true[:]
            angles[side] = angle_of(true[side], now_us / 1e6)
            reading = angles, now_us
        wheels = WheelAngles(*reading[0], reading[1] if own_time else now_us)
        found += [(now_us / 1e6, doubt) for doubt in [monitor.look((speed, speed), wheels, now_us)] if doubt]
        speed = speed_of(now_us / 1e6)
    return found


SPEEDS = [0.3, 2.0, 8.0, 14.0, 22.0, -0.3, -14.0, -22.0]


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("steps", [12, 360, 4096])
@pytest.mark.parametrize(("read_s", "own_time"), [
    (0.02, True), (0.1, True), (0.1, False), (0.3, False), (1.0, False), (1.0, True),
])
def test_encoders_that_are_coarse_or_slow_are_not_doubted(speed, steps, read_s, own_time):
    step_rad = math.tau / steps
    assert not doubts_of(lambda _: speed, lambda true, _: true // step_rad * step_rad, read_s=read_s, own_time=own_time)


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("lag_s", [0.05, 0.2, 0.3])
def test_motors_that_lag_and_change_direction_are_not_doubted(speed, lag_s):
    turned = []

    def lags(true, _):
        turned.append(true)
        return turned[max(0, len(turned) - 1 - round(lag_s / 0.02))]

    for period_s in (1.0, 3.0, 60.0):
        turned.clear()
        assert not doubts_of(lambda at_s, half_s=period_s / 2: speed * (-1) ** (at_s // half_s), lags)


@pytest.mark.parametrize("factor", [0.1005, 0.2, 0.5, 1.8])
def test_wheel_that_slips_or_has_a_wrong_radius_is_not_doubted(factor):
    for speed in SPEEDS:
        assert not doubts_of(lambda _, speed=speed: speed, lambda true, _: factor * true)


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize(("factor", "words"), [
    (0.0, "is it blocked"), (0.0995, "is it blocked"), (0.05, "is it blocked"),
    (-0.05, "is it blocked"), (-0.5, "wires"), (-1.0, "wires"),
])
def test_wheel_that_stands_still_or_runs_backwards_is_named_after_2_s_and_a_turn(side, factor, words):
    for speed in SPEEDS:
        least_s = max(2.0, math.tau / abs(speed))
        ((at_s, doubt),) = doubts_of(
            lambda _, speed=speed: speed, lambda true, _: factor * true, seconds=least_s + 0.1, side=side)
        assert least_s <= at_s
        assert doubt.startswith(f"{('left', 'right')[side]} wheel turned ") and words in doubt and ";" in doubt
        assert f" where {math.copysign(at_s * abs(speed), speed):.2g}"[:4] in doubt


@pytest.mark.parametrize("own_time", [False, True])
def test_encoder_that_froze_with_its_time_is_named(own_time):
    found = doubts_of(lambda _: 10.0, lambda true, _: true, read_s=1e6, own_time=own_time, seconds=4.5)
    assert [at_s for at_s, _ in found] == [2.0, 4.0]
    assert all("left" in doubt and "right" in doubt for _, doubt in found)


@pytest.mark.parametrize("gap_s", [60, 3600])
def test_wheel_of_a_robot_that_was_suspended_while_it_drove_is_not_doubted(gap_s):
    monitor, angle_rad = EncoderMonitor(DRIVE), 0.0
    for at_us in [*range(0, 1_000_000, 20_000), *range(gap_s * 1_000_000, gap_s * 1_000_000 + 9_000_000, 20_000)]:
        assert not monitor.look((8.0, 8.0), WheelAngles(angle_rad, angle_rad, at_us), at_us)
        angle_rad += 8.0 * 0.02


@pytest.mark.parametrize(("age_us", "is_old"), [(-1_000_000, False), (0, False), (1_000_000, False), (1_000_001, True)])
def test_new_readings_of_another_clock_are_named_and_an_old_reading_is_not(age_us, is_old):
    monitor = EncoderMonitor(DRIVE)
    for at_us in range(5_000_000, 6_000_000, 20_000):
        doubt = monitor.look((0.0, 0.0), WheelAngles(0.0, 0.0, at_us - age_us), at_us)
        assert bool(doubt) is (is_old and at_us > 5_000_000), "the first reading may be an old one"
        assert doubt in ("", "a new reading of the wheels is 1 s old; take the robot's clock, in microseconds")
    held = WheelAngles(0.0, 0.0, 5_980_000 - age_us)
    assert not any(monitor.look((0.0, 0.0), held, at_us) for at_us in range(6_000_000, 9_000_000, 20_000))


@pytest.mark.parametrize("unit_us", [1_000, 1_000_000])
def test_wheel_time_in_another_unit_is_named_at_each_new_reading(unit_us):
    monitor, last, found = EncoderMonitor(DRIVE), None, []
    for at_us in range(3_600_000_000, 3_603_000_000, 20_000):
        doubt = monitor.look((0.0, 0.0), WheelAngles(0.0, 0.0, at_us // unit_us), at_us)
        found.append(bool(doubt) == (last is not None and at_us // unit_us > last))
        last = at_us // unit_us
    assert all(found)


def test_wheel_that_is_not_commanded_is_not_compared():
    """Not even with what was commanded before: an operator may have turned it by hand meanwhile."""
    assert not doubts_of(lambda _: 0.0, lambda true, at_s: true - 3 * at_s)
    assert not doubts_of(lambda at_s: 8.0 * (at_s % 2 < 1.5), lambda *_: 0.0)


@pytest.mark.parametrize("jump", [-1000.0, -math.tau, math.tau, 5.5, 1e300])
@pytest.mark.parametrize("speed", [0.0, 0.4, 2.0])
def test_encoder_that_jumps_or_wraps_is_named_once(jump, speed):
    [(at_s, doubt)] = doubts_of(lambda _: speed, lambda true, at_s: true + jump * (at_s >= 3), seconds=4)
    assert at_s == 3.0 and doubt.startswith("left wheel jumped by ") and "look for a loose wire" in doubt


@pytest.mark.parametrize("jumps", [(9.0, 0.0), (0.0, -9.0), (9.0, 9.0)])
def test_jump_of_either_wheel_is_known_until_the_next_reading(jumps):
    monitor, seen = EncoderMonitor(DRIVE), []
    for t_us, angles in ((0, (0.0, 0.0)), (20_000, (0.0, 0.0)), (40_000, jumps), (60_000, jumps)):
        monitor.look((0.0, 0.0), WheelAngles(*angles, t_us), t_us)
        seen.append(monitor.jumped)
    assert seen == [False, False, True, False]


@pytest.mark.parametrize("speed", [22.0, -22.0])
def test_jump_of_an_encoder_that_stood_still_while_it_was_commanded_is_named(speed):
    """Twice the commanded turn may be true; a wheel that was named as standing still begins again."""
    for at_s, jump, is_found in ((0.5, 20.0, False), (0.5, 25.0, True), (2.5, 25.0, True), (8.5, 25.0, True)):
        stuck = partial(lambda _, now_s, at_s, jump: jump * (now_s >= at_s), at_s=at_s, jump=jump)
        found = doubts_of(lambda _: speed, stuck, seconds=at_s + 0.1)
        assert any("jumped" in doubt for _, doubt in found) is is_found


@pytest.mark.parametrize("max_rad_s", [5.0, 22.0, 100.0])
@pytest.mark.parametrize("read_s", [0.02, 0.5])
def test_a_jump_is_what_twice_the_fastest_wheel_could_not_turn(max_rad_s, read_s):
    drive = DiffDriveConfig(max_wheel_rad_s=max_rad_s)
    bound = 2 * max_rad_s * max(read_s, 0.1) + 0.5
    for angle_rad, is_found in ((0.999 * bound, False), (1.001 * bound, True)):
        found = doubts_of(
            lambda _: 0.0, lambda _, at_s, angle_rad=angle_rad: angle_rad * (at_s >= 3), drive, read_s=read_s)
        assert bool(found) is is_found


def wheel(*looks, max_rad_s=10.0):
    """Return what the monitor of one wheel finds at each (commanded rad, angle rad, time of the reading us, now us)."""
    monitor = WheelMonitor(max_rad_s)
    return [(monitor.look(*look), monitor.jumped) for look in looks]


NOTHING = ("", False)


@pytest.mark.parametrize(("commanded_rad", "now_us", "is_found"), [
    (math.tau, 2_000_000, True), (-math.tau, 2_000_000, True), (math.tau, 1_999_999, False),
    (math.nextafter(math.tau, 0.0), 2_000_000, False),
])
def test_wheel_is_compared_from_2_s_and_a_turn_on(commanded_rad, now_us, is_found):
    ((doubt, _),) = wheel((commanded_rad, 0.0, 0, now_us))
    assert doubt.startswith("turned ") is is_found
    ((_, _), (doubt, jumped)) = wheel((0.0, 1000.0, 0, 0), (commanded_rad, 1000.0, now_us, now_us))
    assert not jumped and doubt.startswith("turned 0 rad where ") is is_found


@pytest.mark.parametrize(("turned_rad", "words"), [(1.0, ""), (0.99, "blocked"), (-0.99, "blocked"), (-1.0, "wires")])
def test_tenth_of_the_commanded_turn_is_enough(turned_rad, words):
    _, (doubt, _) = wheel((0.0, 0.0, 0, 0), (10.0, turned_rad, 2_000_000, 2_000_000))
    assert words in doubt and bool(doubt) is bool(words)


@pytest.mark.parametrize(("max_rad_s", "unseen_rad", "bound_rad"), [(10.0, 0.0, 2.5), (10.0, 5.0, 10.5)])
def test_jump_is_more_than_its_bound(max_rad_s, unseen_rad, bound_rad):
    first = (unseen_rad, 0.0, 0, 0)
    for sign in (1, -1):
        assert wheel(first, (0.0, sign * bound_rad, 20_000, 20_000), max_rad_s=max_rad_s) == [NOTHING, NOTHING]
        more_rad = sign * math.nextafter(bound_rad, 99.0)
        _, (doubt, jumped) = wheel(first, (0.0, more_rad, 20_000, 20_000), max_rad_s=max_rad_s)
        assert jumped and doubt.startswith("jumped by ")


def test_readings_closer_than_100_ms_count_as_100_ms_apart():
    for angle_rad, is_found in ((200_000.0, False), (200_001.0, True)):
        _, (_, jumped) = wheel((0.0, 0.0, 0, 0), (0.0, angle_rad, 20_000, 20_000), max_rad_s=1e6)
        assert jumped is is_found


@pytest.mark.parametrize("t_us", [99, 100])
def test_reading_that_is_not_newer_is_ignored(t_us):
    assert wheel((0.0, 0.0, 100, 100), (0.0, 9.0, t_us, 200), (0.0, 0.0, 101, 300)) == [NOTHING] * 3


def test_jump_is_named_also_when_the_wheel_is_compared():
    _, (doubt, _) = wheel((0.0, 0.0, 0, 0), (7.0, 100.0, 20_000, 2_000_000))
    assert doubt.startswith("jumped by 100 rad")


def test_wheel_that_turned_as_commanded_may_not_jump_afterwards():
    seen = wheel((0.0, 0.0, 0, 0), (7.0, 7.0, 20_000, 2_000_000), (0.0, 8.0, 40_000, 2_020_000), max_rad_s=1.0)
    assert [jumped for _, jumped in seen] == [False, False, True]


@pytest.mark.parametrize(("factor", "is_found"), [(1 - 5e-6, False), (1 + 5e-6, True)])
def test_robot_that_was_suspended_was_commanded_for_100_ms(factor, is_found):
    monitor, stuck, speed_rad_s = EncoderMonitor(DRIVE), WheelAngles(0.0, 0.0, 0), factor * math.tau / 0.1
    assert not monitor.look((1e6, -1e6), stuck, 0), "nothing was commanded before the first reading"
    assert bool(monitor.look((speed_rad_s, 0.0), stuck, 2_000_000)) is is_found
    assert not EncoderMonitor(DRIVE).look((1e6, -1e6), stuck, 2_000_000)
