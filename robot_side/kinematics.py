"""Differential drive: twist <-> wheel speeds, saturation that preserves the curve, odometry. Pure."""

import math
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, Planar, Pose, Twist
from sightline.robot_side.ports import WheelAngles

_RATE_WINDOW_US = 40_000  # shortest time for a speed: one encoder step in 20 ms is already 0.2 rad/s


class DiffDriveConfig(Config):
    """Geometry of a two-wheeled robot. The defaults are the Raspberry Pi class robot of the simulation."""

    wheel_radius_m: Annotated[float, Field(gt=0.005, lt=1.0)] = 0.035
    """Radius of the driven wheels."""
    track_width_m: Annotated[float, Field(gt=0.02, lt=3.0)] = 0.174
    """Distance between the two driven wheels."""
    max_wheel_rad_s: Annotated[float, Field(gt=0.1, lt=500.0)] = 22.0
    """Highest wheel speed; a faster twist is scaled so that its curve stays the same."""


def wheel_speeds(drive: DiffDriveConfig, twist: Twist) -> tuple[float, float]:
    """Return (left, right) rad/s for `twist`. Above `max_wheel_rad_s` one factor scales both, so the curve stays."""
    half_turn_mps = twist.angular_rad_s * drive.track_width_m / 2
    left = (twist.linear_mps - half_turn_mps) / drive.wheel_radius_m
    right = (twist.linear_mps + half_turn_mps) / drive.wheel_radius_m
    excess = max(abs(left), abs(right)) / drive.max_wheel_rad_s
    return (left / excess, right / excess) if excess > 1 else (left, right)


def twist_of(drive: DiffDriveConfig, left_rad_s: float, right_rad_s: float) -> Twist:
    """Return the twist of two wheel speeds, the inverse of `wheel_speeds` without its saturation."""
    left_mps, right_mps = left_rad_s * drive.wheel_radius_m, right_rad_s * drive.wheel_radius_m
    return Twist(linear_mps=(left_mps + right_mps) / 2, angular_rad_s=(right_mps - left_mps) / drive.track_width_m)


class Odometer:
    """Dead reckoning from wheel angles: exact for arcs of constant curvature between two readings."""

    def __init__(self, drive: DiffDriveConfig) -> None:
        self._drive = drive
        self._x_m = self._y_m = self._yaw_rad = 0.0
        self._last: WheelAngles | None = None
        self._rate_from: WheelAngles | None = None
        self._moving = STILL

    @property
    def pose(self) -> Pose:
        """Return (x_m, y_m, yaw_rad) since the start; yaw within +-pi."""
        return self._x_m, self._y_m, math.remainder(self._yaw_rad, math.tau)

    @property
    def moving(self) -> Planar:
        """Return (linear_mps, angular_rad_s), averaged over at least the last 40 ms."""
        return self._moving.linear_mps, self._moving.angular_rad_s

    def update(self, wheels: WheelAngles) -> None:
        """Process one reading. A reading that is not newer than the last one is ignored.

        Raises:
            ValueError: an angle is not finite.
        """
        if not (math.isfinite(wheels.left_rad) and math.isfinite(wheels.right_rad)):
            raise ValueError(f"invalid wheel angles ({wheels.left_rad}, {wheels.right_rad}): not finite")
        if self._last is None or self._rate_from is None:
            self._last = self._rate_from = wheels
            return
        if wheels.t_us <= self._last.t_us:
            return
        self._advance(wheels.left_rad - self._last.left_rad, wheels.right_rad - self._last.right_rad)
        self._last = wheels
        self._update_rate(wheels)

    def _advance(self, left_rad: float, right_rad: float) -> None:
        arc = twist_of(self._drive, left_rad, right_rad)  # angles instead of speeds: meters and radians, not per second
        half = arc.angular_rad_s / 2
        chord_m = arc.linear_mps * (math.sin(half) / half if half else 1.0)
        self._x_m += chord_m * math.cos(self._yaw_rad + half)
        self._y_m += chord_m * math.sin(self._yaw_rad + half)
        self._yaw_rad += arc.angular_rad_s

    def _update_rate(self, wheels: WheelAngles) -> None:
        start = self._rate_from
        if start is None or wheels.t_us - start.t_us < _RATE_WINDOW_US:
            return
        seconds = (wheels.t_us - start.t_us) / 1e6
        left, right = (wheels.left_rad - start.left_rad) / seconds, (wheels.right_rad - start.right_rad) / seconds
        self._moving = twist_of(self._drive, left, right)
        self._rate_from = wheels
