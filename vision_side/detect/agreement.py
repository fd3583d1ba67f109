"""Do two detectors see the same? Counted frame by frame, told in one line now and then. Pure.

The clock is the frames' capture time. What counts is what would be steered by: the surest detection of each that the
mission may go by.
"""

from collections import deque
from collections.abc import Callable
from typing import Final

from sightline.vision_side.detect.overlap import corners, overlap
from sightline.vision_side.detect.port import Detection, DetectionResult

WINDOW: Final = 300
"""Frames: ten seconds at 30 a second."""
REPORT_EVERY_US: Final = 5_000_000
"""Between two lines, however much the two disagree."""
LEAST_OVERLAP: Final = 0.3
"""Boxes of one thing by two detectors: one draws the ball, the other its shadow too."""
LabelTest = Callable[[str], bool]
"""Whether a mission may go by what has this label."""


class Agreement:
    """Of one robot's frames, in one session and one mission."""

    def __init__(self) -> None:
        self.compared = self.differed = 0
        self._window: deque[bool] = deque(maxlen=WINDOW)
        self._told_us: int | None = None

    @property
    def share(self) -> float:
        """Of the newest frames, those in which both saw the same; 1 before there are any."""
        return sum(self._window) / len(self._window) if self._window else 1.0

    def add(self, driving: DetectionResult, shadow: DetectionResult, goes_by: LabelTest) -> str:
        """One frame. Returns the line that tells how they differ, where it is time for one."""
        what = disagreement(driving, shadow, goes_by)
        self.compared += 1
        self.differed += bool(what)
        self._window.append(not what)
        if not what or (self._told_us is not None and 0 <= driving.t_us - self._told_us < REPORT_EVERY_US):
            return ""
        self._told_us = driving.t_us
        return (f"{what}; {shadow.detector} agreed with {driving.detector} in {self.share:.0%} of the last "
                f"{len(self._window)} frames")


def disagreement(driving: DetectionResult, shadow: DetectionResult, goes_by: LabelTest) -> str:
    """What the surest detections of two results of one frame disagree on, of those that a mission may go by; empty if
    on nothing. What else they are called does not count."""
    mine, other = _surest(driving, goes_by), _surest(shadow, goes_by)
    if mine is None and other is None:
        return ""
    if mine is None:
        return f"{shadow.detector} sees {_where(other)}, {driving.detector} nothing"
    if other is None:
        return f"{driving.detector} sees {_where(mine)}, {shadow.detector} nothing"
    if overlap(corners(mine), corners(other)) >= LEAST_OVERLAP:
        return ""
    return f"{driving.detector} sees {_where(mine)}, {shadow.detector} {_where(other)}"


def _surest(result: DetectionResult, goes_by: LabelTest) -> Detection | None:
    return next((one for one in result.detections if goes_by(one.label)), None)


def _where(one: Detection | None) -> str:
    if one is None:
        return "nothing"
    return f"{one.label} at ({(one.x1_px + one.x2_px) / 2:.0f}, {(one.y1_px + one.y2_px) / 2:.0f})"
