"""Detector wrappers: filter by label, filter by color, add track ids. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from sightline.protocol.errors import WireError
from sightline.vision_side.config import HsvRange
from sightline.vision_side.detect.color.hsv import ColorMask
from sightline.vision_side.detect.per_robot import PerSession
from sightline.vision_side.detect.plugin_calls import DetectorWrapper
from sightline.vision_side.detect.port import (
    COLOR_LABEL,
    DetectFrame,
    Detection,
    DetectionResult,
    Detector,
    corners,
    overlap,
)


class LabelFilter(DetectorWrapper):
    """A detector that removes the detections of another detector with other labels."""

    def __init__(self, detector: Detector, labels: tuple[str, ...]) -> None:
        super().__init__(detector)
        self._labels = frozenset((*labels, COLOR_LABEL))

    @property
    def labels(self) -> Sequence[str]:
        """Return the labels of the inner detector that pass."""
        return [one for one in super().labels if one in self._labels]

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Return the detections of the inner detector with the configured labels."""
        return [one and self._kept(one) for one in self.inner.detect(frames, deadline_us)]

    def _kept(self, result: DetectionResult) -> DetectionResult:
        kept = tuple(one for one in result.detections if one.label in self._labels)
        return result if len(kept) == len(result.detections) else replace(result, detections=kept)


# Combinator: keep only detections with the configured colors. The model finds balls, the color selects one. Pure.


class ColorFilter(DetectorWrapper):
    """A detector that removes the detections of another detector in other colors."""

    def __init__(self, detector: Detector, ranges: tuple[HsvRange, ...]) -> None:
        super().__init__(detector)
        self._mask = ColorMask(ranges)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Return the inner detector's detections that have the colors. Without pixels there is no answer."""
        results = self.inner.detect(frames, deadline_us)
        return [one and self._kept(frame, one) for frame, one in zip(frames, results, strict=True)]

    def _kept(self, frame: DetectFrame, result: DetectionResult) -> DetectionResult | None:
        try:
            picture = frame.picture()
        except WireError:
            return None
        kept = tuple(one for one in result.detections if self._mask.has_color(picture, one))
        return result if len(kept) == len(result.detections) else replace(result, detections=kept)


# Combinator: give an object the same `track_id` in successive frames, by the overlap of its boxes. Pure.
#
# The clock is the frames' capture time. An id is not reused in a session. After more than a second without a detection
# an object gets a new id: two ids for one object are better than one id for two objects.


KEPT_US: Final = 1_000_000
LEAST_OVERLAP: Final = 0.2
"""Intersection over union; an object that moves by half its width between two frames still has 0.33."""
MAX_TRACKS: Final = 64
"""Tracks of one robot. Every pair is compared. The best detections of a frame, up to this number, get ids."""


@dataclass(slots=True)
class _Track:
    number: int
    box: Detection
    t_us: int


class TrackIds(DetectorWrapper):
    """A detector whose detections carry track ids."""

    def __init__(self, detector: Detector) -> None:
        super().__init__(detector)
        self._memories = PerSession(_Memory)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Return the detections of the inner detector with track ids."""
        return [one and self._named(one) for one in self.inner.detect(frames, deadline_us)]

    def _named(self, result: DetectionResult) -> DetectionResult:
        memory = self._memories.of(result.robot, result.session)
        return replace(result, detections=memory.named(result.detections, result.t_us))


class _Memory:
    """The tracks of one robot's session."""

    def __init__(self) -> None:
        self._tracks: list[_Track] = []
        self._given = 0

    def named(self, found: Sequence[Detection], t_us: int) -> tuple[Detection, ...]:
        """Assign ids, the best pair first."""
        found, rest = found[:MAX_TRACKS], found[MAX_TRACKS:]
        self._tracks = [one for one in self._tracks if t_us - one.t_us <= KEPT_US]
        pairs = sorted(
            ((share, index, track.number) for index, one in enumerate(found) for track in self._tracks
             if (share := overlap(corners(one), corners(track.box))) >= LEAST_OVERLAP and one.label == track.box.label),
            key=lambda pair: -pair[0],
        )
        numbers: dict[int, int] = {}
        for _, index, number in pairs:
            if index not in numbers and number not in numbers.values():
                numbers[index] = number
        return (*(self._keep(one, numbers.get(index), t_us) for index, one in enumerate(found)), *rest)

    def _keep(self, one: Detection, number: int | None, t_us: int) -> Detection:
        if number is None:
            self._given += 1
            number = self._given
        self._tracks = [track for track in self._tracks if track.number != number][-(MAX_TRACKS - 1) :]
        self._tracks.append(_Track(number, one, t_us))
        return replace(one, track_id=number)
