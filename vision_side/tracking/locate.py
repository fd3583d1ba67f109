"""A sphere's outline in pixels -> where its centre is, in metres about the robot. Pure.

A sphere projects to an ellipse, not to a circle about its centre. Its outline rays do form a circular cone: for every
unit ray u, u . c = cos(alpha) with c towards the centre, and the centre is at radius / sin(alpha). So u . w = 1, or
p . w = |p| for any point p of the ray, is linear in w = c / cos(alpha), exact at any angle off the axis, and holds for
whatever part of the outline is in view.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.protocol.messages import CameraModel
from sightline.vision_side.detect.port import Detection

Column = NDArray[np.float64]

_MIN_POINTS = 6
_TRIMS = 3
_OUTLIER = 4.0  # times the median error: no pixel's stair-step is that far off, the edge of an occluder is
_BOX_ANGLES = np.linspace(0.0, 2 * math.pi, 24, endpoint=False)


@dataclass(frozen=True, slots=True)
class Sighting:
    """A target's centre over the floor, from the axle's midpoint: `x_m` forward, `y_m` left."""

    x_m: float
    y_m: float
    detection: Detection


def locate_sphere(detection: Detection, camera: CameraModel, radius_m: float) -> Sighting | None:
    """Where a sphere of `radius_m` is, or None if the outline is no sphere's (too few points, no size, behind)."""
    outline = detection.outline_px if detection.outline_px is not None else _box_outline(detection, camera)
    if len(outline) < _MIN_POINTS:
        return None
    centre = _cone_centre(points_ahead(outline, camera), radius_m)
    if centre is None:
        return None
    right, down, ahead = centre
    tilt_cos, tilt_sin = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    x_m = camera.x_m + ahead * tilt_cos + down * tilt_sin
    return Sighting(x_m, camera.y_m - right, detection)


def points_ahead(outline_px: NDArray[np.float64], camera: CameraModel) -> NDArray[np.float64]:
    """Where the pixels' rays are one metre ahead: right, down, 1, and how far that is (4, N)."""
    points = np.ones((4, len(outline_px)))
    if camera.distortion:
        matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])
        points[:2] = cv2.undistortPoints(outline_px[:, None], matrix, _opencv_distortion(camera))[:, 0].T
    else:
        principal, focal = _pinhole(camera.cx_px, camera.cy_px, camera.fx_px, camera.fy_px)
        np.divide(outline_px.T - principal, focal, out=points[:2])
    np.sqrt(np.add.reduce(points[:3] * points[:3]), out=points[3])
    return points


@lru_cache(maxsize=64)
def _pinhole(cx_px: float, cy_px: float, fx_px: float, fy_px: float) -> tuple[Column, Column]:
    """As columns; kept, since building them costs as much as using them."""
    return np.array([[cx_px], [cy_px]]), np.array([[fx_px], [fy_px]])


def _opencv_distortion(camera: CameraModel) -> NDArray[np.float64]:
    """OpenCV takes 4, 5 or 8 coefficients; the missing ones are zero."""
    count = next(size for size in (4, 5, 8) if len(camera.distortion) <= size)
    return np.array(camera.distortion + (0.0,) * (count - len(camera.distortion)))


def _cone_centre(points: NDArray[np.float64], radius_m: float) -> tuple[float, float, float] | None:
    """Least squares of p . w = |p|, then the centre at radius / sin(alpha) along w. `points` are columns p, |p|."""
    w = _solved(points)
    for _ in range(_TRIMS):
        if w is None:
            return None
        off = np.abs(np.array((*w, -1.0)) @ points)
        limit = _OUTLIER * np.sort(off)[len(off) // 2]
        if np.maximum.reduce(off) <= limit:
            break
        points = points[:, off <= limit]
        w = _solved(points)
    if w is None:
        return None
    right, down, ahead = w
    square = right * right + down * down + ahead * ahead
    if not 1.0 < square < math.inf or ahead <= 0:
        return None  # not a cone that opens forward
    per_w = radius_m / math.sqrt(square - 1.0)  # radius / sin(alpha), by the length of w
    return right * per_w, down * per_w, ahead * per_w


def _solved(points: NDArray[np.float64]) -> tuple[float, float, float] | None:
    """w of the normal equations, by cofactors, several times faster than a call of LAPACK; None if singular."""
    (a, b, c, x), (_, d, e, y), (_, _, f, z), _ = (points @ points.T).tolist()
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * ab + c * ac
    if not abs(determinant) > 1e-12 * abs(a * d * f):
        return None
    return ((aa * x + ab * y + ac * z) / determinant, (ab * x + bb * y + bc * z) / determinant,
            (ac * x + bc * y + cc * z) / determinant)


def _box_outline(detection: Detection, camera: CameraModel) -> NDArray[np.float64]:
    """The ellipse in a detector's box, less what the picture's border cut off."""
    cx, cy = (detection.x1_px + detection.x2_px) / 2, (detection.y1_px + detection.y2_px) / 2
    half_width, half_height = (detection.x2_px - detection.x1_px) / 2, (detection.y2_px - detection.y1_px) / 2
    points = np.column_stack([cx + half_width * np.cos(_BOX_ANGLES), cy + half_height * np.sin(_BOX_ANGLES)])
    x, y = points.T
    shown: NDArray[np.float64] = points[(x > 1) & (y > 1) & (x < camera.width_px - 1) & (y < camera.height_px - 1)]
    return shown
