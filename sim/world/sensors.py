"""Lidar and perfect labels by ray casts. Shell (PyBullet).

Reads no clock. Rays are parallel to the floor. A ray that starts in a body hits nothing, so the robot is masked out.
"""

from __future__ import annotations

import array
import math
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from sightline.robot_side.ports import Ranges
from sightline.sim.bus import Label
from sightline.sim.robot import LidarModel, RangeSensorMount
from sightline.sim.world.bodies import ThingBodies
from sightline.sim.world.effects import Shutter
from sightline.sim.world.engine import pybullet
from sightline.sim.world.physics import TARGET, WALL, Vector
from sightline.sim.world.view import Moment

Numbers = npt.NDArray[np.float64]


class Lidar:
    """Casts the rays of a scan."""

    def __init__(self, client: int, model: LidarModel, seed: int) -> None:
        self._client, self._model = client, model
        self._draw = np.random.default_rng([seed, 3])
        self._first_rad = math.radians(model.first_deg)
        self._angles_rad: Numbers = self._first_rad + np.arange(model.rays, dtype=np.float64) * model.increment_rad

    def scan(self, place: Vector, yaw_rad: float, t_us: int) -> Ranges:
        """Return one scan at an instant, the sensor at `place`."""
        model = self._model
        seen = self._merged(place, yaw_rad) if model.sensors else self._cast(place, yaw_rad)
        return Ranges(
            t_us=t_us, angle_min_rad=self._first_rad, angle_increment_rad=model.increment_rad,
            range_min_m=model.range_min_m, range_max_m=model.range_max_m, ranges_m=self._measured(seen),
        )

    def _cast(self, place: Vector, yaw_rad: float) -> Numbers:
        return self._distances(place, self._angles_rad + yaw_rad, self._model.range_max_m)

    def _distances(self, place: Vector, angles_rad: Numbers, reach_m: float) -> Numbers:
        """Return the length of each ray in m, inf without a hit."""
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
        """Merge all single-ray sensors into one scan. Each echo counts in the ray nearest to its direction."""
        model = self._model
        merged = np.full(model.rays, np.inf)
        for sensor in model.sensors:
            away, angles_rad = self._echoes(sensor, place, yaw_rad)
            numbers = np.rint((angles_rad - self._first_rad) / model.increment_rad).astype(int)
            if model.last_deg - model.first_deg == 360:
                numbers %= model.rays
            inside = (numbers >= 0) & (numbers < model.rays)
            np.minimum.at(merged, numbers[inside], away[inside])
        return merged

    def _echoes(self, sensor: RangeSensorMount, place: Vector, yaw_rad: float) -> tuple[Numbers, Numbers]:
        """Return the echoes of one single-ray sensor: distance from the origin of the scan, and direction."""
        half_rad = math.radians(sensor.span_deg) / 2
        angles_rad: Numbers = math.radians(sensor.facing_deg) + np.linspace(-half_rad, half_rad, sensor.rays)
        ahead_m, left_m = sensor.x_m - self._model.x_m, sensor.y_m
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        at = (place[0] + ahead_m * cos - left_m * sin, place[1] + ahead_m * sin + left_m * cos, place[2])
        gone = self._distances(at, angles_rad + yaw_rad, sensor.reach_m)
        echoes = np.isfinite(gone)
        x_m = ahead_m + gone[echoes] * np.cos(angles_rad[echoes])
        y_m = left_m + gone[echoes] * np.sin(angles_rad[echoes])
        return np.hypot(x_m, y_m), np.arctan2(y_m, x_m)

    def _measured(self, ranges: Numbers) -> array.array[float]:
        model = self._model
        if model.noise_m:
            ranges = ranges + self._draw.normal(0.0, model.noise_m, model.rays)
        return array.array("f", np.where(ranges == np.inf, ranges, np.maximum(ranges, model.range_min_m)).tolist())


# Labels that the simulation gives an image: boxes of walking legs, as from a perfect detector. Shell (PyBullet).
#
# Reads no clock. One box contains both legs. Its score is their visible share.


_NEAR_M = 0.1
_SEEN_AT = (0.15, 0.4, 0.65, 0.9)  # share of a leg's height at which its visibility is sampled
_LEAST_SEEN = 0.25
_LEAST_PX = 2.0
_AROUND_RAD = np.linspace(0.0, math.tau, 12, endpoint=False)

Points = npt.NDArray[np.float64]


def leg_labels(
    client: int, people: Iterable[ThingBodies], camera: Shutter, moment: Moment
) -> tuple[Label, ...]:
    """Return the visible people, best visible first, in pixels of the camera's image."""
    axes = np.array(pybullet.getMatrixFromQuaternion(moment.turn)).reshape(3, 3)
    seen_axes = np.stack([-axes[:, 1], -axes[:, 2], axes[:, 0]], axis=-1)
    found = [_label(client, one, camera, moment, seen_axes) for one in people]
    return tuple(sorted((one for one in found if one), key=lambda one: one.score, reverse=True))


def _label(
    client: int, person: ThingBodies, camera: Shutter, moment: Moment, seen_axes: Points
) -> Label | None:
    lens = np.array(moment.place)
    ahead = _outline(client, person, lens, seen_axes)
    if ahead is None:
        return None
    pixels, size = camera.pixels(ahead, moment.turn_rad_s), (camera.model.width_px, camera.model.height_px)
    left, top = np.maximum(pixels.min(axis=0), 0.0).tolist()
    right, bottom = np.minimum(pixels.max(axis=0), size).tolist()
    if right - left < _LEAST_PX or bottom - top < _LEAST_PX:
        return None
    score = _seen_share(client, person, lens)
    return Label("legs", score, left, top, right, bottom) if score >= _LEAST_SEEN else None


def _outline(client: int, person: ThingBodies, lens: Points, seen_axes: Points) -> Points | None:
    """Return the upper and lower rims of the legs: right, down, ahead of the lens; None next to or behind it."""
    thing = person.thing
    ring = np.stack([np.cos(_AROUND_RAD), np.sin(_AROUND_RAD), np.zeros(len(_AROUND_RAD))], axis=-1) * thing.radius_m
    rims = [
        np.array(_middle(client, leg)) + ring + [0.0, 0.0, up_m]
        for leg in person.bodies for up_m in (-thing.height_m / 2, thing.height_m / 2)
    ]
    ahead = (np.concatenate(rims) - lens) @ seen_axes
    return None if ahead[:, 2].min() < _NEAR_M else np.asarray(ahead)


def _seen_share(client: int, person: ThingBodies, lens: Points) -> float:
    """Return the visible share of points along both legs."""
    seen = looked = 0
    for leg in person.bodies:
        x_m, y_m, _ = _middle(client, leg)
        for share in _SEEN_AT:
            looked += 1
            to = [x_m, y_m, share * person.thing.height_m]
            hit = pybullet.rayTest(lens.tolist(), to, collisionFilterMask=TARGET | WALL, physicsClientId=client)[0]
            seen += hit[0] == leg
    return seen / looked


def _middle(client: int, body: int) -> Vector:
    return pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0]  # type: ignore[no-any-return]
