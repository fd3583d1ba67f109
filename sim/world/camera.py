"""Paints walls as flat quads with their own depth, which costs a third of TinyRenderer's pixels. Pure (NumPy, OpenCV).

One over depth is linear across the picture of a plane, so each face needs one plane equation and one comparison.
"""

import cv2
import numpy as np
import numpy.typing as npt

from sightline.protocol.messages import CameraModel
from sightline.sim.scenario import Wall

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
    colour = np.array(wall.colour)
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
        """One over the depth of the wall in each pixel, per metre; 0 where there is none."""

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
