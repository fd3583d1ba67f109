"""Renders a scene with boxes from the segmentation mask. Shell (PyBullet)."""

import math
from collections.abc import Sequence
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from sightline.sim.scenario import LIT, Color, LegShape, Light, Part, State, color_of
from sightline.sim.scenes.model import (
    HEIGHT_PX,
    MOST_HIDDEN,
    VALIDATED_FROM,
    WIDTH_PX,
    Box,
    Column,
    LabelledBox,
    Lens,
    Scene,
    ScenePlan,
    Solid,
    Surface,
)
from sightline.sim.scenes.plan import plan_scene, with_more_of_the_ball
from sightline.sim.scenes.textures import SIDE, texture
from sightline.sim.world.bodies import ball_visual
from sightline.sim.world.camera import FAR_M, NEAR_M, NOTHING_DEPTH
from sightline.sim.world.engine import camera_arrays, pybullet

Plane = npt.NDArray[np.float32]
_SHADED = (0.7, 1.0)  # brightness of the wall, by its orientation
_ABOVE = np.float32(1e6)


def backdrop(plan: ScenePlan) -> npt.NDArray[np.uint8]:
    """Return the RGB image of the empty room."""
    x, y, z = _rays(plan.lens)
    floor_at = np.where(z < -1e-3, np.float32(plan.floor_m) / np.minimum(z, np.float32(-1e-3)), _ABOVE)
    cos, sin = np.float32(math.cos(plan.wall_turn_rad)), np.float32(math.sin(plan.wall_turn_rad))
    towards = x * cos + y * sin
    wall_at = np.where(towards > 0.05, np.float32(plan.wall_m) / np.maximum(towards, np.float32(0.05)), _ABOVE)
    picture = _painted(plan.floor, x * floor_at, y * floor_at)
    wall = _painted(plan.wall, (y * cos - x * sin) * wall_at, -z * wall_at)
    shaded = cv2.convertScaleAbs(wall, alpha=_SHADED[0] + (_SHADED[1] - _SHADED[0]) * plan.ambient)
    cv2.copyTo(shaded, (wall_at < floor_at).view(np.uint8), picture)
    return picture


def _rays(lens: Lens) -> tuple[Plane, Plane, Plane]:
    """Return the ray of each pixel in the world."""
    axes = lens.axes().astype(np.float32)
    right = ((np.arange(WIDTH_PX, dtype=np.float32) + 0.5 - WIDTH_PX / 2) / lens.focal_px).astype(np.float32)
    down = ((np.arange(HEIGHT_PX, dtype=np.float32) + 0.5 - HEIGHT_PX / 2) / lens.focal_px).astype(np.float32)[:, None]
    x, y, z = (axes[row, 0] * right + axes[row, 1] * down + axes[row, 2] for row in range(3))
    return x, y, z


