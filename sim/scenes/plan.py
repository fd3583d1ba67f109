"""Place the things of a scene, and set the defects of its image. Pure."""

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from sightline.sim.scenario import Color
from sightline.sim.scenes.model import (
    BALL_PX,
    HEIGHT_PX,
    LIGHT_SIZES,
    MOST_DISTRACTORS,
    STATES,
    VALIDATED_FROM,
    WIDTH_PX,
    WITHOUT_BALL_EVERY,
    Column,
    Lens,
    Point,
    Random,
    Scene,
    ScenePlan,
    Solid,
    Span,
    Surface,
    is_scored,
)
from sightline.sim.scenes.textures import any_rgb, families

_YELLOW = {"saturation": (0.72, 1.0), "value": (0.75, 1.0), "hue_deg": (42.0, 58.0)}
_SCORED_LIGHT_DEG = ((30.0, 50.0),)  # elevation of the light; between the bands of training, which never include it
_TRAINED_LIGHT_DEG = ((10.0, 30.0), (50.0, 85.0))
_HIGHEST_M, _LOWEST_M = 1.5, 0.04  # height of the lens above the floor
_HALF_OCCLUDED = 0.5
_LAMPS_HIGH_M = 0.26  # height of the simulated light's housing
_TRIES = 50


def plan_scene(seed: int, column: Column) -> ScenePlan:
    """Draw the scene of a seed. The result never changes."""
    draw = np.random.default_rng([seed, 11])
    half_view_rad = math.radians(draw.uniform(25.0, 37.5))
    lens = Lens(WIDTH_PX / 2 / math.tan(half_view_rad), math.radians(draw.uniform(-3.0, 25.0)))
    ball, floor_m, width_px = _ball(draw, lens, column)
    has_ball = seed % WITHOUT_BALL_EVERY != 0 if seed >= VALIDATED_FROM else draw.random() > 0.2
    solids = [ball] if has_ball else []
    if draw.random() < column.same_colour_boxes:
        solids += [_like(draw, lens, floor_m, ball, width_px) for _ in range(2)]
    if draw.random() < column.lights:
        solids.append(_light(draw, lens, seed))
    if draw.random() < column.legs:
        solids.append(_legs(draw, lens, floor_m))
    solids += [_distractor(draw, lens, floor_m) for _ in range(int(draw.integers(0, MOST_DISTRACTORS + 1)))]
    if has_ball and draw.random() < _HALF_OCCLUDED:
        solids.append(_occluder(draw, ball))
    farthest = max([2.0, *(math.dist(one.at_m, (0, 0, 0)) + 0.5 for one in solids)])
    light_from, ambient = _light_from(draw, is_scored(seed))
    return ScenePlan(
        seed, column, lens, floor_m, farthest * draw.uniform(1.0, 1.8), draw.uniform(-0.5, 0.5),
        _surface(draw, seed), _surface(draw, seed), light_from, ambient, tuple(solids), draw.uniform(0.0, 1.0),
    )


def with_more_of_the_ball(plan: ScenePlan) -> Iterator[ScenePlan]:
    """Yield simpler scenes for a ball that is hidden too much: first without nearer objects, then with the boxes of its
    color moved, then without the nearer ones of these boxes."""
    (ball,) = (one for one in plan.solids if one.label == "ball")
    alike = [one for one in plan.solids if one.is_like_ball]
    others = [one for one in plan.solids if one not in alike and (one == ball or not _is_nearer(one, ball))]
    yield replace(plan, solids=(*others, *alike))
    draw = np.random.default_rng([plan.seed, 13])
    for _ in range(_TRIES if alike else 0):
        elsewhere = [_like(draw, plan.lens, plan.floor_m, ball, _width_px(plan.lens, ball)) for _ in alike]
        yield replace(plan, solids=(*others, *elsewhere))
    yield replace(plan, solids=(*others, *(one for one in alike if not _is_nearer(one, ball))))


def _is_nearer(one: Solid, ball: Solid) -> bool:
    """Return True if a part of the object can be nearer than the ball."""
    return math.dist(one.at_m, (0, 0, 0)) <= math.dist(ball.at_m, (0, 0, 0)) + _reach(one)


def _width_px(lens: Lens, ball: Solid) -> float:
    """Return the width of the ball at the image center, as `_ball` drew it."""
    radius_m, away_m = ball.size_m[0] / 2, float(np.dot(ball.at_m, lens.axes()[:, 2]))
    return 2 * radius_m * lens.focal_px / math.sqrt(away_m * away_m - radius_m * radius_m)


