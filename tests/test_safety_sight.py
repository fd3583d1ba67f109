"""What the gate makes of a camera that froze and of a range sensor, case by case."""

import array
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.protocol.errors import WireError
from sightline.protocol.messages import STILL, State, Twist, Verb
from sightline.protocol.errors import RejectReason
from sightline.robot_side.safety.guard import GuardConfig, RangeGuard
from sightline.robot_side.ports import Ranges
from tests.fixtures.safety import MS, Rig


def refusal(rig, verb, **kwargs):
    with pytest.raises(WireError) as caught:
        rig.request(verb, **kwargs)
    return caught.value.reason


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


@pytest.mark.parametrize(("shown_ms", "reason"), [(400, None), (401, RejectReason.STALE)])
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


def test_what_comes_so_close_that_it_cannot_be_measured_keeps_the_robot_stopped():
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


def test_a_sensor_that_sees_nothing_at_all_any_more_is_silent():
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
