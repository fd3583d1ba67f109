"""Combinator: only detections with certain labels count. Pure."""

from collections.abc import Sequence
from dataclasses import replace

from sightline.vision_side.detect.around import DetectorWrapper
from sightline.vision_side.detect.labels import COLOR_LABEL
from sightline.vision_side.detect.port import DetectFrame, DetectionResult, Detector


class LabelFilter(DetectorWrapper):
    """A detector that leaves out what another one finds under other labels."""

    def __init__(self, detector: Detector, labels: tuple[str, ...]) -> None:
        super().__init__(detector)
        self._labels = frozenset((*labels, COLOR_LABEL))

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """What the other finds, less what is not meant."""
        return [one and self._kept(one) for one in self.inner.detect(frames, deadline_us)]

    def _kept(self, result: DetectionResult) -> DetectionResult:
        kept = tuple(one for one in result.detections if one.label in self._labels)
        return result if len(kept) == len(result.detections) else replace(result, detections=kept)
