"""A lidar: rays from the sensor to whatever is not the robot. Shell (PyBullet); reads no clock."""

from __future__ import annotations

import array
import math

import numpy as np

from robot_side.ports import Ranges
from sim.engine import pybullet
from sim.physics import TARGET, WALL, Vector
from sim.robot_model import LidarModel


class Lidar:
    """Casts rays level with the floor; one that starts in a body would hit nothing, so the robot is masked out."""

    def __init__(self, client: int, model: LidarModel, seed: int) -> None:
        self._client, self._model = client, model
        self._draw = np.random.default_rng([seed, 3])
        self._angles_rad = -math.pi + np.arange(model.rays) * (math.tau / model.rays)

    def scan(self, place: Vector, yaw_rad: float, t_us: int) -> Ranges:
        """One turn at an instant, the sensor at `place`."""
        model = self._model
        angles = self._angles_rad + yaw_rad
        ends = np.empty((model.rays, 3))
        ends[:, 0] = place[0] + model.range_max_m * np.cos(angles)
        ends[:, 1] = place[1] + model.range_max_m * np.sin(angles)
        ends[:, 2] = place[2]
        hits = pybullet.rayTestBatch(
            [place] * model.rays, ends.tolist(), numThreads=1, collisionFilterMask=TARGET | WALL,
            physicsClientId=self._client,
        )
        return Ranges(
            t_us=t_us, angle_min_rad=-math.pi, angle_increment_rad=math.tau / model.rays,
            range_min_m=model.range_min_m, range_max_m=model.range_max_m, ranges_m=self._measured(hits),
        )

    def _measured(self, hits: list[tuple[int, int, float, Vector, Vector]]) -> array.array[float]:
        model = self._model
        ranges = np.array([hit[2] if hit[0] >= 0 else np.inf for hit in hits]) * model.range_max_m
        if model.noise_m:
            ranges = ranges + self._draw.normal(0.0, model.noise_m, model.rays)
        return array.array("f", np.where(ranges == np.inf, ranges, np.maximum(ranges, model.range_min_m)).tolist())
