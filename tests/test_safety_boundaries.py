"""Every number and every branch of the gate and of its table of states: just inside, at it, just outside."""

import array
import math

import pytest

from protocol.errors import WireError
from protocol.messages import STILL, AnswerHeader, Echo, Holder, LastRefusal, Request, RequestHeader, State, Twist, Verb
from protocol.refusals import Refusal
from robot_side.guard import GuardConfig, RangeGuard
from robot_side.limits import AxisRamp, SafetyConfig
from robot_side.ports import Ranges
from robot_side.safety import Decision, SafetyGate
from robot_side.states import TRANSITIONS, Event, after, is_armed
from tests.safety_rig import HUMAN, OTHER, ROBOT, VISION, Rig

VISION_HOLDER, HUMAN_HOLDER = Holder(source="vision", session=VISION), Holder(source="teleop", session=HUMAN)
GUEST = Holder(source="guest", session="00000000")
D, H, A, G, S, F = (
    State.DISARMED, State.HOLD, State.ACTIVE, State.DEGRADED, State.STOPPED, State.FAULT,
)  # fmt: skip


def refused(rig, verb, **kwargs):
    with pytest.raises(WireError) as caught:
        rig.request(verb, **kwargs)
    return caught.value


def twist(linear_mps, angular_rad_s=0.0):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def driving(state=A, **config):
    """A rig brought to `state` over the way a robot gets there."""
    rig = Rig(**config)
    if state in (H, A, G):
        rig.armed()
    if state is A:
        rig.drive(20)
    if state is G:
        rig.drive(20, age_ms=200)
    if state is S:
        rig.gate.stop("STOP by test")
    if state is F:
        rig.gate.fault("broken")
    assert rig.gate.state is state
    return rig


# --- the table of states -----------------------------------------------------------------------------------------

WHERE_TO = {
    Event.ARM: {D: H},
    Event.DISARM: {H: D, A: D, G: D},
    Event.STOP: dict.fromkeys(State, S),
    Event.RESET: {S: D, F: D},
    Event.FAULT: {D: F, H: F, A: F, G: F, F: F},
    Event.FRESH: {H: A, A: A, G: A},
    Event.AGEING: {H: G, A: G, G: G},
    Event.OLD: {H: H, A: H, G: H},
    Event.EXPIRED: {H: D},
    Event.HUMAN_LOST: {H: D, A: D, G: D},
}


def test_each_event_leads_from_each_state_where_it_should():
    for event in Event:
        for state in State:
            assert after(state, event) is WHERE_TO[event].get(state, state), (state, event)
    assert len(TRANSITIONS) == sum(map(len, WHERE_TO.values()))


def test_the_wheels_may_turn_in_three_states():
    assert [is_armed(state) for state in (D, H, A, G, S, F)] == [False, True, True, True, False, False]


# --- a new gate --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stopped", "state", "reason"), [(False, D, "not armed"), (True, S, "STOP was set before the restart")]
)
def test_a_new_gate_is_off(stopped, state, reason):
    gate = SafetyGate(SafetyConfig(), ROBOT, stopped=stopped)
    assert (gate.state, gate.reason, gate.applied) == (state, reason, STILL)
    assert (gate.accepted, gate.last_refusal, gate.latency_us, dict(gate.counters)) == (0, None, None, {})
    assert gate.holder(0) is None and gate.frame_age_us(0) is None
    assert gate.step(5) == Decision(STILL, state, reason)
    assert SafetyGate(SafetyConfig(), ROBOT).state is D


def test_stopped_before_the_restart_does_not_arm_by_itself_after_the_reset():
    rig = Rig(stopped=True, auto_arm=True)
    rig.request(Verb.RESET)
    assert rig.drive(400).gate.state is D


# --- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", ["linear_mps", "angular_rad_s"])
def test_either_axis_must_be_finite(axis, value):
    rig = driving()
    bad = Twist.model_construct(**{"linear_mps": 0.0, "angular_rad_s": 0.0, axis: value})
    verdict = rig.gate.offer("vision", rig.header(), bad, rig.now_us)
    assert (verdict.reason, verdict.accepted, verdict.age_us) == (Refusal.NOT_FINITE, False, None)


