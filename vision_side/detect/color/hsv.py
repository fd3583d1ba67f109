"""Which pixels have the target's colour: one table look-up per pixel, then an opening. Pure.

The table is over BGR565, so any number of ranges, and a hue range through red, cost the same.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.vision_side.config import HsvRange

COARSE = 4
"""Where to look is decided on every fourth pixel of every fourth row, which no disc worth measuring slips between."""
MARGIN_PX = 10
"""Around that: the smallest disc reaches 6 pixels from its only one that was looked at; the rest is background."""
_KERNEL = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class Region:
    """The part of a picture that holds everything of the colour, a margin around it, and where it lies."""

    bgr: NDArray[np.uint8]
    mask: NDArray[Any]
    origin_px: tuple[int, int]


class ColorMask:
    """Marks the configured colours."""

    def __init__(self, ranges: tuple[HsvRange, ...]) -> None:
        self._table = color_table(ranges)

    def region(self, bgr: NDArray[np.uint8]) -> Region | None:
        """Where the colour is, speckle removed; None if nowhere."""
        coarse = codes_565(bgr[COARSE // 2 :: COARSE])[:, COARSE // 2 :: COARSE].copy()
        x, y, width, height = cv2.boundingRect(cv2.LUT(coarse, self._table))
        if not width:
            return None
        x1, y1 = max(0, x * COARSE - MARGIN_PX), max(0, y * COARSE - MARGIN_PX)
        part = bgr[y1 : (y + height) * COARSE + MARGIN_PX, x1 : (x + width) * COARSE + MARGIN_PX]
        # Speckle would cost findContours a hundredfold; a 3x3 opening removes it and keeps discs.
        mask = cv2.morphologyEx(cv2.LUT(codes_565(part), self._table), cv2.MORPH_OPEN, _KERNEL)
        return Region(part, mask, (x1, y1))


def codes_565(bgr: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """BGR565 of each pixel."""
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2BGR565).view(np.uint16)[..., 0]


def colors_565() -> NDArray[np.float64]:
    """The colour (65536, 3) in the middle of each BGR565 code: blue, green, red, 0..255."""
    codes = np.arange(65536, dtype=np.uint32)
    blue, green, red = (codes & 31) * 8 + 3.5, (codes >> 5 & 63) * 4 + 1.5, (codes >> 11) * 8 + 3.5
    return np.stack([blue, green, red], axis=-1)


def color_table(ranges: tuple[HsvRange, ...]) -> NDArray[np.uint8]:
    """255 for every BGR565 code whose colour is within one of `ranges`, 0 elsewhere; 65536 entries."""
    bgr = (colors_565() / 255).astype(np.float32)[None]
    hue, saturation, value = cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV)[0].T
    inside = np.zeros(65536, bool)
    for one in ranges:
        above, below = hue >= one.hue_low_deg, hue <= one.hue_high_deg
        turn = above & below if one.hue_low_deg <= one.hue_high_deg else above | below
        inside |= (turn & (saturation >= one.saturation_low) & (saturation <= one.saturation_high)
                   & (value >= one.value_low) & (value <= one.value_high))
    return np.where(inside, 255, 0).astype(np.uint8)
