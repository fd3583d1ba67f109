"""Where exactly the edge of a coloured blob is: half-way between its own colour and what is around it. Pure.

A colour range says which blob it is; its bounds lie anywhere between the two colours, which would make the same ball
look 7 % smaller in cold light and larger in warm. Brightness is left out, so neither shade nor a dark floor moves it.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_MARGIN_PX = 4
_AROUND = np.ones((3, 5), np.uint8)  # two pixels each way, where every second row is left out
_MIN_CONTRAST = 200.0  # squared steps of colour; below it, noise would draw the edge

Box = Sequence[int]


def sharp_outline(bgr: NDArray[np.uint8], mask: NDArray[Any], box: Box) -> NDArray[Any] | None:
    """The outermost pixels (N, 1, 2) of the blob of `mask` in `box` (x, y, width, height).

    None when the blob's colour differs too little from its surroundings to tell.
    """
    x1, y1 = max(0, box[0] - _MARGIN_PX), max(0, box[1] - _MARGIN_PX)
    rows, columns = slice(y1, box[1] + box[3] + _MARGIN_PX), slice(x1, box[0] + box[2] + _MARGIN_PX)
    blob = _blob(bgr[rows, columns], mask[rows, columns])
    if blob is None:
        return None
    outlines, _ = cv2.findContours(blob, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(x1, y1))
    return max(outlines, key=len) if outlines else None


def _blob(bgr: NDArray[np.uint8], inside: NDArray[Any]) -> NDArray[Any] | None:
    """Not zero where a pixel is more like the colour inside the mask than like the one outside, brightness left out."""
    inside = inside[::2]  # every second row tells a mean as well as every row
    return blob_between(bgr, bgr[::2], inside, cv2.bitwise_not(cv2.dilate(inside, _AROUND)))


def blob_between(
    bgr: NDArray[np.uint8], rows: NDArray[np.uint8], inside: NDArray[Any], outside: NDArray[Any]
) -> NDArray[Any] | None:
    """Not zero where a pixel of `bgr` is more like those of `rows` that are `inside` than like those `outside`.

    None where the two differ too little.
    """
    blue, green, red, _ = cv2.mean(rows, inside)
    other_blue, other_green, other_red, _ = cv2.mean(rows, outside)
    blue, green, red = blue - other_blue, green - other_green, red - other_red
    brighter = (blue + green + red) / 3
    blue, green, red = blue - brighter, green - brighter, red - brighter
    contrast = blue * blue + green * green + red * red
    if contrast < _MIN_CONTRAST:
        return None
    half_way = blue * other_blue + green * other_green + red * other_red + contrast / 2
    return cv2.transform(bgr, np.array(((blue, green, red, -half_way),)))  # what is below zero saturates to zero
