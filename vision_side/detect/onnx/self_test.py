"""An image with a known answer, to check a model on this device. Pure.

The image is drawn with integers only, so it is the same everywhere. The metadata of a model may contain its answer, as
`golden`. Without it, the answer is compared with that of the same model on the CPU.
"""

import json
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sightline.vision_side.detect.port import Detection, corners, overlap

KEY: Final = "golden"
SIZE_PX: Final = (320, 240)
LEAST_OVERLAP: Final = 0.8
MOST_SCORE_APART: Final = 0.1
"""Devices round differently; float16, e.g. of TensorRT, differs in the third digit."""
_DISCS: Final = ((70, 80, 22, (13, 199, 242)), (180, 120, 40, (30, 180, 220)), (270, 60, 12, (200, 80, 30)))
_MAX_TEXT: Final = 20_000


def golden_picture() -> NDArray[np.uint8]:
    """Draw disks on a checkered floor under a gradient of light, BGR."""
    width, height = SIZE_PX
    down, right = np.mgrid[0:height, 0:width]
    gray = 90 + (down * 60) // height + ((right // 20 + down // 20) % 2) * 18
    picture = np.repeat(gray[..., None], 3, axis=-1)
    for x, y, radius, color in _DISCS:
        square = (right - x) ** 2 + (down - y) ** 2
        inside = square <= radius * radius
        shade = 255 - (square * 90) // (radius * radius)
        for channel, value in enumerate(color):
            picture[..., channel] = np.where(inside, value * shade // 255, picture[..., channel])
    return picture.astype(np.uint8)


def golden_text(found: Sequence[Detection]) -> str:
    """Format the detections for the metadata."""
    return json.dumps([[round(one.x1_px, 2), round(one.y1_px, 2), round(one.x2_px, 2), round(one.y2_px, 2),
                        round(one.score, 4), one.label] for one in found])


def read_golden(text: str) -> list[Detection]:
    """Parse the text of `golden_text`. Raises ValueError for other texts."""
    try:
        rows = json.loads(text[:_MAX_TEXT])
        return [Detection(float(x1), float(y1), float(x2), float(y2), float(score), str(label))
                for x1, y1, x2, y2, score, label in rows]
    except (TypeError, ValueError, RecursionError):
        raise ValueError("its metadata has no golden output that can be read") from None


def difference(expected: Sequence[Detection], found: Sequence[Detection], min_score: float) -> str:
    """Return why `found` differs from `expected`, or "". Detections near `min_score` may come and go."""
    surely = min_score + MOST_SCORE_APART
    for one in expected:
        if one.score >= surely and not any(_is_same(one, other) for other in found):
            return f"{one.label} at ({one.x1_px:.0f}, {one.y1_px:.0f}), score {one.score:.2f}, is missing"
    for one in found:
        if one.score >= surely and not any(_is_same(one, other) for other in expected):
            return f"{one.label} at ({one.x1_px:.0f}, {one.y1_px:.0f}), score {one.score:.2f}, should not be there"
    return ""


def _is_same(one: Detection, other: Detection) -> bool:
    return (one.label == other.label and overlap(corners(one), corners(other)) >= LEAST_OVERLAP
            and abs(one.score - other.score) <= MOST_SCORE_APART)
