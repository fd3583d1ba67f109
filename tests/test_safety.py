"""The gate, case by case: each number at its limit, a little under and a little over."""

import array
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import WireError
from protocol.messages import STILL, Echo, Request, RequestHeader, State, Twist, Verb
from protocol.refusals import Refusal
from robot_side.guard import GuardConfig, RangeGuard
from robot_side.limits import (
    STOP_DISTANCE_BOUND_M,
    STOP_TIME_BOUND_US,
    Ramp,
    SafetyConfig,
    age_factor,
    clamp_twist,
    stop_bound,
)
from robot_side.ports import Ranges
from robot_side.states import TRANSITIONS, Event, after, is_armed
from tests.safety_rig import HUMAN, MS, OTHER, ROBOT, VISION, Rig


def refusal(rig, verb, **kwargs):
    with pytest.raises(WireError) as caught:
        rig.request(verb, **kwargs)
    return caught.value.reason


# --- age ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("age_ms", "reason"), [(0, None), (399.999, None), (400, None), (400.001, Refusal.STALE)])
def test_a_command_is_as_old_as_its_frame(age_ms, reason):
    rig = Rig().armed()
    assert rig.offer(age_ms=age_ms).reason == reason


@pytest.mark.parametrize(("ahead_us", "reason"), [(0, None), (1, Refusal.FROM_FUTURE)])
def test_a_frame_of_the_future_is_refused(ahead_us, reason):
    rig = Rig().armed()
    assert rig.offer(age_ms=-ahead_us / MS).reason == reason


@pytest.mark.parametrize(
    ("age_ms", "factor"), [(0, 1), (150, 1), (150.001, 0.999996), (275, 0.5), (399.999, 4e-6), (400, 0)]
)
def test_the_limit_falls_linearly_with_age(age_ms, factor):
    assert age_factor(SafetyConfig(), round(age_ms * MS)) == pytest.approx(factor, abs=1e-7)


def test_age_is_judged_again_at_every_step():
    rig = Rig(silence_ms=399).armed().drive(600)
    assert rig.gate.applied.linear_mps == 0.5
    speeds = [rig.step().twist.linear_mps for _ in range(25)]
    assert speeds == sorted(speeds, reverse=True)
    assert rig.gate.state is State.HOLD and speeds[-1] == 0.0


def test_degraded_keeps_the_curve():
    rig = Rig().armed()
    for _ in range(100):
        rig.offer(0.5, 1.0, age_ms=255)
        decision = rig.step()
    assert decision.state is State.DEGRADED
    assert decision.twist.angular_rad_s / decision.twist.linear_mps == pytest.approx(2.0)
    assert decision.twist.linear_mps == pytest.approx(0.5 * 0.5)


# --- what a command cites ----------------------------------------------------------------------------------------


def test_only_frames_issued_by_this_session_count():
    rig = Rig().armed()
    frame = rig.frame()
    assert rig.offer(header=rig.header(frame.model_copy(update={"session": OTHER}))).reason is Refusal.OTHER_SESSION
    assert rig.offer(header=rig.header(frame.model_copy(update={"seq": 10_000}))).reason is Refusal.UNKNOWN_FRAME
    assert (
        rig.offer(header=rig.header(frame.model_copy(update={"t_us": frame.t_us + 1}))).reason is Refusal.UNKNOWN_FRAME
    )
    status = Echo(channel="status", session=ROBOT, seq=1, t_us=rig.now_us)
    rig.gate.issued.add("status", 1, rig.now_us)
    assert rig.offer(header=rig.header(status)).reason is Refusal.UNKNOWN_FRAME
    assert rig.offer(header=rig.header(frame)).accepted


def test_the_record_is_bounded_and_forgets_the_oldest():
    rig = Rig()
    for seq in range(1000):
        rig.gate.issued.add("frame", seq, rig.now_us)
    assert rig.gate.issued.last_seq("frame") == 999
    old = Echo(channel="frame", session=ROBOT, seq=0, t_us=rig.now_us)
    assert rig.offer(header=rig.header(old)).reason is Refusal.UNKNOWN_FRAME


@pytest.mark.parametrize(("seq", "reason"), [(99, Refusal.OUT_OF_ORDER), (100, Refusal.OUT_OF_ORDER), (101, None)])
def test_sequence_numbers_only_grow(seq, reason):
    rig = Rig().armed()
    assert rig.offer(header=rig.header(seq=100)).accepted
    assert rig.offer(header=rig.header(seq=seq)).reason == reason


def test_a_restarted_vision_starts_its_numbers_over():
    rig = Rig(auto_arm=True).armed().drive(200)
    rig.silence(1100)
    assert rig.offer(header=rig.header(session=OTHER, seq=0)).accepted


