"""Detector of round things of one colour: colour mask, outlines, sharp edge, circle fit. Pure."""

from heapq import nlargest
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision_side.config import HsvConfig
from vision_side.decode import Picture
from vision_side.detect.colour import ColourMask, Region
from vision_side.detect.disc import MIN_POINTS, Outline, grown, round_part
from vision_side.detect.edge import sharp_outline
from vision_side.detect.port import Circle, Detection

Pixels = NDArray[Any]
"""Outline as OpenCV gives it: (N, 1, 2), integers."""

_EDGE_PX = 0.45  # the true edge lies this far outside the centre of an outermost pixel, on average over directions


class HsvDetector:
    """Finds discs of the configured colours."""

    def __init__(self, config: HsvConfig, label: str = "target") -> None:
        self._config = config
        self._label = label
        self._mask = ColourMask(config.ranges)

    def detect(self, picture: Picture) -> tuple[Detection, ...]:
        """Discs of the colour, largest first."""
        region = self._mask.region(picture.bgr)
        if region is None:
            return ()
        outlines, _ = cv2.findContours(region.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        longest = nlargest(self._config.max_contours, outlines, key=len)
        found = [self._disc(picture, region, outline) for outline in longest]
        return tuple(sorted((disc for disc in found if disc), key=_radius, reverse=True))

    def _disc(self, picture: Picture, region: Region, outline: Pixels) -> Detection | None:
        """The disc that `outline` encloses, or None if it is too small or not round."""
        x, y, width, height = cv2.boundingRect(outline)
        if max(width, height) < 2 * self._config.min_radius_px:
            return None
        sharp = sharp_outline(region.bgr, region.mask, (x, y, width, height))
        pixels = (outline if sharp is None else sharp) + region.origin_px
        edge = _own_edge(pixels, picture.bgr.shape)
        if len(edge) < MIN_POINTS:
            return None
        fit = round_part(edge, self._config.min_radius_px, self._config.max_roughness)
        if fit is None or len(fit[1]) < self._config.min_outline_kept * len(edge):
            return None
        return self._detection(pixels, *fit, picture.scale)

    def _detection(self, pixels: Pixels, circle: tuple[float, float, float], edge: Outline, scale: int) -> Detection:
        """In pixels of the encoded picture."""
        x, y, width, height = cv2.boundingRect(pixels)
        disc = Circle(circle[0] * scale, circle[1] * scale, (circle[2] + _EDGE_PX) * scale)
        return Detection(x * scale, y * scale, (x + width) * scale, (y + height) * scale, len(edge) / len(pixels),
                         self._label, disc, grown(edge, circle, _EDGE_PX) * scale)


def _own_edge(pixels: Pixels, shape: tuple[int, ...]) -> Outline:
    """Centres of the outline's pixels, less those that the picture's border made."""
    flat, (rows, columns) = pixels[:, 0], shape[:2]
    x, y, width, height = cv2.boundingRect(pixels)
    if x <= 0 or y <= 0 or x + width >= columns or y + height >= rows:
        xs, ys = flat.T
        flat = flat[(xs > 0) & (ys > 0) & (xs < columns - 1) & (ys < rows - 1)]
    centres: NDArray[np.float64] = flat + 0.5
    return centres


def _radius(detection: Detection) -> float:
    return detection.circle.radius_px if detection.circle else 0.0
