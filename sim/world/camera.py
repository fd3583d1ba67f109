"""The simulated camera: renderer, painted floor, shadows and walls. Shell (PyBullet).

Inverse depth is linear across the image of a plane, so each face needs one plane equation and one comparison.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from sightline.protocol.messages import CameraModel
from sightline.sim.scenario import Color, Wall
from sightline.sim.world.engine import camera_arrays, pybullet

PoseMatrix = npt.NDArray[np.float64]
Pattern = npt.NDArray[np.float32]
SUBPIXEL_BITS = 4
AMBIENT = 0.62  # of a face that is turned away from the light

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (1, 3, 7, 5))
_NORMALS = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, 1]], dtype=float)


class Face:
    """One side of a wall: corners and outward normal in the world, color as lit."""

    def __init__(self, corners: PoseMatrix, normal: PoseMatrix, colour: PoseMatrix, light_from: PoseMatrix) -> None:
        self.corners, self.normal = corners, normal
        is_level = abs(normal[2]) > 0.5
        self.axes = np.eye(3)[:2] if is_level else np.array([[-normal[1], normal[0], 0.0], [0.0, 0.0, 1.0]])
        """Along and across the face, in the world."""
        lit = AMBIENT + (1 - AMBIENT) * max(0.0, float(normal @ light_from))
        self.rgb = np.clip(np.rint(255 * colour * lit), 0, 255).astype(np.uint8)


def corners_of(wall: Wall) -> tuple[PoseMatrix, PoseMatrix]:
    """Return the eight corners of a wall, and the rotation from its axes to the map."""
    start, end = np.array(wall.start_m), np.array(wall.end_m)
    along = end - start
    length_m = float(np.hypot(*along))
    cos, sin = along / length_m
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    corners = (_CORNERS * [length_m, wall.thickness_m, wall.height_m]) @ turn.T
    corners[:, :2] += (start + end) / 2
    return corners, turn


def faces_of(wall: Wall, light_from: PoseMatrix) -> list[Face]:
    """Return the four sides and the top."""
    corners, turn = corners_of(wall)
    colour = np.array(wall.color)
    return [
        Face(corners[list(order)], turn @ normal, colour, light_from)
        for order, normal in zip(_FACES, _NORMALS, strict=True)
    ]


class WallPainter:
    """Paints the visible faces and stores the inverse depth of the wall in each pixel."""

    def __init__(
        self, walls: tuple[Wall, ...], model: CameraModel, light_from: list[float], near_m: float,
        pattern: Pattern | None = None,
    ) -> None:
        """Prepare the faces. `pattern`: brightness of a tile that covers `WALL_TILE_M` of each wall, about 1."""
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
        self._pattern = pattern
        self._tiles: dict[bytes, npt.NDArray[np.uint8]] = {}
        self._boxes: dict[int, tuple[slice, slice]] = {}
        self._rays = inverse_matrix(model)
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
        if self._pattern is not None:
            self._paint_patterns(self._pattern, lens, seen_axes)
        cv2.copyTo(self._colours, (self._which > 0).view(np.uint8), picture)

    def _add_face(self, number: int, corners: PoseMatrix, normal: PoseMatrix) -> None:
        """Store where this face is the nearest so far. `corners` and `normal` are in the camera frame."""
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
        self._boxes[number] = box
        np.copyto(self.nearness[box], nearness, where=in_front)
        np.copyto(self._which[box], np.uint16(number), where=in_front)

    def _paint_patterns(self, pattern: Pattern, lens: PoseMatrix, seen_axes: PoseMatrix) -> None:
        """Paint the pattern over each visible face. Pixel -> ray -> point of the face is a homography."""
        seen = np.bincount(self._which.ravel(), minlength=len(self._faces) + 1)
        for number in (np.flatnonzero(seen[1:]) + 1).tolist():
            face, box = self._faces[number - 1], self._boxes[number]
            normal = face.normal @ seen_axes
            depth = float(face.normal @ (face.corners[0] - lens))
            to_face = [depth * (axis @ seen_axes) + float(axis @ lens) * normal for axis in face.axes]
            shift = np.array([[1, 0, box[1].start], [0, 1, box[0].start], [0, 0, 1.0]])
            per_m = len(pattern) / WALL_TILE_M
            to_texel = np.diag([per_m, -per_m, 1.0]) @ np.stack([*to_face, normal]) @ self._rays @ shift
            colours = self._colours[box]
            painted = cv2.warpPerspective(
                self._tile(face.rgb, pattern), to_texel, colours.shape[1::-1], None,
                cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_WRAP,
            )
            np.copyto(colours, painted, where=(self._which[box] == number)[..., None])

    def _tile(self, rgb: npt.NDArray[np.uint8], pattern: Pattern) -> npt.NDArray[np.uint8]:
        """Return the tile of a face of this color. Most faces share a few tiles."""
        if rgb.tobytes() not in self._tiles:
            self._tiles[rgb.tobytes()] = np.clip(np.rint(pattern[..., None] * rgb), 0, 255).astype(np.uint8)
        return self._tiles[rgb.tobytes()]


class ShadowPainter:
    """Darkens the floor where objects block the light, with a soft edge."""

    def __init__(self, model: CameraModel, part: float) -> None:
        self._model, self._part = model, part
        self._mask = np.empty((model.height_px, model.width_px), np.uint8)
        self._light = np.array(LIGHT_FROM)

    def paint(
        self, picture: npt.NDArray[np.uint8], casters: Sequence[PoseMatrix], lens: PoseMatrix, seen_axes: PoseMatrix
    ) -> None:
        """Paint into `picture`, which shows the floor. `casters`: points (N, 3) of the convex hull of each object."""
        self._mask.fill(255)
        model = self._model
        focal, middle = np.array([model.fx_px, model.fy_px]), np.array([model.cx_px, model.cy_px]) - 0.5
        lit = round(255 * (1 - self._part))
        for points in casters:
            shadow = self._on_floor(points)
            outline = clipped((shadow - lens) @ seen_axes, WALL_NEAR_M)
            if len(outline) >= 3:
                pixels = middle + focal * outline[:, :2] / outline[:, 2:]
                fixed_point = np.clip(np.rint(pixels * (1 << SUBPIXEL_BITS)), -MOST_FIXED, MOST_FIXED).astype(np.int32)
                cv2.fillConvexPoly(self._mask, fixed_point, lit, shift=SUBPIXEL_BITS)
        cv2.GaussianBlur(self._mask, (0, 0), SHADOW_EDGE_PX, self._mask)
        cv2.multiply(picture, cv2.cvtColor(self._mask, cv2.COLOR_GRAY2RGB), picture, 1 / 255)

    def _on_floor(self, points: PoseMatrix) -> PoseMatrix:
        """Return the outline of the shadow."""
        down = points[:, 2:] / self._light[2]
        fallen = (points[:, :2] - down * self._light[:2]).astype(np.float32)
        hull = cv2.convexHull(fallen)[:, 0].astype(np.float64)
        return np.column_stack([hull, np.zeros(len(hull))])


def clipped(corners: PoseMatrix, near_m: float) -> PoseMatrix:
    """Return the part of a convex polygon at depth (third coordinate) `near_m` or more; may be empty."""
    kept: list[PoseMatrix] = []
    for here, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if here[2] >= near_m:
            kept.append(here)
        if (here[2] >= near_m) != (following[2] >= near_m):
            kept.append(here + (following - here) * (near_m - here[2]) / (following[2] - here[2]))
    return np.array(kept)


# The simulated camera: the ball by TinyRenderer, floor and walls painted. Shell (PyBullet).
#
# TinyRenderer's time depends on the pixels, and floor and walls are most of them, so it draws neither.
# Pixel (0, 0) is the top-left corner of the top-left pixel, as in `CameraModel`.


NEAR_M, FAR_M = 0.02, 20.0
WALL_NEAR_M = 0.002  # the lens of a robot that pushes against a wall is nearer to it than `NEAR_M`
NOTHING_DEPTH = 0.99999  # TinyRenderer leaves 1 in empty pixels
FLOOR_SEEN_TO_M = 8.0  # beyond it the floor would flicker
TEXELS_PER_M = 128
TILE_TEXELS = 512
FLOOR_LEVELS = ((3.0, 0.0), (10.0, 2.0), (math.inf, 8.0))
"""For the floor of a look: texels that a pixel may cover, and the blur of the tile used there, texels."""
WALL_TILE_M = 2.0
SHADOW_EDGE_PX = 1.2
MOST_FIXED = 1 << 24  # beyond the border of any image, and within the limit of OpenCV
SHADED_AMBIENT, SHADED_DIFFUSE = 0.45, 0.5
"""Light on objects if shadows are drawn: less ambient, more from the lamp."""
SKY_RGB = (196, 199, 204)
LIGHT_FROM = [0.4, 0.3, 1.0]

Picture = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]


def floor_tile(seed: int) -> Picture:
    """Return gray-brown boards with specks, tileable: texture for a tracker, in no color of a ball."""
    draw = np.random.default_rng([seed, 4])
    grey = _blurred(draw.normal(0.0, 88.0, (TILE_TEXELS, TILE_TEXELS)), 2.0)
    boards = np.repeat(draw.normal(0.0, 7.0, 8), TILE_TEXELS // 8)
    value = 118.0 + grey + boards[:, None]
    tile = np.stack([value * 1.02, value, value * 0.96], axis=-1)
    tile[:: TILE_TEXELS // 8] *= 0.75
    return np.ascontiguousarray(np.clip(tile, 0, 255).astype(np.uint8))


class Surfaces(NamedTuple):
    """Changes of a look to floor and walls; None or 0: none."""

    floor: Picture | None = None
    """Its tile, `TILE_TEXELS` square."""
    pattern: Pattern | None = None
    """Of the walls, see `WallPainter`."""
    wall_color: Color | None = None
    shadows: float = 0.0


def inverse_matrix(model: CameraModel) -> Matrix:
    """Return the matrix from pixel indices to rays 1 m ahead."""
    return np.linalg.inv(np.array([
        [model.fx_px, 0, model.cx_px - 0.5], [0, model.fy_px, model.cy_px - 0.5], [0, 0, 1]
    ]))


class SceneCamera:
    """Draws the bodies of one client and the floor. Allocates its buffers once."""

    def __init__(
        self, client: int, model: CameraModel, walls: tuple[Wall, ...], seed: int, tile: Picture | None = None,
        *, surfaces: Surfaces | None = None,
    ) -> None:
        """Allocate the buffers. `tile` is the floor, `TILE_TEXELS` square, in place of the default boards."""
        surfaces = surfaces or Surfaces()
        self._client, self._model = client, model
        if surfaces.wall_color:
            walls = tuple(wall.model_copy(update={"color": surfaces.wall_color}) for wall in walls)
        self._walls = WallPainter(walls, model, LIGHT_FROM, WALL_NEAR_M, surfaces.pattern) if walls else None
        self._shadows = ShadowPainter(model, surfaces.shadows) if surfaces.shadows else None
        self._light: dict[str, float] = {"shadow": 0}
        if self._shadows:
            self._light = {
                "shadow": 1, "lightAmbientCoeff": SHADED_AMBIENT, "lightDiffuseCoeff": SHADED_DIFFUSE,
                "lightSpecularCoeff": 0.0,
            }
        self._levels = [(math.inf, floor_tile(seed) if tile is None else tile)]
        if surfaces.floor is not None:
            self._levels = [(texels, _blurred(surfaces.floor, sigma)) for texels, sigma in FLOOR_LEVELS]
        size = (model.height_px, model.width_px)
        self._picture = np.empty((*size, 3), np.uint8)
        self._bodies = np.empty((*size, 3), np.uint8)
        self._mask = np.empty(size, np.bool_)
        self._projection = _projection(model)
        self._rays = inverse_matrix(model)

    def draw(self, lens: tuple[float, float, float], turn: Any, casters: Sequence[Matrix] = ()) -> Picture:
        """Return the RGB image from `lens` with the robot's orientation `turn`; valid until the next call.

        `casters` are points (N, 3) of each object that casts a shadow, if the look has shadows.
        """
        axes = np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
        seen_axes = np.stack([-axes[:, 1], -axes[:, 2], axes[:, 0]], axis=-1)
        self._paint_floor(np.array(lens), seen_axes)
        if self._shadows:
            self._shadows.paint(self._picture, casters, np.array(lens), seen_axes)
        if self._walls:
            self._walls.paint(self._picture, np.array(lens), seen_axes)
        forward, up = axes[:, 0], axes[:, 2]
        view = pybullet.computeViewMatrix(lens, [a + b for a, b in zip(lens, forward, strict=True)], up.tolist())
        rgba, depth, _ = camera_arrays(pybullet.getCameraImage(
            self._model.width_px, self._model.height_px, view, self._projection, lightDirection=LIGHT_FROM,
            flags=pybullet.ER_NO_SEGMENTATION_MASK, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=self._client,
            **self._light,
        ))
        np.less(depth, NOTHING_DEPTH, out=self._mask)
        if self._walls:
            self._mask &= _nearness(depth) > self._walls.nearness
        cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB, self._bodies)
        cv2.copyTo(self._bodies, self._mask.view(np.uint8), self._picture)
        return self._picture

    def _paint_floor(self, lens: Matrix, seen_axes: Matrix) -> None:
        """Paint the floor: pixel -> ray -> floor point is a homography. Above the horizon is the end of the room."""
        seen = seen_axes @ self._rays
        to_floor = np.stack([lens[0] * seen[2] - lens[2] * seen[0], lens[1] * seen[2] - lens[2] * seen[1], seen[2]])
        to_texel = np.diag([TEXELS_PER_M, TEXELS_PER_M, 1.0]) @ to_floor
        bottom = self._model.height_px
        for texels, tile in self._levels:
            top = 0 if texels == math.inf else min(bottom, self._first_row(lens[2], texels))
            if top == bottom:
                continue
            shift = np.array([[1, 0, 0], [0, 1, top], [0, 0, 1.0]])
            cv2.warpPerspective(
                tile, to_texel @ shift, (self._model.width_px, bottom - top), self._picture[top:bottom],
                cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_WRAP,
            )
            bottom = top
        right = self._model.width_px
        limit = seen[2] + np.array([0.0, 0.0, lens[2] / FLOOR_SEEN_TO_M])
        edge = [(-limit[2] - limit[0] * u) / limit[1] for u in (0, right)]
        sky = np.array([[0, -8], [right, -8], [right, edge[1]], [0, edge[0]]])
        cv2.fillConvexPoly(self._picture, np.rint(sky).astype(np.int32), SKY_RGB)

    def _first_row(self, lens_m: float, texels: float) -> int:
        """Return the topmost row in which a pixel covers this many texels of the floor, away from the lens."""
        model = self._model
        ahead_m = math.sqrt(texels / TEXELS_PER_M * lens_m * model.fy_px)
        return max(0, math.ceil(model.cy_px + model.fy_px * lens_m / ahead_m))


def _blurred(tile: npt.NDArray[Any], sigma: float) -> npt.NDArray[Any]:
    """Blur a tile as if it were repeated."""
    if not sigma:
        return tile
    around = cv2.copyMakeBorder(tile, *(TILE_TEXELS // 8,) * 4, cv2.BORDER_WRAP)
    inner = slice(TILE_TEXELS // 8, -TILE_TEXELS // 8)
    return np.ascontiguousarray(cv2.GaussianBlur(around, (0, 0), sigma)[inner, inner])


def _nearness(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Convert TinyRenderer's depth (0 near, 1 far) to inverse distance, 1/m."""
    return np.float32(1 / NEAR_M) - depth * np.float32(1 / NEAR_M - 1 / FAR_M)


def _projection(model: CameraModel) -> list[float]:
    """Return the OpenGL projection whose pixel centers match the pinhole model.

    TinyRenderer samples at the left and lower edge of a pixel, hence the half pixel.
    """
    width, height = model.width_px, model.height_px
    half_up_rad = math.atan(height / 2 / model.fy_px)
    matrix = list(pybullet.computeProjectionMatrixFOV(math.degrees(2 * half_up_rad), width / height, NEAR_M, FAR_M))
    matrix[0] = 2 * model.fx_px / width
    matrix[8] += 1 / width
    matrix[9] += 1 / height
    return matrix
