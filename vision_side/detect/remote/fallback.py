"""Remote eyes while they answer, own ones while they do not: late or silent once, and the own ones drive. Shell.

While they drive, the remote is asked beside them, and drives again after ten good answers in a row.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Final, Protocol, runtime_checkable

from protocol.transports.link import Link
from vision_side.clock import now_us
from vision_side.detect.around import attach_detector, close_detector, news_of
from vision_side.detect.news import News
from vision_side.detect.port import DetectFrame, DetectionResult, Detector
from vision_side.detect.remote.by_deadline import ByDeadline

GOOD_ANSWERS: Final = 10
"""In a row; a third of a second at 30 fps."""
RESERVE_US: Final = 20_000
"""Kept back of a deadline for the own eyes, half of it at most: several times what they need for one picture."""
Results = list[DetectionResult | None]


class Asked(Protocol):
    """What was asked and may be answered."""

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

    def ask(self, frames: Sequence[DetectFrame], deadline_us: int) -> Asked:
        """Begin to ask about `frames`."""
        ...


class Fallback:
    """A `Detector` over two."""

    def __init__(self, first: Detector, second: Detector, good_answers: int = GOOD_ANSWERS) -> None:
        """A `first` that cannot be asked without waiting is asked on a thread of its own."""
        self._first: Remote = first if isinstance(first, Remote) else ByDeadline(first)
        self._second = second
        self._news = News()
        self._good_answers = good_answers
        self._good = good_answers
        """Good answers of the first in a row; it drives while these are enough."""
        self._beside: Asked | None = None
        self.switched = 0

    @property
    def on_first(self) -> bool:
        """Whether the first one drives."""
        return self._good >= self._good_answers

    @property
    def refused(self) -> Counter[str]:
        """What the first one refused, if it counts that."""
        return Counter(getattr(self._first, "refused", {}))

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> Results:
        """As the port says."""
        self._judge()
        if not self.on_first:
            return self._by_second(frames, deadline_us)
        reserve_us = min(RESERVE_US, max(0, deadline_us - now_us()) // 2)
        results = self._first.detect(frames, deadline_us - reserve_us)
        if all(results):
            return results
        self._good = 0
        self.switched += 1
        self._news.add("the remote detector is late or silent: own eyes drive on")
        return self._filled(results, frames, deadline_us)

    def attach(self, link: Link) -> None:
        """Give both a robot's link."""
        attach_detector(self._first, link)
        attach_detector(self._second, link)

    def close(self) -> None:
        """Close both."""
        close_detector(self._first)
        close_detector(self._second)

    def news(self) -> list[str]:
        """What both have to say, and which of them drives."""
        return [*news_of(self._first), *self._news.take(), *news_of(self._second)]

    def _filled(self, results: Results, frames: Sequence[DetectFrame], deadline_us: int) -> Results:
        """The second one's results where the first had none."""
        missing = [frame for frame, result in zip(frames, results, strict=True) if result is None]
        more = iter(self._second.detect(missing, deadline_us))
        return [next(more) if result is None else result for result in results]

    def _by_second(self, frames: Sequence[DetectFrame], deadline_us: int) -> Results:
        if self._beside is None:
            self._beside = self._first.ask(frames, deadline_us)
        return self._second.detect(frames, deadline_us)

    def _judge(self) -> None:
        """Count the answer that was asked for beside, if it came, or that it did not."""
        if self._beside is None:
            return
        results = self._beside.take(wait=False)
        if results is None and not self._beside.over:
            return
        self._beside = None
        self._good = self._good + 1 if results and all(results) else 0
        if self.on_first:
            self._news.add(f"the remote detector gave {self._good_answers} good answers: it drives again")
