"""Labeled scenes over photographs: balls and other things as sprites, with shadows, partly hidden. Pure."""

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from sightline.sim.scenes.model import HEIGHT_PX, MOST_HIDDEN, WIDTH_PX, Box, LabelledBox, PhotoScene, Random
from sightline.sim.scenes.sprites import Array, Sprite, SpriteLight, any_light, ball, thing

Picture = npt.NDArray[np.uint8]

BALL_PX: Final = (9.0, 110.0)
_SMALL: Final = 0.4
"""Share of the balls whose width is at most ..."""
_SMALL_PX: Final = 28.0
"""... this. Small balls are missed most often."""
_WITHOUT_BALL: Final = 0.3
_MOST_THINGS: Final = 4
_LEAST_SHARE: Final = 0.35
"""Smallest cut, as a share of the largest 4:3 cut of a photograph."""


def photo_scene(photos: Sequence[Picture], seed: int) -> PhotoScene:
    """Draw the scene of a seed over one of the photographs, RGB. Depends only on seed and photographs."""
    draw = np.random.default_rng([seed, 17])
    canvas = _cut(photos[int(draw.integers(len(photos)))], draw).astype(np.float32) / np.float32(255)
    balls: list[Laid] = []
    others: list[Box] = []
    unclear: list[Box] = []
    for _ in range(int(draw.integers(0, _MOST_THINGS + 1))):
        _, box, seen = _laid(canvas, draw, is_ball=False)
        (others if seen > 1 - MOST_HIDDEN else unclear).append(box)
    for _ in range(0 if draw.random() < _WITHOUT_BALL else 1 + int(draw.random() < 0.2)):
        balls.append(_laid(canvas, draw, is_ball=True))
        if draw.random() < 0.3:
            _hide(canvas, balls, draw)
    others = [one for one in others if not any(_covers(box, one) for _, box, _ in balls)]
    truths = []
    for visible, _, seen in balls:
        in_view = _around(visible)
        if in_view is not None and seen >= 1 - MOST_HIDDEN:
            truths.append(LabelledBox("ball", in_view, seen))
        elif in_view is not None:
            unclear.append(in_view)
    return PhotoScene(np.rint(canvas * 255).astype(np.uint8), tuple(truths), tuple(others), tuple(unclear))


def _cut(photo: Picture, draw: Random) -> Picture:
    """Return a part of the photograph, 320x240, sometimes turned a little."""
    height, width = photo.shape[:2]
    largest = min(width, height * WIDTH_PX / HEIGHT_PX)
    wide = largest * math.sqrt(draw.uniform(_LEAST_SHARE, 1.0))
    high = wide * HEIGHT_PX / WIDTH_PX
    left, top = draw.uniform(0, width - wide), draw.uniform(0, height - high)
    part = photo[int(top) : int(top + high), int(left) : int(left + wide)]
    method = cv2.INTER_AREA if wide > WIDTH_PX else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(part, (WIDTH_PX, HEIGHT_PX), interpolation=method), np.uint8)


Laid = tuple[Array, Box, float]
"""Visible part, (H, W) 0..1; the box around it; its visible share."""


def _laid(canvas: Array, draw: Random, is_ball: bool) -> Laid:
    """Draw a ball or a thing over the canvas."""
    low, high = BALL_PX
    if is_ball and draw.random() < _SMALL:
        high = _SMALL_PX
    width_px = math.exp(draw.uniform(math.log(low), math.log(high)))
    x = draw.uniform(-0.1 * width_px, WIDTH_PX + 0.1 * width_px)
    y = HEIGHT_PX * (1 - draw.uniform(0, 1) ** 1.3) + draw.uniform(-0.2, 0.1) * width_px
    light = _light_at(canvas, x, y, width_px, draw)
    sprite = (ball if is_ball else thing)(draw, width_px, light)
    if draw.random() < 0.75:
        _shade_floor(canvas, (x, y + 0.46 * width_px), width_px, draw)
    cover = _cover(canvas, sprite, x, y)
    whole = math.pi / 4 * width_px**2 if is_ball else float(sprite.cover.sum())
    box = (x - width_px / 2, y - width_px / 2, x + width_px / 2, y + width_px / 2)
    return cover, box, min(1.0, float(cover.sum()) / max(whole, 1.0))


