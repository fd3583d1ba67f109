"""Limits speed towards what the range sensor sees: held state, last before the wheels. Pure.

A scan is turned once into free distances ahead and behind, along the robot's own width. Towards an obstacle the speed
is at most sqrt(2 a (free - stop zone)): what still brakes in time. A stale sensor counts as an obstacle.
"""

import math
from typing import Annotated

from pydantic import Field

from protocol.config import Config
from protocol.messages import Twist
from robot_side.ports import Ranges


class GuardConfig(Config):
    """Zones of the range guard. Distances are from the robot's outline along its direction of travel."""

    stop_m: Annotated[float, Field(ge=0.02, le=5)] = 0.12
    """No motion towards anything nearer. Keep it well below every stand-off."""
    brake_mps2: Annotated[float, Field(gt=0, le=20)] = 0.8
    """Braking the slow zone assumes; below the robot's own, so that motor lag and scan age fit in."""
    half_width_m: Annotated[float, Field(gt=0.01, le=2)] = 0.13
    """Half of the lane kept free: half the robot's width and a margin."""
    front_m: Annotated[float, Field(ge=0, le=2)] = 0.08
    """From the axle to the front edge."""
    rear_m: Annotated[float, Field(ge=0, le=2)] = 0.10
    sensor_x_m: Annotated[float, Field(ge=-2, le=2)] = 0.055
    """Where the sensor sits, from the axle, forward."""
    max_scan_age_ms: Annotated[int, Field(ge=50, le=5_000)] = 400


class RangeGuard:
    """Holds the newest scan's verdict and cuts speed with it."""

    def __init__(self, config: GuardConfig) -> None:
        self._config = config
        self._scan_us: int | None = None
        self.ahead_m = self.behind_m = 0.0

    def see(self, scan: Ranges) -> None:
        """Take a scan."""
        self._scan_us = scan.t_us
        self.ahead_m = self.behind_m = math.inf
        config = self._config
        for index, range_m in enumerate(scan.ranges_m):
            angle_rad = scan.angle_min_rad + index * scan.angle_increment_rad
            if not scan.range_min_m <= range_m <= scan.range_max_m:
                continue
            x_m, y_m = config.sensor_x_m + range_m * math.cos(angle_rad), range_m * math.sin(angle_rad)
            if abs(y_m) > config.half_width_m:
                continue
            if x_m > 0:
                self.ahead_m = min(self.ahead_m, x_m - config.front_m)
            else:
                self.behind_m = min(self.behind_m, -x_m - config.rear_m)

    def limit(self, twist: Twist, now_us: int) -> Twist:
        """`twist` with its forward or backward speed cut to what is safe; turning is left to it."""
        limit_mps = self._limit_mps(self.ahead_m if twist.linear_mps > 0 else self.behind_m, now_us)
        if abs(twist.linear_mps) <= limit_mps:
            return twist
        return Twist(linear_mps=math.copysign(limit_mps, twist.linear_mps), angular_rad_s=twist.angular_rad_s)

    def _limit_mps(self, free_m: float, now_us: int) -> float:
        if not self.is_fresh(now_us):
            return 0.0
        return math.sqrt(2 * self._config.brake_mps2 * max(0.0, free_m - self._config.stop_m))

    def is_fresh(self, now_us: int) -> bool:
        """Whether the newest scan is young enough to be believed."""
        return self._scan_us is not None and 0 <= now_us - self._scan_us <= self._config.max_scan_age_ms * 1000
