"""Combinator: gives what is found in one frame after the other the same `track_id`, by how much boxes overlap. Pure.

The clock is the frames' capture time. An id is never given twice in a session, and what was away for longer than a
second comes back as another one: better two ids for one thing than one id for two.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from sightline.vision_side.detect.around import DetectorWrapper
from sightline.vision_side.detect.per_robot import PerSession
from sightline.vision_side.detect.overlap import corners, overlap
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Detector

KEPT_US: Final = 1_000_000
LEAST_OVERLAP: Final = 0.2
"""Intersection over union; a thing that moves by half its width from frame to frame still has 0.33."""
MAX_TRACKS: Final = 64
"""Of one robot; every pair is compared. The best so many detections of a frame get ids, the rest none."""


@dataclass(slots=True)
class _Track:
    number: int
    box: Detection
    t_us: int


class TrackIds(DetectorWrapper):
    """A detector whose detections carry ids."""

    def __init__(self, detector: Detector) -> None:
        super().__init__(detector)
        self._memories = PerSession(_Memory)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """What the other finds, with ids."""
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
        """The best pair first, whichever it is."""
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
