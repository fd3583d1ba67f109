"""Every number and branch of the states' table and of what the gate makes of a command: inside, at it, outside."""

import math

import pytest

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import STILL, Echo, LastRejection, State, Twist, Verb
from sightline.protocol.proof import session_digest
from sightline.robot_side.safety.gate import Decision, SafetyGate
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.robot_side.safety.states import TRANSITIONS, Event, is_armed, next_state
from tests.fixtures.safety import (
    GUEST,
    HUMAN,
    OTHER,
    ROBOT,
    VISION,
    VISION_HOLDER,
    A,
    D,
    F,
    G,
    H,
    Rig,
    S,
    driving,
    guest,
    guest_driving,
)

# --- the table of states -----------------------------------------------------------------------------------------

WHERE_TO = {
    Event.ARM: {D: H},
    Event.DISARM: {H: D, A: D, G: D},
    Event.STOP: dict.fromkeys(State, S),
    Event.RESET: {S: D, F: D},
    Event.FAULT: {D: F, H: F, A: F, G: F, F: F},
    Event.FREE: {H: A, A: A, G: A},
    Event.SLOWED: {H: G, A: G, G: G},
    Event.MUST_HOLD: {H: H, A: H, G: H},
    Event.EXPIRED: {H: D},
    Event.HUMAN_LOST: {H: D, A: D, G: D},
}


def test_each_event_leads_from_each_state_where_it_should():
    for event in Event:
        for state in State:
            assert next_state(state, event) is WHERE_TO[event].get(state, state), (state, event)
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
    assert (gate.accepted, gate.last_rejection, gate.latency_us, dict(gate.counters)) == (0, None, None, {})
    assert gate.holder(0) is None and gate.frame_age_us(0) is None
    assert gate.step(5) == Decision(STILL, state, reason)
    assert SafetyGate(SafetyConfig(), ROBOT).state is D


def test_robot_stopped_before_a_restart_does_not_arm_automatically_after_the_reset():
    rig = Rig(stopped=True, auto_arm=True)
    rig.request(Verb.RESET)
    assert rig.drive(400).gate.state is D


# --- rejections --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", ["linear_mps", "angular_rad_s"])
def test_either_axis_must_be_finite(axis, value):
    rig = driving()
    bad = Twist.model_construct(**{"linear_mps": 0.0, "angular_rad_s": 0.0, axis: value})
    verdict = rig.gate.offer("vision", rig.header(), bad, rig.now_us)
    assert (verdict.reason, verdict.accepted, verdict.age_us) == (RejectReason.NOT_FINITE, False, None)


def test_rejection_is_counted_with_detail_and_acceptance_has_its_age():
    rig = driving()
    accepted = rig.gate.accepted
    verdict = rig.offer(age_ms=12)
    assert (verdict.reason, verdict.age_us, rig.gate.accepted) == (None, 12_000, accepted + 1)
    assert rig.gate.latency_us == 12_000
    stale = rig.offer(age_ms=401)
    assert stale.detail == "frame 9 is 401 ms old, at most 400"
    assert rig.gate.counters["STALE"] == 1 and rig.gate.accepted == accepted + 1
    assert rig.gate.last_rejection == LastRejection(source="vision", reason="STALE", detail=stale.detail)
    rig.offer(age_ms=402)
    assert rig.gate.counters["STALE"] == 2 and rig.gate.latency_us == 12_000


@pytest.mark.parametrize("size", [31, 32, 33, 199, 200, 201])
def test_last_rejection_is_cut_to_the_bounds_of_a_status(size):
    rig = Rig()
    verdict = rig.gate.reject("s" * size, WireError(RejectReason.MALFORMED, "d" * size))
    assert rig.gate.last_rejection == LastRejection(
        source="s" * min(size, 32), reason="MALFORMED", detail="d" * min(size, 200)
    )
    assert verdict.detail == "d" * size and verdict.reason is RejectReason.MALFORMED


