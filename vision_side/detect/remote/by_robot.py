"""A detector that only waits, waited for beside who asks: a thread for each robot, none holds up another. Shell.

For boxes that come by themselves, and only for that: what is inside is used on several threads at once, though never
for one robot.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence

from vision_side.detect.by_session import MAX_ROBOTS
from vision_side.detect.port import DetectFrame, DetectionResult
from vision_side.detect.remote.by_deadline import ByDeadline, Pending

Results = list[DetectionResult | None]
Detect = Callable[[Sequence[DetectFrame], int], Results]


class Expected:
    """What several robots' boxes are waited for with."""

    begun = True

    def __init__(self, frames: Sequence[DetectFrame], pending: dict[str, Pending]) -> None:
        self._frames, self._pending = frames, pending
        self._there: dict[str, Results] = {}

    def take(self, wait: bool) -> Results | None:
        """The results of all, once; of a robot whose boxes did not come, None."""
        for robot, one in self._pending.items():
            if robot not in self._there and (results := one.take(wait)) is not None:
                self._there[robot] = results
        if len(self._there) < len(self._pending) and not self.over:
            return None
        left = {robot: iter(results) for robot, results in self._there.items()}
        return [next(left.get(frame.robot, iter(())), None) for frame in self._frames]

    @property
    def over(self) -> bool:
        """Whether the deadline has passed."""
        return all(one.over for one in self._pending.values())


class ByRobot:
    """Asks without waiting."""

    def __init__(self, detect: Detect) -> None:
        self._waiter = _Waiter(detect)
        self._threads: OrderedDict[str, ByDeadline] = OrderedDict()

    def ask(self, frames: Sequence[DetectFrame], deadline_us: int) -> Expected:
        """Begin to wait for what is said of `frames`."""
        own: dict[str, list[DetectFrame]] = {}
        for frame in frames:
            own.setdefault(frame.robot, []).append(frame)
        return Expected(frames, {robot: self._thread(robot).ask(some, deadline_us) for robot, some in own.items()})

    def close(self) -> None:
        """End every thread."""
        while self._threads:
            self._threads.popitem()[1].close()

    def _thread(self, robot: str) -> ByDeadline:
        """The robot's; the one that was asked the longest ago ends where there are too many."""
        one = self._threads.pop(robot, None) or ByDeadline(self._waiter)
        self._threads[robot] = one
        if len(self._threads) > MAX_ROBOTS:
            self._threads.popitem(last=False)[1].close()
        return one


class _Waiter:
    """What a thread waits with; nothing in it ends with that thread."""

    def __init__(self, detect: Detect) -> None:
        self.detect = detect
