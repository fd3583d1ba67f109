"""Every number of the gate's limits: just inside, at it, just outside. The expected values are worked out by hand."""

import math

import pytest
from pydantic import ValidationError

from sightline.protocol.messages import STILL
from sightline.robot_side.safety.limits import (
    MIN_TICK_US,
    STOP_DISTANCE_BOUND_M,
    STOP_TIME_BOUND_US,
    TICK_US,
    AxisRamp,
    Ramp,
    SafetyConfig,
    StopBound,
    age_factor,
    clamp_twist,
    stop_bound,
)
from tests.fixtures.safety import BOUNDS, DEFAULTS, WHOLE, config, twist

# --- configuration -----------------------------------------------------------------------------------------------


def test_the_defaults_are_as_documented():
    assert SafetyConfig().model_dump() == DEFAULTS
    assert SafetyConfig().max_age_us == 400_000
    assert SafetyConfig.model_validate({}) == SafetyConfig()
    assert config(zero_speed_age_ms=401).max_age_us == 401_000
    assert (TICK_US, MIN_TICK_US, STOP_TIME_BOUND_US, STOP_DISTANCE_BOUND_M) == (20_000, 2_000, 700_000, 0.25)


def field_errors(field, value):
    try:
        SafetyConfig(**{field: value})
    except ValidationError as error:
        return [one["loc"] for one in error.errors() if one["loc"]]  # the stop bound's own error names no field
    return []


@pytest.mark.parametrize(("field", "lower_allowed", "lower", "upper"), BOUNDS)
def test_each_field_is_bounded(field, lower_allowed, lower, upper):
    step = 1 if field.endswith("_ms") or field in WHOLE else 1e-6
    for value, allowed in [
        (lower - step, False),
        (lower, lower_allowed),
        (lower + step, True),
        (upper - step, True),
        (upper, True),
        (upper + step, False),
    ]:
        assert field_errors(field, value) == ([] if allowed else [(field,)]), value


@pytest.mark.parametrize(("full_ms", "zero_ms", "allowed"), [(399, 400, True), (400, 400, False), (401, 400, False)])
def test_the_limit_falls_over_a_time(full_ms, zero_ms, allowed):
    try:
        SafetyConfig(full_speed_age_ms=full_ms, zero_speed_age_ms=zero_ms, max_linear_mps=0.2)
    except ValidationError as error:
        assert not allowed and "full_speed_age_ms must be below zero_speed_age_ms" in str(error)
    else:
        assert allowed


@pytest.mark.parametrize(("lease_ms", "silence_ms", "allowed"), [(299, 300, False), (300, 300, True), (20, 20, True)])
def test_no_command_outlives_the_lease_of_its_driver(lease_ms, silence_ms, allowed):
    try:
        SafetyConfig(lease_ms=lease_ms, silence_ms=silence_ms)
    except ValidationError as error:
        assert not allowed and "lease_ms must be at least silence_ms" in str(error)
    else:
        assert allowed


def test_a_configuration_that_stops_late_is_rejected_with_its_bound():
    late = config(max_acceleration_mps2=0.5)
    bound = stop_bound(late)
    with pytest.raises(ValidationError) as caught:
        SafetyConfig(max_acceleration_mps2=0.5)
    assert f"stops {bound.zero_us // 1000} ms and {bound.distance_m:.3f} m after its last command" in str(caught.value)
    assert "allowed are 700 ms and 0.25 m" in str(caught.value)


@pytest.mark.parametrize(
    ("zero_us", "distance_m", "allowed"),
    [
        (700_000, 0.25, True),
        (700_001, 0.0, False),
        (699_999, 0.2499, True),
        (0, 0.2501, False),
        (0, 0.25000001, False),
    ],
)
def test_the_stop_bound_itself_is_allowed_and_no_more(monkeypatch, zero_us, distance_m, allowed):
    monkeypatch.setitem(
        SafetyConfig._stops_in_time.__globals__, "stop_bound", lambda _: StopBound(0, 0, zero_us, distance_m)
    )
    try:
        SafetyConfig()
    except ValidationError:
        assert not allowed
    else:
        assert allowed


