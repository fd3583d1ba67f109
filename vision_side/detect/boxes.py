"""Boxes that somebody else found: which frame they answer, which of them is meant, and where that is. Pure.

Nothing is taken on trust: boxes count for the one frame that they name, if that frame came here, and what is made of
them cites that frame, so that the robot judges their age by its own record. No boxes is not the same as no answer.
"""

import math
from collections import OrderedDict

import numpy as np

from sightline.protocol.channels import DETECTIONS
from sightline.protocol.codec import decode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import CameraModel, DetectedBox, Detections, DetectionsHeader, FrameHeader
from sightline.protocol.refusals import RejectReason
from sightline.vision_side.config import BoxesConfig
from sightline.vision_side.detect.port import Circle, Detection
from sightline.vision_side.tracking.locate import Sighting, points_ahead

REMEMBERED = 128
"""Frames; at 60 per second twice what any robot would still move for."""
_EDGE_PX = 1.0  # a box that comes this near to the picture's border may go on beyond it


class BoxReader:
    """Reads one source's boxes against the frames that came here."""

    def __init__(self, config: BoxesConfig) -> None:
        self._config = config
        self._frames: OrderedDict[tuple[str, int], FrameHeader] = OrderedDict()

    def remember(self, frame: FrameHeader) -> None:
        """A frame that boxes may name."""
        self._frames[frame.session, frame.seq] = frame
        if len(self._frames) > REMEMBERED:
            self._frames.popitem(last=False)

    def read(self, header: bytes, payload: bytes, camera: CameraModel) -> tuple[FrameHeader, tuple[Detection, ...]]:
        """The frame that was looked at, and what is meant in it, surest first; empty is "saw nothing".

        Raises WireError: MALFORMED, UNSUPPORTED_VERSION, or UNKNOWN_FRAME for boxes of no frame known here. Whether the
        frame is newer than the last is for who steers to see: that it is, is all the order there need be.
        """
        stamp = decode(DetectionsHeader, header)
        found = decode(Detections, payload, DETECTIONS.max_payload_bytes)
        if (found.width_px, found.height_px) != (camera.width_px, camera.height_px):
            size, own = f"{found.width_px}x{found.height_px}", f"{camera.width_px}x{camera.height_px}"
            raise WireError(RejectReason.MALFORMED, f"boxes of a {size} picture, the camera's is {own}")
        frame = self._frame_of(stamp)
        meant = [_detection(box) for box in found.boxes if self._means(box)]
        return frame, tuple(sorted(meant, key=lambda one: one.score, reverse=True))

    def _frame_of(self, stamp: DetectionsHeader) -> FrameHeader:
        echo = stamp.echo
        frame = self._frames.get((echo.session, echo.seq)) if echo and echo.channel == "frame" else None
        if frame is None or echo is None or frame.t_us != echo.t_us:
            which = f"frame {echo.seq} of session {echo.session}" if echo else "no frame"
            raise WireError(RejectReason.UNKNOWN_FRAME, f"boxes answer {which}, which did not come here")
        return frame

    def _means(self, box: DetectedBox) -> bool:
        return box.score >= self._config.min_score and self._config.label in ("", box.label)


def _detection(box: DetectedBox) -> Detection:
    round_ = box.circle
    circle = Circle(round_.cx_px, round_.cy_px, round_.radius_px) if round_ else None
    return Detection(box.x1_px, box.y1_px, box.x2_px, box.y2_px, box.score, box.label, circle)


def locate_box(one: Detection, camera: CameraModel, config: BoxesConfig, otherwise_m: float) -> Sighting | None:
    """Where the thing in the box is: its bearing, and its range if its size is known and all of it is in view.

    `otherwise_m` is its distance from the lens over the floor where the box does not tell. None for an empty box.
    """
    (left, middle), (right, _), (across, top), (_, bottom) = _edges(one, camera)
    ahead_m = _range(right - left, bottom - top, one, camera, config)
    tilt_cos, tilt_sin = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    forward = tilt_cos + middle * tilt_sin  # over the floor, for each metre along the lens's axis
    if forward <= 0 or right <= left or bottom <= top:
        return None
    per_metre = math.hypot(forward, across)
    ahead_m = otherwise_m / per_metre if ahead_m is None else ahead_m
    return Sighting(camera.x_m + ahead_m * forward, camera.y_m - ahead_m * across, one)


def _edges(one: Detection, camera: CameraModel) -> list[list[float]]:
    """Where the rays of the middles of left, right, top and bottom edge are one metre ahead: right, down."""
    x, y = (one.x1_px + one.x2_px) / 2, (one.y1_px + one.y2_px) / 2
    pixels = np.array([[one.x1_px, y], [one.x2_px, y], [x, one.y1_px], [x, one.y2_px]])
    rays: list[list[float]] = points_ahead(pixels, camera)[:2].T.tolist()
    return rays


def _range(width: float, height: float, one: Detection, camera: CameraModel, config: BoxesConfig) -> float | None:
    """Metres along the lens's axis, by the configured height or else width; None if neither is wholly in view."""
    whole_height = one.y1_px >= _EDGE_PX and one.y2_px <= camera.height_px - _EDGE_PX
    whole_width = one.x1_px >= _EDGE_PX and one.x2_px <= camera.width_px - _EDGE_PX
    if config.height_m is not None and whole_height and height > 0:
        return config.height_m / height
    if config.width_m is not None and whole_width and width > 0:
        return config.width_m / width
    return None