def _reach(one: Solid) -> float:
    """Return a bound on the distance of any part of the object from its center."""
    return {"legs": 0.8, "light": 0.3}.get(one.shape, math.hypot(*one.size_m) / 2 + 0.01)


def _log(draw: Random, span: Span) -> float:
    return math.exp(draw.uniform(math.log(span[0]), math.log(span[1])))


def _ball(draw: Random, lens: Lens, column: Column) -> tuple[Solid, float, float]:
    """Draw the ball, the floor below it, and its width in pixels."""
    width_px, radius_m = _log(draw, BALL_PX), draw.uniform(0.03, 0.15)
    ahead_m = lens.focal_px * math.sqrt(1 + (width_px / 2 / lens.focal_px) ** 2) * 2 * radius_m / width_px
    top = max(lens.horizon_px() + 2, 0.25 * width_px)
    u = draw.uniform(0.25 * width_px, WIDTH_PX - 0.25 * width_px)
    v = draw.uniform(min(top, HEIGHT_PX * 0.7), HEIGHT_PX - 0.25 * width_px)
    at = lens.point(u, v, ahead_m)
    other = draw.random() < column.any_colour
    colour = any_rgb(draw, (0.45, 1.0), (0.4, 1.0)) if other else any_rgb(draw, **_YELLOW)
    floor_m = float(np.clip(at[2] - radius_m, -_HIGHEST_M, -_LOWEST_M))
    return Solid("ball", at, (2 * radius_m,) * 3, colour, label="ball"), floor_m, width_px


def _like(draw: Random, lens: Lens, floor_m: float, ball: Solid, width_px: float) -> Solid:
    """Draw a box next to the ball, of its color and of about its size in the image."""
    away_m = float(np.dot(ball.at_m, lens.axes()[:, 2]))
    ahead_m = away_m * draw.uniform(0.7, 1.4)
    sides = [width_px * _log(draw, (0.5, 1.6)) * ahead_m / lens.focal_px * draw.uniform(0.8, 1.25) for _ in range(3)]
    middle = lens.point(draw.uniform(0.05, 0.95) * WIDTH_PX, HEIGHT_PX / 2, ahead_m)
    at = (middle[0], middle[1], floor_m + sides[2] / 2)
    colour = tuple(float(np.clip(part * draw.uniform(0.96, 1.04), 0, 1)) for part in ball.colour)
    return Solid("box", at, (sides[0], sides[1], sides[2]), (colour[0], colour[1], colour[2]),
                 draw.uniform(0, math.tau), is_like_ball=True)


def _on_floor(draw: Random, lens: Lens, floor_m: float, span_m: Span) -> Point:
    x, y, _ = lens.point(draw.uniform(-10, WIDTH_PX + 10), HEIGHT_PX / 2, _log(draw, span_m))
    return x, y, floor_m


def _distractor(draw: Random, lens: Lens, floor_m: float) -> Solid:
    x, y, z = _on_floor(draw, lens, floor_m, (0.5, 5.0))
    sides = (_log(draw, (0.03, 0.4)), _log(draw, (0.03, 0.4)), _log(draw, (0.04, 0.6)))
    shape = "box" if draw.random() < 0.5 else "cylinder"
    if shape == "cylinder":
        sides = (sides[0] / 2, sides[0] / 2, sides[2])
    return Solid(shape, (x, y, z + sides[2] / 2), sides, _any_colour(draw), draw.uniform(0, math.tau))


def _any_colour(draw: Random) -> Color:
    return any_rgb(draw, (0.0, 1.0), (0.1, 1.0))


def _light(draw: Random, lens: Lens, seed: int) -> Solid:
    """Draw a traffic light whose housing is 16 to 110 pixels high, facing the lens or a little aside."""
    scale = draw.uniform(*LIGHT_SIZES)
    ahead_m = lens.focal_px * _LAMPS_HIGH_M * scale / _log(draw, (16.0, 110.0))
    at = lens.point(draw.uniform(0.05, 0.95) * WIDTH_PX, draw.uniform(0.12, 0.75) * HEIGHT_PX, ahead_m)
    to_lens_rad = math.atan2(-at[1], -at[0])
    turn_rad = to_lens_rad + draw.uniform(-0.7, 0.7)
    return Solid("light", at, (scale,) * 3, (0.0, 0.0, 0.0), turn_rad, f"light-{STATES[seed % len(STATES)]}")


def _legs(draw: Random, lens: Lens, floor_m: float) -> Solid:
    """Draw legs from the knees down, at any moment of a stride, in any direction."""
    at = _on_floor(draw, lens, floor_m, (0.7, 4.0))
    radius_m, height_m = draw.uniform(0.04, 0.075), draw.uniform(0.3, 0.55)
    return Solid("legs", at, (radius_m, radius_m, height_m), _any_colour(draw), draw.uniform(0, math.tau), "legs",
                 draw.uniform(0.0, 1.0))


