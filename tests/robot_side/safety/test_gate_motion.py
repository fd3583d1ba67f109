"""The motion of the wheels: the promised stop, limits per elapsed time, every state and transition."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import STILL, State, Twist, Verb
from sightline.robot_side.safety.limits import (
    STOP_DISTANCE_BOUND_M,
    STOP_TIME_BOUND_US,
    Ramp,
    SafetyConfig,
    clamp_twist,
    stop_bound,
)
from sightline.robot_side.safety.states import TRANSITIONS, Event, is_armed, next_state
from tests.fixtures.safety import HUMAN, MS, VISION, Rig


def refusal(rig, verb, **kwargs):
    with pytest.raises(WireError) as caught:
        rig.request(verb, **kwargs)
    return caught.value.reason


# --- the stop, as promised ---------------------------------------------------------------------------------------


@settings(max_examples=60)
@given(
    linear=st.floats(-0.5, 0.5),
    angular=st.floats(-2.5, 2.5),
    ticks_ms=st.lists(st.floats(5, 30), min_size=60, max_size=60),
    age_ms=st.floats(0, 120),
)
def test_silence_stops_within_the_bounds(linear, angular, ticks_ms, age_ms):
    rig = Rig().armed()
    for _ in range(80):
        rig.offer(linear, angular, age_ms=age_ms)
        rig.step()
    last_us, way_m, zero_us = rig.now_us, 0.0, None
    for tick_ms in [*ticks_ms, *[20.0] * 40]:
        before_us, speed = rig.now_us, abs(rig.gate.applied.linear_mps)
        twist = rig.step(tick_ms).twist
        way_m += speed * (rig.now_us - before_us) / 1e6
        zero_us = rig.now_us if twist == STILL and zero_us is None else zero_us
    assert zero_us is not None and zero_us - last_us <= STOP_TIME_BOUND_US
    assert way_m <= STOP_DISTANCE_BOUND_M


TUNED = [
    {},
    {"max_jerk_mps3": 8.0, "max_linear_mps": 0.4},
    {"max_linear_mps": 0.55, "max_acceleration_mps2": 3.0, "max_jerk_mps3": 12.0},
    {"max_linear_mps": 0.12, "max_angular_rad_s": 0.6, "motor_lag_ms": 80},
    {"max_angular_rad_s": 9.0, "max_acceleration_rad_s2": 30.0},
]


@pytest.mark.parametrize("step_ms", [2, 20])
@pytest.mark.parametrize("changes", TUNED, ids=str)
def test_the_stop_bound_holds_for_motors_that_lag_however_often_the_gate_is_stepped(changes, step_ms):
    """The gate is stepped every 2 ms while commands arrive, also rejected ones."""
    rig = Rig(**changes).armed()
    config = rig.gate.config
    rig.drive(1_500, config.max_linear_mps, config.max_angular_rad_s)
    rig.offer(config.max_linear_mps, config.max_angular_rad_s)
    bound, last_us, way_m = stop_bound(config), rig.now_us, 0.0
    wheels_mps, turning_rad_s = rig.gate.applied.linear_mps, rig.gate.applied.angular_rad_s
    assert wheels_mps == pytest.approx(config.max_linear_mps)
    assert turning_rad_s == pytest.approx(config.max_angular_rad_s)
    follows = -math.expm1(-0.25 / config.motor_lag_ms)
    while (rig.gate.applied != STILL or wheels_mps > 0.02 * config.max_linear_mps
           or turning_rad_s > 0.02 * config.max_angular_rad_s):
        for _ in range(step_ms * 4):
            wheels_mps += (rig.gate.applied.linear_mps - wheels_mps) * follows
            turning_rad_s += (rig.gate.applied.angular_rad_s - turning_rad_s) * follows
            way_m += wheels_mps * 0.25e-3
        rig.step(step_ms)
        ramped = rig.gate.applied == STILL
        assert ramped or rig.now_us - last_us < bound.ramped_us
    assert rig.now_us - last_us <= bound.zero_us and way_m <= bound.distance_m


def test_the_default_configuration_keeps_its_bound_with_room():
    bound = stop_bound(SafetyConfig())
    assert bound.falls_us <= 340_000 and bound.zero_us <= 600_000 and bound.distance_m <= 0.2


@pytest.mark.parametrize(
    "broken",
    [
        {"max_linear_mps": 1.0},
        {"silence_ms": 900, "zero_speed_age_ms": 900},
        {"max_acceleration_mps2": 0.3},
        {"max_acceleration_rad_s2": 1.0},
        {"full_speed_age_ms": 400},
        {"max_jerk_mps3": 0.5},
    ],
)
def test_configuration_that_breaks_the_bound_is_rejected(broken):
    with pytest.raises(ValueError, match=r"700 ms|must be below"):
        SafetyConfig(**broken)


def test_a_slow_link_may_have_a_longer_age_at_a_lower_speed():
    SafetyConfig(zero_speed_age_ms=800, full_speed_age_ms=300, max_linear_mps=0.35, max_acceleration_mps2=2.0)


# --- limits per elapsed time -------------------------------------------------------------------------------------


@settings(max_examples=100)
@given(
    goals=st.lists(st.tuples(st.floats(-5, 5), st.floats(-9, 9)), min_size=1, max_size=8),
    ticks_ms=st.lists(st.floats(1, 60), min_size=10, max_size=40),
)
def test_speed_acceleration_and_its_sign_stay_within_limits(goals, ticks_ms):
    config = SafetyConfig()
    ramp, before = Ramp(config), STILL
    for index, tick_ms in enumerate(ticks_ms):
        linear, angular = goals[index * len(goals) // len(ticks_ms)]
        goal = clamp_twist(
            Twist(linear_mps=linear, angular_rad_s=angular), config.max_linear_mps, config.max_angular_rad_s
        )
        twist = ramp.step(goal, round(tick_ms * MS))
        dt_s = round(tick_ms * MS) / 1e6
        # One jerk step of slack: the ramp snaps to a goal nearer than that.
        assert abs(twist.linear_mps - before.linear_mps) <= config.max_acceleration_mps2 * dt_s + 0.01
        assert abs(twist.angular_rad_s - before.angular_rad_s) <= config.max_acceleration_rad_s2 * dt_s + 0.1
        assert abs(twist.linear_mps) <= config.max_linear_mps + 1e-9
        assert abs(twist.angular_rad_s) <= config.max_angular_rad_s + 1e-9
        before = twist


def test_twist_as_large_as_a_float_drives_at_the_limit():
    rig = Rig().armed().drive(1_000, 1e308)
    assert rig.gate.applied == Twist(linear_mps=rig.gate.config.max_linear_mps, angular_rad_s=0.0)
    assert rig.gate.counters["CLAMPED"] == 50


def test_late_step_moves_as_far_as_several_punctual_steps():
    goal = Twist(linear_mps=0.5, angular_rad_s=0.0)
    late, punctual = Ramp(SafetyConfig()), Ramp(SafetyConfig())
    for _ in range(5):
        expected = punctual.step(goal, 20_000)
    assert late.step(goal, 100_000) == expected


def test_the_ramp_does_not_overshoot():
    ramp, goal = Ramp(SafetyConfig()), Twist(linear_mps=0.37, angular_rad_s=-1.3)
    for _ in range(60):
        twist = ramp.step(goal, 20_000)
        assert twist.linear_mps <= 0.37 + 1e-12 and twist.angular_rad_s >= -1.3 - 1e-12
    assert twist == goal


def test_out_of_range_is_accepted_clamped_and_counted():
    rig = Rig().armed()
    assert rig.offer(48.0, 24.0).accepted
    assert rig.gate.counters["CLAMPED"] == 1
    rig.drive(1500, 48.0, 24.0)
    assert rig.gate.applied.linear_mps == pytest.approx(0.5)
    assert rig.gate.applied.angular_rad_s == pytest.approx(0.25)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_number_that_is_not_finite_never_reaches_the_ramp(value):
    rig = Rig().armed()
    twist = Twist.model_construct(linear_mps=value, angular_rad_s=0.0)
    assert rig.gate.offer("vision", rig.header(), twist, rig.now_us).reason is RejectReason.NOT_FINITE


# --- states ------------------------------------------------------------------------------------------------------


def test_nothing_but_arming_leads_from_off_to_armed():
    for (state, event), to in TRANSITIONS.items():
        if is_armed(to) and not is_armed(state):
            assert (state, event) == (State.DISARMED, Event.ARM)
        if state is State.STOPPED:
            assert to in (State.STOPPED, State.DISARMED)
    assert all(next_state(state, Event.STOP) is State.STOPPED for state in State)


@settings(max_examples=60)
@given(
    st.lists(
        st.sampled_from(["offer", "old", "step", "gap", "stop", "reset", "arm", "disarm", "teleop", "fault"]),
        max_size=60,
    )
)
def test_wheels_turn_only_on_a_live_command_in_an_armed_state(actions):
    rig = Rig(auto_arm=True)
    last_good_us = -(10**9)
    for action in actions:
        try:
            if action in ("offer", "teleop"):
                verdict = rig.offer(
                    0.5,
                    source="teleop" if action == "teleop" else "vision",
                    session=HUMAN if action == "teleop" else VISION,
                )
                last_good_us = rig.now_us if verdict.accepted else last_good_us
            elif action == "old":
                assert not rig.offer(age_ms=500).accepted
            elif action == "fault":
                rig.gate.fault("broken")
            elif action in ("step", "gap"):
                rig.step(20 if action == "step" else 700)
            else:
                rig.request(Verb(action), echo=action not in ("stop", "disarm"))
        except WireError:
            pass
        speed_before = abs(rig.gate.applied.linear_mps)
        decision = rig.step()
        if rig.now_us - last_good_us > STOP_TIME_BOUND_US:
            assert decision.twist == STILL
        if not is_armed(decision.state):
            assert abs(decision.twist.linear_mps) <= speed_before, "never faster while off"