def test_a_refusal_is_counted_and_kept_in_words_and_an_acceptance_has_its_age():
    rig = driving()
    accepted = rig.gate.accepted
    verdict = rig.offer(age_ms=12)
    assert (verdict.reason, verdict.age_us, rig.gate.accepted) == (None, 12_000, accepted + 1)
    assert rig.gate.latency_us == 12_000
    stale = rig.offer(age_ms=401)
    assert stale.detail == "frame 9 is 401 ms old, at most 400"
    assert rig.gate.counters["STALE"] == 1 and rig.gate.accepted == accepted + 1
    assert rig.gate.last_refusal == LastRefusal(source="vision", reason="STALE", detail=stale.detail)
    rig.offer(age_ms=402)
    assert rig.gate.counters["STALE"] == 2 and rig.gate.latency_us == 12_000


@pytest.mark.parametrize("size", [31, 32, 33, 199, 200, 201])
def test_the_last_refusal_is_cut_to_what_a_status_holds(size):
    rig = Rig()
    verdict = rig.gate.refuse("s" * size, WireError(Refusal.MALFORMED, "d" * size))
    assert rig.gate.last_refusal == LastRefusal(
        source="s" * min(size, 32), reason="MALFORMED", detail="d" * min(size, 200)
    )
    assert verdict.detail == "d" * size and verdict.reason is Refusal.MALFORMED


@pytest.mark.parametrize("state", [S, F])
def test_nothing_drives_in_stopped_and_fault_and_nobody_gets_the_lease(state):
    rig = driving(state)
    verdict = rig.offer()
    assert (verdict.reason, verdict.detail) == (Refusal(str(state)), rig.gate.reason)
    assert rig.gate.holder(rig.now_us) is None


def test_disarmed_commands_are_judged_and_form_the_lease():
    rig = Rig()
    verdict = rig.offer()
    assert (verdict.reason, verdict.detail) == (Refusal.DISARMED, "not armed")
    assert rig.gate.holder(rig.now_us) == VISION_HOLDER
    assert rig.gate.accepted == 0 and rig.gate.frame_age_us(rig.now_us) is None
    assert rig.offer(age_ms=401).reason is Refusal.STALE


def test_the_loser_is_told_who_drives():
    rig = driving()
    assert rig.offer(session=OTHER).detail == f"vision {VISION} drives"
    rig.drive(20, source="teleop", session=HUMAN)
    verdict = rig.offer()
    assert (verdict.reason, verdict.detail) == (Refusal.NOT_HOLDER, f"teleop {HUMAN} drives")


def test_key_and_header_name_one_known_driver():
    rig = Rig(guests=True)
    for source, header in [
        ("operator", None),
        ("operator", rig.header(source="operator")),
        ("vision", rig.header(source="teleop")),
    ]:
        verdict = rig.gate.offer(source, header, STILL, rig.now_us)
        assert verdict.reason is Refusal.UNKNOWN_SOURCE and repr(source) in verdict.detail
    for source in ("vision", "teleop"):
        verdict = rig.gate.offer(source, None, STILL, rig.now_us)
        assert verdict.reason is Refusal.MALFORMED and source in verdict.detail
    assert rig.gate.offer("guest", None, STILL, rig.now_us).reason is Refusal.DISARMED
    assert rig.gate.holder(rig.now_us) == GUEST
    off = Rig().gate.offer("guest", None, STILL, 0)
    assert off.reason is Refusal.UNKNOWN_SOURCE and "safety.guests" in off.detail


def test_a_status_is_no_frame_and_a_repeated_number_no_command():
    rig = driving()
    rig.gate.issued.add("status", 1, rig.now_us)
    status = Echo(channel="status", session=ROBOT, seq=1, t_us=rig.now_us)
    verdict = rig.offer(header=rig.header(status))
    assert verdict.reason is Refusal.UNKNOWN_FRAME and "status" in verdict.detail
    rig.gate.issued.add("beat", 1, rig.now_us)
    beat = rig.header(Echo(channel="beat", session=ROBOT, seq=1, t_us=rig.now_us))
    assert rig.offer(header=beat).accepted
    assert rig.offer(header=beat).reason is Refusal.OUT_OF_ORDER


