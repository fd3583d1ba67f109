"""What the simulation itself labels in a picture: boxes of walking legs, as a perfect detector's. Shell (PyBullet).

Reads no clock. A box holds both legs of a person; its score is the share of them that nothing hides.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from sightline.protocol.messages import CameraModel
from sightline.sim.world.engine import pybullet
from sightline.sim.label_bus import Label
from sightline.sim.world.physics import TARGET, WALL, Vector
from sightline.sim.world.bodies import ThingBodies

_NEAR_M = 0.1
_SEEN_AT = (0.15, 0.4, 0.65, 0.9)  # of a leg's height: where it is looked for
_LEAST_SEEN = 0.25
_LEAST_PX = 2.0
_AROUND_RAD = np.linspace(0.0, math.tau, 12, endpoint=False)

Points = npt.NDArray[np.float64]


def leg_labels(
    client: int, people: Iterable[ThingBodies], camera: CameraModel, lens: Vector, turn: Any
) -> tuple[Label, ...]:
    """The people in view, best seen first."""
    axes = np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
    seen_axes = np.stack([-axes[:, 1], -axes[:, 2], axes[:, 0]], axis=-1)
    found = [_label(client, one, camera, np.array(lens), seen_axes) for one in people]
    return tuple(sorted((one for one in found if one), key=lambda one: one.score, reverse=True))


def _label(
    client: int, person: ThingBodies, camera: CameraModel, lens: Points, seen_axes: Points
) -> Label | None:
    pixels = _outline_px(client, person, camera, lens, seen_axes)
    if pixels is None:
        return None
    left, top = np.maximum(pixels.min(axis=0), 0.0).tolist()
    right, bottom = np.minimum(pixels.max(axis=0), [camera.width_px, camera.height_px]).tolist()
    if right - left < _LEAST_PX or bottom - top < _LEAST_PX:
        return None
    score = _seen_share(client, person, lens)
    return Label("legs", score, left, top, right, bottom) if score >= _LEAST_SEEN else None


def _outline_px(
    client: int, person: ThingBodies, camera: CameraModel, lens: Points, seen_axes: Points
) -> Points | None:
    """Where the legs' upper and lower rims are in the picture; None for a person beside or behind the lens."""
    thing = person.thing
    ring = np.stack([np.cos(_AROUND_RAD), np.sin(_AROUND_RAD), np.zeros(len(_AROUND_RAD))], axis=-1) * thing.radius_m
    rims = [
        np.array(_middle(client, leg)) + ring + [0.0, 0.0, up_m]
        for leg in person.bodies for up_m in (-thing.height_m / 2, thing.height_m / 2)
    ]
    ahead = (np.concatenate(rims) - lens) @ seen_axes
    if ahead[:, 2].min() < _NEAR_M:
        return None
    focal, middle = np.array([camera.fx_px, camera.fy_px]), np.array([camera.cx_px, camera.cy_px])
    return np.asarray(middle + focal * ahead[:, :2] / ahead[:, 2:])


def _seen_share(client: int, person: ThingBodies, lens: Points) -> float:
    """Of points up and down both legs, those that the lens sees."""
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
