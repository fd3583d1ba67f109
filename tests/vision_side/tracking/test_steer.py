"""The controllers of speed and turn rate, term by term: feed-forward, gains, limits, integrals, anti-windup."""

import math

import pytest

from sightline.protocol.messages import Twist
from sightline.vision_side.config import SteerConfig
from sightline.vision_side.tracking.steering import Aim, Steer

STAND_OFF_M = 0.8
BEARING_RAD = math.atan2(0.9, 1.2)
"""Of a target 1.2 m ahead and 0.9 m to the left: 1.5 m away, its cosine 0.8, its sine 0.6."""
USUAL = {
    "bearing_kp": 2.0, "bearing_ki": 0.0, "distance_kp": 1.0, "distance_ki": 0.0, "max_gain_latency": 0.9,
    "max_linear_mps": 5.0, "max_reverse_mps": 5.0, "max_angular_rad_s": 10.0, "integral_linear_mps": 1.0,
    "integral_angular_rad_s": 2.0, "back_calculation_hz": 0.0, "drive_within_rad": 1.5,
}
FADE = 1 - (BEARING_RAD / 1.5) ** 2


def steer_of(**changes):
    return Steer(SteerConfig(**{**USUAL, **changes}), STAND_OFF_M)


def aim(x_m=1.2, y_m=0.9, vx_mps=0.0, vy_mps=0.0, lens_x_m=0.0):
    return Aim(x_m, y_m, vx_mps, vy_mps, lens_x_m)


def step(steer, target, *, dt_s=0.1, latency_s=0.05, may_drive=True):
    twist = steer.step(dt_s, target, latency_s, may_drive)
    assert isinstance(twist, Twist)
    return twist.linear_mps, twist.angular_rad_s


def ahead(distance_m):
    return aim(distance_m, 0.0)


# --- where the target is -----------------------------------------------------------------------------------------


def test_bearing_is_left_positive_and_the_distance_is_over_the_floor():
    target = aim()
    assert target.bearing_rad == pytest.approx(BEARING_RAD) and target.distance_m == pytest.approx(1.5)
    assert aim(-1.0, -1.0).bearing_rad == pytest.approx(-0.75 * math.pi)
    assert Aim(1.0, 0.0, 0.0, 0.0).lens_x_m == 0.0


# --- feed-forward and gains --------------------------------------------------------------------------------------


def test_still_target_gives_each_error_times_its_gain():
    """0.7 m too far: 0.7 m/s, faded by the bearing. That speed moves the target aside, which the turn follows."""
    linear, angular = step(steer_of(), aim())
    assert linear == pytest.approx(0.7 * FADE)
    assert angular == pytest.approx(2.0 * BEARING_RAD + 0.7 * FADE * 0.6 / 1.5)


def test_moving_target_gives_its_receding_speed_and_its_crossing_speed():
    """0.3 and 0.2 m/s: 0.36 m/s away from the robot, and -0.02 m/s across to the left."""
    still, moving = step(steer_of(), aim()), step(steer_of(), aim(vx_mps=0.3, vy_mps=0.2))
    assert moving[0] - still[0] == pytest.approx(0.36 * FADE)
    assert moving[1] - still[1] == pytest.approx((-0.02 + 0.36 * FADE * 0.6) / 1.5)


def test_robot_that_may_only_turn_follows_the_bearing():
    assert step(steer_of(), aim(vx_mps=0.3, vy_mps=0.2), may_drive=False) == pytest.approx(
        (0.0, 2.0 * BEARING_RAD - 0.02 / 1.5)
    )


def test_lens_ahead_of_the_axle_needs_a_smaller_turn():
    """0.3 m ahead at 1.5 m: 1 + 0.3 * 0.8 / 1.5 = 1.16 times."""
    without, ahead_of_axle = step(steer_of(), aim()), step(steer_of(), aim(lens_x_m=0.3))
    assert ahead_of_axle[0] == pytest.approx(without[0])
    assert ahead_of_axle[1] == pytest.approx(without[1] / 1.16)


@pytest.mark.parametrize(("latency_s", "gains"), [
    (0.0, (1.0, 2.0)), (0.45, (1.0, 2.0)), (0.5, (1.0, 1.8)), (0.9, (1.0, 1.0)), (1.8, (0.5, 0.5)),
])  # fmt: skip
def test_gains_times_latency_stay_within_their_limit(latency_s, gains):
    linear, angular = step(steer_of(), aim(), latency_s=latency_s)
    assert linear == pytest.approx(gains[0] * 0.7 * FADE)
    assert angular - linear * 0.6 / 1.5 == pytest.approx(gains[1] * BEARING_RAD)


def test_latency_below_a_millisecond_counts_as_one():
    """At most 20 per second without a latency, if the limit of their product is 0.02."""
    for latency_s in (0.0, 0.001):
        linear, _ = step(steer_of(distance_kp=10.0, max_gain_latency=0.005), ahead(1.0), latency_s=latency_s)
        assert linear == pytest.approx(5.0 * 0.2)