def test_refused_commands_refresh_nothing():
    rig = Rig().armed().drive(600)
    stale = rig.frame()
    for _ in range(100):
        rig.offer(header=rig.header(stale, session=OTHER))
        rig.offer(header=rig.header(stale, seq=1))
        rig.step(10)
    assert rig.gate.applied == STILL and rig.gate.state is State.HOLD


# --- sources, lease, ranks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["operator", "status", "vision2", ""])
def test_unknown_sources_do_not_drive(source):
    rig = Rig().armed()
    assert rig.gate.offer(source, rig.header(), STILL, rig.now_us).reason is Refusal.UNKNOWN_SOURCE


def test_key_and_header_must_agree():
    rig = Rig().armed()
    assert rig.gate.offer("teleop", rig.header(source="vision"), STILL, rig.now_us).reason is Refusal.UNKNOWN_SOURCE


def test_guests_are_off_unless_switched_on_and_slow_then():
    guest = Twist(linear_mps=0.5, angular_rad_s=0.0)
    assert Rig().gate.offer("guest", None, guest, 0).reason is Refusal.UNKNOWN_SOURCE
    assert Rig().gate.offer("vision", None, guest, 0).reason is Refusal.MALFORMED
    rig = Rig().armed()
    assert rig.offer(source="guest", session=OTHER).reason is Refusal.UNKNOWN_SOURCE, "with a header too"
    rig = Rig(guests=True)
    for _ in range(5):
        rig.gate.offer("guest", None, guest, rig.now_us)
        rig.step()
    rig.request(Verb.ARM)
    for _ in range(50):
        assert rig.gate.offer("guest", None, guest, rig.now_us).accepted
        rig.step()
    assert rig.gate.applied.linear_mps == pytest.approx(0.2)
    assert rig.offer().accepted, "vision outranks a guest"
    assert rig.gate.offer("guest", None, guest, rig.now_us).reason is Refusal.NOT_HOLDER


def test_one_vision_drives_at_a_time_and_the_next_takes_over_when_it_is_silent():
    rig = Rig().armed().drive(200)
    verdict = rig.offer(session=OTHER)
    assert verdict.reason is Refusal.NOT_HOLDER and VISION in verdict.detail
    rig.silence(960)
    assert rig.offer(session=OTHER).reason is Refusal.NOT_HOLDER
    rig.silence(40)
    assert rig.offer(session=OTHER).accepted


def test_a_human_outranks_vision_and_losing_the_human_disarms():
    rig = Rig(auto_arm=True).armed().drive(200)
    rig.drive(200, source="teleop", session=HUMAN)
    assert rig.offer().reason is Refusal.NOT_HOLDER
    assert refusal(rig, Verb.ARM, session=OTHER) is Refusal.NOT_ALLOWED
    for _ in range(100):  # vision goes on asking; nobody hands the robot back to it
        rig.offer()
        rig.step()
    assert rig.gate.state is State.DISARMED and rig.gate.applied == STILL
    assert rig.request(Verb.ARM) == "armed"


def test_release_by_a_human_disarms():
    rig = Rig().armed().drive(100).drive(100, source="teleop", session=HUMAN)
    assert rig.request(Verb.RELEASE, source="teleop", session=HUMAN, echo=False) == "released"
    assert rig.gate.state is State.DISARMED


# --- arming ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("commands", "armed"), [(0, False), (4, False), (5, True)])
def test_arming_needs_five_live_commands(commands, armed):
    rig = Rig()
    for _ in range(commands):
        assert rig.offer().reason is Refusal.DISARMED
        rig.step()
    if armed:
        assert rig.request(Verb.ARM) == "armed"
    else:
        assert refusal(rig, Verb.ARM) is Refusal.NOT_ALLOWED
    assert is_armed(rig.gate.state) == armed


def test_commands_before_arming_are_not_obeyed_after_it():
    rig = Rig()
    for _ in range(5):
        rig.offer(0.5)
    rig.request(Verb.ARM)
    assert rig.step().twist == STILL and rig.gate.state is State.HOLD


def test_motion_ramps_from_zero_after_arming():
    rig = Rig().armed()
    rig.offer(0.5)
    assert 0 < rig.step().twist.linear_mps <= 0.5 * 20 * 0.02**2 * 2 + 1e-9


def test_auto_arm_is_off_by_default_and_does_not_undo_a_person():
    assert Rig().armed is not None and not SafetyConfig().auto_arm
    rig = Rig().drive(400)
    assert rig.gate.state is State.DISARMED
    rig = Rig(auto_arm=True).drive(400)
    assert rig.gate.state is State.ACTIVE
    rig.request(Verb.DISARM, echo=False)
    rig.drive(1000)
    assert rig.gate.state is State.DISARMED and rig.gate.applied == STILL


