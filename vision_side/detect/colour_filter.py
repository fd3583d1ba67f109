"""Combinator: of what a detector finds, only what has the colours: the model says ball, the colour says which. Pure."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from sightline.protocol.errors import WireError
from sightline.vision_side.config import HsvRange
from sightline.vision_side.decode import Picture
from sightline.vision_side.detect.around import DetectorWrapper
from sightline.vision_side.detect.color.hsv import color_table
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Detector

LEAST_SHARE: Final = 0.3
"""Of the pixels in the box's middle: shade and shine take some of a ball's colour, another ball has none of it."""
_MIDDLE: Final = 0.6
"""The middle part of a box lies wholly on a ball, whose disc leaves the box's corners out."""


class ColorFilter(DetectorWrapper):
    """A detector that leaves out what another one finds in other colours."""

    def __init__(self, detector: Detector, ranges: tuple[HsvRange, ...]) -> None:
        super().__init__(detector)
        self._table = color_table(ranges)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """What the other finds, less what has another colour; no answer where there is no picture to tell by."""
        results = self.inner.detect(frames, deadline_us)
        return [one and self._kept(frame, one) for frame, one in zip(frames, results, strict=True)]

    def _kept(self, frame: DetectFrame, result: DetectionResult) -> DetectionResult | None:
        try:
            picture = frame.picture()
        except WireError:
            return None
        kept = tuple(one for one in result.detections if self._share(picture, one) >= LEAST_SHARE)
        return result if len(kept) == len(result.detections) else replace(result, detections=kept)

    def _share(self, picture: Picture, one: Detection) -> float:
        """How much of the box's middle has the colour."""
        columns = _middle(one.x1_px, one.x2_px, picture.scale, picture.bgr.shape[1])
        rows = _middle(one.y1_px, one.y2_px, picture.scale, picture.bgr.shape[0])
        part = np.ascontiguousarray(picture.bgr[rows, columns])
        codes = cv2.cvtColor(part, cv2.COLOR_BGR2BGR565).view(np.uint16)[..., 0]
        return float(np.count_nonzero(self._table[codes])) / codes.size


def _middle(low_px: float, high_px: float, scale: int, size: int) -> slice:
    """At least one pixel of the decoded picture."""
    cut = (high_px - low_px) * (1 - _MIDDLE) / 2
    first = min(size - 1, max(0, int((low_px + cut) / scale)))
    return slice(first, max(first + 1, min(size, int((high_px - cut) / scale) + 1)))
