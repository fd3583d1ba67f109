"""Limits speed towards obstacles that the range sensor sees, and checks its blind zone. Pure.

Each near point of a scan becomes one inequality on the twist. With n the direction from the robot's outline to the
point, the robot closes in on it at `linear * forward + angular * turning`, which may be at most
sqrt(2 brake (clearance - stop)): what can still brake in time. Motion along a wall or away from it is free.
A stale sensor counts as an obstacle all around.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import STILL, Twist
from sightline.robot_side.ports import Ranges

# First the speed gives way; without it a turn can come too close to a point looked at before, so it gives way in the
# second pass, and for all points in the third. At zero speed a smaller turn is safe for every point: no fourth.
_PASSES = 3


class GuardConfig(Config):
    """Outline of the robot from its axle's midpoint, and the zones around it."""

    front_m: float = Field(default=0.07, ge=0, le=2, description="outline ahead of the axle")
    rear_m: float = Field(default=0.10, ge=0, le=2, description="outline behind the axle")
    half_width_m: float = Field(default=0.09, gt=0.01, le=2, description="outline to each side")
    sensor_x_m: float = Field(default=0.055, ge=-2, le=2, description="position of the sensor, ahead of the axle")
    stop_m: float = Field(
        default=0.08,
        ge=0.02,
        le=5,
        description="clearance at which no motion towards a point is left; keep it well below every stand-off",
    )
    brake_mps2: float = Field(
        default=0.5,
        gt=0,
        le=20,
        description="braking that the slow zone assumes; well below what the robot can, for motor lag and scan age",
    )
    max_scan_age_ms: int = Field(
        default=400, ge=50, le=5_000, description="an older scan counts as an obstacle all around"
    )


@dataclass(frozen=True, slots=True)
class _Near:
    """`linear * forward + angular * turning <= limit_mps`."""

    forward: float
    turning: float
    limit_mps: float

    def cut(self, linear: float, angular: float) -> tuple[float, float]:
        """The twist that holds it: speed gives way before turning, so that the robot can turn to where it is free."""
        if linear * self.forward + angular * self.turning <= self.limit_mps:
            return linear, angular
        left_mps = self.limit_mps - angular * self.turning
        if left_mps >= 0:
            return left_mps / self.forward, angular
        return 0.0, self.limit_mps / self.turning


def _met_m(scan: Ranges, range_m: float) -> float | None:
    """How far away a ray met something: inf for nothing, None if it does not say. Too close to measure is as near."""
    if range_m == math.inf:
        return range_m
    if range_m == 0 or range_m > scan.range_max_m:
        return None
    return max(range_m, scan.range_min_m)


class RangeGuard:
    """Holds what the newest scan forbids, and cuts twists with it."""

    def __init__(self, config: GuardConfig) -> None:
        self._config = config
        self._scan_us: int | None = None
        self._near: list[_Near] = []

    def see(self, scan: Ranges) -> None:
        """Take a scan. One with a nan, or of which no ray says anything, is none: soon it counts as an obstacle."""
        met_m = [_met_m(scan, range_m) for range_m in scan.ranges_m]
        if any(map(math.isnan, scan.ranges_m)) or all(range_m is None for range_m in met_m):
            return
        self._scan_us = scan.t_us
        angles = (scan.angle_min_rad + index * scan.angle_increment_rad for index in range(len(met_m)))
        self._near = [
            self._inequality(self._config.sensor_x_m + range_m * math.cos(angle_rad), range_m * math.sin(angle_rad))
            for range_m, angle_rad in zip(met_m, angles, strict=True)
            if range_m is not None and range_m < math.inf
        ]

    def _inequality(self, x_m: float, y_m: float) -> _Near:
        config = self._config
        nearest_x_m = max(-config.rear_m, min(config.front_m, x_m))
        nearest_y_m = max(-config.half_width_m, min(config.half_width_m, y_m))
        clearance_m = math.hypot(x_m - nearest_x_m, y_m - nearest_y_m)
        # A point inside the outline (noise, or the robot's own parts) is taken as straight ahead or behind.
        inside = clearance_m < 1e-6
        forward = math.copysign(1.0, x_m) if inside else (x_m - nearest_x_m) / clearance_m
        sideways = 0.0 if inside else (y_m - nearest_y_m) / clearance_m
        limit_mps = math.sqrt(2 * config.brake_mps2 * max(0.0, clearance_m - config.stop_m))
        # The outline's nearest spot moves at v + w x r: (linear - angular * y, angular * x).
        return _Near(forward, sideways * nearest_x_m - forward * nearest_y_m, limit_mps)

    def limit(self, twist: Twist, now_us: int) -> Twist:
        """`twist` cut to what the scan allows; the same object when nothing was cut."""
        if not self.is_fresh(now_us):
            return twist if twist == STILL else Twist(linear_mps=0.0, angular_rad_s=0.0)
        linear, angular = twist.linear_mps, twist.angular_rad_s
        for _ in range(_PASSES):
            for near in self._near:
                linear, angular = near.cut(linear, angular)
        if (linear, angular) == (twist.linear_mps, twist.angular_rad_s):
            return twist
        return Twist(linear_mps=linear, angular_rad_s=angular)

    def is_fresh(self, now_us: int) -> bool:
        """Whether the newest scan is young enough to be believed."""
        return self._scan_us is not None and 0 <= now_us - self._scan_us <= self._config.max_scan_age_ms * 1000


# A range sensor does not see into its blind zone: all of it must lie within the guard's stop zone. Pure.
#
# Otherwise a robot that creeps up to something loses sight of it before the guard has stopped it, and drives on.


class BlindZoneError(ConfigError):
    """A sensor that is blind beyond the stop zone."""


def check_blind_zone(guard: GuardConfig, scan: Ranges) -> None:
    """Raise BlindZoneError unless whatever this sensor cannot see is nearer to the robot than `guard.stop_m`.

    Of `scan`, what counts is where the sensor looks and its minimum, not what it saw. Raises ValueError where one of
    these is no number: a bad reading, which a later one may mend.
    """
    said = (scan.range_min_m, scan.angle_min_rad, scan.angle_increment_rad)
    if not all(map(math.isfinite, said)):
        raise ValueError(f"the range sensor's least range and angles are {said}: no numbers")
    reach_m = max(_blind(guard, scan), default=0.0)
    if reach_m >= guard.stop_m:
        raise BlindZoneError(
            f"guard.stop_m = {guard.stop_m:g}: the range sensor sees nothing nearer than {scan.range_min_m:.3g} m, "
            f"which reaches {reach_m:.3f} m beyond the robot's outline; set guard.stop_m above that "
            "(docs/reference/robots-and-scenarios.md)"
        )


def _blind(guard: GuardConfig, scan: Ranges) -> Iterator[float]:
    """Clearance of the furthest spots that each ray is blind for: both ends, for an outline that is convex."""
    for index in range(len(scan.ranges_m)):
        angle_rad = scan.angle_min_rad + index * scan.angle_increment_rad
        for range_m in (0.0, scan.range_min_m):
            x_m, y_m = guard.sensor_x_m + range_m * math.cos(angle_rad), range_m * math.sin(angle_rad)
            ahead_m, aside_m = max(x_m - guard.front_m, -guard.rear_m - x_m), abs(y_m) - guard.half_width_m
            yield math.hypot(max(0.0, ahead_m), max(0.0, aside_m))