def test_ten_seconds_of_hold_disarm_and_auto_arm_takes_it_up():
    rig = Rig(auto_arm=True).drive(400).silence(10_200)
    assert is_armed(rig.gate.state)
    rig.silence(200)
    assert rig.gate.state is State.DISARMED
    assert rig.drive(400).gate.state is State.ACTIVE


@pytest.mark.parametrize(("age_us", "granted"), [(2_000_000, True), (2_000_001, False)])
def test_an_arm_request_that_was_kept_back_does_not_arm(age_us, granted):
    rig = Rig(lease_ms=5000)
    for _ in range(5):
        rig.offer()
    rig.gate.issued.add("status", 1, rig.now_us)
    header = RequestHeader(
        source="operator", session=HUMAN, seq=1, echo=Echo(channel="status", session=ROBOT, seq=1, t_us=rig.now_us)
    )
    rig.now_us += age_us
    try:
        rig.gate.request(header, Request(id=1, verb=Verb.ARM), rig.now_us)
    except WireError as error:
        assert error.reason is Refusal.STALE
    assert is_armed(rig.gate.state) == granted


def test_arm_reset_and_acquire_must_cite_a_status():
    rig = Rig()
    for verb in (Verb.ARM, Verb.RESET, Verb.ACQUIRE):
        assert refusal(rig, verb, echo=False) is Refusal.MALFORMED


# --- STOP --------------------------------------------------------------------------------------------------------


def test_stop_latches_until_reset_and_reset_starts_nothing():
    rig = Rig(auto_arm=True).armed().drive(600)
    rig.request(Verb.STOP, source="operator", session=OTHER, echo=False)
    assert rig.offer().reason is Refusal.STOPPED
    assert refusal(rig, Verb.RESET) is Refusal.NOT_ALLOWED, "still rolling"
    rig.drive(1000)
    assert rig.gate.applied == STILL and rig.gate.state is State.STOPPED
    assert refusal(rig, Verb.ARM) is Refusal.STOPPED
    rig.request(Verb.RESET)
    rig.drive(2000)
    assert rig.gate.state is State.DISARMED and rig.gate.applied == STILL
    rig.request(Verb.ARM)
    assert rig.drive(100).gate.state is State.ACTIVE


def test_a_gate_that_was_stopped_starts_stopped():
    rig = Rig(stopped=True, auto_arm=True).drive(500)
    assert rig.gate.state is State.STOPPED and rig.gate.applied == STILL


def test_a_fault_stops_and_a_reset_leaves_it():
    rig = Rig().armed().drive(400)
    rig.gate.fault("no drive")
    assert rig.offer().reason is Refusal.FAULT
    rig.silence(600)
    assert rig.request(Verb.RESET) == "reset; arm to drive"


# --- the stop, as the promises say it ----------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
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
def test_configuration_that_breaks_the_bound_is_refused(broken):
    with pytest.raises(ValueError, match=r"700 ms|must be below"):
        SafetyConfig(**broken)


def test_a_slow_link_may_have_a_longer_age_at_a_lower_speed():
    SafetyConfig(zero_speed_age_ms=800, full_speed_age_ms=300, max_linear_mps=0.35, max_acceleration_mps2=2.0)


# --- limits per elapsed time -------------------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
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


def test_a_late_step_moves_as_far_as_punctual_ones():
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
def test_what_is_not_finite_never_reaches_the_ramp(value):
    rig = Rig().armed()
    twist = Twist.model_construct(linear_mps=value, angular_rad_s=0.0)
    assert rig.gate.offer("vision", rig.header(), twist, rig.now_us).reason is Refusal.NOT_FINITE


# --- states ------------------------------------------------------------------------------------------------------


def test_nothing_but_arming_leads_from_off_to_armed():
    for (state, event), to in TRANSITIONS.items():
        if is_armed(to) and not is_armed(state):
            assert (state, event) == (State.DISARMED, Event.ARM)
        if state is State.STOPPED:
            assert to in (State.STOPPED, State.DISARMED)
    assert all(after(state, Event.STOP) is State.STOPPED for state in State)


@settings(max_examples=60, deadline=None)
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


# --- a frozen camera ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unchanged_us", "holds"), [(400_000, False), (400_001, True)])
def test_a_picture_that_does_not_change_holds_the_robot(unchanged_us, holds):
    rig = Rig().armed().drive(400)
    rig.gate.pictures.add(rig.now_us, 7)
    rig.gate.pictures.add(rig.now_us + unchanged_us, 7)
    rig.drive(40)
    assert (rig.gate.state is State.HOLD) == holds
    assert ("does not change" in rig.gate.reason) == holds
    rig.gate.pictures.add(rig.now_us + unchanged_us + 1, 8)
    assert rig.drive(40).gate.state is State.ACTIVE


