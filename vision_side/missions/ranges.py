"""Range scans: decoding, and echoes in the odometry frame. Pure."""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from sightline.protocol.codec import decode, decode_ranges
from sightline.protocol.messages import FrameHeader, Pose, ScanHeader
from sightline.vision_side.missions.port import RangeScan


def decode_scan(header: bytes, payload: bytes) -> tuple[ScanHeader, RangeScan]:
    """Decode a scan and its stamp.

    Raises WireError: MALFORMED for broken headers and sizes, NOT_FINITE for a nan or a negative range.
    """
    stamp = decode(ScanHeader, header)
    ranges_m = np.array(decode_ranges(payload), np.float32)
    scan = RangeScan(stamp.t_us, stamp.angle_min_rad, stamp.angle_increment_rad, stamp.range_min_m, stamp.range_max_m,
                     ranges_m)
    return stamp, scan


# Positions of the echoes of a scan, for the pose at the time of the scan. Pure.
#
# A scan is older than its frame by up to one turn of the sensor. The robot may have turned since then. So the echoes
# are converted to the odometry frame with the pose of the scan time.


Points = NDArray[np.float64]
"""(N, 2), meters."""

_REMEMBERED = 64  # poses: two seconds at 30 fps, longer than the largest accepted age of a scan
_MAX_AHEAD_S = 0.2  # longest extrapolation of the newest pose to a newer scan


class PoseMemory:
    """Stores the poses of the robot of the last two seconds."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, Pose]] = deque(maxlen=_REMEMBERED)
        self._moving = (0.0, 0.0)

    def add(self, header: FrameHeader) -> None:
        """Store the odometry of a frame. Frames come in order."""
        self._poses.append((header.t_us, header.pose))
        self._moving = header.moving

    def at(self, t_us: int) -> Pose:
        """Return the pose at `t_us`: interpolated, extrapolated for a short time, or else the nearest in time."""
        newest_us, newest = self._poses[-1]
        if t_us >= newest_us:
            return _moved(newest, self._moving, min((t_us - newest_us) / 1e6, _MAX_AHEAD_S))
        later_us, later = newest_us, newest
        for before_us, before in reversed(self._poses):
            if before_us <= t_us:
                share = (t_us - before_us) / max(1, later_us - before_us)
                return _between(before, later, share)
            later_us, later = before_us, before
        return later


def _moved(pose: Pose, moving: tuple[float, float], seconds: float) -> Pose:
    middle = pose[2] + moving[1] * seconds / 2
    way = moving[0] * seconds
    return pose[0] + way * math.cos(middle), pose[1] + way * math.sin(middle), pose[2] + moving[1] * seconds


def _between(one: Pose, other: Pose, share: float) -> Pose:
    turn = math.remainder(other[2] - one[2], math.tau)
    return one[0] + share * (other[0] - one[0]), one[1] + share * (other[1] - one[1]), one[2] + share * turn


def echoes(scan: RangeScan, sensor_x_m: float) -> Points:
    """Return the points of `scan` relative to the robot. The sensor is `sensor_x_m` ahead of the axle.

    An obstacle too close to measure gets the distance `range_min_m`.
    """
    ranges = scan.ranges_m.astype(np.float64)
    met = np.flatnonzero((ranges > 0) & (ranges <= scan.range_max_m))
    ranges, angles = np.maximum(ranges[met], scan.range_min_m), scan.angle_min_rad + met * scan.angle_increment_rad
    return np.column_stack([sensor_x_m + ranges * np.cos(angles), ranges * np.sin(angles)])


def in_odometry(points: Points, pose: Pose) -> Points:
    """Convert points relative to the robot at `pose` to the odometry frame."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y])


def about_robot(points: Points, pose: Pose) -> Points:
    """Convert points of the odometry frame to points relative to the robot at `pose`."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = points[:, 0] - pose[0], points[:, 1] - pose[1]
    return np.column_stack([cos * x + sin * y, cos * y - sin * x])