@pytest.mark.parametrize("state", [S, F])
def test_stopped_and_fault_permit_no_motion_and_no_lease(state):
    rig = driving(state)
    verdict = rig.offer()
    assert (verdict.reason, verdict.detail) == (RejectReason(str(state)), rig.gate.reason)
    assert rig.gate.holder(rig.now_us) is None


def test_disarmed_commands_are_validated_and_form_the_lease():
    rig = Rig()
    verdict = rig.offer()
    assert (verdict.reason, verdict.detail) == (RejectReason.DISARMED, "not armed")
    assert rig.gate.holder(rig.now_us) == VISION_HOLDER
    assert rig.gate.accepted == 0 and rig.gate.frame_age_us(rig.now_us) is None
    assert rig.offer(age_ms=401).reason is RejectReason.STALE


def test_rejected_driver_receives_holder():
    rig = driving()
    assert rig.offer(session=OTHER).detail == f"vision {session_digest('vision', VISION)} drives"
    rig.drive(20, source="teleop", session=HUMAN)
    verdict = rig.offer()
    assert verdict.reason is RejectReason.NOT_HOLDER
    assert verdict.detail == f"teleop {session_digest('teleop', HUMAN)} drives"


def test_key_and_header_name_one_known_driver():
    rig = Rig(guests=True)
    for source, header in [
        ("operator", None),
        ("operator", rig.header(source="operator")),
        ("vision", rig.header(source="teleop")),
        ("teleop", rig.header(source="vision")),
    ]:
        verdict = rig.gate.offer(source, header, STILL, rig.now_us)
        assert verdict.reason is RejectReason.UNKNOWN_SOURCE and repr(source) in verdict.detail
    for source in ("vision", "teleop"):
        verdict = rig.gate.offer(source, None, STILL, rig.now_us)
        assert verdict.reason is RejectReason.MALFORMED and source in verdict.detail
    assert rig.gate.offer("guest", None, STILL, rig.now_us).reason is RejectReason.DISARMED
    assert rig.gate.holder(rig.now_us) == GUEST
    off = Rig().gate.offer("guest", None, STILL, 0)
    assert off.reason is RejectReason.UNKNOWN_SOURCE and "safety.guests" in off.detail


def test_twist_that_cites_a_status_or_repeats_a_number_is_rejected():
    rig = driving()
    rig.gate.issued.add("status", 1, rig.now_us)
    status = Echo(channel="status", session=ROBOT, seq=1, t_us=rig.now_us)
    verdict = rig.offer(header=rig.header(status))
    assert verdict.reason is RejectReason.UNKNOWN_FRAME and "status" in verdict.detail
    rig.gate.issued.add("beat", 1, rig.now_us)
    beat = rig.header(Echo(channel="beat", session=ROBOT, seq=1, t_us=rig.now_us))
    assert rig.offer(header=beat).accepted
    assert rig.offer(header=beat).reason is RejectReason.OUT_OF_ORDER


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
    for commands in (1, 2):
        assert rig.offer(*asked).accepted
        assert rig.gate.counters["CLAMPED"] == before + commands * clamped
    rig.drive(2_000, *asked)
    assert (rig.gate.applied.linear_mps, rig.gate.applied.angular_rad_s) == pytest.approx(goal)


@pytest.mark.parametrize(
    ("config", "linear_mps", "angular_rad_s"),
    [
        ({}, 0.2, 1.0),
        ({"guest_max_linear_mps": 0.3, "guest_max_angular_rad_s": 2.0}, 0.3, 2.0),
        ({"guest_max_linear_mps": 3.0, "guest_max_angular_rad_s": 9.0}, 0.5, 2.5),
    ],
)
def test_guest_has_the_lowest_speed_limit(config, linear_mps, angular_rad_s):
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
    assert rig.gate.offer("guest", None, STILL, rig.now_us).age_us == 0, "it counts from its arrival"
    assert rig.gate.latency_us is None


