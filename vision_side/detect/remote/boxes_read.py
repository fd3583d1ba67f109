"""Columns of numbers from somebody else -> detections, nothing taken on trust. Pure."""

import re
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sightline.protocol.messages import MAX_DETECTED_BOXES, DetectedBox
from sightline.vision_side.detect.labels import clean_label
from sightline.vision_side.detect.port import Circle, Detection, clipped
from sightline.vision_side.detect.remote.refusing import NoAnswerError, NoAnswerReason

MAX_ROWS: Final = 1024
"""Security limit: a model with a fixed number of rows fills up with scores of 0; more than this is no detector's."""
MIN_SCORE: Final = 0.25
"""As for boxes on the wire: less sure than this is no box, unless configured otherwise."""
_HASH: Final = re.compile("[0-9a-fA-F]{8,64}")
Numbers = NDArray[Any]


def read_columns(
    boxes: Numbers, scores: Numbers, labels: Sequence[str], *, stretch: tuple[float, float], size_px: tuple[int, int],
    min_score: float,
) -> tuple[Detection, ...]:
    """Boxes (K, 4) xyxy, scores (K,) and labels (K) as detections, best first, at most as many as the wire allows.

    `stretch` turns the boxes' pixels into those of the encoded picture. Rows below `min_score` are no boxes and may
    hold anything finite. Raises NoAnswerError for a wrong shape or order, too many rows, and what is not finite.
    """
    _check_shapes(boxes, scores, labels)
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
        raise NoAnswerError(NoAnswerReason.NOT_FINITE, "a box or score is nan or infinite")
    order = [int(row) for row in np.argsort(-scores, kind="stable") if scores[row] >= min_score]
    found = [_detection(boxes[row], float(scores[row]), labels[row], stretch, size_px) for row in order]
    return tuple(one for one in found if one)[:MAX_DETECTED_BOXES]


def _check_shapes(boxes: Numbers, scores: Numbers, labels: Sequence[str]) -> None:
    rows = len(scores) if scores.ndim == 1 else -1
    if boxes.ndim != 2 or boxes.shape[1] != 4 or boxes.shape[0] != rows or len(labels) != rows:
        got = f"boxes {boxes.shape}, scores {scores.shape}, {len(labels)} labels"
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"{got}; expected (K, 4), (K,) and K")
    if rows > MAX_ROWS:
        raise NoAnswerError(NoAnswerReason.TOO_MANY, f"{rows} boxes, at most {MAX_ROWS}")


def _detection(
    box: Numbers, score: float, label: str, stretch: tuple[float, float], size_px: tuple[int, int]
) -> Detection | None:
    """The part in the picture; None if there is none."""
    across, down = stretch
    x1, y1, x2, y2 = (float(value) for value in box)
    if x2 < x1 or y2 < y1 or score > 1:
        corners = f"{x1:g} {y1:g} {x2:g} {y2:g}"
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"a box inside out or a score over 1: {corners}, {score:g}")
    one = Detection(x1 * across, y1 * down, x2 * across, y2 * down, score, clean_label(label))
    return clipped(one, *size_px)


def read_boxes(boxes: Sequence[DetectedBox], size_px: tuple[int, int], min_score: float) -> tuple[Detection, ...]:
    """Boxes of the wire, which checked each by itself, as detections in the picture, best first."""
    found = [clipped(_of_wire(box), *size_px) for box in boxes if box.score >= min_score]
    return tuple(sorted((one for one in found if one), key=lambda one: one.score, reverse=True))


def _of_wire(box: DetectedBox) -> Detection:
    ring = box.circle
    circle = Circle(ring.cx_px, ring.cy_px, ring.radius_px) if ring else None
    label = clean_label(box.label)
    return Detection(box.x1_px, box.y1_px, box.x2_px, box.y2_px, box.score, label, circle, track_id=box.track)


def hash_of(text: str) -> str:
    """A model's hash as results carry it: 16 digits; empty for what is none."""
    return text[:16].lower() if _HASH.fullmatch(text) else ""