# --- age ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("age_us", "factor"),
    [
        (-1, 1.0), (0, 1.0), (149_999, 1.0), (150_000, 1.0), (150_001, 249_999 / 250_000), (275_000, 0.5),
        (399_999, 1 / 250_000), (400_000, 0.0), (400_001, 0.0), (10_000_000, 0.0),
    ],
)  # fmt: skip
def test_the_limit_falls_linearly_with_age(age_us, factor):
    assert age_factor(SafetyConfig(), age_us) == factor


# --- clamping ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "given"),
    [
        ((0.5, 2.5), (0.5, 2.5)),
        ((0.499, 2.499), (0.499, 2.499)),
        ((-0.5, -2.5), (-0.5, -2.5)),
        ((1.0, 1.0), (0.5, 0.5)),
        ((-1.0, 1.0), (-0.5, 0.5)),
        ((0.2, 5.0), (0.1, 2.5)),
        ((0.2, -5.0), (0.1, -2.5)),
        ((1.0, 10.0), (0.25, 2.5)),
        ((2.0, 5.0), (0.5, 1.25)),
        ((0.0, 0.0), (0.0, 0.0)),
        ((1e308, 0.0), (0.5, 0.0)),
        ((0.0, -1e308), (0.0, -2.5)),
        ((-1e308, 1e308), (-0.5, 0.5)),
        ((1e308, 1.0), (0.5, 5e-7)),
    ],
)
def test_both_axes_are_cut_by_one_factor(asked, given):
    cut = clamp_twist(twist(*asked), 0.5, 2.5)
    assert (cut.linear_mps, cut.angular_rad_s) == given


def test_twist_within_limits_is_returned_unchanged():
    asked = twist(0.5, 2.5)
    assert clamp_twist(asked, 0.5, 2.5) is asked
    assert clamp_twist(asked, 0.5 - 1e-12, 2.5) is not asked
    assert clamp_twist(asked, 0.5, 2.5 - 1e-12) is not asked


@pytest.mark.parametrize("limits", [(0.0, 2.5), (0.5, 0.0), (-1.0, 2.5), (0.5, -1.0), (0.0, 0.0)])
def test_a_limit_of_zero_is_standing_still(limits):
    assert clamp_twist(twist(0.3, 0.3), *limits) is STILL


@pytest.mark.parametrize("limits", [(1e-9, 2.5), (0.5, 1e-9)])
def test_a_limit_above_zero_is_not(limits):
    assert clamp_twist(twist(0.3, 0.3), *limits) != STILL


# --- the stop that a configuration implies -----------------------------------------------------------------------


def mean_share(span_ms, lag_ms):
    """Share of a first lag that is left on the average over `span_ms`, and at its end."""
    if lag_ms == 0:
        return 0.0, 0.0
    return -math.expm1(-span_ms / lag_ms) * lag_ms / span_ms, math.exp(-span_ms / lag_ms)


