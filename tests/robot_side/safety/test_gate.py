"""The gate, case by case: each number at its limit, a little under and a little over."""

import array
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import STILL, Echo, Request, RequestHeader, State, Twist, Verb
from sightline.robot_side.ports import Ranges
from sightline.robot_side.safety.guard import GuardConfig, RangeGuard
from sightline.robot_side.safety.limits import SafetyConfig, age_factor
from sightline.robot_side.safety.states import is_armed
from tests.fixtures.safety import HUMAN, MS, OTHER, ROBOT, VISION, Rig


def refusal(rig, verb, **kwargs):
    with pytest.raises(WireError) as caught:
        rig.request(verb, **kwargs)
    return caught.value.reason


# --- age ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("age_ms", "reason"), [(0, None), (399.999, None), (400, None), (400.001, RejectReason.STALE)])
def test_a_command_is_as_old_as_its_frame(age_ms, reason):
    rig = Rig().armed()
    assert rig.offer(age_ms=age_ms).reason == reason


@pytest.mark.parametrize(("ahead_us", "reason"), [(0, None), (1, RejectReason.FROM_FUTURE)])
def test_a_frame_of_the_future_is_rejected(ahead_us, reason):
    rig = Rig().armed()
    assert rig.offer(age_ms=-ahead_us / MS).reason == reason


@pytest.mark.parametrize(
    ("age_ms", "factor"), [(0, 1), (150, 1), (150.001, 0.999996), (275, 0.5), (399.999, 4e-6), (400, 0)]
)
def test_the_limit_falls_linearly_with_age(age_ms, factor):
    assert age_factor(SafetyConfig(), round(age_ms * MS)) == pytest.approx(factor, abs=1e-7)


def test_age_is_checked_again_at_every_step():
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
    assert (
        rig.offer(header=rig.header(frame.model_copy(update={"session": OTHER}))).reason is RejectReason.OTHER_SESSION
    )
    assert rig.offer(header=rig.header(frame.model_copy(update={"seq": 10_000}))).reason is RejectReason.UNKNOWN_FRAME
    assert (
        rig.offer(header=rig.header(frame.model_copy(update={"t_us": frame.t_us + 1}))).reason
        is RejectReason.UNKNOWN_FRAME
    )
    status = Echo(channel="status", session=ROBOT, seq=1, t_us=rig.now_us)
    rig.gate.issued.add("status", 1, rig.now_us)
    assert rig.offer(header=rig.header(status)).reason is RejectReason.UNKNOWN_FRAME
    assert rig.offer(header=rig.header(frame)).accepted


def test_the_record_is_bounded_and_forgets_the_oldest():
    rig = Rig()
    for seq in range(1000):
        rig.gate.issued.add("frame", seq, rig.now_us)
    assert rig.gate.issued.last_seq("frame") == 999
    old = Echo(channel="frame", session=ROBOT, seq=0, t_us=rig.now_us)
    assert rig.offer(header=rig.header(old)).reason is RejectReason.UNKNOWN_FRAME


@pytest.mark.parametrize(
    ("seq", "reason"), [(99, RejectReason.OUT_OF_ORDER), (100, RejectReason.OUT_OF_ORDER), (101, None)]
)
def test_sequence_numbers_only_grow(seq, reason):
    rig = Rig().armed()
    assert rig.offer(header=rig.header(seq=100)).accepted
    assert rig.offer(header=rig.header(seq=seq)).reason == reason


@pytest.mark.parametrize("seq", [2**52, 2**53 - 1])
def test_seq_near_the_largest_integer_neither_begins_nor_continues_a_session(seq):
    rig = Rig().armed().drive(60)
    assert rig.offer(header=rig.header(seq=seq)).reason is RejectReason.OUT_OF_ORDER
    assert rig.offer(header=rig.header(session=OTHER, seq=seq)).reason is RejectReason.OUT_OF_ORDER
    assert rig.offer().accepted


def test_camera_that_repeats_its_buffers_holds_the_robot():
    rig = Rig().armed().drive(60)
    for index in range(30):
        rig.gate.pictures.add(rig.now_us, 1 + index % 2)
        rig.drive(20)
    assert rig.gate.state is State.HOLD
    rig.gate.pictures.add(rig.now_us, 1)
    assert rig.offer().reason is RejectReason.STALE