def _painted(surface: Surface, along: Plane, across: Plane) -> npt.NDArray[np.uint8]:
    """Paint the surface where each ray meets it. Far away it is smoothed, because subpixel tiles would flicker."""
    texels = np.float32(SIDE / surface.tile_m)
    tile = texture(surface.family, surface.seed)
    u, v = np.mod(along * texels, SIDE).astype(np.float32), np.mod(across * texels, SIDE).astype(np.float32)
    return np.asarray(cv2.remap(tile, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.uint8)


# Draws labeled scenes: bodies by TinyRenderer, boxes from its segmentation mask. Shell (PyBullet).


Mask = npt.NDArray[Any]

_MIN_SIDE_PX = 5
_MIN_SEEN = 0.4
"""Visible share of a light's or legs' box. Below it, a detection is neither right nor wrong."""
_NO_TURN = (0.0, 0.0, 0.0, 1.0)
_BLOOM_PX = 1.5


class SceneRenderer:
    """A PyBullet client that draws one scene after the other."""

    def __init__(self) -> None:
        self._client = int(pybullet.connect(pybullet.DIRECT))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pybullet.disconnect(physicsClientId=self._client)

    def scene(self, seed: int, column: Column) -> Scene:
        """Return the scene of a seed. In scored and validation scenes a ball is hidden by `MOST_HIDDEN` at most,
        and boxes of its color stay.

        In training a ball that is hidden more is unclear, and nothing is learned there.
        """
        plan = plan_scene(seed, column)
        drawn = self._drawn(plan)
        if seed >= VALIDATED_FROM and _has_ball(plan.solids):
            more = with_more_of_the_ball(plan)
            while not _has_ball(drawn.truths) and (another := next(more, None)):
                drawn = self._drawn(another)
        return drawn

    def _drawn(self, plan: ScenePlan) -> Scene:
        pybullet.resetSimulation(physicsClientId=self._client)
        bodies = [self._add(one) for one in plan.solids]
        rgb, which = self._picture(plan, bodies)
        truths, others, unclear = [], [], []
        for solid, own in zip(plan.solids, bodies, strict=True):
            seen = _box(np.isin(which, [body for body, _ in own if body >= 0]))
            if solid.label:
                truth = _truth(plan.lens, solid, seen, which, own)
                if truth is not None and _is_clear(truth):
                    truths.append(truth)
                elif seen is not None:
                    unclear.append(seen)
            elif seen is not None:
                others.append(seen)
        return Scene(plan, rgb, tuple(truths), tuple(others), tuple(unclear))

    def _picture(self, plan: ScenePlan, bodies: list[list[tuple[int, str]]]) -> tuple[npt.NDArray[np.uint8], Mask]:
        axes = plan.lens.axes()
        forward, up = axes[:, 2].tolist(), (-axes[:, 1]).tolist()
        rgba, depth, segments = camera_arrays(pybullet.getCameraImage(
            WIDTH_PX, HEIGHT_PX, pybullet.computeViewMatrix([0, 0, 0], forward, up), _projection(plan.lens), shadow=0,
            lightDirection=plan.light_from, lightAmbientCoeff=plan.ambient, lightDiffuseCoeff=1.0 - 0.6 * plan.ambient,
            lightSpecularCoeff=0.0, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=self._client,
        ))
        picture = backdrop(plan)
        which = np.where(depth < NOTHING_DEPTH, segments, -1)
        cv2.copyTo(cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB), (which >= 0).astype(np.uint8), picture)
        _shine(picture, which, bodies, plan)
        return picture, which

    def _add(self, one: Solid) -> list[tuple[int, str]]:
        """Add its bodies. Returns each with the lamp's state it shows, if any; negative: not part of its box."""
        if one.shape == "light":
            return self._add_light(one)
        if one.shape == "legs":
            return [(self._cylinder(one, at), "") for at in _feet(one)]
        if one.shape == "ball":
            return [(self._body(ball_visual(self._client, one.size_m[0] / 2, one.colour), one.at_m), "")]
        if one.shape == "cylinder":
            return [(self._cylinder(one, one.at_m), "")]
        turn = pybullet.getQuaternionFromEuler([0, 0, one.turn_rad])
        return [(self._body(self._box_visual(one.size_m, one.colour), one.at_m, turn), "")]

    def _add_light(self, one: Solid) -> list[tuple[int, str]]:
        scale, state = one.size_m[0], _state(one)
        model = Light(at_m=(0.0, 0.0))
        turn = pybullet.getQuaternionFromEuler([0, 0, one.turn_rad])
        added: list[tuple[int, str]] = []
        for part in model.parts():
            at, size = _placed(part, model, one), tuple(side * scale for side in part.size_m)
            colour = color_of(part, state)
            visual = ball_visual(self._client, size[0], colour) if part.shape == "ball" else self._box_visual(
                (size[0], size[1], size[2]), colour)
            body = self._body(visual, at, turn)
            is_pole = part.shape == "box" and part.size_m != model.housing_m
            added.append((-1 if is_pole else body, state if part.state == state else ""))
        return added

    def _cylinder(self, one: Solid, at: tuple[float, float, float]) -> int:
        return self._body(int(pybullet.createVisualShape(
            pybullet.GEOM_CYLINDER, radius=one.size_m[0], length=one.size_m[2], rgbaColor=[*one.colour, 1],
            specularColor=[0, 0, 0], physicsClientId=self._client,
        )), at)

    def _box_visual(self, size: tuple[float, float, float], colour: Color) -> int:
        return int(pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=[side / 2 for side in size], rgbaColor=[*colour, 1],
            specularColor=[0, 0, 0], physicsClientId=self._client,
        ))

    def _body(self, visual: int, at: tuple[float, float, float],
              turn: tuple[float, float, float, float] = _NO_TURN) -> int:
        return int(pybullet.createMultiBody(0, -1, visual, at, turn, physicsClientId=self._client))


def _has_ball(ones: Sequence[Solid] | Sequence[LabelledBox]) -> bool:
    return any(one.label == "ball" for one in ones)


def _projection(lens: Lens) -> list[float]:
    """Return the projection of the simulated camera. TinyRenderer samples at the left and lower edge of a pixel."""
    half_up_rad = math.atan(HEIGHT_PX / 2 / lens.focal_px)
    aspect = WIDTH_PX / HEIGHT_PX
    matrix = list(pybullet.computeProjectionMatrixFOV(math.degrees(2 * half_up_rad), aspect, NEAR_M, FAR_M))
    matrix[8] += 1 / WIDTH_PX
    matrix[9] += 1 / HEIGHT_PX
    return matrix


