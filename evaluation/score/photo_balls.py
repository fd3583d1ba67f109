"""Render a ray-cast ball into a photograph, to score detectors. Pure.

Camera frame: x right, y down, z forward. Light is computed in linear values, 0 to 1. For scores only: it
shares no code with the generator of training images.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sightline.evaluation.score.ball_textures import KINDS, BallSurface, surface

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

WIDTH, HEIGHT = 320, 240
"""Size of an image, px."""
MIN_RADIUS_PX, MAX_RADIUS_PX = 5.0, 45.0
COVERED_SHARE = 0.15
"""Share of the balls that are partly covered."""
_FOCAL_PX = 280.0
_FINE = 4
"""Rays per pixel and axis."""
_GAMMA = 2.2
_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)

__all__ = ["KINDS", "PhotoBall", "photo_with_ball", "photo_without_ball"]


@dataclass(frozen=True, slots=True)
class PhotoBall:
    """An image with one ball."""

    rgb: Bytes
    """(240, 320, 3)."""
    box: tuple[float, float, float, float]
    """x1, y1, x2, y2 of the ball's visible part, px."""
    kind: str
    radius_px: float
    seen: float
    """Visible share of the ball's disk."""


@dataclass(frozen=True, slots=True)
class _Pose:
    """Place of the ball: image position and radius in px; center and radius in units of its depth; up direction."""

    u: float
    v: float
    radius_px: float
    center: Floats
    radius: float
    up: Floats


@dataclass(frozen=True, slots=True)
class _Light:
    """Direction to the light, and linear RGB of the light, of the sky (the surroundings above) and of the floor."""

    toward: Floats
    sun: Floats
    sky: Floats
    floor: Floats


@dataclass(frozen=True, slots=True)
class _Patch:
    """The rendered ball in a part of the image: its origin (x, y) px, linear RGB times alpha, alpha, and cover."""

    x: int
    y: int
    rgb: Floats
    alpha: Floats
    cover: Floats
    box: tuple[float, float, float, float]
    seen: float


def photo_with_ball(photo: Bytes, kind: str, seed: int) -> PhotoBall:
    """Put a ball of `kind` into a window of `photo`, (height, width, 3) RGB. The same arguments give the same image.

    Raises ValueError for an unknown kind.
    """
    rng = np.random.default_rng([seed, 1 + KINDS.index(kind)])
    window, finish = _view(photo, seed)
    linear = _decode(window)
    pose = _place(linear, rng)
    light = _estimate_light(linear, pose, rng)
    patch = _render(pose, light, surface(kind, rng), rng)
    shaded = linear * _shadow(pose, light, rng)[..., None]
    pasted, alpha = _paste(shaded, linear, patch, _softness(window), rng)
    noise = rng.normal(0, _noise_level(window), pasted.shape).astype(np.float32)
    # Unchanged pixels keep the values of the photograph, without rounding by the conversion to linear light.
    same = (alpha < 1e-3) & (np.abs(pasted - linear).max(axis=2) < 1e-3)
    rgb = np.where(same[..., None], window.astype(np.float32), _encode(pasted) + noise * alpha[..., None])
    return PhotoBall(finish(rgb), patch.box, kind, pose.radius_px, patch.seen)


def photo_without_ball(photo: Bytes, seed: int) -> Bytes:
    """Return the window of `photo_with_ball`, gain and white balance too, without a ball: (240, 320, 3) RGB."""
    window, finish = _view(photo, seed)
    return finish(window.astype(np.float32))


