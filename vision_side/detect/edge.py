"""Where exactly the edge of a coloured blob is: half-way between its own colour and what is around it. Pure.

A colour range says which blob it is; its bounds lie anywhere between the two colours, which would make the same ball
look 7 % smaller in cold light and larger in warm. Brightness is left out, so neither shade nor a dark floor moves it.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_MARGIN_PX = 4
_AROUND = np.ones((5, 5), np.uint8)
_MIN_CONTRAST = 200.0  # squared steps of colour; below it, noise would draw the edge

Box = tuple[int, int, int, int]


def sharp_outline(bgr: NDArray[np.uint8], mask: NDArray[np.uint8], box: Box) -> NDArray[Any] | None:
    """The outermost pixels (N, 1, 2) of the blob of `mask` in `box` (x, y, width, height).

    None when the blob's colour differs too little from its surroundings to tell.
    """
    x1, y1 = max(0, box[0] - _MARGIN_PX), max(0, box[1] - _MARGIN_PX)
    rows, columns = slice(y1, box[1] + box[3] + _MARGIN_PX), slice(x1, box[0] + box[2] + _MARGIN_PX)
    likeness = _likeness(bgr[rows, columns], mask[rows, columns])
    if likeness is None:
        return None
    _, blob = cv2.threshold(likeness, 127, 255, cv2.THRESH_BINARY)
    outlines, _ = cv2.findContours(blob, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(x1, y1))
    return max(outlines, key=len) if outlines else None


def _likeness(bgr: NDArray[np.uint8], inside: NDArray[np.uint8]) -> NDArray[Any] | None:
    """0 for the colour outside the mask, 255 for the one inside, linear between."""
    outside = cv2.bitwise_not(cv2.dilate(inside, _AROUND))
    here, there = cv2.mean(bgr, inside)[:3], cv2.mean(bgr, outside)[:3]
    brighter = (sum(here) - sum(there)) / 3
    towards = [one - other - brighter for one, other in zip(here, there, strict=True)]
    contrast = sum(one * one for one in towards)
    if contrast < _MIN_CONTRAST:
        return None
    offset = -sum(one * other for one, other in zip(towards, there, strict=True))
    return cv2.transform(bgr, np.array([[*towards, offset]]) * (255 / contrast))
