"""Position over the floor of a detection: a sphere by its outline, a box by its size. Pure.

A sphere projects to an ellipse, not to a circle about its center. Its outline rays form a circular cone. For every unit
ray u, u . c = cos(alpha) with c toward the center, and the center is at radius / sin(alpha). So u . w = 1, or
p . w = |p| for any point p of the ray, is linear in w = c / cos(alpha). The equation is exact at any angle to the
axis, and holds for each visible part of the outline.

The planes through the lens and the sides of a box touch the sphere. For the normal n of such a plane
n . c = radius * |n|, which is linear in c. So three sides locate a sphere that the image border cuts off.
"""

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.protocol.channels import DETECTIONS
from sightline.protocol.codec import decode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import CameraModel, DetectedBox, Detections, DetectionsHeader, FrameHeader
from sightline.vision_side.config import BoxesConfig
from sightline.vision_side.detect.port import Circle, Detection, corners, is_normalized
from sightline.vision_side.tracking.appearance import Look

Column = NDArray[np.float64]

_MIN_POINTS = 6
_TRIMS = 3
# Times the median error. The pixel grid causes smaller errors, the edge of an occluder larger ones.
_OUTLIER = 4.0
# If two image borders cut a box, its true size is unknown. The range may be 80 % too large, the bearing is still good.
_CUT_TWICE_EXACTNESS = 0.3
_BOX_ANGLES = np.linspace(0.0, 2 * math.pi, 24, endpoint=False)


@dataclass(frozen=True, slots=True)
class Sighting:
    """The center of a target over the floor, from the midpoint of the axle.

    Args:
        x_m: forward.
        y_m: left.
        detection: its detection.
        exactness: above 0 to 1. Less than 1 for a range that is partly assumed.
        look: its look, or None if unknown.
    """

    x_m: float
    y_m: float
    detection: Detection
    exactness: float = 1.0
    look: Look | None = field(default=None, compare=False)


def locate_sphere(detection: Detection, camera: CameraModel, radius_m: float) -> Sighting | None:
    """Locate a sphere by its outline.

    Args:
        detection: outline, or box, in px of the encoded image.
        camera: model of this image.
        radius_m: radius of the sphere, m.

    Returns:
        Its center over the floor, or None if the outline does not fit a sphere in front of the camera. The range is
        inexact for a box without an outline that two borders of the image cut.

    Source: the outline rays of a sphere form a circular cone, see the module.
    """
    whole = _whole_sides(detection, camera)
    if detection.outline_px is None and sum(whole) == 3:
        center = _tangent_center(detection, whole, camera, radius_m)
    else:
        outline = detection.outline_px if detection.outline_px is not None else _box_outline(detection, camera)
        center = _cone_center(points_ahead(outline, camera), radius_m) if len(outline) >= _MIN_POINTS else None
    if center is None:
        return None
    right, down, ahead = center
    tilt_cos, tilt_sin = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    x_m = camera.x_m + ahead * tilt_cos + down * tilt_sin
    is_cut_twice = detection.outline_px is None and sum(whole) < 3
    return Sighting(x_m, camera.y_m - right, detection, _CUT_TWICE_EXACTNESS if is_cut_twice else 1.0)


def points_ahead(outline_px: NDArray[np.float64], camera: CameraModel) -> NDArray[np.float64]:
    """Convert pixels to rays.

    Args:
        outline_px: (N, 2), px.
        camera: intrinsics and distortion.

    Returns:
        (4, N): right, down, 1 m ahead, and the length of this vector.
    """
    points = np.ones((4, len(outline_px)))
    if camera.distortion:
        matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])
        points[:2] = cv2.undistortPoints(outline_px[:, None], matrix, _opencv_distortion(camera))[:, 0].T
    else:
        principal, focal = _pinhole(camera.cx_px, camera.cy_px, camera.fx_px, camera.fy_px)
        np.divide(outline_px.T - principal, focal, out=points[:2])
    np.sqrt(np.add.reduce(points[:3] * points[:3]), out=points[3])
    return points


def place_px(x_m: float, y_m: float, was_px: tuple[float, float], camera: CameraModel) -> tuple[float, float] | None:
    """Return the place in the image of an object over the floor.

    Args:
        x_m: forward of the midpoint of the axle.
        y_m: left of it.
        was_px: its place in an earlier image. The vertical slope of the ray stays the same.
        camera: model of this image.

    Returns:
        Its place, or None for an object that is not in front of the camera.
    """
    _, (down,) = points_ahead(np.array([was_px]), camera)[:2].tolist()
    forward, ahead_m = math.cos(camera.pitch_rad) + down * math.sin(camera.pitch_rad), x_m - camera.x_m
    if not (ahead_m > 0 and forward > 0):  # also for nan
        return None
    right = (camera.y_m - y_m) / ahead_m * forward
    none = np.zeros(3)
    points, _ = cv2.projectPoints(np.array([[right, down, 1.0]]), none, none, np.eye(3), _opencv_distortion(camera))
    across, below = points.ravel().tolist()
    x_px, y_px = camera.cx_px + camera.fx_px * across, camera.cy_px + camera.fy_px * below
    return (x_px, y_px) if math.isfinite(x_px + y_px) else None


