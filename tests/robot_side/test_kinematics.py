"""Differential drive and odometry: exact on arcs, the curve kept under saturation."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.protocol.messages import Twist
from sightline.robot_side.kinematics import DiffDriveConfig, Odometer, twist_of, wheel_speeds
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
