"""Limit the speed toward obstacles, and check the blind zone of the range sensor. Pure.

Each near point of a scan becomes one inequality on the twist. The robot approaches the point at
`linear * forward + angular * turning`. This speed may be at most sqrt(2 brake (clearance - stop)), so that the robot
still brakes in time. Motion along a wall or away from it is free. A stale sensor counts as an obstacle all around.
docs/explanation/decisions/0003 compares this rule with a lane of free distance.
"""

import math
from collections.abc import Iterable, Iterator

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import STILL, Twist
from sightline.robot_side.ports import Ranges

# The first pass reduces the speed. Without that speed a turn can approach an earlier point, so the second pass reduces
# the turn, and the third applies it to all points. At zero speed a smaller turn is safe for every point.
_PASSES = 3


class GuardConfig(Config):
    """The outline of the robot, measured from the midpoint of its axle, and the zones around it."""

    front_m: float = Field(default=0.07, ge=0, le=2, description="outline ahead of the axle")
    rear_m: float = Field(default=0.10, ge=0, le=2, description="outline behind the axle")
    half_width_m: float = Field(default=0.09, gt=0.01, le=2, description="outline to each side")
    sensor_x_m: float = Field(default=0.055, ge=-2, le=2, description="position of the sensor, ahead of the axle")
    stop_m: float = Field(
        default=0.08,
        ge=0.02,
        le=5,
        description="clearance at which no motion toward a point remains; set it well below every stand-off",
    )
    brake_mps2: float = Field(
        default=0.5,
        gt=0,
        le=20,
        description="braking that the slow zone assumes; well below the real one, for motor lag and scan age",
    )
    max_scan_age_ms: int = Field(
        default=400, ge=50, le=5_000, description="an older scan counts as an obstacle all around"
    )


_Near = tuple[float, float, float]
"""One near point as an inequality (forward, turning, limit_mps): `linear * forward + angular * turning <= limit_mps`.

A plain tuple, because a scan has up to 16,384 points, and the control loop passes all of them at each tick.
"""


def _cut(near: _Near, angular: float) -> tuple[float, float]:
    """Return the twist at the limit. Speed is reduced before turning, so that the robot can turn away."""
    forward, turning, limit_mps = near
    left_mps = limit_mps - angular * turning
    if left_mps >= 0:
        return left_mps / forward, angular
    return 0.0, limit_mps / turning


def _inequalities(config: GuardConfig, points: Iterable[tuple[float, float]]) -> Iterator[_Near]:
    """Yield the inequality of each point, x_m and y_m from the midpoint of the axle."""
    front_m, rear_m, half_width_m = config.front_m, config.rear_m, config.half_width_m
    stop_m, braking_mps2 = config.stop_m, 2 * config.brake_mps2
    for x_m, y_m in points:
        nearest_x_m = max(-rear_m, min(front_m, x_m))
        nearest_y_m = max(-half_width_m, min(half_width_m, y_m))
        clearance_m = math.hypot(x_m - nearest_x_m, y_m - nearest_y_m)
        # A point inside the outline is noise or a part of the robot and has no direction. It counts as ahead or behind,
        # which blocks motion toward the point and permits motion away from it.
        inside = clearance_m < 1e-6
        forward = math.copysign(1.0, x_m) if inside else (x_m - nearest_x_m) / clearance_m
        sideways = 0.0 if inside else (y_m - nearest_y_m) / clearance_m
        limit_mps = math.sqrt(braking_mps2 * max(0.0, clearance_m - stop_m))
        # Rigid-body motion: the nearest spot of the outline moves at v + w x r = (linear - angular * y, angular * x).
        yield forward, sideways * nearest_x_m - forward * nearest_y_m, limit_mps


def _met_m(scan: Ranges, range_m: float) -> float | None:
    """Return the distance of a ray in m: inf without an obstacle, None without an echo, range_min_m if too close."""
    if range_m == math.inf:
        return range_m
    if range_m == 0 or range_m > scan.range_max_m:
        return None
    return max(range_m, scan.range_min_m)


