"""The look of an object: how often each color occurs in it, without its brightness. Pure."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Detection

Look = NDArray[np.float32]
"""(64,), square roots of the shares of the colors. The product of two looks is their Bhattacharyya coefficient."""

OTHER: Final = 0.4
"""Difference of two looks from which they belong to two objects (docs/explanation/decisions/0013-identity.md)."""
# Number of bins per share (red, green). Finer bins would separate a yellow ball from itself under a lamp.
_BINS = 8
# Used share of the width and height of a box, because its corners show the background of a ball.
_MIDDLE = 0.6
# Largest number of pixels along each side, and least number in all.
_SIDE_PX = 20
_LEAST_PIXELS = 16
# Weight of the newest look, so that the look follows the light.
_NEWEST = 0.3


def look_of(picture: DecodedImage, one: Detection) -> Look | None:
    """Return the look of a detection.

    Args:
        picture: the decoded image.
        one: detection in pixels of the encoded image.

    Returns:
        Its look, or None for fewer than 16 pixels.
    """
    left, right = _middle(one.x1_px, one.x2_px, picture.scale)
    top, bottom = _middle(one.y1_px, one.y2_px, picture.scale)
    part = picture.bgr[top : bottom : 1 + (bottom - top) // _SIDE_PX, left : right : 1 + (right - left) // _SIDE_PX]
    if part.shape[0] * part.shape[1] < _LEAST_PIXELS:
        return None
    pixels = part.astype(np.int32)
    light = np.maximum(pixels.sum(axis=2), 1)
    shares = np.minimum(pixels[..., 1:] * _BINS // light[..., None], _BINS - 1)
    places = shares[..., 0] * _BINS + shares[..., 1]
    # Dark pixels count less: their color is noise.
    counts = np.bincount(places.ravel(), light.ravel(), _BINS * _BINS).reshape(_BINS, _BINS)
    return _normal(np.sqrt(cv2.GaussianBlur(counts, (3, 3), 0)).astype(np.float32).ravel())


def _middle(low_px: float, high_px: float, scale: int) -> tuple[int, int]:
    """Return the middle part of a side of a box, in decoded pixels."""
    center, half = (low_px + high_px) / 2, (high_px - low_px) / 2 * _MIDDLE
    return max(0, round((center - half) / scale)), max(0, round((center + half) / scale))


def _normal(look: Look) -> Look:
    return look / np.float32(np.linalg.norm(look))


def difference(one: Look | None, other: Look | None) -> float:
    """Return the difference, from 0 for equal or unknown looks to 1 for looks without a common color."""
    return 0.0 if one is None or other is None else 1.0 - min(1.0, float(one @ other))


def updated(look: Look | None, newest: Look | None) -> Look | None:
    """Return the look of an object, updated by its newest look."""
    if look is None or newest is None:
        return newest if look is None else look
    return _normal((1 - _NEWEST) * look + _NEWEST * newest)