# --- what is kept of a command -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "goal", "clamped"),
    [
        ((0.5, 2.5), (0.5, 2.5), 0),
        ((0.51, 0.0), (0.5, 0.0), 1),
        ((0.0, 2.51), (0.0, 2.5), 1),
        ((1.0, 1.0), (0.5, 0.5), 1),
        ((-1.0, -1.0), (-0.5, -0.5), 1),
    ],
)
def test_a_command_is_cut_to_the_limits_and_counted(asked, goal, clamped):
    rig = Rig().armed()
    before = rig.gate.counters["CLAMPED"]
    assert rig.offer(*asked).accepted
    assert rig.gate.counters["CLAMPED"] == before + clamped
    rig.drive(2_000, *asked)
    assert (rig.gate.applied.linear_mps, rig.gate.applied.angular_rad_s) == pytest.approx(goal)


def guest(rig, linear=9.0, angular=0.0):
    return rig.gate.offer("guest", None, twist(linear, angular), rig.now_us)


def guest_driving(ms=600, linear=9.0, angular=0.0, **config):
    rig = Rig(guests=True, **config)
    for _ in range(5):
        guest(rig)
        rig.step()
    rig.request(Verb.ARM)
    for _ in range(ms // 20):
        guest(rig, linear, angular)
        rig.step()
    return rig


@pytest.mark.parametrize(
    ("config", "linear_mps", "angular_rad_s"),
    [
        ({}, 0.2, 1.0),
        ({"guest_max_linear_mps": 0.3, "guest_max_angular_rad_s": 2.0}, 0.3, 2.0),
        ({"guest_max_linear_mps": 3.0, "guest_max_angular_rad_s": 9.0}, 0.5, 2.5),
    ],
)
def test_a_guest_is_slower_and_never_faster_than_anybody(config, linear_mps, angular_rad_s):
    assert guest_driving(linear=9.0, **config).gate.applied.linear_mps == pytest.approx(linear_mps)
    assert guest_driving(linear=0.0, angular=-9.0, **config).gate.applied.angular_rad_s == pytest.approx(-angular_rad_s)


@pytest.mark.parametrize(
    ("config", "life_us"),
    [({}, 250_000), ({"guest_life_ms": 100}, 100_000), ({"guest_life_ms": 399, "silence_ms": 200}, 200_000)],
)
def test_a_guests_command_lives_its_own_time(config, life_us):
    for late_us, state in [(-1, None), (0, None), (1, H)]:
        rig = guest_driving(40, **config)
        guest(rig)
        rig.now_us += life_us + late_us
        decision = rig.gate.step(rig.now_us)
        assert (decision.state is H) == (state is H)
        if state:
            assert decision.reason == f"no accepted command for more than {life_us // 1000} ms"


def test_a_long_silence_is_named_in_milliseconds():
    rig = Rig(silence_ms=1000).armed()
    rig.offer()
    assert rig.step(2_000).reason == "no accepted command for more than 1000 ms"


def test_the_age_of_the_frame_is_never_negative():
    rig = driving(A)
    rig.offer()
    assert [rig.gate.frame_age_us(rig.now_us + later_us) for later_us in (-5, 0, 5)] == [0, 0, 5]


def test_a_guest_has_no_latency():
    rig = guest_driving(40)
    assert rig.gate.latency_us is None and rig.gate.frame_age_us(rig.now_us + 7) == 20_007


# --- step: silence, age, holding ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("silent_us", "state", "reason"),
    [
        (150_000, A, "driving"),
        (150_001, G, "the frames are ageing; slower"),
        (299_999, G, "the frames are ageing; slower"),
        (300_000, G, "the frames are ageing; slower"),
        (300_001, H, "no accepted command for more than 300 ms"),
    ],
)
def test_silence_slows_and_then_holds(silent_us, state, reason):
    rig = Rig().armed()
    rig.offer()
    rig.now_us += silent_us
    decision = rig.gate.step(rig.now_us)
    assert (decision.state, decision.reason) == (state, reason)


@pytest.mark.parametrize(
    ("age_us", "state", "reason"),
    [
        (150_000, A, "driving"),
        (150_001, G, "the frames are ageing; slower"),
        (399_999, G, "the frames are ageing; slower"),
        (400_000, H, "the frame behind the command is 400 ms old"),
        (400_001, H, "the frame behind the command is 400 ms old"),
    ],
)
def test_the_age_of_the_frame_slows_and_then_holds(age_us, state, reason):
    rig = Rig().armed()
    rig.offer(age_ms=140)
    rig.now_us += age_us - 140_000
    decision = rig.gate.step(rig.now_us)
    assert (decision.state, decision.reason) == (state, reason)
    assert rig.gate.frame_age_us(rig.now_us) == age_us


