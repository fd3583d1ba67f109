"""Every number and branch of the gate's step (silence, age, ramp, range guard): just inside, at it, just outside."""

import array
import math

import pytest

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import STILL, Verb
from sightline.robot_side.ports import Ranges
from sightline.robot_side.safety.gate import Decision
from sightline.robot_side.safety.guard import GuardConfig, RangeGuard
from sightline.robot_side.safety.limits import AxisRamp
from tests.fixtures.safety import (
    A,
    D,
    G,
    H,
    Rig,
    S,
    driving,
    twist,
)

# --- step: silence, age, holding ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("silent_us", "state", "reason"),
    [
        (150_000, A, "driving"),
        (150_001, G, "the frame is aging; slower"),
        (299_999, G, "the frame is aging; slower"),
        (300_000, G, "the frame is aging; slower"),
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
        (150_001, G, "the frame is aging; slower"),
        (399_999, G, "the frame is aging; slower"),
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
def test_a_frozen_image_holds(unchanged_us, state):
    rig = Rig().armed()
    rig.gate.pictures.add(rig.now_us - unchanged_us, 7)
    rig.gate.pictures.add(rig.now_us, 7)
    verdict = rig.offer()
    assert verdict.accepted == (unchanged_us <= 400_000)
    if not verdict.accepted:
        assert verdict.reason is RejectReason.STALE
        assert verdict.detail == "the camera image has not changed for 400 ms"
    decision = rig.step(0)
    assert decision.state is state
    assert (decision.reason == "the camera image does not change") == (unchanged_us > 400_000)


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
def test_ramp_uses_the_time_between_steps(elapsed_us):
    rig, axis = Rig().armed(), AxisRamp(2.0, 20.0)
    rig.step()
    rig.offer(0.5)
    rig.now_us += elapsed_us
    got = rig.gate.step(rig.now_us).twist.linear_mps
    for slice_us in [20_000] * (elapsed_us // 20_000) + [elapsed_us % 20_000]:
        axis.step(0.5, slice_us / 1e6)
    assert got == axis.speed


def test_first_step_and_constant_clock_move_nothing():
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


def test_the_guard_cuts_last_and_the_ramp_continues_from_there():
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


def test_silent_sensor_stops_immediately_and_is_reported():
    rig = guarded()
    rig.gate._guard.see(Ranges(rig.now_us - 5_000_001, 0.0, 0.0, 0.05, 8.0, array.array("f", [math.inf])))
    rig.offer(0.5)
    assert rig.step() == Decision(STILL, A, "the range sensor is silent")


def test_the_guard_does_not_explain_a_gate_that_is_off():
    rig = guarded()
    rig.gate.stop("STOP by test")
    see(rig, 0.06)
    assert rig.step() == Decision(STILL, S, "STOP by test")


def test_a_guard_that_cuts_nothing_reports_nothing():
    rig = guarded()
    rig.offer(0.5)
    assert rig.step() == Decision(twist(0.5), A, "driving")


# --- the battery -------------------------------------------------------------------------------------------------


def battery_rig(volts, seconds_old=0.0):
    """An armed rig with a battery that gave `volts` so long ago."""
    rig = Rig(battery=True).armed()
    rig.battery.see(volts, rig.now_us - round(seconds_old * 1e6))
    return rig


@pytest.mark.parametrize(
    ("volts", "seconds_old", "factor", "state", "reason"),
    [
        (8.0, 0.0, 1.0, A, "driving"),
        (6.9, 0.0, 0.5, G, "the battery is low; half speed"),
        (8.0, 6.0, 0.5, G, "the battery is silent; half speed"),
        (6.3, 0.0, 0.0, H, "the battery is empty"),
    ],
)
@pytest.mark.parametrize(("linear", "angular"), [(0.5, 0.0), (0.0, 2.5), (0.5, 2.5), (-0.5, 1.0)])
def test_battery_scales_both_axes_so_that_the_curve_stays(volts, seconds_old, factor, state, reason, linear, angular):
    rig = battery_rig(volts, seconds_old)
    rig.drive(3000, linear, angular)
    decision = rig.gate.step(rig.now_us)
    assert (decision.state, decision.reason) == (state, reason)
    assert rig.gate.applied.linear_mps == pytest.approx(factor * linear)
    assert rig.gate.applied.angular_rad_s == pytest.approx(factor * angular)


@pytest.mark.parametrize(("age_ms", "factor"), [(0, 0.5), (275, 0.5), (350, 0.2)])
def test_smaller_limit_wins_with_a_low_battery(age_ms, factor):
    rig = battery_rig(6.9)
    for _ in range(150):
        rig.offer(0.5, 0.0, age_ms=age_ms - 20 if age_ms else 0)
        rig.step()
    assert rig.gate.applied.linear_mps == pytest.approx(factor * 0.5)
    assert rig.gate.reason == ("the battery is low; half speed" if factor == 0.5 else "the frame is aging; slower")


def test_an_empty_battery_is_the_reason_also_without_a_command():
    rig = battery_rig(6.3)
    rig.silence(400)
    assert (rig.gate.state, rig.gate.reason) == (H, "the battery is empty")
