"""Selects the next frames for a detector: newest only, fair turns, deadlines, batches. Pure."""

from collections import OrderedDict, deque
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from operator import add
from typing import Final, Generic, TypeVar

Item = TypeVar("Item")

_BATCH_SHARE: Final = 0.5
"""Share of a deadline for one batch. Frames that arrive meanwhile must still have their own turn."""
_SMOOTHING: Final = 0.2
_AGES: Final = 512
"""Ages stored for the percentiles; some seconds of a busy service."""


@dataclass(frozen=True, slots=True)
class QueuedFrame(Generic[Item]):
    """The newest frame of one robot, and its arrival time."""

    robot: str
    item: Item
    arrived_us: int


@dataclass(slots=True)
class FrameCounters:
    """Outcomes of the frames of one robot; the counters never decrease."""

    offered: int = 0
    served: int = 0
    overtaken: int = 0
    """Frames that a newer frame replaced before their turn."""
    stale: int = 0
    """Frames that were too old at their turn, or when the detector was free. They are not computed."""
    late: int = 0
    """Frames that were detected after their deadline. The boxes are not published."""
    rejected: int = 0
    """Invalid frames, invalid images, and invalid results."""

    def __add__(self, other: "FrameCounters") -> "FrameCounters":
        return FrameCounters(*map(add, astuple(self), astuple(other)))

    @property
    def dropped(self) -> int:
        """Return the number of frames without an answer."""
        return self.too_many + self.rejected

    @property
    def too_many(self) -> int:
        """Return the number of frames without an answer for lack of time. Rejected frames do not count as load."""
        return self.overtaken + self.stale + self.late