def test_the_limit_falls_on_both_axes_with_the_frames_age():
    rig = Rig().armed()
    for _ in range(100):
        rig.offer(0.3, 0.3, age_ms=255)
        rig.step()
    assert (rig.gate.applied.linear_mps, rig.gate.applied.angular_rad_s) == pytest.approx((0.25, 0.25))
    for _ in range(100):
        rig.offer(0.0, 2.5, age_ms=255)
        rig.step()
    assert rig.gate.applied.angular_rad_s == pytest.approx(1.25)


@pytest.mark.parametrize(("unchanged_us", "state"), [(399_999, G), (400_000, H), (400_001, H)])
def test_a_frozen_picture_holds(unchanged_us, state):
    rig = Rig().armed()
    rig.gate.pictures.add(rig.now_us - unchanged_us, 7)
    rig.gate.pictures.add(rig.now_us, 7)
    verdict = rig.offer()
    assert verdict.accepted == (unchanged_us <= 400_000)
    if not verdict.accepted:
        assert verdict.reason is Refusal.STALE
        assert verdict.detail == "the camera's picture has not changed for 400 ms"
    decision = rig.step(0)
    assert decision.state is state
    assert (decision.reason == "the camera's picture does not change") == (unchanged_us > 400_000)


def test_without_a_command_an_armed_gate_holds():
    rig = Rig().armed()
    assert rig.step() == Decision(STILL, H, "armed; no command yet")


@pytest.mark.parametrize(("after_arming_us", "state"), [(9_999_999, H), (10_000_000, H), (10_000_001, D)])
def test_ten_seconds_of_hold_disarm(after_arming_us, state):
    rig = Rig().armed()
    rig.now_us += after_arming_us
    decision = rig.gate.step(rig.now_us)
    assert decision.state is state
    assert (decision.reason == "disarmed after 10 s without commands") == (state is D)


@pytest.mark.parametrize(("held_us", "state"), [(1_500_000, H), (1_500_001, D)])
def test_the_ten_seconds_begin_with_the_hold(held_us, state):
    rig = driving(A, disarm_after_hold_s=1.5)
    rig.silence(1_000)
    since_us = rig.now_us
    assert rig.drive(2_000).gate.state is A
    rig.now_us += 400_000
    assert rig.gate.step(rig.now_us).state is H and rig.now_us - since_us > 1_500_000
    rig.now_us += held_us // 2
    assert rig.gate.step(rig.now_us).state is H
    rig.now_us += held_us - held_us // 2
    assert rig.gate.step(rig.now_us).state is state


def test_holding_keeps_the_newest_reason():
    rig = driving(A)
    assert rig.step(301).reason == "no accepted command for more than 300 ms"
    rig.offer(age_ms=395)
    assert rig.step(5).reason == "the frame behind the command is 400 ms old"
    rig.offer(age_ms=0)
    assert rig.step().state is A


# --- step: the ramp per elapsed time -----------------------------------------------------------------------------


