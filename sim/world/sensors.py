"""A lidar, or several small sensors merged into one scan: rays to whatever is not the robot. Shell (PyBullet).

Reads no clock. Rays are level with the floor; one that starts in a body would hit nothing, so the robot is masked out.
"""

from __future__ import annotations

import array
import math

import numpy as np
import numpy.typing as npt

from sightline.robot_side.ports import Ranges
from sightline.sim.world.engine import pybullet
from sightline.sim.world.physics import TARGET, WALL, Vector
from sightline.sim.robot import LidarModel, RangeSensorMount

Numbers = npt.NDArray[np.float64]


class Lidar:
    """Casts the rays of a scan."""

    def __init__(self, client: int, model: LidarModel, seed: int) -> None:
        self._client, self._model = client, model
        self._draw = np.random.default_rng([seed, 3])
        self._first_rad = math.radians(model.first_deg)
        self._angles_rad: Numbers = self._first_rad + np.arange(model.rays, dtype=np.float64) * model.increment_rad

    def scan(self, place: Vector, yaw_rad: float, t_us: int) -> Ranges:
        """One turn at an instant, the sensor at `place`."""
        model = self._model
        seen = self._merged(place, yaw_rad) if model.eyes else self._cast(place, yaw_rad)
        return Ranges(
            t_us=t_us, angle_min_rad=self._first_rad, angle_increment_rad=model.increment_rad,
            range_min_m=model.range_min_m, range_max_m=model.range_max_m, ranges_m=self._measured(seen),
        )

    def _cast(self, place: Vector, yaw_rad: float) -> Numbers:
        return self._distances(place, self._angles_rad + yaw_rad, self._model.range_max_m)

    def _distances(self, place: Vector, angles_rad: Numbers, reach_m: float) -> Numbers:
        """How far the rays go, inf where they hit nothing."""
        ends = np.empty((len(angles_rad), 3))
        ends[:, 0] = place[0] + reach_m * np.cos(angles_rad)
        ends[:, 1] = place[1] + reach_m * np.sin(angles_rad)
        ends[:, 2] = place[2]
        hits = pybullet.rayTestBatch(
            [place] * len(ends), ends.tolist(), numThreads=1, collisionFilterMask=TARGET | WALL,
            physicsClientId=self._client,
        )
        return np.array([hit[2] if hit[0] >= 0 else np.inf for hit in hits]) * reach_m

    def _merged(self, place: Vector, yaw_rad: float) -> Numbers:
        """What all eyes see, from the one place: each echo counts in the ray that is nearest to its direction."""
        model = self._model
        merged = np.full(model.rays, np.inf)
        for eye in model.eyes:
            away, angles_rad = self._echoes(eye, place, yaw_rad)
            numbers = np.rint((angles_rad - self._first_rad) / model.increment_rad).astype(int)
            if model.last_deg - model.first_deg == 360:
                numbers %= model.rays
            inside = (numbers >= 0) & (numbers < model.rays)
            np.minimum.at(merged, numbers[inside], away[inside])
        return merged

    def _echoes(self, eye: RangeSensorMount, place: Vector, yaw_rad: float) -> tuple[Numbers, Numbers]:
        """Of one eye: how far its echoes are from the scan's place, and in which direction of the robot."""
        half_rad = math.radians(eye.span_deg) / 2
        angles_rad: Numbers = math.radians(eye.facing_deg) + np.linspace(-half_rad, half_rad, eye.rays)
        ahead_m, left_m = eye.x_m - self._model.x_m, eye.y_m
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        at = (place[0] + ahead_m * cos - left_m * sin, place[1] + ahead_m * sin + left_m * cos, place[2])
        gone = self._distances(at, angles_rad + yaw_rad, eye.reach_m)
        echoes = np.isfinite(gone)
        x_m = ahead_m + gone[echoes] * np.cos(angles_rad[echoes])
        y_m = left_m + gone[echoes] * np.sin(angles_rad[echoes])
        return np.hypot(x_m, y_m), np.arctan2(y_m, x_m)

    def _measured(self, ranges: Numbers) -> array.array[float]:
        model = self._model
        if model.noise_m:
            ranges = ranges + self._draw.normal(0.0, model.noise_m, model.rays)
        return array.array("f", np.where(ranges == np.inf, ranges, np.maximum(ranges, model.range_min_m)).tolist())
