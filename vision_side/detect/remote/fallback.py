"""A local detector that steers while the remote detector is late. Shell.

While the local detector steers, the remote one still gets requests. After ten good answers in a row, the remote one
steers again. This holds for each robot separately: a robot without answers changes nothing for the others.
"""

from collections import OrderedDict
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Final

from sightline.protocol.clock import monotonic_us
from sightline.protocol.log import RepeatLimiter
from sightline.protocol.transports.link import Link
from sightline.vision_side.detect.per_robot import MAX_ROBOTS
from sightline.vision_side.detect.plugin_calls import Notices, attach_detector, close_detector, notices_of
from sightline.vision_side.detect.port import DetectFrame, Detector
from sightline.vision_side.detect.remote.deadline import MAX_PIXELS, DeadlineDetector, Pending, Results

GOOD_ANSWERS: Final = 10
"""Good answers in a row; a third of a second at 30 fps."""
RESERVE_US: Final = 20_000
"""Part of a deadline for the local detector, at most half: several times its computing time for one image."""


class Fallback:
    """A `Detector` with a first and a second detector."""

    def __init__(self, first: Detector, second: Detector, max_pixels: int = MAX_PIXELS) -> None:
        """Run a `first` without its own deadline on a separate thread, with images of up to `max_pixels`."""
        self._first = first if isinstance(first, DeadlineDetector) else DeadlineDetector(first, max_pixels)
        self._second = second
        self._news = Notices()
        self._returns = RepeatLimiter()
        self._logged: OrderedDict[str, None] = OrderedDict()
        """Robots that the second detector steers, according to the log."""
        self._good: OrderedDict[str, int] = OrderedDict()
        """Robots that the second detector steers -> good answers of the first in a row."""
        self._beside: list[tuple[list[str], Pending]] = []
        """Requests to the first detector for frames that the second answers: at most one per robot."""

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> Results:
        """See `Detector`."""
        self._count_beside()
        firsts = [one for one in frames if one.robot not in self._good]
        others = [one for one in frames if one.robot in self._good]
        first_us = deadline_us - min(RESERVE_US, max(0, deadline_us - monotonic_us()) // 2)
        answers = iter(self._first.detect(firsts, first_us) if firsts else [])
        results = [next(answers, None) if one.robot not in self._good else None for one in frames]
        for frame, result in zip(frames, results, strict=True):
            if result is None and frame.robot not in self._good:
                self._switch(frame.robot)
        self._request_beside(others, first_us)  # with the deadline that holds while the first detector steers
        return self._filled(results, frames, deadline_us)

    def attach(self, link: Link) -> None:
        """Pass a robot's link to both."""
        attach_detector(self._first, link)
        attach_detector(self._second, link)

    def close(self) -> None:
        """Close both, even if one of them fails to close."""
        with ExitStack() as ending:
            ending.callback(close_detector, self._second)
            ending.callback(close_detector, self._first)

    def notices(self) -> list[str]:
        """Return the lines of both, and the changes between them."""
        self._log_returns()
        return [*notices_of(self._first), *self._news.take(), *notices_of(self._second)]

    def _switch(self, robot: str) -> None:
        """Use the second detector from now on."""
        self._good[robot] = 0
        if len(self._good) > MAX_ROBOTS:  # the robot that switched first uses the first detector again
            self._good.popitem(last=False)
        if robot not in self._logged:
            self._logged[robot] = None
            if len(self._logged) > MAX_ROBOTS:
                self._logged.popitem(last=False)
            self._news.add(f"the first detector is late or silent for {robot}: the fallback drives on")

    def _log_returns(self) -> None:
        """Log that the first detector drives again, immediately and then after 1, 2, 4 ... 60 s."""
        # Otherwise a first detector that is late now and then would be two lines each time.
        for robot in [one for one in self._logged if one not in self._good]:
            if self._returns.due(robot, monotonic_us()):
                del self._logged[robot]
                self._news.add(f"the first detector gave {GOOD_ANSWERS} good answers for {robot}: it drives "
                               "again")

    def _filled(self, results: Results, frames: Sequence[DetectFrame], deadline_us: int) -> Results:
        """Fill missing results of the first with those of the second."""
        missing = [frame for frame, result in zip(frames, results, strict=True) if result is None]
        more = iter(self._second.detect(missing, deadline_us) if missing else [])
        return [next(more) if result is None else result for result in results]

    def _request_beside(self, frames: Sequence[DetectFrame], deadline_us: int) -> None:
        """Request frames also from the first detector, for robots of the second without a request in flight."""
        in_flight = {robot for robots, _ in self._beside for robot in robots}
        new = [one for one in frames if one.robot not in in_flight]
        if new:
            self._beside.append(([one.robot for one in new], self._first.request(new, deadline_us)))

    def _count_beside(self) -> None:
        """Count good and missing answers of the first detector, for robots of the second."""
        waiting = []
        for robots, pending in self._beside:
            results = pending.take(wait=False)
            if results is None and not pending.over:
                waiting.append((robots, pending))
            elif results is not None or pending.begun:  # frames that it did not begin are not its failure
                self._count(robots, results or [])
        self._beside = waiting

    def _count(self, robots: Sequence[str], results: Results) -> None:
        good = dict.fromkeys(robots, len(results) == len(robots))
        for robot, result in zip(robots, results, strict=False):
            good[robot] = good[robot] and result is not None
        for robot in good.keys() & self._good.keys():
            self._good[robot] = self._good[robot] + 1 if good[robot] else 0
            if self._good[robot] >= GOOD_ANSWERS:
                del self._good[robot]
