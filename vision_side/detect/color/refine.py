"""Find the exact edge of a ball inside the box of a model. Pure.

The box of a model is one or two pixels off, which is 5 % of the distance of a ball. The edge in the image is exact.
"""

from dataclasses import replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.color.hsv import (
    Box,
    Fit,
    Outline,
    blob_between,
    disc_detection,
    fit_round_part,
    own_edge,
)
from sightline.vision_side.detect.port import Circle, Detection

_WITHIN: Final = 0.7  # of the box: inside the ball, also if the box is slightly off
_BEYOND: Final = 1.2  # of the box: outside the ball
_MARGIN: Final = 0.35  # of the box, around it: the sample of the background
_MARGIN_PX: Final = 5
_LEAST_RADIUS_PX: Final = 3.0
_ROUGHNESS: Final = 0.09
_LEAST_EDGE: Final = 0.4  # of the outline on the circle; the rest may be hidden
_OFF: Final = 0.4  # radii: a circle further off the box center, or of another size by more, is another object


def refined(picture: DecodedImage, one: Detection) -> Detection:
    """Add the circle and the outline from the image to `one`. Returns `one` unchanged if there is no circle."""
    scale = picture.scale
    box = np.array([one.x1_px, one.y1_px, one.x2_px, one.y2_px]) / scale
    around = _around(box, picture.bgr.shape)
    if around is None:
        return one
    rows, columns = around
    part = picture.bgr[rows, columns]
    found = _disc(part, box - [columns.start, rows.start] * 2, (columns.start, rows.start), picture.bgr.shape)
    if found is None:
        return one
    exact = disc_detection(found, (one.score, one.label), (columns.start, rows.start), scale)
    return replace(exact, track_id=one.track_id) if exact.circle and _fits(exact.circle, one) else one


def _around(box: NDArray[np.float64], shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """Return rows and columns of the box with its margin, or None for a box that is too small."""
    x1, y1, x2, y2 = box.tolist()
    if x2 - x1 < 2 * _LEAST_RADIUS_PX or y2 - y1 < 2 * _LEAST_RADIUS_PX:
        return None
    margin = max(_MARGIN_PX, _MARGIN * max(x2 - x1, y2 - y1))
    rows = slice(max(0, int(y1 - margin)), min(shape[0], int(y2 + margin) + 1))
    columns = slice(max(0, int(x1 - margin)), min(shape[1], int(x2 + margin) + 1))
    return rows, columns


def _disc(
    part: NDArray[np.uint8], box: NDArray[np.float64], origin_px: tuple[int, int], shape: tuple[int, ...]
) -> tuple[Box, Fit, Outline] | None:
    """Return box, circle and edge of the ball, in pixels of `part`."""
    inside = _ellipse(part, box, _WITHIN)
    outside = cv2.bitwise_not(_ellipse(part, box, _BEYOND))
    if not inside.any() or not outside.any():
        return None
    blob = blob_between(part, part, inside, outside)
    if blob is None:
        return None
    outlines, _ = cv2.findContours(blob, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(outlines, key=len, default=None)
    if outline is None:
        return None
    bounds = cv2.boundingRect(outline)
    edge = own_edge(outline, bounds, origin_px, shape)
    fit = fit_round_part(edge, _LEAST_RADIUS_PX, _ROUGHNESS)
    return (bounds, *fit) if fit is not None and len(fit[1]) >= _LEAST_EDGE * len(edge) else None


def _ellipse(part: NDArray[np.uint8], box: NDArray[np.float64], share: float) -> NDArray[Any]:
    """Return 255 in the ellipse that fills `share` of the box, to an eighth of a pixel."""
    x1, y1, x2, y2 = (box * 8).tolist()
    mask = np.zeros(part.shape[:2], np.uint8)
    middle = round((x1 + x2) / 2 - 4), round((y1 + y2) / 2 - 4)
    axes = max(1, round((x2 - x1) / 2 * share)), max(1, round((y2 - y1) / 2 * share))
    cv2.ellipse(mask, middle, axes, 0, 0, 360, 255, -1, cv2.LINE_8, 3)
    return mask


def _fits(circle: Circle, one: Detection) -> bool:
    """Return True if the circle belongs to the object in the model's box."""
    radius = max(one.x2_px - one.x1_px, one.y2_px - one.y1_px) / 2
    x, y = one.center_px
    away_px = max(abs(circle.cx_px - x), abs(circle.cy_px - y), abs(circle.radius_px - radius))
    return away_px <= _OFF * radius