@pytest.mark.parametrize("elapsed_us", [1, 7_000, 20_000, 61_000])
def test_the_ramp_runs_by_the_time_between_steps(elapsed_us):
    rig, axis = Rig().armed(), AxisRamp(2.0, 20.0)
    rig.step()
    rig.offer(0.5)
    rig.now_us += elapsed_us
    got = rig.gate.step(rig.now_us).twist.linear_mps
    for slice_us in [20_000] * (elapsed_us // 20_000) + [elapsed_us % 20_000]:
        axis.step(0.5, slice_us / 1e6)
    assert got == axis.speed


def test_the_first_step_and_a_clock_that_stands_move_nothing():
    rig = Rig(live_commands_to_arm=1)
    rig.offer()
    rig.request(Verb.ARM)
    rig.offer(0.5)
    assert rig.step(0).twist == STILL, "the first step knows no time before it"
    rig.step(40)
    moving = rig.gate.applied
    assert moving != STILL and rig.step(0).twist == moving
    assert rig.gate.step(rig.now_us - 5_000).twist == moving
    assert rig.gate.applied == moving


# --- step: the range guard ---------------------------------------------------------------------------------------


def guarded(range_m=math.inf, *, armed=True, **guard):
    rig = Rig(guard=RangeGuard(GuardConfig(max_scan_age_ms=5_000, **guard)))
    see(rig, math.inf)
    if armed:
        rig.armed().drive(600)
    see(rig, range_m)
    return rig


def see(rig, range_m):
    rig.gate._guard.see(Ranges(rig.now_us, 0.0, 0.0, 0.05, 8.0, array.array("f", [range_m])))


def test_the_guard_cuts_last_and_the_ramp_goes_on_from_there():
    rig = guarded(0.15)  # 0.055 + 0.15 - 0.07 - 0.08: 0.055 m to brake in
    limit_mps = math.sqrt(2 * 0.5 * 0.055)
    rig.offer(0.5)
    decision = rig.step()
    assert decision.twist.linear_mps == pytest.approx(limit_mps, rel=1e-6)
    assert (decision.state, decision.reason) == (A, "an obstacle is near")
    assert rig.gate.applied == decision.twist
    see(rig, math.inf)
    rig.offer(0.5)
    decision = rig.step()
    assert decision.twist.linear_mps == pytest.approx(limit_mps + 0.008, rel=1e-6)
    assert decision.reason == "driving"


def test_a_silent_sensor_stops_at_once_and_says_so():
    rig = guarded()
    rig.gate._guard.see(Ranges(rig.now_us - 5_000_001, 0.0, 0.0, 0.05, 8.0, array.array("f", [])))
    rig.offer(0.5)
    assert rig.step() == Decision(STILL, A, "the range sensor is silent")


def test_the_guard_does_not_explain_a_gate_that_is_off():
    rig = guarded()
    rig.gate.stop("STOP by test")
    see(rig, 0.06)
    assert rig.step() == Decision(STILL, S, "STOP by test")


def test_a_guard_that_cuts_nothing_says_nothing():
    rig = guarded()
    rig.offer(0.5)
    assert rig.step() == Decision(twist(0.5), A, "driving")


# --- requests ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", Verb)
def test_stop_disarm_and_release_need_no_echo(verb):
    rig = Rig()
    if verb in (Verb.STOP, Verb.DISARM, Verb.RELEASE):
        assert rig.request(verb, echo=False)
    else:
        error = refused(rig, verb, echo=False)
        assert error.reason is Refusal.MALFORMED and error.detail == "what lets a robot move again must cite a status"


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.RESET, Verb.ACQUIRE])
@pytest.mark.parametrize(
    ("age_us", "reason"), [(-1, Refusal.FROM_FUTURE), (0, None), (2_000_000, None), (2_000_001, Refusal.STALE)]
)
def test_other_requests_cite_something_young(verb, age_us, reason):
    gate = SafetyGate(SafetyConfig(), ROBOT)
    gate.issued.add("status", 3, 10_000_000)
    cited = Echo(channel="status", session=ROBOT, seq=3, t_us=10_000_000)
    header = RequestHeader(source="teleop", session=HUMAN, seq=0, echo=cited)
    try:
        gate.request(header, Request(id=1, verb=verb), 10_000_000 + age_us)
    except WireError as error:
        assert error.reason is (reason or Refusal.NOT_ALLOWED) and (reason or verb is Verb.ARM)
    else:
        assert reason is None


def test_each_verb_says_what_it_did():
    rig = Rig().armed()
    assert rig.gate.reason == "armed by operator" and rig.gate.state is H
    assert rig.request(Verb.ARM) == "already armed"
    assert rig.request(Verb.DISARM) == "disarmed" and rig.gate.reason == "disarmed by operator"
    assert rig.gate.state is D
    assert rig.request(Verb.RESET) == "nothing to reset: DISARMED"
    assert rig.request(Verb.STOP) == "STOPPED" and rig.gate.reason == "STOP by operator"
    error = refused(rig, Verb.ARM)
    assert (error.reason, error.detail) == (Refusal.STOPPED, "STOP by operator; reset first")
    assert rig.request(Verb.RESET) == "reset; arm to drive" and rig.gate.reason == "reset by operator; not armed"
    assert rig.gate.state is D
    assert rig.gate.stop() == "STOPPED" and rig.gate.reason == "STOP"
    assert rig.gate.stop("again") == "STOPPED" and rig.gate.reason == "STOP", "what set the latch stays"
    rig.request(Verb.RESET)
    rig.gate.fault("no drive")
    assert (rig.gate.state, rig.gate.reason) == (F, "no drive")
    assert refused(rig, Verb.ARM).reason is Refusal.FAULT
    assert rig.request(Verb.RESET) == "reset; arm to drive"
    rig.armed()
    assert rig.gate.disarm() == "disarmed" and rig.gate.reason == "disarmed"


