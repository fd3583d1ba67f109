"""A local detector that takes over while the remote one is late. Shell.

While they drive, the remote is asked beside them, and drives again after ten good answers in a row. Each robot for
itself: one whose frames are not answered changes nothing for the others.
"""

from collections import Counter, OrderedDict
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Final, Protocol, runtime_checkable

from sightline.protocol.clock import monotonic_us
from sightline.protocol.transports.link import Link
from sightline.vision_side.detect.per_robot import MAX_ROBOTS
from sightline.vision_side.detect.plugin_calls import Notices, attach_detector, close_detector, notices_of
from sightline.vision_side.detect.port import DetectFrame, DetectionResult, Detector
from sightline.vision_side.detect.remote.deadline import MAX_PIXELS, DeadlineDetector

GOOD_ANSWERS: Final = 10
"""In a row; a third of a second at 30 fps."""
RESERVE_US: Final = 20_000
"""Kept back of a deadline for the own eyes, half of it at most: several times what they need for one picture."""
Results = list[DetectionResult | None]


class PendingAnswer(Protocol):
    """What was asked and may be answered."""

    begun: bool
    """Whether somebody began to look; newer frames may have taken its place before."""

    def take(self, wait: bool) -> Results | None:
        """The results, once; with `wait` by the deadline."""
        ...

    @property
    def over(self) -> bool:
        """Whether the deadline has passed."""
        ...


@runtime_checkable
class Remote(Detector, Protocol):
    """A detector that can be asked without waiting, such as `ByDeadline`."""

    def ask(self, frames: Sequence[DetectFrame], deadline_us: int) -> PendingAnswer:
        """Begin to ask about `frames`."""
        ...


class Fallback:
    """A `Detector` over two."""

    def __init__(
        self, first: Detector, second: Detector, good_answers: int = GOOD_ANSWERS, max_pixels: int = MAX_PIXELS
    ) -> None:
        """A `first` that cannot be asked without waiting is asked on a thread of its own, about up to `max_pixels`."""
        self._first: Remote = first if isinstance(first, Remote) else DeadlineDetector(first, max_pixels)
        self._second = second
        self._news = Notices()
        self._good_answers = good_answers
        self._good: OrderedDict[str, int] = OrderedDict()
        """For each robot that the second drives: good answers of the first in a row."""
        self._beside: list[tuple[list[str], PendingAnswer]] = []
        """Whose frames the first was asked about beside; each robot is in one at most."""
        self.switched = 0

    @property
    def refused(self) -> Counter[str]:
        """What the first one refused, if it counts that."""
        return Counter(getattr(self._first, "refused", {}))

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> Results:
        """As the port says."""
        self._judge()
        firsts = [one for one in frames if one.robot not in self._good]
        others = [one for one in frames if one.robot in self._good]
        first_us = deadline_us - min(RESERVE_US, max(0, deadline_us - monotonic_us()) // 2)
        answers = iter(self._first.detect(firsts, first_us) if firsts else [])
        results = [next(answers, None) if one.robot not in self._good else None for one in frames]
        for frame, result in zip(frames, results, strict=True):
            if result is None and frame.robot not in self._good:
                self._switch(frame.robot)
        self._ask_beside(others, first_us)  # who would be late when it drives is late here, too
        return self._filled(results, frames, deadline_us)

    def attach(self, link: Link) -> None:
        """Give both a robot's link."""
        attach_detector(self._first, link)
        attach_detector(self._second, link)

    def close(self) -> None:
        """Close both, also where one fails to."""
        with ExitStack() as ending:
            ending.callback(close_detector, self._second)
            ending.callback(close_detector, self._first)

    def news(self) -> list[str]:
        """What both have to say, and which of them drives."""
        return [*notices_of(self._first), *self._news.take(), *notices_of(self._second)]

    def _switch(self, robot: str) -> None:
        """From now on the second drives."""
        self._good[robot] = 0
        if len(self._good) > MAX_ROBOTS:  # who was switched first begins anew with the first one
            self._good.popitem(last=False)
        self.switched += 1
        self._news.add(f"the first detector is late or silent for {robot}: own eyes drive on")

    def _filled(self, results: Results, frames: Sequence[DetectFrame], deadline_us: int) -> Results:
        """The second one's results where the first had none."""
        missing = [frame for frame, result in zip(frames, results, strict=True) if result is None]
        more = iter(self._second.detect(missing, deadline_us) if missing else [])
        return [next(more) if result is None else result for result in results]

    def _ask_beside(self, frames: Sequence[DetectFrame], deadline_us: int) -> None:
        """Ask the first about frames that the second answers, of robots of which nothing is under way."""
        under_way = {robot for robots, _ in self._beside for robot in robots}
        new = [one for one in frames if one.robot not in under_way]
        if new:
            self._beside.append(([one.robot for one in new], self._first.ask(new, deadline_us)))

    def _judge(self) -> None:
        """Count the answers that were asked for beside, where they came, or that they did not."""
        waiting = []
        for robots, asked in self._beside:
            results = asked.take(wait=False)
            if results is None and not asked.over:
                waiting.append((robots, asked))
            elif results is not None or asked.begun:  # what nobody looked at says nothing of the first
                self._count(robots, results or [])
        self._beside = waiting

    def _count(self, robots: Sequence[str], results: Results) -> None:
        good = dict.fromkeys(robots, len(results) == len(robots))
        for robot, result in zip(robots, results, strict=False):
            good[robot] = good[robot] and result is not None
        for robot in good.keys() & self._good.keys():
            self._good[robot] = self._good[robot] + 1 if good[robot] else 0
            if self._good[robot] >= self._good_answers:
                del self._good[robot]
                self._news.add(f"the first detector gave {self._good_answers} good answers for {robot}: it drives "
                               "again")
