"""The legacy leg follower. Pure.

It takes 70 of a lidar's rays, one a degree, from 39 degrees left to 30 right, and indexes them with the box's edges as
shares of the image. The image center is ray 35, straight ahead is ray 39, and the law steers for ray 30.
The integrals ignore time and have no bounds; there is no memory. All of that is kept.
"""

import math
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from sightline.protocol.config import Config as Settings
from sightline.protocol.messages import STILL, CameraModel, Twist
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.port import Plan, RangeScan, View

_RAYS = 70
_FIRST_DEG = 39.0  # the leftmost ray; each next ray is one degree further right
_AHEAD_RAY = 30


class LegsBaseline:
    """One step of the legacy law for each answer of the detector."""

    class Config(Settings):
        """Numbers of the legacy law; gains per step, ranges in meters, angles in rays. A sane preset halves
        `angular_kp` and has no integrals: `linear_ki = 0`, `angular_ki = 0`.
        """

        label: Annotated[str, Field(max_length=64)] = "legs"
        linear_kp: float = 0.25
        linear_ki: float = 0.02
        angular_kp: float = -0.0145
        angular_ki: float = -0.0005
        driving_share: float = 0.4
        """Share of `angular_kp` that it applies while it drives."""
        far_m: Annotated[float, Field(gt=0)] = 2.5
        drive_from_m: Annotated[float, Field(gt=0)] = 0.65
        turn_from_m: Annotated[float, Field(gt=0)] = 0.35

    wants_scan: ClassVar[bool] = True

    def __init__(self, config: Config, camera: CameraModel) -> None:
        self._config = config
        self._width_px = camera.width_px
        self._linear_sum = self._angular_sum = 0.0

    def step(self, view: View) -> Plan:
        """Find the nearest ray in all boxes, then drive and turn, only turn, or stop."""
        config = self._config
        boxes = [one for one in view.detections if config.label in ("", one.label)]
        ray, away_m = self._nearest(boxes, view.scan)
        if away_m >= config.far_m:
            self._linear_sum = self._angular_sum = 0.0
            return Plan(STILL, "out of range")
        if away_m <= config.turn_from_m:
            return Plan(STILL, "too near", distance_m=away_m)
        if away_m <= config.drive_from_m:
            self._angular_sum += ray
            return Plan(self._twist(0.0, ray * config.angular_kp), "turning", distance_m=away_m)
        self._linear_sum += away_m
        self._angular_sum += ray
        linear = away_m * config.linear_kp + config.linear_ki * self._linear_sum
        return Plan(self._twist(linear, ray * config.angular_kp * config.driving_share), "driving", distance_m=away_m)

    def _twist(self, linear: float, angular: float) -> Twist:
        """Return the twist, limited to 1000, because the integral has no bound and the text of a twist has 64 bytes."""
        angular += self._config.angular_ki * self._angular_sum
        return Twist(linear_mps=min(linear, 1000.0), angular_rad_s=max(-1000.0, min(1000.0, angular)))

    def _nearest(self, boxes: list[Detection], scan: RangeScan | None) -> tuple[int, float]:
        """Return the nearest echo in any box: its ray relative to the law's "ahead", and its range."""
        best = 0, self._config.far_m
        rays = _seventy(scan) if scan is not None else []
        for one in boxes:
            first = max(0, int(one.x1_px / self._width_px * _RAYS))
            last = min(len(rays), int(one.x2_px / self._width_px * _RAYS))
            for index in range(first, last):
                if rays[index] < best[1]:
                    best = index - _AHEAD_RAY, rays[index]
        return best


def _seventy(scan: RangeScan) -> list[float]:
    """Return the 70 rays, each the nearest ray of the scan by angle; inf outside of the arc."""
    if not scan.angle_increment_rad:  # a single ray has no arc
        return [math.inf] * _RAYS
    angles = np.radians(_FIRST_DEG - np.arange(_RAYS))
    turned = np.remainder(angles - scan.angle_min_rad, math.tau)
    index = np.rint(turned / scan.angle_increment_rad).astype(np.int64)
    if len(scan.ranges_m) * scan.angle_increment_rad > math.tau - 1.5 * scan.angle_increment_rad:
        index %= len(scan.ranges_m)
    known = (index >= 0) & (index < len(scan.ranges_m))
    ranges = np.full(_RAYS, math.inf)
    ranges[known] = scan.ranges_m[index[known]]
    found: list[float] = ranges.tolist()
    return found