def test_late_command_on_a_repeated_image_is_stale_after_the_camera_delivers_new_ones():
    rig = Rig().armed().drive(60)
    rig.gate.pictures.add(rig.now_us, 1)
    rig.silence(500)
    repeated = rig.frame()
    rig.gate.pictures.add(rig.now_us, 1)
    rig.silence(20)
    rig.gate.pictures.add(rig.now_us, 2)
    assert rig.offer(header=rig.header(repeated)).reason is RejectReason.STALE
    assert rig.offer().accepted


def test_a_restarted_vision_starts_its_numbers_over():
    rig = Rig(auto_arm=True).armed().drive(200)
    rig.silence(1100)
    assert rig.offer(header=rig.header(session=OTHER, seq=0)).accepted


def test_rejected_commands_refresh_nothing():
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
    assert rig.gate.offer(source, rig.header(), STILL, rig.now_us).reason is RejectReason.UNKNOWN_SOURCE


def test_key_and_header_must_agree():
    rig = Rig().armed()
    assert (
        rig.gate.offer("teleop", rig.header(source="vision"), STILL, rig.now_us).reason is RejectReason.UNKNOWN_SOURCE
    )


def test_guests_are_off_unless_switched_on_and_slow_then():
    guest = Twist(linear_mps=0.5, angular_rad_s=0.0)
    assert Rig().gate.offer("guest", None, guest, 0).reason is RejectReason.UNKNOWN_SOURCE
    assert Rig().gate.offer("vision", None, guest, 0).reason is RejectReason.MALFORMED
    rig = Rig().armed()
    assert rig.offer(source="guest", session=OTHER).reason is RejectReason.UNKNOWN_SOURCE, "with a header too"
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
    assert rig.gate.offer("guest", None, guest, rig.now_us).reason is RejectReason.NOT_HOLDER


def test_one_vision_drives_at_a_time_and_the_next_takes_over_when_it_is_silent():
    rig = Rig().armed().drive(200)
    verdict = rig.offer(session=OTHER)
    assert verdict.reason is RejectReason.NOT_HOLDER and VISION not in verdict.detail
    rig.silence(960)
    assert rig.offer(session=OTHER).reason is RejectReason.NOT_HOLDER
    rig.silence(40)
    assert rig.offer(session=OTHER).accepted


def test_a_human_outranks_vision_and_losing_the_human_disarms():
    rig = Rig(auto_arm=True).armed().drive(200)
    rig.drive(200, source="teleop", session=HUMAN)
    assert rig.offer().reason is RejectReason.NOT_HOLDER
    assert refusal(rig, Verb.ARM, session=OTHER) is RejectReason.NOT_ALLOWED
    for _ in range(100):  # vision continues to send; the robot does not return to it
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
        assert rig.offer().reason is RejectReason.DISARMED
        rig.step()
    if armed:
        assert rig.request(Verb.ARM) == "armed"
    else:
        assert refusal(rig, Verb.ARM) is RejectReason.NOT_ALLOWED
    assert is_armed(rig.gate.state) == armed


def test_commands_before_arming_are_not_applied_after_it():
    rig = Rig()
    for _ in range(5):
        rig.offer(0.5)
    rig.request(Verb.ARM)
    assert rig.step().twist == STILL and rig.gate.state is State.HOLD


def test_motion_ramps_from_zero_after_arming():
    rig = Rig().armed()
    rig.offer(0.5)
    assert 0 < rig.step().twist.linear_mps <= 0.5 * 20 * 0.02**2 * 2 + 1e-9


def test_auto_arm_is_off_by_default_and_does_not_undo_an_operator():
    assert Rig().armed is not None and not SafetyConfig().auto_arm
    rig = Rig().drive(400)
    assert rig.gate.state is State.DISARMED
    rig = Rig(auto_arm=True).drive(400)
    assert rig.gate.state is State.ACTIVE
    rig.request(Verb.DISARM, echo=False)
    rig.drive(1000)
    assert rig.gate.state is State.DISARMED and rig.gate.applied == STILL


def test_auto_arm_arms_again_after_ten_seconds_of_hold_disarm():
    rig = Rig(auto_arm=True).drive(400).silence(10_200)
    assert is_armed(rig.gate.state)
    rig.silence(200)
    assert rig.gate.state is State.DISARMED
    assert rig.drive(400).gate.state is State.ACTIVE


@pytest.mark.parametrize(("age_us", "granted"), [(2_000_000, True), (2_000_001, False)])
def test_delayed_arm_request_does_not_arm(age_us, granted):
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
        assert error.reason is RejectReason.STALE
    assert is_armed(rig.gate.state) == granted