def _light_at(canvas: Array, x: float, y: float, width_px: float, draw: Random) -> SpriteLight:
    """Return light of about the brightness, and a little of the color, of the place."""
    half = max(8, int(width_px))
    rows = slice(max(0, int(y) - half), max(1, min(HEIGHT_PX, int(y) + half)))
    columns = slice(max(0, int(x) - half), max(1, min(WIDTH_PX, int(x) + half)))
    mean = canvas[rows, columns].reshape(-1, 3).mean(axis=0) if canvas[rows, columns].size else np.full(3, 0.5)
    brightness = float(np.clip(mean.mean() / 0.45, 0.25, 1.3)) ** draw.uniform(0.0, 0.8) * draw.uniform(0.7, 1.15)
    tint = (mean / max(float(mean.mean()), 0.02)) ** draw.uniform(0.0, 0.4)
    return any_light(draw, np.asarray(brightness * tint, np.float32))


def _shade_floor(canvas: Array, at: tuple[float, float], width_px: float, draw: Random) -> None:
    """Draw a soft oval shadow, in place."""
    shadow = np.zeros((HEIGHT_PX, WIDTH_PX), np.float32)
    half = (0.5 * width_px * draw.uniform(0.7, 1.2), 0.5 * width_px * draw.uniform(0.15, 0.4))
    aside = draw.uniform(-0.25, 0.25) * width_px
    scale = 16
    center = (int((at[0] + aside) * scale), int((at[1] - 0.1 * half[1]) * scale))
    cv2.ellipse(shadow, center, (int(half[0] * scale), int(half[1] * scale)), 0, 0, 360, 1.0, -1, cv2.LINE_AA, 4)
    cv2.GaussianBlur(shadow, (0, 0), max(0.7, draw.uniform(0.04, 0.15) * width_px), shadow)
    canvas *= (1 - draw.uniform(0.15, 0.7) * shadow)[..., None]


def _cover(canvas: Array, sprite: Sprite, x: float, y: float) -> Array:
    """Blend the sprite around (x, y), in place. Returns its visible part."""
    side = sprite.cover.shape[0]
    move = np.array([[1, 0, x - side / 2], [0, 1, y - side / 2]], np.float64)
    size = (WIDTH_PX, HEIGHT_PX)
    cover = np.asarray(cv2.warpAffine(sprite.cover, move, size, flags=cv2.INTER_LINEAR), np.float32)
    rgb = cv2.warpAffine(sprite.rgb, move, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    canvas += cover[..., None] * (rgb - canvas)
    return cover


def _hide(canvas: Array, balls: list[Laid], draw: Random) -> None:
    """Cover part of the last ball with a thing or a part of the surroundings."""
    visible, box, seen = balls[-1]
    width_px = box[2] - box[0]
    angle, reach = draw.uniform(0, math.tau), width_px * draw.uniform(0.35, 0.6)
    x, y = (box[0] + box[2]) / 2 + reach * math.cos(angle), (box[1] + box[3]) / 2 + reach * math.sin(angle)
    before = canvas.copy()
    if draw.random() < 0.6:
        over = _cover(canvas, thing(draw, width_px * draw.uniform(0.5, 1.4), any_light(draw, np.ones(3, np.float32))),
                      x, y)
    else:
        over = np.zeros((HEIGHT_PX, WIDTH_PX), np.float32)
        half = max(2, int(width_px * draw.uniform(0.2, 0.5)))
        cv2.rectangle(over, (int(x) - half, int(y) - half), (int(x) + half, int(y) + half), 1.0, -1)
        aside = int(width_px * draw.uniform(1.0, 1.6)) * (1 if draw.random() < 0.5 else -1)
        canvas += over[..., None] * (np.roll(before, aside, axis=1) - canvas)
    visible *= 1 - over
    area = math.pi / 4 * width_px**2
    balls[-1] = (visible, box, min(seen, float(visible.sum()) / area))


def _covers(ball_box: Box, other: Box) -> bool:
    """Return True if the center of `other` is behind the ball."""
    x, y = (other[0] + other[2]) / 2, (other[1] + other[3]) / 2
    return ball_box[0] < x < ball_box[2] and ball_box[1] < y < ball_box[3]


def _around(visible: Array) -> Box | None:
    """Return the box around pixels that are at least half visible, half-open; None without any."""
    x, y, width, height = cv2.boundingRect((visible >= 0.5).astype(np.uint8))
    return (float(x), float(y), float(x + width), float(y + height)) if width else None