@pytest.mark.parametrize("end", ["stop", "disarm", "fault"])
def test_a_robot_without_a_command_in_force_has_no_latency(end):
    rig = driving()
    rig.offer(age_ms=12)
    assert rig.gate.latency_us == 12_000
    getattr(rig.gate, end)("tested")
    assert rig.gate.latency_us is None and rig.offer(age_ms=13).reason is not None
    assert rig.gate.latency_us is None, "a rejected command has none"


def test_without_a_header_no_frame_age_is_shown():
    rig = guest_driving(40)
    assert rig.gate.frame_age_us(rig.now_us) is None
    rig.offer(source="guest", session=OTHER)
    rig.step(1_100)
    assert rig.offer(source="guest", session=OTHER).accepted
    assert rig.gate.frame_age_us(rig.now_us + 7) == 7, "with a header its echo proves the age"


def repeat(rig, ms, linear, angular=0.0):
    """One command without a header at each tick; the state after each."""
    states = []
    for _ in range(ms // 20):
        guest(rig, linear, angular)
        states.append(rig.step().state)
    return states


def driven_m(rig):
    return sum(abs(twist.linear_mps) * 0.02 for _, twist in rig.applied)


@pytest.mark.parametrize(("linear", "config", "most_m"), [
    (9.0, {}, 0.275), (-9.0, {}, 0.275), (9.0, {"guest_unchanged_m": 0.1}, 0.125),
    (0.05, {}, 0.105), (0.05, {"guest_unchanged_ms": 1_000}, 0.055),
])
def test_one_repeated_command_without_a_header_drives_a_bounded_distance(linear, config, most_m):
    rig = guest_driving(20, linear=linear, **config)
    states = repeat(rig, 5_000, linear)
    assert states[0] is State.ACTIVE and states[-1] is State.HOLD
    assert rig.gate.applied == STILL
    assert most_m - 0.03 < driven_m(rig) <= most_m
    assert "the same command without a frame" in rig.gate.reason


def test_one_repeated_turn_without_a_header_takes_a_bounded_time():
    rig = guest_driving(20, 0.0, 0.5)
    assert set(repeat(rig, 1_980, 0.0, 0.5)) == {State.ACTIVE}, "up to 2000 ms after its arrival"
    guest(rig, 0.0, 0.5)
    rig.now_us += 1
    assert rig.gate.step(rig.now_us).state is State.HOLD


def test_a_changed_command_drives_on_and_counts_as_it_was_sent():
    rig = guest_driving(20, linear=9.0)
    for step in range(200):
        assert guest(rig, 9.0 + step).accepted
        assert rig.step().state is State.ACTIVE
    assert driven_m(rig) > 0.7
    repeat(rig, 2_000, 9.0)
    assert rig.gate.state is State.HOLD
    guest(rig, 9.1)
    assert rig.step().state is State.ACTIVE


def test_standing_still_may_repeat():
    assert set(repeat(guest_driving(20), 4_000, 0.0)) == {State.ACTIVE}


def test_the_distance_starts_again_with_each_command():
    rig = guest_driving(20)
    repeat(rig, 1_000, 9.0)
    assert set(repeat(rig, 1_000, 8.0)) == {State.ACTIVE}


def test_a_header_exempts_from_the_bound():
    rig = driving(A)
    for _ in range(200):
        rig.offer()
        assert rig.step().state is State.ACTIVE
    assert driven_m(rig) > 1


def test_arming_by_an_operator_starts_the_bound_again():
    rig = guest_driving(20)
    repeat(rig, 5_000, 9.0)
    rig.request(Verb.DISARM)
    repeat(rig, 400, 9.0)
    rig.request(Verb.ARM)
    assert rig.gate.state is State.HOLD
    assert repeat(rig, 100, 9.0)[-1] is State.ACTIVE