@lru_cache(maxsize=64)
def _pinhole(cx_px: float, cy_px: float, fx_px: float, fy_px: float) -> tuple[Column, Column]:
    """Return principal point and focal lengths as columns."""
    # Cached, because creating them takes as long as using them.
    return np.array([[cx_px], [cy_px]]), np.array([[fx_px], [fy_px]])


def _opencv_distortion(camera: CameraModel) -> NDArray[np.float64]:
    """Pad the coefficients with zeros to 4, 5 or 8, the lengths that OpenCV accepts."""
    count = next(size for size in (4, 5, 8) if len(camera.distortion) <= size)
    return np.array(camera.distortion + (0.0,) * (count - len(camera.distortion)))


def _cone_center(points: NDArray[np.float64], radius_m: float) -> tuple[float, float, float] | None:
    """Solve p . w = |p| by least squares. The center is at radius / sin(alpha) along w. `points` are columns p, |p|."""
    w = _solved(points)
    for _ in range(_TRIMS):
        if w is None:
            return None
        off = np.abs(np.array((*w, -1.0)) @ points)
        # Points beyond the limit are the edge of another object in front of the sphere.
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
        # Not a cone that opens forward.
        return None
    # radius / sin(alpha), from the length of w.
    per_w = radius_m / math.sqrt(square - 1.0)
    return right * per_w, down * per_w, ahead * per_w


def _solved(points: NDArray[np.float64]) -> tuple[float, float, float] | None:
    """Solve the normal equations for w. Returns None if they are singular."""
    # By cofactors, which is several times faster than a call of LAPACK.
    (a, b, c, x), (_, d, e, y), (_, _, f, z), _ = (points @ points.T).tolist()
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * ab + c * ac
    if not abs(determinant) > 1e-12 * abs(a * d * f):
        return None
    return ((aa * x + ab * y + ac * z) / determinant, (ab * x + bb * y + bc * z) / determinant,
            (ac * x + bc * y + cc * z) / determinant)


def _tangent_center(
    one: Detection, whole: list[bool], camera: CameraModel, radius_m: float
) -> tuple[float, float, float] | None:
    """Solve n . c = radius * |n| for the planes of the sides of a box that are `whole`."""
    (left, _), (right, _), (_, top), (_, bottom) = _edges(one, camera)
    if right <= left or bottom <= top:
        return None
    normals = np.array([[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]])[whole]
    w = _solved(np.vstack([normals.T, np.linalg.norm(normals, axis=1)]))
    return None if w is None else (w[0] * radius_m, w[1] * radius_m, w[2] * radius_m)


def _box_outline(detection: Detection, camera: CameraModel) -> NDArray[np.float64]:
    """Return the ellipse in a detector's box, without the points at the border of the image."""
    cx, cy = detection.center_px
    half_width, half_height = (detection.x2_px - detection.x1_px) / 2, (detection.y2_px - detection.y1_px) / 2
    points = np.column_stack([cx + half_width * np.cos(_BOX_ANGLES), cy + half_height * np.sin(_BOX_ANGLES)])
    x, y = points.T
    shown: NDArray[np.float64] = points[(x > 1) & (y > 1) & (x < camera.width_px - 1) & (y < camera.height_px - 1)]
    return shown


# Boxes of another service: their frame, the selected box, and its position. Pure.
#
# Boxes count only if this service received the frame that they name. The twist cites that frame, so the robot validates
# its age by its own record. "No boxes" differs from "no answer".


# Frames; at 60 fps twice the longest frame age at which a robot still moves.
REMEMBERED = 128
# A box this near to the image border may continue beyond it, so its size is unknown.
_EDGE_PX = 1.0


