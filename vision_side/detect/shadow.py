"""A second detector next to the first one, and how often they agree. Shell (a thread).

The clock is the capture time of the frames. Only the best detection of each detector that the mission may use is
compared.
"""

import threading
from collections import OrderedDict, deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final

from sightline.protocol.clock import monotonic_us
from sightline.protocol.config import PLUGIN_ERRORS
from sightline.protocol.log import report_fault
from sightline.protocol.transports.link import Link
from sightline.vision_side.detect.per_robot import MAX_ROBOTS, DecoderPool, PerSession
from sightline.vision_side.detect.plugin_calls import Notices, attach_detector, close_detector, notices_of, validated
from sightline.vision_side.detect.port import (
    DetectFrame,
    Detection,
    DetectionResult,
    Detector,
    LabelTest,
    corners,
    overlap,
)

WINDOW: Final = 300
"""Frames: ten seconds at 30 fps."""
REPORT_EVERY_US: Final = 5_000_000
"""Shortest time between two lines about a difference."""
LEAST_OVERLAP: Final = 0.3
"""Least overlap of two boxes of one object: one detector may include the shadow of a ball."""


class Agreement:
    """Agreement of the two detectors on one robot's frames, in one session and one mission."""

    def __init__(self) -> None:
        self.compared = self.differed = 0
        self._window: deque[bool] = deque(maxlen=WINDOW)
        self._reported_us: int | None = None

    @property
    def share(self) -> float:
        """Return the share of the newest frames with the same result, 1 without frames."""
        return sum(self._window) / len(self._window) if self._window else 1.0

    def add(self, driving: DetectionResult, shadow: DetectionResult, goes_by: LabelTest) -> str:
        """Compare the results of one frame. Returns a line about the difference, if one is due."""
        what = disagreement(driving, shadow, goes_by)
        self.compared += 1
        self.differed += bool(what)
        self._window.append(not what)
        if not what or (self._reported_us is not None and 0 <= driving.t_us - self._reported_us < REPORT_EVERY_US):
            return ""
        self._reported_us = driving.t_us
        return (f"{what}; {shadow.detector} agreed with {driving.detector} in {self.share:.0%} of the last "
                f"{len(self._window)} frames")


def disagreement(driving: DetectionResult, shadow: DetectionResult, goes_by: LabelTest) -> str:
    """Describe the difference between the best detections of two results, or return "". Only detections that the
    mission may use count. Places are compared, labels are not."""
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
    x, y = one.center_px
    return f"{one.label} at ({x:.0f}, {y:.0f})"


# A second detector that gets the same frames and never steers. Shell. It has a separate thread and decoder and takes
# only the newest frame, so it delays no answer. The configuration selects the driving detector.


_PATIENCE_US: Final = 1_000_000
"""Deadline of the shadow detector. It delays no other thread."""
_END_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class _Task:
    """A frame, the result of the driving detector, and the counter of the comparison."""

    frame: DetectFrame
    result: DetectionResult | None
    agreement: Agreement


class ShadowDetector:
    """A driving detector, and a shadow detector that is compared with it."""

    def __init__(self, driving: Detector, shadow: Detector, name: str, max_pixels: int) -> None:
        self._driving, self._shadow, self._name = driving, shadow, name
        self._agreements = PerSession(Agreement)
        self._decoders = DecoderPool(max_pixels)
        self._notices = Notices()
        self._tasks: OrderedDict[str, _Task] = OrderedDict()
        self._bell = threading.Condition()
        self._ending = False
        self._thread = threading.Thread(target=self._work, name="shadow detector", daemon=True)
        self._thread.start()

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Return the results of the driving detector. The shadow detector receives the frames afterwards."""
        results = self._driving.detect(frames, deadline_us)
        for frame, result in zip(frames, results, strict=True):
            counted = (frame.header.session, frame.goes_by)  # a change of either resets the counter
            self._put(_Task(frame, result, self._agreements.of(frame.robot, counted)))
        return results

    def attach(self, link: Link) -> None:
        """Pass a robot's link to both."""
        attach_detector(self._driving, link)
        attach_detector(self._shadow, link)

    def shadow_text(self, robot: str) -> str:
        """Describe the share of the robot's frames on which both detectors agree."""
        agreement = self._agreements.find(robot)
        return f"shadow {agreement.share:.0%} agree" if agreement and agreement.compared else "shadow no answer yet"

    def notices(self) -> list[str]:
        """Return the notices of both detectors, and their differences at most every few seconds."""
        return [*notices_of(self._driving), *notices_of(self._shadow), *self._notices.take()]

    def close(self) -> None:
        """End the thread, then close both detectors."""
        with self._bell:
            self._ending = True
            self._bell.notify()
        self._thread.join(_END_S)
        with ExitStack() as ending:  # closes both, even if one of them fails
            ending.callback(close_detector, self._driving)
            ending.callback(close_detector, self._shadow)

    def _put(self, task: _Task) -> None:
        """Store the newest frame of each robot. It replaces an older frame that still waits."""
        with self._bell:
            self._tasks[task.frame.robot] = task
            if len(self._tasks) > MAX_ROBOTS:
                self._tasks.popitem(last=False)
            self._bell.notify()

    def _work(self) -> None:
        while True:
            with self._bell:
                self._bell.wait_for(lambda: self._tasks or self._ending)
                if self._ending:
                    return
                _, task = self._tasks.popitem(last=False)
            try:
                self._compare(task)
            except PLUGIN_ERRORS as error:  # an error of a plug-in must not end the thread
                text = report_fault("detector", error, self._name)
                self._notices.add(f"{self._name} failed: {type(error).__name__}: {text}"[:160])

    def _compare(self, task: _Task) -> None:
        frame = self._decoders.again(task.frame)
        answer = self._shadow.detect([frame], monotonic_us() + _PATIENCE_US)[0]
        if answer is None or task.result is None:
            return
        line = task.agreement.add(task.result, validated(frame, answer), task.frame.goes_by)
        if line:
            self._notices.add(f"shadow: {line}")