class RangeGuard:
    """Limits twists by the newest scan."""

    def __init__(self, config: GuardConfig) -> None:
        self._config = config
        self._scan_us: int | None = None
        self._near: list[_Near] = []

    def see(self, scan: Ranges) -> None:
        """Process a scan, see `Ranges`. An invalid scan is ignored, so that the sensor soon counts as silent.

        Args:
            scan: one turn of the sensor, m and rad.
        """
        met_m = [_met_m(scan, range_m) for range_m in scan.ranges_m]
        if any(map(math.isnan, scan.ranges_m)) or all(range_m is None for range_m in met_m):
            return
        self._scan_us = scan.t_us
        angles = (scan.angle_min_rad + index * scan.angle_increment_rad for index in range(len(met_m)))
        sensor_x_m = self._config.sensor_x_m
        self._near = list(_inequalities(self._config, (
            (sensor_x_m + range_m * math.cos(angle_rad), range_m * math.sin(angle_rad))
            for range_m, angle_rad in zip(met_m, angles, strict=True)
            if range_m is not None and range_m < math.inf
        )))

    def limit(self, twist: Twist, now_us: int) -> Twist:
        """Limit a twist by the newest scan.

        Args:
            twist: m/s and rad/s, after the ramp.
            now_us: time on the robot's clock.

        Returns:
            The same object if no limit applies. Zero if the scan is stale.
        """
        if not self.is_fresh(now_us):
            return twist if twist == STILL else Twist(linear_mps=0.0, angular_rad_s=0.0)
        linear, angular = twist.linear_mps, twist.angular_rad_s
        for _ in range(_PASSES):
            before = linear, angular
            for near in self._near:
                forward, turning, limit_mps = near
                if not linear * forward + angular * turning <= limit_mps:
                    linear, angular = _cut(near, angular)
            if (linear, angular) == before:
                break  # a further pass changes nothing either
        if (linear, angular) == (twist.linear_mps, twist.angular_rad_s):
            return twist
        return Twist(linear_mps=linear, angular_rad_s=angular)

    def is_fresh(self, now_us: int) -> bool:
        """Return True if the newest scan is younger than `max_scan_age_ms`."""
        return self._scan_us is not None and 0 <= now_us - self._scan_us <= self._config.max_scan_age_ms * 1000


# The blind zone of a range sensor must lie within the stop zone of the guard. Otherwise an obstacle vanishes from the
# scan before the guard has stopped a slow robot, and the robot continues.


class BlindZoneError(ConfigError):
    """The blind zone of the sensor is larger than the stop zone."""


def check_blind_zone(guard: GuardConfig, scan: Ranges) -> None:
    """Check that the blind zone of a sensor lies within `guard.stop_m`.

    Args:
        guard: outline and stop zone, m.
        scan: any scan of the sensor. Only its angles and its minimum range matter.

    Raises:
        BlindZoneError: the blind zone reaches beyond the stop zone.
        ValueError: an angle or the minimum range is not finite. A later scan may be valid.
    """
    geometry = (scan.range_min_m, scan.angle_min_rad, scan.angle_increment_rad)
    if not all(map(math.isfinite, geometry)):
        raise ValueError(f"invalid minimum range and angles {geometry} of the range sensor: not finite")
    reach_m = max(_blind(guard, scan), default=0.0)
    if reach_m >= guard.stop_m:
        raise BlindZoneError(
            f"guard.stop_m = {guard.stop_m:g}: the range sensor is blind below {scan.range_min_m:.3g} m, which reaches "
            f"{reach_m:.3f} m beyond the outline of the robot; set guard.stop_m above {reach_m:.3f} "
            "(docs/reference/robots-and-scenarios.md)"
        )


def _blind(guard: GuardConfig, scan: Ranges) -> Iterator[float]:
    """Yield the clearance at both ends of the blind part of each ray. The outline is convex, so the ends suffice."""
    for index in range(len(scan.ranges_m)):
        angle_rad = scan.angle_min_rad + index * scan.angle_increment_rad
        # The sensor itself, the near end of every ray, counts once.
        for range_m in (scan.range_min_m,) if index else (0.0, scan.range_min_m):
            x_m, y_m = guard.sensor_x_m + range_m * math.cos(angle_rad), range_m * math.sin(angle_rad)
            ahead_m, aside_m = max(x_m - guard.front_m, -guard.rear_m - x_m), abs(y_m) - guard.half_width_m
            yield math.hypot(max(0.0, ahead_m), max(0.0, aside_m))
