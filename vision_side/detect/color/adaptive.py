"""What colour a thing has just now, as a cloud in the plane of chromaticity, and which pixels share it. Pure.

Chromaticity is red and green as shares of the whole, so that neither shade nor exposure moves it; warm or cold light
does, slowly, and the cloud goes along.
"""

import math
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.vision_side.detect.color.hsv import codes_565, colors_565

Shares = NDArray[np.float32]
"""(..., 2): red and green shares."""

_LEAST_SIGMA: Final = 0.012  # JPEG at quality 30 spreads one colour by as much
_MOST_SIGMA: Final = 0.05  # a cloud wider than this holds half of all colours
_DARKEST: Final = 36.0  # of 765, below which shares are noise
_MAX_STEP: Final = 0.01  # of the middle in one picture: light changes slowly, another thing's colour at once
_MOVED: Final = 0.25  # of a sigma: as long as the cloud moved no further, its table of colours is as good as new
_KERNEL: Final = np.ones((3, 3), np.uint8)


class ColorModel:
    """The colour of one thing."""

    def __init__(self, bgr: NDArray[np.uint8]) -> None:
        """`bgr` (N, 3) are pixels of it."""
        self._middle, self._spread = _cloud(_shares(bgr)[0])
        self._table: NDArray[np.uint8] | None = None
        self._table_middle = self._middle

    def distance(self, bgr: NDArray[np.uint8]) -> float:
        """How far the middle colour of the pixels `bgr` (N, 3) is from this one, in sigmas."""
        middle, _ = _cloud(_shares(bgr)[0])
        return math.sqrt(float(self._square(middle[None])[0]))

    def learn(self, bgr: NDArray[np.uint8], part: float) -> None:
        """Go along with pixels of the thing by `part` (0..1) of the way, no step larger than light makes."""
        middle, spread = _cloud(_shares(bgr)[0])
        step = (middle - self._middle) * part
        length = float(np.hypot(*step))
        self._middle = self._middle + step * min(1.0, _MAX_STEP / length if length else 1.0)
        self._spread = self._spread + (spread - self._spread) * part

    def mask(self, bgr: NDArray[np.uint8], sigmas: float) -> NDArray[Any]:
        """255 where a pixel of `bgr` (rows, columns, 3) has the colour, speckle removed."""
        if self._table is None or math.sqrt(float(self._square(self._table_middle[None])[0])) > _MOVED:
            shares, bright = _code_shares()
            inside = (self._square(shares) <= sigmas * sigmas) & bright
            self._table, self._table_middle = inside.astype(np.uint8) * np.uint8(255), self._middle
        return cv2.morphologyEx(cv2.LUT(codes_565(bgr), self._table), cv2.MORPH_OPEN, _KERNEL)

    def _square(self, shares: NDArray[Any]) -> NDArray[Any]:
        """Squared distance of each from the middle, in sigmas."""
        (a, b), (_, d) = self._spread.tolist()
        determinant = a * d - b * b
        red, green = shares[..., 0] - float(self._middle[0]), shares[..., 1] - float(self._middle[1])
        square: NDArray[Any] = (d * red * red - 2 * b * red * green + a * green * green) / determinant
        return square


def _shares(bgr: NDArray[Any]) -> tuple[Shares, NDArray[np.bool_]]:
    """Red's and green's share of each pixel, and whether it is bright enough to tell."""
    colours = bgr.astype(np.float32)
    whole = colours[..., 0] + colours[..., 1] + colours[..., 2]
    shares: Shares = colours[..., 2:0:-1] / np.maximum(whole, 1.0)[..., None]
    return shares, whole >= _DARKEST


@lru_cache(maxsize=1)
def _code_shares() -> tuple[Shares, NDArray[np.bool_]]:
    """Those of every BGR565 code."""
    return _shares(colors_565())


def _cloud(shares: Shares) -> tuple[NDArray[Any], NDArray[Any]]:
    """Middle and covariance, no narrower than noise and no wider than a colour is."""
    middle = np.median(shares, axis=0)
    off = shares - middle
    off = off[np.abs(off).max(axis=-1) <= 3 * _MOST_SIGMA]  # shine and what is in front
    (a, b), (_, d) = (off.T @ off / max(1, len(off))).tolist() if len(off) else ((0.0, 0.0), (0.0, 0.0))
    low, high = _LEAST_SIGMA**2, _MOST_SIGMA**2
    a, d = min(high, max(low, a)), min(high, max(low, d))
    limit = 0.8 * math.sqrt(a * d)
    b = min(limit, max(-limit, b))
    return middle, np.array(((a, b), (b, d)))
