"""Detector of things of one colour, round ones unless told otherwise: mask, outlines, sharp edge, circle fit. Pure."""

from typing import Any

import cv2
from numpy.typing import NDArray

from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import Picture
from sightline.vision_side.detect.color.hsv import ColorMask, Region
from sightline.vision_side.detect.disc import Fit, Outline, fit_round_part
from sightline.vision_side.detect.edge import Box, sharp_outline
from sightline.vision_side.detect.port import Circle, Detection

Pixels = NDArray[Any]
"""Outline as OpenCV gives it: (N, 1, 2), integers."""

_EDGE_PX = 0.45  # the true edge lies this far outside the centre of an outermost pixel, on average over directions


class HsvDetector:
    """Finds discs of the configured colours, or anything that has them."""

    def __init__(self, config: HsvConfig, label: str = "target") -> None:
        self._config = config
        self._label = label
        self._mask = ColorMask(config.ranges)

    def detect(self, picture: Picture) -> tuple[Detection, ...]:
        """What has the colour, and the shape if one is asked for, largest first."""
        region = self._mask.region(picture.bgr)
        return () if region is None else self.measure(picture, region)

    def measure(self, picture: Picture, region: Region) -> tuple[Detection, ...]:
        """What is in `region` of `picture`, whoever marked it, and has the shape; largest first."""
        outlines, _ = cv2.findContours(region.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        longest = sorted(outlines, key=len, reverse=True)[: self._config.max_contours]
        look = self._disc if self._config.shape == "disc" else self._thing
        found = [look(picture, region, outline) for outline in longest]
        return tuple(sorted((one for one in found if one), key=_radius, reverse=True))

    def _thing(self, picture: Picture, region: Region, outline: Pixels) -> Detection | None:
        """The box around whatever it is; None if it is too small."""
        box = cv2.boundingRect(outline)
        if min(box[2], box[3]) < 2 * self._config.min_radius_px:
            return None
        sharp = sharp_outline(region.bgr, region.mask, box)
        x, y, width, height = box if sharp is None else cv2.boundingRect(sharp)
        left, top, scale = region.origin_px[0] + x, region.origin_px[1] + y, picture.scale
        right, bottom = left + width, top + height
        return Detection(left * scale, top * scale, right * scale, bottom * scale, 1.0, self._label)

    def _disc(self, picture: Picture, region: Region, outline: Pixels) -> Detection | None:
        """The disc that `outline` encloses, or None if it is too small or not round."""
        box = cv2.boundingRect(outline)
        if max(box[2], box[3]) < 2 * self._config.min_radius_px:
            return None
        sharp = sharp_outline(region.bgr, region.mask, box)
        if sharp is not None:
            outline, box = sharp, cv2.boundingRect(sharp)
        edge = own_edge(outline, box, region.origin_px, picture.bgr.shape)
        fit = fit_round_part(edge, self._config.min_radius_px, self._config.max_roughness)
        if fit is None or len(fit[1]) < self._config.min_outline_kept * len(edge):
            return None
        whose = (len(fit[1]) / len(outline), self._label)
        return disc_detection((box, *fit), whose, region.origin_px, picture.scale)


def disc_detection(shape: tuple[Box, Fit, Outline], whose: tuple[float, str], origin_px: tuple[int, int],
                   scale: int) -> Detection:
    """In pixels of the encoded picture. The shape's circle and edge go by the centres of the region's pixels."""
    box, circle, edge = shape
    x, y = origin_px[0] + box[0], origin_px[1] + box[1]
    cx, cy = origin_px[0] + 0.5 + circle[0], origin_px[1] + 0.5 + circle[1]
    radius = circle[2] + _EDGE_PX
    outwards = radius / circle[2]
    ring = edge.T * (outwards * scale)
    ring[0] += (cx - outwards * circle[0]) * scale
    ring[1] += (cy - outwards * circle[1]) * scale
    return Detection(x * scale, y * scale, (x + box[2]) * scale, (y + box[3]) * scale, *whose,
                     Circle(cx * scale, cy * scale, radius * scale), ring.T)


def own_edge(pixels: Pixels, box: Box, origin_px: tuple[int, int], shape: tuple[int, ...]) -> Pixels:
    """The outline's pixels (N, 2), less those that the picture's border made."""
    flat = pixels[:, 0]
    left, top = -origin_px[0], -origin_px[1]  # where the picture begins, in the region's pixels
    right, bottom = left + shape[1] - 1, top + shape[0] - 1
    x, y, width, height = box
    if x <= left or y <= top or x + width > right or y + height > bottom:
        xs, ys = flat.T
        flat = flat[(xs > left) & (ys > top) & (xs < right) & (ys < bottom)]
    return flat


def _radius(detection: Detection) -> float:
    """Of its circle; of what has none, half its height."""
    return detection.circle.radius_px if detection.circle else (detection.y2_px - detection.y1_px) / 2