def _state(one: Solid) -> State:
    states: dict[str, State] = {"light-red": "red", "light-yellow": "yellow", "light-green": "green"}
    return states[one.label]


def _placed(part: Part, model: Light, one: Solid) -> tuple[float, float, float]:
    """Return a part of the light model, moved from the origin to the place of this light."""
    ahead_m, scale = -part.at_m[0], one.size_m[0]
    cos, sin = math.cos(one.turn_rad), math.sin(one.turn_rad)
    x, y, z = one.at_m
    return x + scale * ahead_m * cos, y + scale * ahead_m * sin, z + scale * (part.at_m[2] - model.height_m)


def _feet(one: Solid) -> list[tuple[float, float, float]]:
    """Return the centers of both legs."""
    walk, (x, y, z) = LegShape(), one.at_m
    cos, sin = math.cos(one.turn_rad), math.sin(one.turn_rad)
    feet = []
    for is_left in (True, False):
        ahead_m = walk.ahead_m(one.step * walk.stride_m, is_left)
        left_m = walk.apart_m / 2 if is_left else -walk.apart_m / 2
        feet.append((x + ahead_m * cos - left_m * sin, y + ahead_m * sin + left_m * cos, z + one.size_m[2] / 2))
    return feet


def _shine(picture: npt.NDArray[np.uint8], which: Mask, bodies: list[list[tuple[int, str]]], plan: ScenePlan) -> None:
    """Draw lit lamps at full brightness regardless of the light on them; `glow` is the visible share."""
    for own in bodies:
        for body, state in own:
            if not state:
                continue
            lamp = (which == body).astype(np.float32)
            share = cv2.GaussianBlur(lamp, (0, 0), _BLOOM_PX)[..., None] * plan.glow
            share[lamp > 0] = plan.glow
            lit = np.minimum(np.array(LIT[state], np.float32) * 255 * (1.0 + 0.15 * plan.glow), 255)
            picture[:] = np.rint(picture + share * (lit - picture)).astype(np.uint8)


def _box(mask: Mask) -> Box | None:
    """Return the half-open box around the marked pixels; None without any."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return (float(x), float(y), float(x + width), float(y + height)) if width else None


def _truth(lens: Lens, solid: Solid, seen: Box | None, which: Mask, own: list[tuple[int, str]]) -> LabelledBox | None:
    if seen is None:
        return None
    if solid.shape == "ball":
        whole = lens.ball_box(solid.at_m, solid.size_m[0] / 2)
        area = math.pi / 4 * (whole[2] - whole[0]) * (whole[3] - whole[1])
        return LabelledBox(solid.label, seen, min(1.0, int(np.count_nonzero(which == own[0][0])) / area), whole)
    return LabelledBox(solid.label, seen, _seen_share(lens, solid, seen))


def _seen_share(lens: Lens, solid: Solid, seen: Box) -> float:
    """Return the area of the visible box as a share of the box around the whole object."""
    corners = _corners(solid)
    at = (corners @ lens.axes())
    at[:, 2] = np.maximum(at[:, 2], 0.1)
    u = WIDTH_PX / 2 + lens.focal_px * at[:, 0] / at[:, 2]
    v = HEIGHT_PX / 2 + lens.focal_px * at[:, 1] / at[:, 2]
    whole = float(np.ptp(u) * np.ptp(v))
    return min(1.0, (seen[2] - seen[0]) * (seen[3] - seen[1]) / max(whole, 1.0))


def _corners(solid: Solid) -> npt.NDArray[np.float64]:
    """Return points of the world that bound the object."""
    if solid.shape == "legs":
        radius, _, height = solid.size_m
        return np.array([[x + a * radius, y + b * radius, z + c * height / 2] for x, y, z in _feet(solid)
                         for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    _, wide, high = (side * solid.size_m[0] / 2 for side in Light(at_m=(0.0, 0.0)).housing_m)
    cos, sin = math.cos(solid.turn_rad), math.sin(solid.turn_rad)
    x, y, z = solid.at_m
    return np.array([[x - a * wide * sin, y + a * wide * cos, z + b * high] for a in (-1, 1) for b in (-1, 1)])


def _is_clear(truth: LabelledBox) -> bool:
    x1, y1, x2, y2 = truth.box
    if truth.label == "ball":
        return truth.seen >= 1 - MOST_HIDDEN
    return min(x2 - x1, y2 - y1) >= _MIN_SIDE_PX and truth.seen >= _MIN_SEEN