def _view(photo: Bytes, seed: int) -> tuple[Bytes, Callable[[Floats], Bytes]]:
    """Cut the window, and return it with the function that applies gain and white balance to the finished image."""
    rng = np.random.default_rng([seed, 0])
    tall, wide = photo.shape[:2]
    largest = min(tall / 3, wide / 4)
    # At least half of the area of the photograph, as far as its shape permits.
    smallest = min(largest, (tall * wide / 24) ** 0.5)
    unit = rng.uniform(smallest, largest)
    height, width = int(3 * unit), int(4 * unit)
    y, x = int(rng.integers(0, tall - height + 1)), int(rng.integers(0, wide - width + 1))
    window = cv2.resize(photo[y : y + height, x : x + width], (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    gains = (rng.uniform(0.6, 1.1) * rng.uniform(0.9, 1.1, 3)).astype(np.float32)

    def finish(rgb: Floats) -> Bytes:
        return np.asarray(np.clip(np.rint(rgb * gains), 0, 255), np.uint8)

    return window.astype(np.uint8), finish


def _floats(values: ArrayLike) -> Floats:
    return np.asarray(values, np.float32)


def _decode(rgb: Bytes) -> Floats:
    """Convert 8-bit values to linear ones."""
    return _floats((rgb.astype(np.float32) / 255) ** np.float32(_GAMMA))


def _encode(linear: Floats) -> Floats:
    """Convert linear values to 0..255. Bright values saturate."""
    return _floats(np.clip(linear, 0, 1) ** np.float32(1 / _GAMMA) * 255)


def _place(linear: Floats, rng: np.random.Generator) -> _Pose:
    """Choose radius and place: larger when lower, and the smoothest ground of three places."""
    radius = float(np.exp(rng.uniform(np.log(MIN_RADIUS_PX), np.log(MAX_RADIUS_PX))))
    size = np.log(radius / MIN_RADIUS_PX) / np.log(MAX_RADIUS_PX / MIN_RADIUS_PX)
    lowest = HEIGHT - radius - 4
    spots = []
    for _ in range(3):
        down = np.clip(0.15 + 0.7 * size + rng.normal(0, 0.2), 0, 1)
        u, v = rng.uniform(radius + 4, WIDTH - radius - 4), HEIGHT / 3 + down * (lowest - HEIGHT / 3)
        rows = slice(int(v), int(v + 1.5 * radius) + 2)
        ground = linear[rows, max(0, int(u - 1.5 * radius)) : int(u + 1.5 * radius)]
        spots.append((float(ground.std(axis=(0, 1)).mean()), float(u), float(v)))
    _, u, v = min(spots)
    pitch = np.radians(rng.uniform(12, 30))
    center = np.array([(u - WIDTH / 2) / _FOCAL_PX, (v - HEIGHT / 2) / _FOCAL_PX, 1], np.float32)
    # A ball off the axis looks larger (an ellipse). This keeps the area of its disk.
    depth = radius / _FOCAL_PX / float(np.linalg.norm(center)) ** 0.5
    return _Pose(u, v, radius, center, depth, np.array([0, -np.cos(pitch), -np.sin(pitch)], np.float32))


def _estimate_light(linear: Floats, pose: _Pose, rng: np.random.Generator) -> _Light:
    """Estimate the light at the ball from its surroundings."""
    reach = max(8.0, pose.radius_px)
    smooth = _floats(cv2.GaussianBlur(linear, (0, 0), reach))
    row, column = int(pose.v), int(pose.u)
    floor = smooth[min(HEIGHT - 1, int(row + 1.3 * pose.radius_px)), column]
    luma = linear @ _LUMA
    bright = float(np.quantile(luma, 0.9))
    level = float(np.clip((floor @ _LUMA / 0.3) ** 0.5 * (bright / 0.6) ** 0.5, 0.12, 1.1))
    left, right = (smooth[row, np.clip(int(column + side * 3 * reach), 0, WIDTH - 1)] @ _LUMA for side in (-1, 1))
    aside = np.clip(np.log((right + 0.02) / (left + 0.02)), -1, 1) * 0.6 + rng.normal(0, 0.3)
    toward = pose.up + np.array([np.clip(aside, -0.9, 0.9), 0, 0]) + np.array([0, 0, rng.uniform(-0.7, 0.4)])
    direct = rng.uniform(0.25, 0.65)
    sun = _tint(linear[luma >= bright].mean(axis=0), 0.5) * level * direct * 1.3
    sky = _tint(linear[: max(20, row)].mean(axis=(0, 1)), 0.5) * level * (1 - direct)
    return _Light(_unit(toward.astype(np.float32)), sun, sky, (0.9 * floor).astype(np.float32))


def _tint(rgb: Floats, share: float) -> Floats:
    """Return the color of `rgb` at luminance 1, mixed with gray."""
    return _floats(share * np.clip(rgb / max(1e-3, float(rgb @ _LUMA)), 0.4, 1.8) + 1 - share)


def _unit(vectors: Floats) -> Floats:
    return _floats(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _rays(x: Floats, y: Floats) -> Floats:
    """Return unit directions through image points, px; shape of x by y, and 3."""
    grid_x, grid_y = np.meshgrid((x - WIDTH / 2) / _FOCAL_PX, (y - HEIGHT / 2) / _FOCAL_PX)
    return _unit(np.stack([grid_x, grid_y, np.ones_like(grid_x)], axis=-1).astype(np.float32))


def _shadow(pose: _Pose, light: _Light, rng: np.random.Generator) -> Floats:
    """Return the factor, (240, 320), by which the ball darkens the floor: blocked light and blocked sky."""
    rays = _rays(np.arange(WIDTH) + np.float32(0.5), np.arange(HEIGHT) + np.float32(0.5))
    contact = pose.center - pose.radius * pose.up
    downward = rays @ pose.up
    below = downward < -0.01
    reach = np.where(below, contact @ pose.up / np.where(below, downward, -1), 0)
    to_ball = pose.center - rays * reach[..., None]
    distance = np.linalg.norm(to_ball, axis=-1) / pose.radius
    sky = np.clip((to_ball @ pose.up) / pose.radius / np.maximum(distance, 0.2) ** 3, 0, 1)
    along = to_ball @ light.toward / pose.radius
    miss = np.sqrt(np.maximum(distance**2 - along**2, 0))
    soft = rng.uniform(0.15, 0.5)
    sun = np.clip((1 + soft - miss) / (2 * soft), 0, 1) * (along > 0)
    share = float(light.sun @ _LUMA / ((light.sun + light.sky) @ _LUMA))
    dark = 1 - (1 - share) * 0.9 * sky - share * 0.8 * sun * sun * (3 - 2 * sun)
    return np.where(below, dark, 1).astype(np.float32)


def _render(pose: _Pose, light: _Light, ball: BallSurface, rng: np.random.Generator) -> _Patch:
    """Cast 4 by 4 rays per pixel at the ball, and average them."""
    span = 1.35 * pose.radius_px + 5
    x1, y1 = max(0, int(pose.u - span)), max(0, int(pose.v - span))
    x2, y2 = min(WIDTH, int(pose.u + span) + 1), min(HEIGHT, int(pose.v + span) + 1)
    x, y = (_floats((np.arange(a * _FINE, b * _FINE) + 0.5) / _FINE) for a, b in ((x1, x2), (y1, y2)))
    rays = _rays(x, y)
    along = rays @ pose.center
    miss = np.sqrt(np.maximum(pose.center @ pose.center - along**2, 0)) / pose.radius
    fuzz = cv2.GaussianBlur(rng.normal(0, 1, miss.shape).astype(np.float32), (0, 0), 1.2)
    disk = miss < 1 - ball.fuzz * np.abs(fuzz) * 4
    hit = rays[disk]
    reach = along[disk] - pose.radius * np.sqrt(np.maximum(1 - miss[disk] ** 2, 0))
    normals = _unit(_floats(hit * reach[:, None] - pose.center))
    rgb = np.zeros((*disk.shape, 3), np.float32)
    rgb[disk] = _shade(normals, -hit, ball, light, pose.up)
    cover, seen = _cover(disk, x, y, pose, rng)
    rows, columns = np.nonzero(disk & ~cover)
    box = (x1 + columns.min() / _FINE, y1 + rows.min() / _FINE, x1 + (columns.max() + 1) / _FINE,
           y1 + (rows.max() + 1) / _FINE)  # fmt: skip
    small = (x2 - x1, y2 - y1)
    rgb, alpha, covered = (
        _floats(cv2.resize(_floats(one), small, interpolation=cv2.INTER_AREA)) for one in (rgb, disk, cover)
    )
    return _Patch(x1, y1, rgb, alpha, covered, (float(box[0]), float(box[1]), float(box[2]), float(box[3])), seen)


def _shade(normals: Floats, to_camera: Floats, ball: BallSurface, light: _Light, up: Floats) -> Floats:
    """Return linear RGB, (n, 3), of points with these normals: Lambert, sky and floor, highlight and reflection."""
    albedo, bumpy = ball.at(normals)
    toward_light = bumpy @ light.toward
    diffuse = np.clip((toward_light + ball.wrap) / (1 + ball.wrap), 0, 1)[:, None]
    above = (0.5 + 0.5 * (bumpy @ up))[:, None]
    # Near the floor the ball sees only its own shadow.
    dim = 1 - 0.6 * np.clip(-(normals @ up), 0, 1)[:, None] ** 1.5
    ambient = (light.sky * above + light.floor * (1 - above)) * dim
    facing = np.clip((bumpy * to_camera).sum(axis=1), 0, 1)
    halfway = _unit(to_camera + light.toward)
    shine = np.clip((bumpy * halfway).sum(axis=1), 0, 1) ** ball.shininess * (toward_light > 0)
    mirrored = 2 * facing[:, None] * bumpy - to_camera
    seen_above = np.clip(0.5 + 1.5 * (mirrored @ up), 0, 1)[:, None]
    mirror = (0.04 + 0.5 * (1 - facing) ** 5)[:, None] * (light.sky * seen_above + light.floor * (1 - seen_above) * dim)
    rim = albedo * ball.rim * ((1 - facing) ** 2)[:, None] * light.sky
    linear = albedo * (light.sun * diffuse + ambient) + rim + ball.gloss * (1.5 * shine[:, None] * light.sun + mirror)
    knee = np.float32(0.75)
    return _floats(np.where(linear > knee, 1 - (1 - knee) * np.exp(-(linear - knee) / (1 - knee)), linear))


def _cover(
    disk: NDArray[np.bool_], x: Floats, y: Floats, pose: _Pose, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], float]:
    """Choose the rays that an occluder blocks, most often none. Returns them and the visible share of the disk."""
    angle = rng.choice([np.pi / 2, np.pi / 2, 0, np.pi]) + rng.normal(0, 0.12)
    share = rng.uniform(0.6, 0.95)
    if rng.random() >= COVERED_SHARE:
        return np.zeros_like(disk), 1.0
    right, down = np.meshgrid((x - pose.u) / pose.radius_px, (y - pose.v) / pose.radius_px)
    into = right * np.cos(angle) + down * np.sin(angle)
    across = right * np.sin(angle) - down * np.cos(angle)
    edge = np.quantile(into[disk], share)
    cover = (into > edge) & (into < 1.25) & (np.abs(across) < 1.25)
    return cover, float(1 - (cover & disk).sum() / disk.sum())


def _paste(
    shaded: Floats, plain: Floats, patch: _Patch, softness: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Blend ball and occluder into the image. Returns it, linear, and the visible alpha of the ball."""
    tall, wide = patch.alpha.shape
    rgb, alpha, cover = np.zeros_like(shaded), np.zeros_like(shaded[..., 0]), np.zeros_like(shaded[..., 0])
    area = (slice(patch.y, patch.y + tall), slice(patch.x, patch.x + wide))
    rgb[area], alpha[area], cover[area] = patch.rgb, patch.alpha, patch.cover
    rgb, alpha, cover = (_floats(cv2.GaussianBlur(one, (0, 0), softness)) for one in (rgb, alpha, cover))
    with_ball = shaded * (1 - alpha[..., None]) + rgb
    # The occluder shows the surroundings of the ball.
    step = wide if patch.x + wide / 2 < WIDTH / 2 else -wide
    step = int(step * rng.uniform(0.8, 1.1))
    beside = np.roll(plain, -step, axis=1)
    return with_ball * (1 - cover[..., None]) + beside * cover[..., None], alpha * (1 - cover)


def _edges(window: Bytes) -> Floats:
    """Return the absolute second derivative of the gray window, levels."""
    gray = cv2.cvtColor(window, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return _floats(np.abs(cv2.filter2D(gray, -1, _floats([[1, -2, 1], [-2, 4, -2], [1, -2, 1]]))))


def _softness(window: Bytes) -> float:
    """Return the blur, sigma in px, that makes a ball as sharp as the photograph."""
    return float(np.interp(np.quantile(_edges(window), 0.98), [15, 100], [0.8, 0.3]))


def _noise_level(window: Bytes) -> float:
    """Return the noise of the photograph, sigma in levels, limited to that of cameras."""
    return float(np.clip(np.median(_edges(window)) / 0.6745 / 6, 1, 4))