@pytest.mark.parametrize("state", [S, F])
def test_reset_waits_for_the_wheels(state):
    rig = Rig().armed().drive(600)
    rig.gate.stop() if state is S else rig.gate.fault("broken")
    while rig.gate.applied != STILL:
        error = refused(rig, Verb.RESET)
        assert error.reason is Refusal.NOT_ALLOWED and "not at zero" in error.detail
        rig.step()
    assert rig.request(Verb.RESET) and rig.gate.state is D


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.RESET])
def test_arm_and_reset_are_not_for_others_beside_a_human(verb):
    rig = Rig()
    rig.offer(source="teleop", session=HUMAN)
    for source, session in [("operator", OTHER), ("teleop", OTHER), ("operator", HUMAN), ("vision", HUMAN)]:
        error = refused(rig, verb, source=source, session=session)
        assert (error.reason, error.detail) == (Refusal.NOT_ALLOWED, f"teleop {HUMAN} drives")
    if verb is Verb.RESET:
        assert rig.request(verb, source="teleop", session=HUMAN).startswith("nothing")
    else:
        assert "live commands" in refused(rig, verb, source="teleop", session=HUMAN).detail
    beside_vision = Rig()
    beside_vision.offer()
    assert "live commands" in refused(beside_vision, Verb.ARM, session=OTHER).detail


# --- arming ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("commands", "missing"),
    [
        (0, "nobody sends valid commands yet; is vision running?"),
        (1, "1 of 5 live commands seen; ask again"),
        (4, "4 of 5 live commands seen; ask again"),
        (5, None),
        (6, None),
    ],
)
def test_arming_needs_five_live_commands(commands, missing):
    rig = Rig()
    for _ in range(commands):
        rig.offer()
    if missing is None:
        assert rig.request(Verb.ARM) == "armed"
    else:
        error = refused(rig, Verb.ARM)
        assert (error.reason, error.detail) == (Refusal.NOT_ALLOWED, missing)


def test_the_five_are_of_one_driver_in_a_row():
    rig = Rig()
    for _ in range(4):
        rig.offer()
    rig.offer(source="teleop", session=HUMAN)
    assert "1 of 5" in refused(rig, Verb.ARM, source="teleop", session=HUMAN).detail
    for _ in range(4):
        rig.offer(source="teleop", session=HUMAN)
    assert rig.request(Verb.ARM, source="teleop", session=HUMAN) == "armed"


@pytest.mark.parametrize(("gap_us", "granted"), [(999_999, True), (1_000_000, False)])
def test_the_five_are_live_as_long_as_the_lease(gap_us, granted):
    rig = Rig()
    for _ in range(4):
        rig.offer()
    rig.now_us += gap_us
    rig.offer()
    assert (granted and rig.request(Verb.ARM) == "armed") or "1 of 5" in refused(rig, Verb.ARM).detail


def test_the_five_are_asked_for_again_after_disarming():
    rig = Rig().armed()
    rig.request(Verb.DISARM)
    assert "0 of 5" in refused(rig, Verb.ARM).detail
    assert Rig(live_commands_to_arm=1).gate.config.live_commands_to_arm == 1


def test_arming_waits_for_the_wheels():
    rig = Rig().armed().drive(600)
    rig.request(Verb.DISARM)
    while rig.gate.applied != STILL:
        for _ in range(5):
            rig.offer()
        error = refused(rig, Verb.ARM)
        assert (error.reason, error.detail) == (Refusal.NOT_ALLOWED, "the wheels are not at zero yet; ask again")
        rig.step()
    for _ in range(5):
        rig.offer()
    assert rig.request(Verb.ARM) == "armed"


def test_commands_from_before_arming_are_forgotten():
    rig = driving(A)
    rig.request(Verb.DISARM)
    assert rig.gate.frame_age_us(rig.now_us) is None
    rig.silence(600).armed()
    assert rig.step().reason == "armed; no command yet"


# --- auto_arm ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("commands", "state"), [(4, D), (5, H)])
def test_auto_arm_arms_with_the_fifth_command(commands, state):
    rig = Rig(auto_arm=True)
    for _ in range(commands):
        rig.offer()
    assert rig.step().state is state
    off = Rig()
    for _ in range(commands):
        off.offer()
    assert off.step().state is D