class FairQueue(Generic[Item]):
    """One slot for each robot. The robot with the oldest last turn is next."""

    def __init__(self, max_batch: int, deadline_us: int) -> None:
        self._max_batch, self._deadline_us = max_batch, deadline_us
        self._waiting: OrderedDict[str, QueuedFrame[Item] | None] = OrderedDict()
        self.counters: dict[str, FrameCounters] = {}

    def offer(self, robot: str, item: Item, now_us: int) -> None:
        """Store the newest frame of `robot`. It replaces the waiting frame."""
        counters = self.counters.setdefault(robot, FrameCounters())
        counters.offered += 1
        counters.overtaken += self._waiting.get(robot) is not None
        self._waiting[robot] = QueuedFrame(robot, item, now_us)

    def forget(self, robot: str) -> FrameCounters:
        """Forget a robot that has left. Returns the outcomes of its frames."""
        self._waiting.pop(robot, None)
        return self.counters.pop(robot, FrameCounters())

    @property
    def waits(self) -> bool:
        """Return True if a frame waits."""
        return any(turn is not None for turn in self._waiting.values())

    def take(self, now_us: int, each_us: int = 0) -> list[QueuedFrame[Item]]:
        """Take waiting frames as one batch. At `each_us` per frame it fits in half a deadline. It may be empty."""
        most = self._max_batch
        if each_us > 0:
            most = max(1, min(most, int(self._deadline_us * _BATCH_SHARE) // each_us))
        batch: list[QueuedFrame[Item]] = []
        for robot in [name for name, turn in self._waiting.items() if turn is not None]:
            if len(batch) == most:
                break
            turn = self._waiting[robot]
            self._waiting[robot] = None
            if turn is None or _is_too_old(turn, now_us, each_us, self._deadline_us):
                self.counters[robot].stale += 1
                continue
            self._waiting.move_to_end(robot)
            batch.append(turn)
        return batch


def _is_too_old(turn: QueuedFrame[Item], now_us: int, each_us: int, deadline_us: int) -> bool:
    """Return True if the boxes would come after the deadline of the frame."""
    # One slow frame (a device that warms up) must not reject all later ones, because then no new time is measured.
    return now_us - turn.arrived_us + min(each_us, int(deadline_us * _BATCH_SHARE)) > deadline_us


class BatchClock:
    """Times of batches: duration of a frame, start of the next preparation, and load of the detector.

    At most two batches are in progress: one is decoded while the detector examines the other. A batch that is decoded
    too early only becomes older, so it is taken just in time.
    """

    def __init__(self, deadline_us: int, began_us: int) -> None:
        self._deadline_us = deadline_us
        self._busy_since_us: int | None = None
        self._detect_us = self._prepare_us = self._each_us = 0.0
        self._busy_us, self._counted_us = 0, began_us
        self._queue_ages_us: deque[int] = deque(maxlen=_AGES)
        self._answer_ages_us: deque[int] = deque(maxlen=_AGES)

    @property
    def each_us(self) -> int:
        """Return the time that one frame takes, us; 0 before the first batch."""
        return int(self._each_us)

    def wait_us(self, now_us: int) -> int:
        """Return the wait before the next batch is taken, us. A batch may be taken earlier if the detector is free.

        Before the end of the first batch, the duration is unknown, and the wait is one deadline.
        """
        if self._busy_since_us is None:
            return 0
        if not self._detect_us:
            return self._deadline_us
        return max(0, round(self._busy_since_us + self._detect_us - self._prepare_us - now_us))

    def prepared(self, batch: Iterable[QueuedFrame[Item]], began_us: int, now_us: int) -> None:
        """Note a batch that was taken at `began_us` and whose decoding ends now."""
        self._queue_ages_us.extend(began_us - turn.arrived_us for turn in batch)
        self._prepare_us = _smoothed(self._prepare_us, now_us - began_us)

    def begin(self, batch: Iterable[QueuedFrame[Item]], now_us: int) -> tuple[list[QueuedFrame[Item]], int]:
        """Begin to examine a batch.

        Returns:
            The frames whose boxes can come before their deadline, and the earliest deadline, us.
        """
        fresh = [turn for turn in batch if not _is_too_old(turn, now_us, self.each_us, self._deadline_us)]
        if fresh:
            self._busy_since_us = now_us
        return fresh, min((turn.arrived_us for turn in fresh), default=now_us) + self._deadline_us

    def end(self, count: int, now_us: int) -> None:
        """Note that the detector has examined `count` frames since `begin`."""
        took_us = self.busy_us(now_us)
        self._busy_us += now_us - max(self._counted_us, now_us - took_us)
        self._busy_since_us = None
        self._detect_us = _smoothed(self._detect_us, took_us)
        self._each_us = _smoothed(self._each_us, (took_us + self._prepare_us) / count)

    def answered(self, age_us: int) -> None:
        """Note the age of a frame whose boxes are sent now."""
        self._answer_ages_us.append(age_us)

    def busy_us(self, now_us: int) -> int:
        """Return the time since the detector began the current batch, us; 0 without a batch."""
        return 0 if self._busy_since_us is None else now_us - self._busy_since_us

    def busy_ratio(self, now_us: int) -> float:
        """Return the share of the time since the last call in which the detector was busy, 0 to 1."""
        period_us = now_us - self._counted_us
        ratio = (self._busy_us + min(self.busy_us(now_us), period_us)) / max(1, period_us)
        self._busy_us, self._counted_us = 0, now_us
        return min(1.0, ratio)

    def queue_p95_us(self) -> int | None:
        """Return the 95th percentile of the age of frames when their turn came, us."""
        return percentile_95(self._queue_ages_us)

    def answer_p95_us(self) -> int | None:
        """Return the 95th percentile of the age of frames when their boxes were sent, us."""
        return percentile_95(self._answer_ages_us)


def _smoothed(before: float, now: float) -> float:
    return before + (now - before) * (_SMOOTHING if before else 1.0)


def percentile_95(ages: deque[int]) -> int | None:
    """Return the 95th percentile, or None without an age. Another thread may add ages meanwhile."""
    ordered = sorted(ages.copy())
    return ordered[int(len(ordered) * 0.95)] if ordered else None
