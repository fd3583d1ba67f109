"""The numbers of the gate's limits as they should be, and configurations made of them."""

from sightline.protocol.messages import Twist
from sightline.robot_side.safety.limits import (
    SafetyConfig,
)

DEFAULTS = {
    "max_linear_mps": 0.5,
    "max_angular_rad_s": 2.5,
    "max_acceleration_mps2": 2.0,
    "max_acceleration_rad_s2": 12.0,
    "max_jerk_mps3": 20.0,
    "max_jerk_rad_s3": 200.0,
    "motor_lag_ms": 50,
    "full_speed_age_ms": 150,
    "zero_speed_age_ms": 400,
    "silence_ms": 300,
    "lease_ms": 1_000,
    "disarm_after_hold_s": 10.0,
    "live_commands_to_arm": 5,
    "auto_arm": False,
    "guests": False,
    "guest_life_ms": 250,
    "guest_max_linear_mps": 0.2,
    "guest_max_angular_rad_s": 1.0,
}
# Field, whether the lower bound itself is allowed, lower, upper bound.
BOUNDS = [
    ("max_linear_mps", False, 0.0, 3.0),
    ("max_angular_rad_s", False, 0.0, 10.0),
    ("max_acceleration_mps2", False, 0.0, 20.0),
    ("max_acceleration_rad_s2", False, 0.0, 100.0),
    ("max_jerk_mps3", False, 0.0, 500.0),
    ("max_jerk_rad_s3", False, 0.0, 2000.0),
    ("motor_lag_ms", True, 0, 500),
    ("full_speed_age_ms", True, 20, 5_000),
    ("zero_speed_age_ms", True, 20, 5_000),
    ("silence_ms", True, 20, 5_000),
    ("lease_ms", True, 20, 5_000),
    ("disarm_after_hold_s", True, 1, 600),
    ("live_commands_to_arm", True, 1, 100),
    ("guest_life_ms", True, 20, 5_000),
    ("guest_max_linear_mps", False, 0.0, 3.0),
    ("guest_max_angular_rad_s", False, 0.0, 10.0),
]
WHOLE = {"motor_lag_ms", "live_commands_to_arm"}


def twist(linear_mps, angular_rad_s=0.0):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def config(**changes):
    """A configuration that is not asked for its stop bound."""
    return SafetyConfig.model_construct(**{**DEFAULTS, **changes})