def test_arm_reset_and_acquire_must_cite_a_status():
    rig = Rig()
    for verb in (Verb.ARM, Verb.RESET, Verb.ACQUIRE):
        assert refusal(rig, verb, echo=False) is RejectReason.MALFORMED


# --- STOP --------------------------------------------------------------------------------------------------------


def test_stop_latches_until_reset_and_reset_starts_nothing():
    rig = Rig(auto_arm=True).armed().drive(600)
    rig.request(Verb.STOP, source="operator", session=OTHER, echo=False)
    assert rig.offer().reason is RejectReason.STOPPED
    assert refusal(rig, Verb.RESET) is RejectReason.NOT_ALLOWED, "still rolling"
    rig.drive(1000)
    assert rig.gate.applied == STILL and rig.gate.state is State.STOPPED
    assert refusal(rig, Verb.ARM) is RejectReason.STOPPED
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
    assert rig.offer().reason is RejectReason.FAULT
    rig.silence(600)
    assert rig.request(Verb.RESET) == "reset; arm to drive"


# What the gate makes of a camera that froze and of a range sensor, case by case.


# --- a frozen camera ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unchanged_us", "holds"), [(400_000, False), (400_001, True)])
def test_an_image_that_does_not_change_holds_the_robot(unchanged_us, holds):
    rig = Rig().armed().drive(400)
    rig.gate.pictures.add(rig.now_us, 7)
    rig.gate.pictures.add(rig.now_us + unchanged_us, 7)
    rig.drive(40)
    assert (rig.gate.state is State.HOLD) == holds
    assert ("does not change" in rig.gate.reason) == holds
    rig.gate.pictures.add(rig.now_us + unchanged_us + 1, 8)
    assert rig.drive(40).gate.state is State.ACTIVE


@pytest.mark.parametrize(("shown_ms", "reason"), [(400, None), (401, RejectReason.STALE)])
def test_a_repeated_image_is_as_old_as_when_it_was_first_shown(shown_ms, reason):
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


def test_guard_slows_only_toward_an_obstacle():
    near = guard_with([(0, 0.12)])  # lens at 0.055: 0.175 from the axle, 0.105 from the front edge
    assert 0 < near.limit(AHEAD, 0).linear_mps < 0.2
    assert near.limit(BACK, 0) == BACK and near.limit(TURN, 0) == TURN
    assert guard_with([(0, 0.09)]).limit(AHEAD, 0).linear_mps == 0.0
    assert guard_with([(0, 2.0)]).limit(AHEAD, 0) == AHEAD
    assert guard_with([]).limit(AHEAD, 0) == AHEAD


def test_object_too_close_to_measure_keeps_the_robot_stopped():
    guard = guard_with([(0, 0.09)])
    rig = Rig(guard=guard)
    rig.now_us = 0
    rig.armed()
    for range_m in (0.09, 0.06, 0.05, 0.0499, 0.03, 0.001):
        for _ in range(25):
            guard.see(scan(rig.now_us, [(0, range_m)]))
            rig.drive(20, 0.5)
            assert rig.gate.applied == STILL, range_m
    assert rig.gate.reason == "an obstacle is near"
    assert rig.drive(20, -0.3).gate.applied.linear_mps < 0.0, "away from it is free"


def test_sensor_without_any_echo_counts_as_silent():
    """Covered, or its laser dead: zeros, where an open hall would be inf."""
    guard = guard_with([])
    rig = Rig(guard=guard)
    rig.now_us = 0
    rig.armed().drive(240)
    assert rig.gate.applied.linear_mps > 0.2
    for _ in range(25):
        guard.see(scan(rig.now_us, [(bearing_deg, 0.0) for bearing_deg in range(360)]))
        rig.drive(20, 0.5)
    assert rig.gate.applied == STILL and rig.gate.reason == "the range sensor is silent"


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


@settings(max_examples=100)
@given(
    points=st.lists(st.tuples(st.integers(0, 359), st.floats(0.06, 1.5)), max_size=12),
    linear=st.floats(-0.5, 0.5),
    angular=st.floats(-2.5, 2.5),
)
def test_the_guard_never_adds_motion(points, linear, angular):
    cut = guard_with(points).limit(Twist(linear_mps=linear, angular_rad_s=angular), 0)
    assert abs(cut.linear_mps) <= abs(linear) + 1e-9 and cut.linear_mps * linear >= 0
    assert abs(cut.angular_rad_s) <= abs(angular) + 1e-9 and cut.angular_rad_s * angular >= 0


def test_gate_keeps_the_limit_of_the_guard_for_any_command():
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