def test_auto_arm_says_so_and_waits_for_a_command():
    rig = Rig(auto_arm=True)
    for _ in range(5):
        rig.offer()
    assert rig.gate.state is D
    assert rig.step().reason == "armed; no command yet"
    rig.offer()
    assert rig.step().state is A


LEAVING = {
    "stop": lambda rig: rig.request(Verb.STOP, echo=False),
    "disarm": lambda rig: rig.request(Verb.DISARM, echo=False),
    "fault": lambda rig: rig.gate.fault("broken"),
    "release": lambda rig: rig.drive(60, source="teleop", session=HUMAN).request(
        Verb.RELEASE, source="teleop", session=HUMAN, echo=False
    ),
    "lost": lambda rig: rig.drive(60, source="teleop", session=HUMAN).silence(1_100),
}


@pytest.mark.parametrize("how", LEAVING)
def test_what_a_person_ended_does_not_arm_by_itself_again(how):
    rig = Rig(auto_arm=True).drive(400)
    assert rig.gate.state is A
    LEAVING[how](rig)
    rig.silence(1_200)
    rig.request(Verb.RESET)
    assert rig.drive(400).gate.state is D
    rig.request(Verb.ARM)
    rig.drive(100).silence(10_400)
    assert rig.gate.state is D
    assert rig.drive(400).gate.state is A, "a person armed: unattended again"


def test_disarming_a_disarmed_gate_ends_auto_arm():
    rig = Rig(auto_arm=True)
    rig.request(Verb.DISARM, echo=False)
    assert rig.drive(400).gate.state is D


def test_arming_by_a_person_does_not_switch_auto_arm_on():
    rig = Rig().armed().drive(100)
    rig.silence(10_400)
    assert rig.gate.state is D
    assert rig.drive(400).gate.state is D


# --- lease: acquire, release, losing a human ---------------------------------------------------------------------


@pytest.mark.parametrize(("now_us", "held"), [(999_999, True), (1_000_000, False)])
def test_the_holder_holds_for_the_lease(now_us, held):
    rig = Rig()
    rig.offer()
    assert rig.gate.holder(rig.now_us + now_us) == (VISION_HOLDER if held else None)


def test_acquire_takes_the_lease_ahead_of_the_first_command():
    rig = Rig()
    assert rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN) == "acquired"
    assert rig.gate.holder(rig.now_us) == HUMAN_HOLDER
    assert "0 of 5" in refused(rig, Verb.ARM, source="teleop", session=HUMAN).detail
    assert rig.offer().reason is Refusal.NOT_HOLDER
    for source, session in [("teleop", OTHER), ("vision", VISION), ("operator", OTHER)]:
        error = refused(rig, Verb.ACQUIRE, source=source, session=session)
        assert (error.reason, error.detail) == (Refusal.NOT_HOLDER, "teleop drives")
    error = refused(Rig(), Verb.ACQUIRE, source="operator")
    assert (error.reason, error.detail) == (Refusal.NOT_HOLDER, "nobody drives")


def test_acquiring_again_renews_nothing():
    rig = Rig()
    rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN)
    rig.silence(500)
    assert rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN) == "already held"
    rig.silence(480)
    assert rig.gate.holder(rig.now_us) == HUMAN_HOLDER
    assert rig.gate.holder(rig.now_us + 20_000) is None


def test_who_acquires_is_not_driven_by_the_one_before():
    rig = Rig().armed().drive(400)
    rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN)
    assert rig.step().state is H


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.RESET, Verb.ACQUIRE])
@pytest.mark.parametrize("denial", ["stop", "disarm"])
def test_what_was_asked_before_a_stop_or_disarm_does_not_undo_it(verb, denial):
    rig = Rig().armed()
    rig.gate.issued.add("status", 70, rig.now_us)
    getattr(rig.gate, denial)()
    for seq, reason in ((70, Refusal.STALE), (71, None)):
        rig.gate.issued.add("status", seq, rig.now_us)
        cited = Echo(channel="status", session=ROBOT, seq=seq, t_us=rig.now_us)
        header = RequestHeader(source="teleop", session=HUMAN, seq=seq, echo=cited)
        try:
            rig.gate.request(header, Request(id=1, verb=verb), rig.now_us)
        except WireError as error:
            assert reason is None or error.detail == "cites a status from before the last STOP or disarm; ask again"
            assert reason is None or error.reason is reason
        else:
            assert reason is None


