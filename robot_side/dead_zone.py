"""What stands inside a range sensor's dead zone is not seen: all of it must lie within the guard's stop zone. Pure.

Otherwise a robot that creeps up to something loses sight of it before the guard has stopped it, and drives on.
"""

import math
from collections.abc import Iterator

from sightline.protocol.errors import ConfigError
from sightline.robot_side.safety.guard import GuardConfig
from sightline.robot_side.ports import Ranges


class BlindZoneError(ConfigError):
    """A sensor that is blind beyond the stop zone."""


def check_blind_zone(guard: GuardConfig, scan: Ranges) -> None:
    """Raise DeadZoneError unless whatever this sensor cannot see is nearer to the robot than `guard.stop_m`.

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
            f"which reaches {reach_m:.3f} m beyond the robot's outline; set guard.stop_m above that (docs/robots.md)"
        )


def _blind(guard: GuardConfig, scan: Ranges) -> Iterator[float]:
    """Clearance of the furthest spots that each ray is blind for: both ends, for an outline that is convex."""
    for index in range(len(scan.ranges_m)):
        angle_rad = scan.angle_min_rad + index * scan.angle_increment_rad
        for range_m in (0.0, scan.range_min_m):
            x_m, y_m = guard.sensor_x_m + range_m * math.cos(angle_rad), range_m * math.sin(angle_rad)
            ahead_m, aside_m = max(x_m - guard.front_m, -guard.rear_m - x_m), abs(y_m) - guard.half_width_m
            yield math.hypot(max(0.0, ahead_m), max(0.0, aside_m))