def _occluder(draw: Random, ball: Solid) -> Solid:
    """Draw an object in front of the ball whose edge crosses the ball."""
    share, side = draw.uniform(0.55, 0.9), 1 if draw.random() < 0.5 else -1
    x, y, z = (part * share for part in ball.at_m)
    seen_m, wide_m = ball.size_m[0] * share, ball.size_m[0] * _log(draw, (0.3, 2.0))
    aside_m = side * (wide_m / 2 + seen_m * draw.uniform(-0.2, 0.45))
    shape = "box" if draw.random() < 0.7 else "cylinder"
    tall_m = ball.size_m[2] * draw.uniform(0.8, 4.0)
    sizes = (wide_m, wide_m, tall_m) if shape == "box" else (wide_m / 2, wide_m / 2, tall_m)
    return Solid(shape, (x, y + aside_m, z), sizes, _any_colour(draw))


def _light_from(draw: Random, scored: bool) -> tuple[Point, float]:
    bands = _SCORED_LIGHT_DEG if scored else _TRAINED_LIGHT_DEG
    high = math.radians(draw.uniform(*bands[int(draw.integers(len(bands)))]))
    around = draw.uniform(math.pi / 2, 3 * math.pi / 2)  # from the side of the lens, otherwise all is dark
    way = (math.cos(high) * math.cos(around), math.cos(high) * math.sin(around), math.sin(high))
    return way, draw.uniform(0.4, 0.8)


def _surface(draw: Random, seed: int) -> Surface:
    known = families(seed)
    return Surface(known[int(draw.integers(len(known)))], int(draw.integers(1 << 31)), _log(draw, (0.5, 4.0)))


# Effects of camera and link on the image of a scene: light, color cast, blur, noise, JPEG. Pure.


Picture = npt.NDArray[np.uint8]
_SOFT_PX = (0.3, 0.7)  # standard deviation of the softness of any lens
_POOL_SIDE = 1024


def as_seen(scene: Scene) -> bytes:
    """Return the scene as JPEG, with defects that its seed draws from its column."""
    return with_defects(scene.rgb, scene.plan.column, np.random.default_rng([scene.plan.seed, 13]))


def with_defects(rgb: Picture, column: Column, draw: Random) -> bytes:
    """Encode `rgb` as JPEG with the defects of the column."""
    gains = draw.uniform(*column.gain) * (1 + draw.uniform(-column.white_balance, column.white_balance, 3))
    steps = np.clip(np.rint(np.arange(256)[:, None] * gains), 0, 255).astype(np.uint8)
    picture: Picture = np.asarray(cv2.LUT(rgb, steps.reshape(1, 256, 3)), np.uint8)
    if draw.random() < column.blurred:
        picture = _blurred(picture, draw.uniform(*column.blur_px), draw)
    else:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), draw.uniform(*_SOFT_PX)), np.uint8)
    noise = draw.normal(0.0, 1.0, (_POOL_SIDE,)).astype(np.float32) * draw.uniform(*column.noise)
    grain = noise[draw.integers(0, _POOL_SIDE, picture.shape, dtype=np.uint16)]
    cv2.add(picture, np.rint(grain).astype(np.int16), picture, dtype=cv2.CV_8U)
    quality = int(draw.integers(column.quality[0], column.quality[1] + 1))
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(picture), quality, "RGB", "420"))


def _blurred(picture: Picture, across_px: float, draw: Random) -> Picture:
    """Blur by a kernel of this width: out of focus, or motion."""
    if draw.random() < 0.5:
        side = 2 * int(across_px / 2) + 1
        return np.asarray(cv2.GaussianBlur(picture, (side, side), 0), np.uint8)
    return np.asarray(cv2.filter2D(picture, -1, streak(across_px, draw.uniform(0.0, math.pi))), np.uint8)


def streak(long_px: float, angle_rad: float) -> npt.NDArray[np.float32]:
    """Return the kernel of a uniform motion over `long_px`, about its center."""
    side = 2 * math.ceil(long_px / 2) + 1
    kernel = np.zeros((side, side), np.float32)
    along = np.linspace(-long_px / 2, long_px / 2, 8 * side)
    x, y = side // 2 + along * math.cos(angle_rad), side // 2 + along * math.sin(angle_rad)
    np.add.at(kernel, (np.rint(y).astype(int).clip(0, side - 1), np.rint(x).astype(int).clip(0, side - 1)), 1.0)
    return np.asarray(kernel / kernel.sum(), np.float32)
