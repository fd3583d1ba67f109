"""A second detector that runs beside the first one, and how often they agree. Shell (a thread).

The clock is the frames' capture time. What counts is what would be steered by: the surest detection of each that the
mission may go by.
"""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Final

from sightline.protocol.clock import monotonic_us
from sightline.protocol.transports.link import Link
from sightline.vision_side.detect.per_robot import MAX_ROBOTS, DecoderPool
from sightline.vision_side.detect.plugin_calls import Notices, attach_detector, close_detector, notices_of, validated
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Detector, corners, overlap

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


# A second detector beside the driving one: it looks at the same frames and never steers, until it is promoted. Shell.
# It has a thread and a decoder of its own and sees the newest frame only, so it delays no answer: only while a
# promotion takes effect may one frame wait for what it is looking at. Where each of the two drives some robots of a
# fleet, neither looks on.


_PATIENCE_US: Final = 1_000_000
"""The shadow's own deadline: it holds nobody up."""
_FRESH_US: Final = 3_000_000
"""Who has not answered for longer is not fit to drive."""
_END_S: Final = 2.0


@dataclass(slots=True)
class _Pair:
    """What is known of one robot."""

    session: str
    goes_by: LabelTest
    """What its mission may go by."""
    agreement: Agreement = field(default_factory=Agreement)
    promoted: bool = False
    answered: bool = False
    """The last frame that the one that looks on was shown."""
    seen_us: int = 0


@dataclass(frozen=True, slots=True)
class _Task:
    """A frame, and what the driving detector answered."""

    frame: DetectFrame
    result: DetectionResult | None
    promoted: bool


class ShadowDetector:
    """A detector that drives, and one that could."""

    def __init__(
        self, driving: Detector, shadow: Detector, name: str, max_pixels: int, goes_by: LabelTest = lambda _label: True
    ) -> None:
        """`goes_by` holds for each robot until `go_by` says what its mission may go by."""
        self._eyes = (driving, shadow)
        self._locks = (threading.Lock(), threading.Lock())  # one caller at a time, also while they change places
        self._answered_us: list[int | None] = [None, None]
        self._name, self._goes_by = name, goes_by
        self._pairs: OrderedDict[str, _Pair] = OrderedDict()
        self._decoders = DecoderPool(max_pixels)
        self._news = Notices()
        self._tasks: OrderedDict[str, _Task] = OrderedDict()
        self._bell = threading.Condition()
        self._ending = False
        self._thread = threading.Thread(target=self._work, name="shadow detector", daemon=True)
        self._thread.start()

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """What the driving detector of each frame's robot sees; the other one gets the frames afterwards."""
        results: list[DetectionResult | None] = [None] * len(frames)
        for promoted in (False, True):
            mine = [index for index, one in enumerate(frames) if self._pair(one).promoted is promoted]
            if mine:
                answers = self._ask(promoted, [frames[index] for index in mine], deadline_us)
                for index, answer in zip(mine, answers, strict=True):
                    results[index] = answer
        if self._both_drive():
            with self._bell:
                self._tasks.clear()
            return results
        for frame, result in zip(frames, results, strict=True):
            self._put(_Task(frame, result, self._pair(frame).promoted))
        return results

    def attach(self, link: Link) -> None:
        """Give both a robot's link."""
        for one in self._eyes:
            attach_detector(one, link)

    def promote(self, robot: str, shadow: bool) -> str:
        """Let the shadow drive, or no longer; returns why it may not, empty if it does from the next frame on."""
        pair = self._pairs.get(robot)
        if pair is None:
            return "no frame of this robot came yet"
        if shadow and not pair.promoted and not self._is_fit(pair):
            return f"{self._name} does not answer, so it cannot drive"
        if pair.promoted is not shadow:
            pair.promoted = shadow
            pair.agreement, pair.answered = Agreement(), False
        return ""

    def go_by(self, robot: str, goes_by: LabelTest) -> None:
        """What the robot's mission may go by: the two are compared by that. Counting begins anew where it changes."""
        pair = self._pairs.get(robot)
        if pair is not None and pair.goes_by != goes_by:
            pair.goes_by, pair.agreement = goes_by, Agreement()

    def shadow_text(self, robot: str) -> str:
        """Who looks on, and how often it sees the same."""
        pair = self._pairs.get(robot)
        agreement = pair.agreement if pair else Agreement()
        share = f"{agreement.share:.0%} agree" if agreement.compared else "no answer yet"
        if self._both_drive():
            share = "looks on at none"
        return f"{'promoted; ' if pair and pair.promoted else ''}shadow {share}"

    def news(self) -> list[str]:
        """Where the two disagree, at most every few seconds, and what both have to say."""
        return [*(line for eye in self._eyes for line in notices_of(eye)), *self._news.take()]

    def close(self) -> None:
        """End the thread, then close both."""
        with self._bell:
            self._ending = True
            self._bell.notify()
        self._thread.join(_END_S)
        with ExitStack() as ending:  # both, also where one fails to
            for eye in self._eyes:
                ending.callback(close_detector, eye)

    def _ask(self, shadow: bool, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        with self._locks[shadow]:
            results = self._eyes[shadow].detect(frames, deadline_us)
        if any(results):
            self._answered_us[shadow] = monotonic_us()
        return results

    def _pair(self, frame: DetectFrame) -> _Pair:
        """A robot that starts anew keeps who drives it; what was counted begins anew."""
        pair = self._pairs.get(frame.robot)
        if pair is None:
            pair = _Pair(frame.header.session, self._goes_by)
        elif pair.session != frame.header.session:
            pair.session, pair.agreement = frame.header.session, Agreement()
        pair.seen_us = monotonic_us()
        self._pairs[frame.robot] = pair
        self._pairs.move_to_end(frame.robot)
        if len(self._pairs) > MAX_ROBOTS:
            self._pairs.popitem(last=False)
        return pair

    def _is_fit(self, pair: _Pair) -> bool:
        """By its last look at this robot, which in a large fleet is a while ago, and that it answers anybody at all."""
        answered_us = self._answered_us[True]
        is_there = answered_us is not None and monotonic_us() - answered_us <= _FRESH_US
        return is_there and (pair.answered or self._both_drive())

    def _both_drive(self) -> bool:
        """Whether one drives some of the robots that were just here, and the other one others."""
        since_us = monotonic_us() - _FRESH_US
        return len({one.promoted for one in self._pairs.values() if one.seen_us >= since_us}) > 1

    def _put(self, task: _Task) -> None:
        """The newest frame of each robot waits; an older one that was not looked at yet is left out."""
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
            except Exception as error:  # a plug-in's own fault, which must not end the shadow for good
                self._news.add(f"{self._name} failed: {type(error).__name__}: {error}"[:160])

    def _compare(self, task: _Task) -> None:
        frame, pair = self._decoders.again(task.frame), self._pairs.get(task.frame.robot)
        if pair is None or pair.promoted is not task.promoted:
            return
        answer = None
        try:
            given = self._ask(not task.promoted, [frame], monotonic_us() + _PATIENCE_US)[0]
            answer = given and validated(frame, given)
        finally:
            if pair.promoted is task.promoted:
                pair.answered = answer is not None
        if answer is None or task.result is None or pair.promoted is not task.promoted:
            return
        line = pair.agreement.add(task.result, answer, pair.goes_by)
        if line:
            self._news.add(f"shadow: {line}")
