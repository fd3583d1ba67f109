"""The simulated camera: renderer, painted floor and walls, defects. Shell (PyBullet).

One over depth is linear across the picture of a plane, so each face needs one plane equation and one comparison.
"""

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from sightline.protocol.messages import CameraModel
from sightline.robot_side.ports import scaled_quality, scaled_size
from sightline.sim.scenario import Look, Wall
from sightline.sim.world.engine import camera_arrays, pybullet

PoseMatrix = npt.NDArray[np.float64]
SUBPIXEL_BITS = 4
AMBIENT = 0.62  # of a face turned away from the light

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (1, 3, 7, 5))
_NORMALS = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, 1]], dtype=float)


class Face:
    """One side of a wall: corners and outward normal in the world, colour as lit."""

    def __init__(self, corners: PoseMatrix, normal: PoseMatrix, colour: PoseMatrix, light_from: PoseMatrix) -> None:
        self.corners, self.normal = corners, normal
        lit = AMBIENT + (1 - AMBIENT) * max(0.0, float(normal @ light_from))
        self.rgb = np.clip(np.rint(255 * colour * lit), 0, 255).astype(np.uint8)


def faces_of(wall: Wall, light_from: PoseMatrix) -> list[Face]:
    """The four sides and the top."""
    start, end = np.array(wall.start_m), np.array(wall.end_m)
    along = end - start
    length_m = float(np.hypot(*along))
    cos, sin = along / length_m
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    corners = (_CORNERS * [length_m, wall.thickness_m, wall.height_m]) @ turn.T
    corners[:, :2] += (start + end) / 2
    colour = np.array(wall.color)
    return [
        Face(corners[list(order)], turn @ normal, colour, light_from)
        for order, normal in zip(_FACES, _NORMALS, strict=True)
    ]


class WallPainter:
    """Paints the faces that the lens sees and remembers how near each pixel's wall is."""

    def __init__(self, walls: tuple[Wall, ...], model: CameraModel, light_from: list[float], near_m: float) -> None:
        light = np.array(light_from) / np.linalg.norm(light_from)
        self._faces = [face for wall in walls for face in faces_of(wall, light)]
        self._model, self._near_m = model, near_m
        size = (model.height_px, model.width_px)
        self._columns = np.arange(model.width_px, dtype=np.float32) + np.float32(0.5 - model.cx_px)
        self._rows = (np.arange(model.height_px, dtype=np.float32) + np.float32(0.5 - model.cy_px))[:, None]
        self._polygon = np.empty(size, np.uint8)
        self._palette = np.array([(0, 0, 0), *(face.rgb for face in self._faces)], np.uint8)
        self._which = np.empty(size, np.uint16)
        self._colours = np.empty((*size, 3), np.uint8)
        self.nearness = np.zeros(size, np.float32)
        """Inverse depth of the wall in each pixel, 1/m; 0 without a wall."""

    def paint(self, picture: npt.NDArray[np.uint8], lens: PoseMatrix, seen_axes: PoseMatrix) -> None:
        """Paint into `picture`. `seen_axes`: columns right, down, forward of the camera, in the world."""
        self.nearness.fill(0)
        self._which.fill(0)
        for number, face in enumerate(self._faces, start=1):
            if face.normal @ (lens - face.corners[0]) > 0:
                self._add_face(number, (face.corners - lens) @ seen_axes, face.normal @ seen_axes)
        np.take(self._palette, self._which, axis=0, out=self._colours, mode="clip")
        cv2.copyTo(self._colours, (self._which > 0).view(np.uint8), picture)

    def _add_face(self, number: int, corners: PoseMatrix, normal: PoseMatrix) -> None:
        """Note where this face is the nearest so far; `corners` and `normal` as the camera sees them."""
        outline = clipped(corners, self._near_m)
        if len(outline) < 3:
            return
        model = self._model
        focal, middle = np.array([model.fx_px, model.fy_px]), np.array([model.cx_px, model.cy_px]) - 0.5
        points = middle + focal * outline[:, :2] / outline[:, 2:]
        left, top = np.maximum(np.floor(points.min(axis=0)), 0).astype(int)
        right, bottom = np.maximum(np.ceil(points.max(axis=0)) + 1, 0).astype(int)
        box = (slice(top, bottom), slice(left, right))
        polygon = self._polygon[box]
        if not polygon.size:
            return
        self._polygon.fill(0)
        fixed_point = np.rint(points * (1 << SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillConvexPoly(self._polygon, fixed_point, 1, shift=SUBPIXEL_BITS)
        a, b, c = (normal / (normal @ corners[0]) / [*focal, 1]).astype(np.float32)
        nearness = (a * self._columns[box[1]] + c) + b * self._rows[box[0]]
        in_front = (nearness > self.nearness[box]) & polygon.view(np.bool_)
        np.copyto(self.nearness[box], nearness, where=in_front)
        np.copyto(self._which[box], np.uint16(number), where=in_front)


def clipped(corners: PoseMatrix, near_m: float) -> PoseMatrix:
    """The convex polygon's part at depth (third coordinate) `near_m` or more; may be empty."""
    kept: list[PoseMatrix] = []
    for here, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if here[2] >= near_m:
            kept.append(here)
        if (here[2] >= near_m) != (following[2] >= near_m):
            kept.append(here + (following - here) * (near_m - here[2]) / (following[2] - here[2]))
    return np.array(kept)


# The simulated camera: the ball by TinyRenderer, floor and walls painted, then the defects. Shell (PyBullet).
#
# TinyRenderer's time goes into pixels, and floor and walls are most of them: it draws neither.
# Pixel (0, 0) is the top-left corner of the top-left pixel, as in `CameraModel`.


NEAR_M, FAR_M = 0.02, 20.0
WALL_NEAR_M = 0.002  # the lens of a robot that pushes against a wall is nearer to it than `NEAR_M`
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

    def __init__(
        self, client: int, model: CameraModel, walls: tuple[Wall, ...], seed: int, tile: Picture | None = None
    ) -> None:
        """`tile` is the floor, `TILE_TEXELS` square, in place of the boards that robots see."""
        self._client, self._model = client, model
        self._walls = WallPainter(walls, model, LIGHT_FROM, WALL_NEAR_M) if walls else None
        self._tile = floor_tile(seed) if tile is None else tile
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
        rgba, depth, _ = camera_arrays(pybullet.getCameraImage(
            self._model.width_px, self._model.height_px, view, self._projection, shadow=0, lightDirection=LIGHT_FROM,
            flags=pybullet.ER_NO_SEGMENTATION_MASK, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=self._client,
        ))
        np.less(depth, NOTHING_DEPTH, out=self._mask)
        if self._walls:
            self._mask &= _nearness(depth) > self._walls.nearness
        cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB, self._bodies)
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
    """Return the matrix that moves red, green and blue toward their brightness, or away from it."""
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
        """Return a random part of stored noise. New noise costs 20 times as much."""
        down, right = self._draw.integers(0, NOISE_MARGIN_PX, 2).tolist()
        return pool[down : down + self._size[0], right : right + self._size[1]]
