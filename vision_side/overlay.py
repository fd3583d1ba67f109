"""Draw the results over their image: axes, outline, raw and filtered center, text. Pure."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.protocol.messages import CameraModel, FrameHeader, Twist
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.pipeline import Observation

Image = NDArray[np.uint8]
Point = tuple[float, float]
Color = tuple[int, int, int]

AXES: Final = (210, 210, 210)
OUTLINE: Final = (255, 230, 0)
TARGET: Final = (80, 235, 80)
OTHER: Final = (170, 170, 60)
RAW: Final = (70, 110, 255)
FILTERED: Final = (255, 120, 255)
TEXT_COLOR: Final = (255, 255, 255)
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_FONT_PER_WIDTH: Final = 0.48 / 640  # about sixty letters across the image
_STRIP_SHADE: Final = 0.35  # brightness of the image under text, so that the text is legible
_LINE_PER_FONT: Final = 40  # line height in pixels at font size 1
_GAP: Final = "    "
_FAR_PX: Final = 9e3  # OpenCV drawing coordinates have 16 bits


@dataclass(frozen=True, slots=True)
class OverlayData:
    """The data for the overlay of one frame.

    `radius_m` is the radius of the target, for the predicted center. `age_us` is a lower bound of the frame age, if the
    robot has not measured one.
    """

    header: FrameHeader
    seen: Observation
    twist: Twist | None
    mission: str
    camera: CameraModel
    radius_m: float
    age_us: int | None = None


def draw_overlay(picture: Image, shown: OverlayData, width_px: int) -> Image:
    """Scale `picture` to `width_px` and draw the overlay."""
    camera = shown.camera
    height_px = max(1, round(width_px * camera.height_px / camera.width_px))
    canvas = _resized(picture, width_px, height_px)
    scale = width_px / camera.width_px
    cv2.line(canvas, (width_px // 2, 0), (width_px // 2, height_px - 1), AXES, 1)
    cv2.line(canvas, (0, height_px // 2), (width_px - 1, height_px // 2), AXES, 1)
    target = shown.seen.target
    for one in shown.seen.detections:
        if one is not target:
            _draw_other(canvas, one, scale)
    if target is not None:
        _draw_target(canvas, target, scale)
    filtered = filtered_px(shown)
    if filtered is not None:
        cv2.drawMarker(canvas, _at(filtered, scale), FILTERED, cv2.MARKER_DIAMOND, 31, 2, cv2.LINE_AA)
    font = width_px * _FONT_PER_WIDTH
    _write_strip(canvas, [_what_it_does(shown)], font, top=True)
    _write_strip(canvas, [_where_it_is(target, filtered), _what_it_commands(shown)], font, top=False)
    return canvas


def draw_preview(picture: Image, width_px: int) -> Image:
    """Scale `picture` down to `width_px`. A smaller image stays unchanged."""
    height, width = picture.shape[:2]
    if width <= width_px:
        return picture
    return _resized(picture, width_px, max(1, round(width_px * height / width)))


def raw_px(target: Detection) -> Point:
    """Return the center of the circle, or of the box without a circle."""
    if target.circle is not None:
        return target.circle.cx_px, target.circle.cy_px
    return target.center_px


def radius_px(target: Detection) -> float:
    """Return the radius of the circle. Without a circle: the radius of a disk with the area of the box, px."""
    if target.circle is not None:
        return target.circle.radius_px
    return math.sqrt(max(0.0, (target.x2_px - target.x1_px) * (target.y2_px - target.y1_px)) / math.pi)


def filtered_px(shown: OverlayData) -> Point | None:
    """Return the tracked center of the target in pixels of the encoded image, or None if it is not in front."""
    seen, camera = shown.seen, shown.camera
    if seen.bearing_rad is None or seen.distance_m is None:
        return None
    forward, left = (seen.distance_m * part for part in (math.cos(seen.bearing_rad), math.sin(seen.bearing_rad)))
    up = shown.radius_m - camera.z_m
    tilt_cos, tilt_sin = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    ahead, down = forward * tilt_cos + up * tilt_sin, forward * tilt_sin - up * tilt_cos
    if not (math.isfinite(ahead) and ahead > 0.01):  # a point behind the lens has no pixel
        return None
    across_px, down_px = camera.cx_px - camera.fx_px * left / ahead, camera.cy_px + camera.fy_px * down / ahead
    # A mission without a height follows objects of any height. The detection gives the height.
    return across_px, raw_px(seen.target)[1] if seen.target is not None else down_px


def _resized(picture: Image, width_px: int, height_px: int) -> Image:
    shrinks = picture.shape[1] > width_px
    way = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.ascontiguousarray(cv2.resize(picture, (width_px, height_px), interpolation=way), np.uint8)


def _draw_other(canvas: Image, one: Detection, scale: float) -> None:
    first, second = _at((one.x1_px, one.y1_px), scale), _at((one.x2_px, one.y2_px), scale)
    cv2.rectangle(canvas, first, second, OTHER, 1)
    _outlined(canvas, f"{_plain(one.label)} {one.score:.2f}", (first[0] + 3, first[1] + 13), 0.4, OTHER)


def _draw_target(canvas: Image, target: Detection, scale: float) -> None:
    if target.outline_px is not None and len(target.outline_px):
        points = np.round(np.asarray(target.outline_px) * scale).astype(np.int32)
        for point in points.reshape(-1, 2):
            cv2.circle(canvas, (int(point[0]), int(point[1])), 1, OUTLINE, -1)
    if target.circle is not None:
        cv2.circle(canvas, _at(raw_px(target), scale), max(1, round(radius_px(target) * scale)), TARGET, 1, cv2.LINE_AA)
    else:
        corners = (target.x1_px, target.y1_px), (target.x2_px, target.y2_px)
        cv2.rectangle(canvas, _at(corners[0], scale), _at(corners[1], scale), TARGET, 2)
    cv2.drawMarker(canvas, _at(raw_px(target), scale), RAW, cv2.MARKER_CROSS, 19, 2, cv2.LINE_AA)


def _at(point: Point, scale: float) -> tuple[int, int]:
    """Convert a point to the canvas. Points far outside, and nan, go where drawing is fast."""
    across, down = (-_FAR_PX if math.isnan(value) else min(max(value * scale, -_FAR_PX), _FAR_PX) for value in point)
    return round(across), round(down)


# --- text --------------------------------------------------------------------------------------------------------

StyledText = Sequence[tuple[str, Color]]


def _what_it_does(shown: OverlayData) -> StyledText:
    seen, header = shown.seen, shown.header
    words = [f"{shown.mission}: {seen.phase}" if shown.mission else seen.phase]
    words += [f"{seen.distance_m:.2f} m"] if seen.distance_m is not None else []
    words += [f"{math.degrees(seen.bearing_rad):+.1f} deg"] if seen.bearing_rad is not None else []
    words += [seen.note] if seen.note else []
    return [(f"frame {header.seq}  age {_age_text(shown)}", TEXT_COLOR), (_GAP.join(words), TEXT_COLOR)]


def _age_text(shown: OverlayData) -> str:
    """Return the time from capture to accepted command as the robot measures it, otherwise the local frame age."""
    if shown.header.latency_us is not None:
        return f"{shown.header.latency_us / 1000:.0f} ms"
    return "?" if shown.age_us is None else f">= {shown.age_us / 1000:.0f} ms"


def _where_it_is(target: Detection | None, filtered: Point | None) -> StyledText:
    parts: list[tuple[str, Color]] = []
    if target is not None:
        x, y = raw_px(target)
        parts.append((f"raw {x:.1f}, {y:.1f}", RAW))
    if filtered is not None:
        parts.append((f"filtered {filtered[0]:.1f}, {filtered[1]:.1f}", FILTERED))
    if target is not None:
        parts.append((f"radius {radius_px(target):.1f} px", TARGET))
    return parts or [("nothing found", TEXT_COLOR)]


def _what_it_commands(shown: OverlayData) -> StyledText:
    twist, applied = shown.twist, shown.header.applied
    command = "no command" if twist is None else f"twist {_twist_text((twist.linear_mps, twist.angular_rad_s))}"
    return [(command, TEXT_COLOR), (f"wheels {_twist_text(applied)}", TEXT_COLOR)]


def _twist_text(twist: tuple[float, float]) -> str:
    return f"{twist[0]:+.2f} m/s {twist[1]:+.2f} rad/s"


def _write_strip(canvas: Image, lines: Sequence[StyledText], font: float, *, top: bool) -> None:
    height = round(_LINE_PER_FONT * font)
    band = canvas[: height + 6] if top else canvas[-(height * len(lines) + 6) :]
    band[:] = cv2.convertScaleAbs(band, alpha=_STRIP_SHADE)
    start = 0 if top else canvas.shape[0] - len(band)
    for number, words in enumerate(lines):
        _write_line(canvas, words, start + height * (number + 1) - 2, font)


def _write_line(canvas: Image, words: StyledText, y_px: int, font: float) -> None:
    x_px, end_px = 8, canvas.shape[1] - 8
    for text, color in words:
        plain = _fitting(_plain(text), end_px - x_px, font)
        cv2.putText(canvas, plain, (x_px, y_px), _FONT, font, color, 1, cv2.LINE_AA)
        x_px += _width(plain + _GAP, font)


def _fitting(text: str, room_px: int, font: float) -> str:
    """Cut `text` to the available width."""
    if _width(text, font) <= room_px:
        return text
    letters = bisect_right(range(len(text)), room_px, key=lambda count: _width(text[:count] + "...", font)) - 1
    return text[:letters] + "..." if letters > 0 else ""


def _width(text: str, font: float) -> int:
    size: Any = cv2.getTextSize(text, _FONT, font, 1)[0]
    return int(size[0])


def _plain(text: str) -> str:
    """Replace letters that the font lacks. It has ASCII only."""
    return "".join(letter if " " <= letter <= "~" else "?" for letter in text)


def _outlined(canvas: Image, text: str, at: tuple[int, int], font: float, color: Color) -> None:
    for shade, thickness in (((0, 0, 0), 3), (color, 1)):
        cv2.putText(canvas, text, at, _FONT, font, shade, thickness, cv2.LINE_AA)
