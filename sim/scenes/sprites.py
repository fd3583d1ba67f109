"""Draw balls of many designs, and other things, as sprites over a photograph. Pure."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from sightline.sim.scenes.textures import any_rgb

Random = np.random.Generator
Array = npt.NDArray[np.float32]

_FINE: Final = 2
"""Samples per pixel each way, while the sprite is drawn."""
_SEAM_POINTS: Final = 96
_ICOSAHEDRON: Final = np.array([[a, b * (1 + math.sqrt(5)) / 2, 0] for a in (-1, 1) for b in (-1, 1)], np.float32)


@dataclass(frozen=True, slots=True)
class Sprite:
    """An image that covers a part of another."""

    rgb: Array
    """(H, W, 3), 0..1."""
    cover: Array
    """(H, W), 0..1: covered share of each pixel."""


@dataclass(frozen=True, slots=True)
class SpriteLight:
    """The light at a place."""

    towards: Array
    """Unit vector to the light: right, down, out of the image."""
    ambient: float
    """Ambient share of the light, 0..1."""
    rgb: Array
    """Color and strength, about 1."""


def any_light(draw: Random, rgb: Array) -> SpriteLight:
    """Draw a light from above, of that color."""
    towards = np.array([draw.normal(0, 0.6), -draw.uniform(0.3, 1.0), draw.uniform(0.05, 0.9)], np.float32)
    return SpriteLight(towards / np.linalg.norm(towards), draw.uniform(0.3, 0.85), rgb)


# --- balls ---------------------------------------------------------------------------------------------------------


def ball(draw: Random, width_px: float, light: SpriteLight) -> Sprite:
    """Draw a ball of this width in any color and design."""
    side = math.ceil(width_px) + 2
    x, y = _grid(side, width_px)
    off = np.hypot(x, y)
    z = np.sqrt(np.maximum(1 - off**2, 0)).astype(np.float32)
    normal = np.stack([x, y, z], axis=-1)
    paint = _DESIGNS[int(draw.choice(len(_DESIGNS), p=_WEIGHTS))](draw, normal @ _turn(draw))
    rgb = _lit(draw, paint, normal, light)
    cover = np.clip((1 - off) * width_px / 2 * _FINE + 0.5, 0, 1).astype(np.float32)
    return _shrunk(rgb, cover, side)


def _grid(side: int, width_px: float) -> tuple[Array, Array]:
    """Return x and y of each sample from the center; 1 is the edge of an object `width_px` wide."""
    steps = ((np.arange(side * _FINE, dtype=np.float32) + 0.5) / _FINE - side / 2) * np.float32(2 / width_px)
    x, y = np.meshgrid(steps, steps)
    return x.astype(np.float32), y.astype(np.float32)


def _shrunk(rgb: Array, cover: Array, side: int) -> Sprite:
    size = (side, side)
    return Sprite(np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.float32),
                  np.asarray(cv2.resize(cover, size, interpolation=cv2.INTER_AREA), np.float32))


def _turn(draw: Random) -> Array:
    """Draw a uniform random rotation (QR of a normal matrix; Stewart, The Efficient Generation of Random Orthogonal
    Matrices, 1980).
    """
    matrix, upper = np.linalg.qr(draw.normal(size=(3, 3)))
    return np.asarray(matrix * np.sign(np.diag(upper)), np.float32)


def _lit(draw: Random, paint: Array, normal: Array, light: SpriteLight) -> Array:
    """Shade `paint`: directional and ambient light, brighter from above. Half of the balls have a highlight."""
    direct = np.maximum(normal @ light.towards, 0)
    around = light.ambient * (1 - draw.uniform(0.1, 0.45) * (normal[..., 1] + 0.3))
    rgb = paint * (around + (1 - light.ambient) * 1.25 * direct)[..., None]
    if draw.random() < 0.5:
        half = light.towards + np.array([0, 0, 1], np.float32)
        sharp, strength = draw.uniform(8, 80), draw.uniform(0.1, 0.7)
        rgb = rgb + strength * (np.maximum(normal @ (half / np.linalg.norm(half)), 0) ** sharp)[..., None]
    return np.asarray(np.clip(rgb * light.rgb, 0, 1), np.float32)


def _color(draw: Random, saturation: tuple[float, float], value: tuple[float, float],
           hue_deg: tuple[float, float] = (0.0, 360.0)) -> Array:
    return np.array(any_rgb(draw, saturation, value, hue_deg), np.float32)


def _toy(draw: Random) -> Array:
    """Draw a strong color, as of toys."""
    return _color(draw, (0.55, 1.0), (0.35, 1.0))


def _pale(draw: Random) -> Array:
    return _color(draw, (0.0, 0.12), (0.7, 1.0))


def _common(draw: Random) -> Array:
    """Draw yellow to orange, any strong color, or nearly white."""
    kind = draw.random()
    if kind < 0.35:
        return _color(draw, (0.6, 1.0), (0.65, 1.0), (15.0, 75.0))
    return _toy(draw) if kind < 0.8 else _pale(draw)


def _plain(draw: Random, at: Array) -> Array:
    """Draw one color."""
    return _common(draw) * _speckle(draw, at, draw.uniform(0, 0.06))


def _speckle(draw: Random, at: Array, spread: float) -> Array:
    """Draw fine grain about 1."""
    return np.asarray(1 + spread * draw.standard_normal(at.shape[:2], np.float32), np.float32)[..., None]


def _tennis(draw: Random, at: Array) -> Array:
    """Draw felt with a seam (x = a cos t + b cos 3t, y = a sin t - b sin 3t, z = 2 sqrt(ab) sin 2t; a + b = 1)."""
    felt = _color(draw, (0.35, 0.85), (0.6, 1.0), (50.0, 85.0))
    time, a = np.linspace(0, math.tau, _SEAM_POINTS, endpoint=False), draw.uniform(0.68, 0.8)
    b = 1 - a
    curve = np.stack([a * np.cos(time) + b * np.cos(3 * time), a * np.sin(time) - b * np.sin(3 * time),
                      2 * math.sqrt(a * b) * np.sin(2 * time)], axis=-1).astype(np.float32)
    near = (at.reshape(-1, 3) @ curve.T).max(axis=1).reshape(at.shape[:2])
    return _marked(felt * _speckle(draw, at, draw.uniform(0.05, 0.15)), near > math.cos(draw.uniform(0.05, 0.11)),
                   _pale(draw))


def _marked(paint: Array, where: npt.NDArray[np.bool_], rgb: Array) -> Array:
    return np.where(where[..., None], rgb, paint).astype(np.float32)


def _basketball(draw: Random, at: Array) -> Array:
    """Draw orange to brown, or two colors, with dark lines: two great circles and two bows."""
    first = _color(draw, (0.5, 0.95), (0.4, 0.95), (8.0, 35.0)) if draw.random() < 0.8 else _toy(draw)
    paint = first * _speckle(draw, at, draw.uniform(0.02, 0.12))
    if draw.random() < 0.15:
        paint = _marked(paint, at[..., 0] > 0, _toy(draw))
    wide = draw.uniform(0.02, 0.05)
    bow = np.abs(np.abs(at[..., 0]) - draw.uniform(0.45, 0.6) - 0.25 * at[..., 1] ** 2)
    lines = np.minimum(np.minimum(np.abs(at[..., 0]), np.abs(at[..., 1])), bow) < wide
    return _marked(paint, lines, _color(draw, (0.0, 0.3), (0.02, 0.2)))


def _corners() -> Array:
    """Return the 12 corners of an icosahedron, unit vectors."""
    corners = np.concatenate([np.roll(_ICOSAHEDRON, places, axis=1) for places in range(3)])
    return np.asarray(corners / np.linalg.norm(corners, axis=1, keepdims=True), np.float32)


def _football(draw: Random, at: Array) -> Array:
    """Draw white with dark patches around the corners of an icosahedron, and seams."""
    near = (at.reshape(-1, 3) @ _corners().T).max(axis=1).reshape(at.shape[:2])
    paint = np.broadcast_to(_pale(draw), at.shape).astype(np.float32)
    if draw.random() < 0.6:
        seams = _seams(at, _corners(), draw.uniform(0.01, 0.03))
        paint = _marked(paint, seams, _color(draw, (0.0, 0.2), (0.2, 0.6)))
    dark = _color(draw, (0.0, 0.4), (0.02, 0.25)) if draw.random() < 0.7 else _toy(draw)
    return _marked(paint, near > math.cos(draw.uniform(0.3, 0.42)), dark)


def _seams(at: Array, points: Array, wide: float) -> npt.NDArray[np.bool_]:
    """Return where the two nearest points are about equally near."""
    near = np.sort(at.reshape(-1, 3) @ points.T, axis=1)
    return np.asarray((near[:, -1] - near[:, -2] < wide).reshape(at.shape[:2]))


def _directions(draw: Random, count: int) -> Array:
    """Draw uniformly distributed unit vectors (count, 3)."""
    points = draw.normal(size=(count, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True), np.float32)


def _panels(draw: Random, at: Array) -> Array:
    """Draw panels around even or random points, in two to four colors, often with seams."""
    points = _directions(draw, int(draw.integers(4, 28)))
    which = (at.reshape(-1, 3) @ points.T).argmax(axis=1).reshape(at.shape[:2])
    base = _pale(draw) if draw.random() < 0.7 else _toy(draw)
    colors = np.stack([base, base, _toy(draw), _color(draw, (0, 1), (0, 0.3)) if draw.random() < 0.5 else base])
    paint = colors[draw.integers(0, len(colors), len(points))][which]
    if draw.random() < 0.6:
        paint = _marked(paint, _seams(at, points, draw.uniform(0.01, 0.04)), _color(draw, (0, 0.3), (0.05, 0.6)))
    return np.asarray(paint, np.float32)


def _stripes(draw: Random, at: Array) -> Array:
    """Draw bands, or segments as of a beach ball."""
    colors = np.stack([_pale(draw) if draw.random() < 0.6 else _toy(draw), _toy(draw), _toy(draw)])
    if draw.random() < 0.5:
        bands = np.floor(np.arctan2(at[..., 1], at[..., 0]) / math.pi * int(draw.integers(2, 5))).astype(int)
    else:
        bands = np.floor(at[..., 2] * draw.uniform(1.0, 4.0) + draw.uniform(0, 1)).astype(int)
    return np.asarray(colors[bands % int(draw.integers(2, 4))], np.float32)


def _patches(draw: Random, at: Array) -> Array:
    """Draw round patches, as dots or a print, on one color."""
    points = _directions(draw, int(draw.integers(1, 16)))
    near = (at.reshape(-1, 3) @ points.T).max(axis=1).reshape(at.shape[:2])
    paint = np.asarray(np.broadcast_to(_pale(draw) if draw.random() < 0.4 else _toy(draw), at.shape), np.float32)
    return _marked(paint, near > math.cos(draw.uniform(0.1, 0.5)), _toy(draw))


def _marble(draw: Random, at: Array) -> Array:
    """Draw two colors that blend into each other."""
    waves = sum(np.sin(at @ (draw.normal(size=3) * draw.uniform(1, 6)).astype(np.float32) + draw.uniform(0, math.tau))
                for _ in range(4))
    share = (0.5 + 0.25 * np.asarray(waves, np.float32)).clip(0, 1)[..., None]
    return np.asarray(_toy(draw) * share + (_pale(draw) if draw.random() < 0.5 else _toy(draw)) * (1 - share))


_DESIGNS: Final[tuple[Callable[[Random, Array], Array], ...]] = (
    _plain, _tennis, _basketball, _football, _panels, _stripes, _patches, _marble)
_WEIGHTS: Final = (0.42, 0.14, 0.10, 0.12, 0.09, 0.05, 0.04, 0.04)


# --- other things --------------------------------------------------------------------------------------------------


def thing(draw: Random, width_px: float, light: SpriteLight) -> Sprite:
    """Draw an object other than a ball: a box, a cylinder, a cone, an oval plate, a ring, a polygon."""
    side = math.ceil(width_px) + 2
    x, y = _grid(side, width_px)
    inside, shade = _SHAPES[int(draw.integers(len(_SHAPES)))](draw, x, y)
    paint = np.asarray(_common(draw) * _speckle(draw, x, draw.uniform(0, 0.08)))
    if draw.random() < 0.3:
        place = (x * draw.uniform(-3, 3) + y * draw.uniform(-3, 3)) % 1 < draw.uniform(0.3, 0.7)
        paint = _marked(paint, place, _color(draw, (0, 1), (0, 1)))
    rgb = np.clip(paint * shade[..., None] * light.rgb, 0, 1).astype(np.float32)
    return _shrunk(rgb, inside.astype(np.float32), side)


Shape = tuple[npt.NDArray[np.bool_], Array]


def _turned(draw: Random, x: Array, y: Array, most_rad: float) -> tuple[Array, Array]:
    angle = draw.uniform(-most_rad, most_rad)
    cos, sin = np.float32(math.cos(angle)), np.float32(math.sin(angle))
    return x * cos + y * sin, y * cos - x * sin


def _box(draw: Random, x: Array, y: Array) -> Shape:
    """Draw a front, a side and a top, each evenly lit."""
    x, y = _turned(draw, x, y, 0.15)
    left, top = draw.uniform(-0.8, 0.0), draw.uniform(-0.75, -0.1)
    slant = draw.uniform(0.2, 0.7)
    inside = (np.abs(x) < 0.95) & (np.abs(y) < 0.95)
    shade = np.where(y < top, 1.0, np.where(x < left, draw.uniform(0.35, 0.75), draw.uniform(0.6, 0.95)))
    cut = (y < top) & (x < -0.95 + slant * (top - y)) | (y < top) & (x > 0.95 - slant * (top - y) * 0.3)
    return inside & ~cut, shade.astype(np.float32)


def _cylinder(draw: Random, x: Array, y: Array) -> Shape:
    """Draw a cylinder, upright or lying, shaded across."""
    x, y = _turned(draw, x, y, math.pi)
    wide, flat = draw.uniform(0.2, 0.6), draw.uniform(0.0, 0.3)
    bow = flat * np.sqrt(np.maximum(1 - (x / wide) ** 2, 0))
    inside = (np.abs(x) < wide) & (y < 0.75 - 0.2 * flat + bow) & (y > -0.75 - bow)
    across = 0.55 + 0.45 * np.cos((x / wide - draw.uniform(-0.6, 0.6)) * 1.3)
    return inside, across.astype(np.float32)


def _cone(draw: Random, x: Array, y: Array) -> Shape:
    slope = draw.uniform(0.25, 0.6)
    inside = (y > -0.95) & (y < 0.85) & (np.abs(x) < slope * (y + 1.0))
    return inside, (0.6 + 0.4 * np.cos(x / (slope * (y + 1.05)).clip(0.05) * 1.4)).clip(0.3, 1).astype(np.float32)


def _plate(draw: Random, x: Array, y: Array) -> Shape:
    """Draw a flat oval, often with a rim."""
    x, y = _turned(draw, x, y, 0.4)
    off = np.hypot(x / 0.97, y / draw.uniform(0.2, 0.68))
    shade = np.where(off > draw.uniform(0.6, 0.95), draw.uniform(0.5, 1.1), draw.uniform(0.7, 1.0))
    return off < 1, shade.astype(np.float32)


def _ring(draw: Random, x: Array, y: Array) -> Shape:
    off = np.hypot(x, y / draw.uniform(0.5, 1.0))
    return (off < 0.97) & (off > draw.uniform(0.45, 0.8)), np.full_like(x, draw.uniform(0.5, 1.0))


def _polygon(draw: Random, x: Array, y: Array) -> Shape:
    """Draw a polygon of three to six corners."""
    inside = np.ones(x.shape, bool)
    for angle in np.cumsum(np.full(int(draw.integers(3, 7)), 1.0)) * math.tau / draw.uniform(3, 6) + draw.uniform(0, 6):
        inside &= x * math.cos(angle) + y * math.sin(angle) < draw.uniform(0.4, 0.8)
    return inside & (np.hypot(x, y) < 1), (0.8 + 0.2 * x * draw.uniform(-1, 1)).astype(np.float32)


_SHAPES: Final[tuple[Callable[[Random, Array, Array], Shape], ...]] = (
    _box, _box, _cylinder, _cylinder, _cone, _plate, _ring, _polygon)