def test_a_request_cites_a_status_and_no_frame():
    rig = Rig()
    header = RequestHeader(source="operator", session=HUMAN, seq=0, echo=rig.frame())
    with pytest.raises(WireError) as caught:
        rig.gate.request(header, Request(id=1, verb=Verb.RESET), rig.now_us)
    assert caught.value.reason is Refusal.MALFORMED


def test_a_human_who_acquires_and_then_is_silent_was_lost():
    rig = Rig().armed().drive(100)
    rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN)
    rig.silence(980)
    assert rig.gate.state is H
    assert rig.step(20) == Decision(STILL, D, "the person driving was lost; arm again")


@pytest.mark.parametrize(("silent_us", "reason"), [(999_999, Refusal.NOT_HOLDER), (1_000_000, Refusal.DISARMED)])
def test_a_human_lost_between_two_ticks_is_not_succeeded(silent_us, reason):
    rig = driving(A)
    rig.offer(source="teleop", session=HUMAN)
    rig.now_us += silent_us
    assert rig.offer().reason is reason
    assert (rig.gate.state is D) == (reason is Refusal.DISARMED)
    rig = driving(A)
    rig.offer(source="teleop", session=HUMAN)
    rig.now_us += 1_000_000
    rig.request(Verb.ACQUIRE, source="vision", session=VISION)
    assert (rig.gate.state, rig.gate.reason) == (D, "the person driving was lost; arm again")


def test_the_commands_of_one_driver_do_not_arm_for_another_who_acquires():
    rig = Rig()
    for _ in range(4):
        rig.offer()
    rig.request(Verb.ACQUIRE, source="vision", session=VISION)
    rig.offer()
    assert rig.gate._missing_to_arm(rig.now_us) == "", "its own stay"
    rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN)
    assert "0 of 5" in refused(rig, Verb.ARM, source="teleop", session=HUMAN).detail


def test_release_gives_the_lease_back():
    rig = driving(A)
    assert rig.request(Verb.RELEASE, source="vision", session=OTHER, echo=False) == "not held"
    assert rig.request(Verb.RELEASE, source="teleop", session=VISION, echo=False) == "not held"
    assert rig.gate.holder(rig.now_us) == VISION_HOLDER
    assert rig.request(Verb.RELEASE, source="vision", session=VISION, echo=False) == "released"
    assert rig.gate.holder(rig.now_us) is None and rig.gate.state is A
    assert rig.step().reason == "armed; no command yet"
    assert rig.offer(session=OTHER).accepted


def test_a_human_who_lets_go_disarms():
    rig = driving(A).drive(60, source="teleop", session=HUMAN)
    assert rig.request(Verb.RELEASE, source="teleop", session=HUMAN, echo=False) == "released"
    assert (rig.gate.state, rig.gate.reason) == (D, "the person driving let go; arm again")
    assert rig.gate.holder(rig.now_us) is None


@pytest.mark.parametrize(("silent_us", "lost"), [(999_999, False), (1_000_000, True)])
def test_a_human_is_lost_when_the_lease_runs_out(silent_us, lost):
    rig = driving(A)
    rig.offer(source="teleop", session=HUMAN)
    rig.now_us += silent_us
    decision = rig.gate.step(rig.now_us)
    assert (decision.state is D) == lost
    assert (decision.reason == "the person driving was lost; arm again") == lost
    vision = driving(A)
    vision.offer()
    vision.now_us += silent_us
    assert vision.gate.step(vision.now_us).state is H


def test_a_lost_human_is_lost_once():
    rig = driving(A)
    rig.offer(source="teleop", session=HUMAN)
    rig.silence(1_100)
    rig.armed()
    assert rig.step().state is H


@pytest.mark.parametrize(("guests", "reason"), [(True, Refusal.DISARMED), (False, Refusal.UNKNOWN_SOURCE)])
def test_a_guest_with_a_header_is_a_guest(guests, reason):
    gate = SafetyGate(SafetyConfig(guests=guests), ROBOT)
    gate.issued.add("frame", 0, 0)
    cited = Echo(channel="frame", session=ROBOT, seq=0, t_us=0)
    named = AnswerHeader(source="guest", session="0000eeee", seq=0, echo=cited)
    assert gate.offer("guest", named, STILL, 0).reason is reason
    if not guests:
        return
    assert gate.holder(0) == Holder(source="guest", session="0000eeee")
