"""The simulated camera: the ball by TinyRenderer, floor and walls painted, then the defects. Shell (PyBullet).

TinyRenderer's time goes into pixels, and floor and walls are most of them: it draws neither.
Pixel (0, 0) is the top-left corner of the top-left pixel, as in `CameraModel`.
"""

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from sightline.protocol.messages import CameraModel
from sightline.robot_side.ports import scaled_quality, scaled_size
from sightline.sim.world.engine import pybullet
from sightline.sim.look import Look
from sightline.sim.scenario import Wall
from sightline.sim.world.camera import WallPainter

NEAR_M, FAR_M = 0.02, 20.0
NOTHING_DEPTH = 0.99999  # TinyRenderer leaves 1 where it drew nothing
FLOOR_SEEN_TO_M = 8.0  # beyond it the floor would only flicker
TEXELS_PER_M = 128
TILE_TEXELS = 512
NOISE_MARGIN_PX = 64
SKY_RGB = (196, 199, 204)
LIGHT_FROM = [0.4, 0.3, 1.0]

Picture = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]


def floor_tile(seed: int) -> Picture:
    """Grey-brown boards with specks, tileable: structure for a tracker, no colour that a ball could have."""
    draw = np.random.default_rng([seed, 4])
    middle = slice(TILE_TEXELS, 2 * TILE_TEXELS)
    specks = np.tile(draw.normal(0.0, 88.0, (TILE_TEXELS, TILE_TEXELS)), (3, 3))
    grey = cv2.GaussianBlur(specks, (0, 0), 2.0)[middle, middle]
    boards = np.repeat(draw.normal(0.0, 7.0, 8), TILE_TEXELS // 8)
    value = 118.0 + grey + boards[:, None]
    tile = np.stack([value * 1.02, value, value * 0.96], axis=-1)
    tile[:: TILE_TEXELS // 8] *= 0.75
    return np.ascontiguousarray(np.clip(tile, 0, 255).astype(np.uint8))


class SceneCamera:
    """Draws one client's bodies and its floor, buffers allocated once."""

    def __init__(self, client: int, model: CameraModel, walls: tuple[Wall, ...], seed: int) -> None:
        self._client, self._model = client, model
        self._walls = WallPainter(walls, model, LIGHT_FROM, NEAR_M) if walls else None
        self._tile = floor_tile(seed)
        size = (model.height_px, model.width_px)
        self._picture = np.empty((*size, 3), np.uint8)
        self._bodies = np.empty((*size, 3), np.uint8)
        self._mask = np.empty(size, np.bool_)
        self._projection = _projection(model)
        self._rays = np.linalg.inv(np.array([
            [model.fx_px, 0, model.cx_px - 0.5], [0, model.fy_px, model.cy_px - 0.5], [0, 0, 1]
        ]))

    def draw(self, lens: tuple[float, float, float], turn: Any) -> Picture:
        """RGB picture from `lens` with the robot's orientation `turn`; valid until the next call."""
        axes = np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
        seen_axes = np.stack([-axes[:, 1], -axes[:, 2], axes[:, 0]], axis=-1)
        self._paint_floor(np.array(lens), seen_axes)
        if self._walls:
            self._walls.paint(self._picture, np.array(lens), seen_axes)
        forward, up = axes[:, 0], axes[:, 2]
        view = pybullet.computeViewMatrix(lens, [a + b for a, b in zip(lens, forward, strict=True)], up.tolist())
        image = pybullet.getCameraImage(
            self._model.width_px, self._model.height_px, view, self._projection, shadow=0, lightDirection=LIGHT_FROM,
            flags=pybullet.ER_NO_SEGMENTATION_MASK, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=self._client,
        )
        np.less(image[3], NOTHING_DEPTH, out=self._mask)
        if self._walls:
            self._mask &= _nearness(image[3]) > self._walls.nearness
        cv2.cvtColor(image[2], cv2.COLOR_RGBA2RGB, self._bodies)
        cv2.copyTo(self._bodies, self._mask.view(np.uint8), self._picture)
        return self._picture

    def _paint_floor(self, lens: Matrix, seen_axes: Matrix) -> None:
        """Pixel -> ray -> point on the floor is a homography; above the horizon there is the far end of the room."""
        seen = seen_axes @ self._rays
        to_floor = np.stack([lens[0] * seen[2] - lens[2] * seen[0], lens[1] * seen[2] - lens[2] * seen[1], seen[2]])
        to_texel = np.diag([TEXELS_PER_M, TEXELS_PER_M, 1.0]) @ to_floor
        cv2.warpPerspective(
            self._tile, to_texel, (self._model.width_px, self._model.height_px), self._picture,
            cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_WRAP,
        )
        right = self._model.width_px
        limit = seen[2] + np.array([0.0, 0.0, lens[2] / FLOOR_SEEN_TO_M])
        edge = [(-limit[2] - limit[0] * u) / limit[1] for u in (0, right)]
        sky = np.array([[0, -8], [right, -8], [right, edge[1]], [0, edge[0]]])
        cv2.fillConvexPoly(self._picture, np.rint(sky).astype(np.int32), SKY_RGB)


def _nearness(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """One over the metres that TinyRenderer's depth (0 near, 1 far) stands for."""
    return np.float32(1 / NEAR_M) - depth * np.float32(1 / NEAR_M - 1 / FAR_M)


def _projection(model: CameraModel) -> list[float]:
    """OpenGL projection whose pixel centres are where the pinhole model has them.

    TinyRenderer samples at a pixel's left and lower edge, hence the half pixel.
    """
    width, height = model.width_px, model.height_px
    half_up_rad = math.atan(height / 2 / model.fy_px)
    matrix = list(pybullet.computeProjectionMatrixFOV(math.degrees(2 * half_up_rad), width / height, NEAR_M, FAR_M))
    matrix[0] = 2 * model.fx_px / width
    matrix[8] += 1 / width
    matrix[9] += 1 / height
    return matrix


def _fading(saturation: float) -> Matrix:
    """What brings red, green and blue nearer to their brightness, or further from it."""
    weights = np.array([0.299, 0.587, 0.114])  # of brightness, as JPEG has them
    return np.asarray(saturation * np.eye(3) + (1 - saturation) * weights)


class Defects:
    """Exposure, white balance, blur, noise, JPEG: what stands between a scene and what arrives."""

    def __init__(self, look: Look, width_px: int, height_px: int, seed: int) -> None:
        self._look = look
        self._draw = np.random.default_rng([seed, 5])
        self._size = (height_px, width_px)
        steps = np.arange(256)[:, None] * look.exposure * np.array(look.white_balance)
        self._table = np.clip(np.rint(steps), 0, 255).astype(np.uint8).reshape(1, 256, 3)
        self._fade = _fading(look.saturation) if look.saturation != 1.0 else None
        self._is_neutral = look.exposure == 1.0 and look.white_balance == (1.0, 1.0, 1.0)
        pool = (height_px + NOISE_MARGIN_PX, width_px + NOISE_MARGIN_PX, 3)
        self._pool = np.rint(self._draw.normal(0.0, look.noise, pool)).astype(np.int16) if look.noise else None

    def jpeg(self, picture: Picture, quality_percent: int = 100, scale_percent: int = 100) -> bytes:
        """`picture` (RGB, changed in place) as the JPEG that the camera gives."""
        look = self._look
        if self._fade is not None:
            cv2.transform(picture, self._fade, picture)
        if not self._is_neutral:
            cv2.LUT(picture, self._table, picture)
        if look.blur_px:
            cv2.GaussianBlur(picture, (0, 0), look.blur_px, picture)
        if self._pool is not None:
            cv2.add(picture, self._noise(self._pool), picture, dtype=cv2.CV_8U)
        quality = scaled_quality(look.jpeg_quality, quality_percent)
        return bytes(simplejpeg.encode_jpeg(self._scaled(picture, scale_percent), quality, "RGB", "420"))

    def _scaled(self, picture: Picture, scale_percent: int) -> Picture:
        if scale_percent == 100:
            return picture
        size = scaled_size(self._size[1], self._size[0], scale_percent)
        return np.asarray(cv2.resize(picture, (size.width_px, size.height_px), interpolation=cv2.INTER_AREA), np.uint8)

    def _noise(self, pool: npt.NDArray[np.int16]) -> npt.NDArray[np.int16]:
        """A randomly placed part of noise drawn beforehand: drawing it anew costs 20 times as much."""
        down, right = self._draw.integers(0, NOISE_MARGIN_PX, 2).tolist()
        return pool[down : down + self._size[0], right : right + self._size[1]]