@pytest.mark.parametrize(("shown_ms", "reason"), [(400, None), (401, Refusal.STALE)])
def test_a_repeated_picture_is_as_old_as_when_it_was_first_shown(shown_ms, reason):
    rig = Rig(silence_ms=300).armed().drive(400)
    rig.gate.pictures.add(rig.now_us, 7)
    rig.now_us += shown_ms * MS
    rig.gate.pictures.add(rig.now_us, 7)
    verdict = rig.offer()
    assert verdict.reason is reason
    assert verdict.age_us == 400 * MS if reason is None else "has not changed for 401 ms" in verdict.detail


def test_a_frame_from_before_the_last_change_keeps_its_own_age():
    rig = Rig().armed()
    old = rig.frame(age_ms=50)
    rig.gate.pictures.add(rig.now_us, 8)
    assert rig.offer(header=rig.header(old)).age_us == 50 * MS


def test_a_source_that_is_not_live_is_never_frozen():
    rig = Rig().armed()
    for step in range(100):
        rig.gate.pictures.add(step * 33_333, 0)
    assert rig.gate.pictures.unchanged_us() == 0


# --- range guard -------------------------------------------------------------------------------------------------


def scan(t_us, points):
    """A 360-ray scan that sees (bearing_deg, range_m) points and nothing else."""
    ranges = [math.inf] * 360
    for bearing_deg, range_m in points:
        ranges[bearing_deg % 360] = range_m
    return Ranges(t_us, 0.0, math.tau / 360, 0.05, 8.0, array.array("f", ranges))


AHEAD = Twist(linear_mps=0.5, angular_rad_s=0.0)
TURN = Twist(linear_mps=0.0, angular_rad_s=1.0)
BACK = Twist(linear_mps=-0.3, angular_rad_s=0.0)


def guard_with(points):
    guard = RangeGuard(GuardConfig())
    guard.see(scan(0, points))
    return guard


def test_the_guard_slows_towards_what_it_sees_and_only_towards_it():
    near = guard_with([(0, 0.12)])  # lens at 0.055: 0.175 from the axle, 0.105 from the front edge
    assert 0 < near.limit(AHEAD, 0).linear_mps < 0.2
    assert near.limit(BACK, 0) == BACK and near.limit(TURN, 0) == TURN
    assert guard_with([(0, 0.09)]).limit(AHEAD, 0).linear_mps == 0.0
    assert guard_with([(0, 2.0)]).limit(AHEAD, 0) == AHEAD
    assert guard_with([]).limit(AHEAD, 0) == AHEAD


def test_a_scan_with_a_nan_is_not_believed():
    guard = guard_with([])
    guard.see(scan(300_000, [(0, math.nan)]))
    assert guard.is_fresh(400_000) and not guard.is_fresh(400_001)


def test_the_guard_lets_the_robot_drive_along_a_wall_but_not_turn_into_it():
    guard = guard_with([(90, 0.16)])  # 7 cm beside the left edge
    assert guard.limit(AHEAD, 0) == AHEAD
    into = Twist(linear_mps=0.3, angular_rad_s=1.0)
    cut = guard.limit(into, 0)
    assert cut != into and cut.linear_mps <= 0.3 and cut.angular_rad_s <= 1.0


@pytest.mark.parametrize(("age_us", "moves"), [(0, True), (400_000, True), (400_001, False), (-1, False)])
def test_a_stale_scan_is_an_obstacle(age_us, moves):
    guard = guard_with([])
    assert (guard.limit(AHEAD, age_us) != STILL) == moves
    assert (guard.limit(TURN, age_us) != STILL) == moves
    assert RangeGuard(GuardConfig()).limit(AHEAD, 0) == STILL


@settings(max_examples=100, deadline=None)
@given(
    points=st.lists(st.tuples(st.integers(0, 359), st.floats(0.06, 1.5)), max_size=12),
    linear=st.floats(-0.5, 0.5),
    angular=st.floats(-2.5, 2.5),
)
def test_the_guard_never_adds_motion(points, linear, angular):
    cut = guard_with(points).limit(Twist(linear_mps=linear, angular_rad_s=angular), 0)
    assert abs(cut.linear_mps) <= abs(linear) + 1e-9 and cut.linear_mps * linear >= 0
    assert abs(cut.angular_rad_s) <= abs(angular) + 1e-9 and cut.angular_rad_s * angular >= 0


def test_the_gate_holds_the_guards_limit_whatever_is_commanded():
    guard = guard_with([(0, 0.09)])
    rig = Rig(guard=guard)
    rig.now_us = 0
    for _ in range(5):
        rig.offer()
        rig.step()
    rig.request(Verb.ARM)
    for _ in range(20):
        guard.see(scan(rig.now_us, [(0, 0.09)]))
        rig.drive(40, 0.5)
        assert rig.gate.applied.linear_mps == 0.0
    assert "obstacle" in rig.gate.reason