def test_target_at_the_lens_counts_as_5_cm_away():
    steer = steer_of(distance_kp=1.0, max_linear_mps=0.5)
    linear, angular = step(steer, aim(0.0, 0.0, vx_mps=0.1, vy_mps=0.2))
    assert (linear, angular) == (pytest.approx(0.05 - 0.8), 0.0), "no direction: neither receding nor crossing"
    linear, angular = step(steer_of(), aim(0.025, 0.0, vy_mps=0.2))
    assert (linear, angular) == (pytest.approx(0.05 - 0.8), pytest.approx(0.2 * 0.5 / 0.05))


# --- limits ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("bearing_rad", "share"), [
    (0.0, 1.0), (0.75, 0.75), (-0.75, 0.75), (1.2, 0.36), (1.5, 0.0), (2.0, 0.0), (-3.0, 0.0),
])  # fmt: skip
def test_speed_fades_with_the_bearing_so_that_it_turns_before_it_drives(bearing_rad, share):
    linear, _ = step(steer_of(), aim(2.0 * math.cos(bearing_rad), 2.0 * math.sin(bearing_rad)))
    assert linear == pytest.approx(1.2 * share, abs=1e-12)


def test_speeds_stay_within_their_limits():
    steer = steer_of(max_linear_mps=0.4, max_reverse_mps=0.3, max_angular_rad_s=1.1)
    assert step(steer, ahead(9.0))[0] == 0.4
    assert step(steer, ahead(0.1))[0] == -0.3
    assert step(steer, aim(0.0, 1.0), may_drive=False)[1] == 1.1
    assert step(steer, aim(0.0, -1.0), may_drive=False)[1] == -1.1


# --- integrals ---------------------------------------------------------------------------------------------------


def test_integrals_grow_with_the_error_the_gain_and_the_time():
    steer = steer_of(distance_ki=0.5, bearing_ki=0.25, drive_within_rad=1.5)
    first, second, third = step(steer, aim()), step(steer, aim(), dt_s=0.2), step(steer, aim())
    for now, before, dt_s in ((second, first, 0.1), (third, second, 0.2)):
        grown = 0.5 * 0.7 * dt_s
        assert now[0] - before[0] == pytest.approx(grown * FADE)
        assert now[1] - before[1] == pytest.approx(0.25 * BEARING_RAD * dt_s + grown * FADE * 0.6 / 1.5)


def test_integral_of_the_distance_rests_while_the_robot_may_only_turn():
    steer = steer_of(distance_ki=0.5, bearing_ki=0.25, back_calculation_hz=5.0)
    for _ in range(5):
        step(steer, aim(), may_drive=False)
    assert step(steer, aim())[0] == pytest.approx(0.7 * FADE)


def test_integrals_stay_within_their_bounds_to_both_sides():
    for side in (1, -1):
        steer = steer_of(distance_ki=5.0, bearing_ki=5.0, integral_linear_mps=0.05, integral_angular_rad_s=0.04)
        target = aim(0.8 + side * 0.1, 0.0)
        first = step(steer, target)[0]
        for _ in range(20):
            last = step(steer, target)[0]
        assert last - first == pytest.approx(side * 0.05)
        target = aim(0.8 * math.cos(0.1), side * 0.8 * math.sin(0.1))
        steer.reset()
        first = step(steer, target, may_drive=False)[1]
        for _ in range(20):
            last = step(steer, target, may_drive=False)[1]
        assert last - first == pytest.approx(side * 0.04)


def test_what_the_limits_cut_is_taken_from_the_integrals():
    """Back-calculation: 5 per second times 0.1 s of the 0.2 m/s and of the part of the turn that were cut."""
    steer = steer_of(max_linear_mps=0.5, back_calculation_hz=5.0)
    step(steer, ahead(1.5))
    assert step(steer, ahead(0.8))[0] == pytest.approx(-0.5 * 0.2)
    steer = steer_of(max_angular_rad_s=1.0, back_calculation_hz=5.0)
    cut = 2.0 * BEARING_RAD - 1.0
    step(steer, aim(), may_drive=False)
    assert step(steer, ahead(0.8))[1] == pytest.approx(-0.5 * cut)


def test_integrals_give_way_to_what_the_robot_did_not_apply():
    steer = steer_of(back_calculation_hz=4.0)
    steer.unmet(0.1, -0.2, 0.3)
    assert step(steer, ahead(0.8)) == pytest.approx((-0.08, 0.12))
    steer.reset()
    steer.unmet(0.25, -0.2, 0.3)
    steer.unmet(0.5, -0.1, 0.1)
    assert step(steer, ahead(0.8)) == pytest.approx((-0.3, 0.4)), "at most all of it"


def test_reset_forgets_both_integrals():
    steer = steer_of()
    steer.unmet(0.1, 0.5, 0.5)
    steer.reset()
    assert step(steer, ahead(0.8)) == (0.0, 0.0)
