"""The ramp of teleop, command by command: up slowly, down at once, and no leap after a stall."""

import pytest

from sightline.operator_side.teleop.control import SpeedUp
from sightline.protocol.messages import Twist

START_US = 7_000_000


def twist(linear_mps=0.0, angular_rad_s=0.0):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def test_command_after_a_stall_of_the_operators_machine_is_one_bounded_step():
    """The ramp counts 100 ms of a stall: 0.8 m/s2 and 5 rad/s2 give 0.08 m/s and 0.5 rad/s more, not the goal."""
    ramp = SpeedUp()
    first = ramp.step(twist(1.0, 3.0), START_US)
    after = ramp.step(twist(1.0, 3.0), START_US + 2_000_000)
    assert after.linear_mps - first.linear_mps == pytest.approx(0.08)
    assert after.angular_rad_s - first.angular_rad_s == pytest.approx(0.5)