def stop_by_hand(settings, step_ms):
    """The stop worked out on its own: step by step, the lag as the mean over each."""
    speeds, ways = [settings.max_linear_mps, settings.max_angular_rad_s], 0.0
    axes = [AxisRamp(settings.max_acceleration_mps2, settings.max_jerk_mps3)]
    axes.append(AxisRamp(settings.max_acceleration_rad_s2, settings.max_jerk_rad_s3))
    for axis, speed in zip(axes, speeds, strict=True):
        axis.force(speed)
    wheels, falls_ms, ramped_ms, ms = list(speeds), None, None, 0
    mean, end = mean_share(step_ms, settings.motor_lag_ms)
    while ((axes[0].speed, axes[1].speed) != (0.0, 0.0)
           or any(one > 0.02 * top for one, top in zip(wheels, speeds, strict=True))) and ms < 2000:
        ms += step_ms
        span = settings.zero_speed_age_ms - settings.full_speed_age_ms
        share = min(1.0, max(0.0, (settings.zero_speed_age_ms - ms) / span)) if ms <= settings.silence_ms else 0.0
        for axis, speed in zip(axes, speeds, strict=True):
            axis.step(speed * share, step_ms / 1000)
        if falls_ms is None and axes[0].speed < speeds[0]:
            falls_ms = ms
        if ramped_ms is None and (axes[0].speed, axes[1].speed) == (0.0, 0.0):
            ramped_ms = ms
        ways += (axes[0].speed + (wheels[0] - axes[0].speed) * mean) * step_ms / 1000
        wheels = [axis.speed + (one - axis.speed) * end for axis, one in zip(axes, wheels, strict=True)]
    return falls_ms + 20, (ramped_ms or ms) + 20, ms + 20, ways + speeds[0] * 0.02


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"motor_lag_ms": 0},
        {"motor_lag_ms": 20},
        {"motor_lag_ms": 21},
        {"motor_lag_ms": 200},
        {"silence_ms": 100},
        {"silence_ms": 99},
        {"silence_ms": 119, "full_speed_age_ms": 300},
        {"silence_ms": 120, "full_speed_age_ms": 300},
        {"silence_ms": 200, "full_speed_age_ms": 200},
        {"max_angular_rad_s": 10.0, "max_acceleration_rad_s2": 15.0},
        {"max_angular_rad_s": 10.0, "max_acceleration_rad_s2": 30.0, "motor_lag_ms": 100},
        {"max_linear_mps": 0.1, "max_acceleration_mps2": 1.0, "max_jerk_mps3": 5.0},
        {"full_speed_age_ms": 20, "zero_speed_age_ms": 100},
        {"max_linear_mps": 1.5, "max_acceleration_mps2": 9.0, "max_jerk_mps3": 130.0},
        {"silence_ms": 1979, "full_speed_age_ms": 4000, "zero_speed_age_ms": 5000},
        *({"motor_lag_ms": lag_ms} for lag_ms in (34, 85, 96, 134)),
    ],
    ids=str,
)
def test_stop_bound_equals_the_simulated_ramp(changes):
    settings = config(**changes)
    falls_ms, ramped_ms, zero_ms, distance_m = map(max, stop_by_hand(settings, 20), stop_by_hand(settings, 2))
    bound = stop_bound(settings)
    assert (bound.falls_us, bound.ramped_us, bound.zero_us) == (falls_ms * 1000, ramped_ms * 1000, zero_ms * 1000)
    assert bound.distance_m == pytest.approx(distance_m, rel=1e-12)


def test_the_stop_bound_of_the_defaults():
    bound = stop_bound(SafetyConfig())
    assert (bound.falls_us, bound.ramped_us, bound.zero_us) == (180_000, 506_000, 590_000)
    assert bound.distance_m == pytest.approx(0.1959, abs=1e-4)


@pytest.mark.parametrize("changes", [
    {"max_jerk_mps3": 6.0},  # 762 ms
    {"max_linear_mps": 0.6, "max_acceleration_mps2": 3.0, "max_jerk_mps3": 10.0},  # 0.277 m
    {"max_angular_rad_s": 10.0, "max_acceleration_rad_s2": 28.0},  # 708 ms until it does not turn
])
def test_stop_bound_exceeded_in_short_steps_or_in_turning_is_rejected(changes):
    with pytest.raises(ValidationError, match=r"after its last command.* full_speed_age_ms .* jerks"):
        SafetyConfig(**changes)


def test_simulated_stop_ends_after_two_seconds():
    assert stop_bound(config(max_acceleration_mps2=0.01)).zero_us == 2_020_000


# Every number of the gate's ramp, one axis and both: just inside, at it, just outside. Worked out by hand.


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
def test_goal_within_one_jerk_step_is_reached_immediately(sign, error, reached):
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
def test_reversed_goal_brakes_from_zero_acceleration(sign):
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