class BoxReader:
    """Reads the boxes of one source, which name frames that this service received."""

    def __init__(self, config: BoxesConfig) -> None:
        self._config = config
        self._frames: OrderedDict[tuple[str, int], FrameHeader] = OrderedDict()
        self._senders: tuple[str | None, str | None] = (None, None)
        self.returns = 0
        """Number of changes back to the service before the last one. A service that starts again is another one."""

    def remember(self, frame: FrameHeader) -> None:
        """Store a frame that boxes may name."""
        self._frames[frame.session, frame.seq] = frame
        if len(self._frames) > REMEMBERED:
            self._frames.popitem(last=False)

    def read(self, header: bytes, payload: bytes, camera: CameraModel) -> tuple[FrameHeader, tuple[Detection, ...]]:
        """Decode boxes. The pipeline checks that their frame is newer than the last one.

        Args:
            header: header bytes.
            payload: payload bytes.
            camera: model of the camera, whose size the boxes must have.

        Returns:
            The frame that they name, and the detections of the target, best first. Empty means "detected nothing".

        Raises:
            WireError: MALFORMED, UNSUPPORTED_VERSION, or UNKNOWN_FRAME for a frame that this service does not have.
        """
        stamp = decode(DetectionsHeader, header)
        found = decode(Detections, payload, DETECTIONS.max_payload_bytes)
        if (found.width_px, found.height_px) != (camera.width_px, camera.height_px):
            size, own = f"{found.width_px}x{found.height_px}", f"{camera.width_px}x{camera.height_px}"
            raise WireError(RejectReason.MALFORMED, f"boxes of a {size} image, the camera delivers {own}")
        frame = self._frame_of(stamp)
        self._note_sender(stamp.session)
        meant = [_detection(box) for box in found.boxes if self._means(box)]
        if is_normalized(np.array([corners(one) for one in meant]).reshape(len(meant), 4)):
            raise WireError(RejectReason.MALFORMED, "all boxes lie within two pixels of the corner, as if from 0 to 1")
        return frame, tuple(sorted(meant, key=lambda one: one.score, reverse=True))

    def _note_sender(self, session: str) -> None:
        before, last = self._senders
        if session != last:
            self.returns += session == before
            self._senders = last, session

    def _frame_of(self, stamp: DetectionsHeader) -> FrameHeader:
        echo = stamp.echo
        frame = self._frames.get((echo.session, echo.seq)) if echo and echo.channel == "frame" else None
        if frame is None or echo is None or frame.t_us != echo.t_us:
            which = f"frame {echo.seq} of session {echo.session}, not received here" if echo else "no frame"
            raise WireError(RejectReason.UNKNOWN_FRAME, f"boxes answer {which}")
        return frame

    def _means(self, box: DetectedBox) -> bool:
        return box.score >= self._config.min_score and self._config.label in ("", box.label)


def _detection(box: DetectedBox) -> Detection:
    round_ = box.circle
    circle = Circle(round_.cx_px, round_.cy_px, round_.radius_px) if round_ else None
    return Detection(box.x1_px, box.y1_px, box.x2_px, box.y2_px, box.score, box.label, circle)


def locate_box(one: Detection, camera: CameraModel, config: BoxesConfig, otherwise_m: float) -> Sighting | None:
    """Locate the object in a box by its bearing, and by its size if the box is fully in view.

    Args:
        one: detection in px of the encoded image.
        camera: model of this image.
        config: size of the object, m.
        otherwise_m: assumed distance from the lens if the size is unknown, m.

    Returns:
        Its center over the floor, or None for an empty box.
    """
    (left, middle), (right, _), (across, top), (_, bottom) = _edges(one, camera)
    ahead_m = _range(right - left, bottom - top, one, camera, config)
    tilt_cos, tilt_sin = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    # Over the floor, per meter along the axis of the lens.
    forward = tilt_cos + middle * tilt_sin
    if forward <= 0 or right <= left or bottom <= top:
        return None
    per_meter = math.hypot(forward, across)
    ahead_m = otherwise_m / per_meter if ahead_m is None else ahead_m
    return Sighting(camera.x_m + ahead_m * forward, camera.y_m - ahead_m * across, one)


def _edges(one: Detection, camera: CameraModel) -> list[list[float]]:
    """Return the rays (right, down, at 1 m ahead) of the centers of the left, right, top and bottom edges."""
    x, y = one.center_px
    pixels = np.array([[one.x1_px, y], [one.x2_px, y], [x, one.y1_px], [x, one.y2_px]])
    rays: list[list[float]] = points_ahead(pixels, camera)[:2].T.tolist()
    return rays


def _range(width: float, height: float, one: Detection, camera: CameraModel, config: BoxesConfig) -> float | None:
    """Return the range along the axis of the lens, m, by the height or else the width, if it is fully in view."""
    left, right, top, bottom = _whole_sides(one, camera)
    if config.height_m is not None and top and bottom and height > 0:
        return config.height_m / height
    if config.width_m is not None and left and right and width > 0:
        return config.width_m / width
    return None


def _whole_sides(one: Detection, camera: CameraModel) -> list[bool]:
    """Return False for each side (left, right, top, bottom) so near to the image border that it may cut the object."""
    edges = ((one.x1_px, camera.width_px), (one.x2_px, camera.width_px), (one.y1_px, camera.height_px),
             (one.y2_px, camera.height_px))
    return [_EDGE_PX <= edge_px <= size_px - _EDGE_PX for edge_px, size_px in edges]
