"""Whose frame a detector looks at next: the newest of each robot, in fair turns, and none that is too old. Pure."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

Item = TypeVar("Item")

_BATCH_SHARE: Final = 0.5
"""Of a deadline, for one batch: what arrives while it is looked at must still have its own turn."""


@dataclass(frozen=True, slots=True)
class QueuedFrame(Generic[Item]):
    """One robot's newest frame, and when it came."""

    robot: str
    item: Item
    arrived_us: int


@dataclass(slots=True)
class FrameCounters:
    """What became of one robot's frames; the numbers only grow."""

    offered: int = 0
    served: int = 0
    overtaken: int = 0
    """A newer one took its place before its turn."""
    stale: int = 0
    """Not worth looking at any more when its turn came."""
    late: int = 0
    """Looked at, but not by its deadline: nobody was told."""
    refused: int = 0
    """No frame, or no picture."""

    @property
    def dropped(self) -> int:
        """All that was not answered."""
        return self.too_many + self.refused

    @property
    def too_many(self) -> int:
        """What was not answered for want of time; what is refused says nothing of the load."""
        return self.overtaken + self.stale + self.late


class FairQueue(Generic[Item]):
    """One place for each robot. Whoever waits for the longest time since its last turn is next."""

    def __init__(self, max_batch: int, deadline_us: int) -> None:
        self._max_batch, self._deadline_us = max_batch, deadline_us
        self._waiting: OrderedDict[str, QueuedFrame[Item] | None] = OrderedDict()
        self.tallies: dict[str, FrameCounters] = {}

    def offer(self, robot: str, item: Item, now_us: int) -> None:
        """The newest frame of `robot`, in place of the one before."""
        tally = self.tallies.setdefault(robot, FrameCounters())
        tally.offered += 1
        tally.overtaken += self._waiting.get(robot) is not None
        self._waiting[robot] = QueuedFrame(robot, item, now_us)

    def take(self, now_us: int, each_us: int = 0) -> list[QueuedFrame[Item]]:
        """What waits, as one batch that fits in half a deadline if a frame takes `each_us`; empty if nothing waits."""
        most, share_us = self._max_batch, int(self._deadline_us * _BATCH_SHARE)
        if each_us > 0:
            most = max(1, min(most, share_us // each_us))
        # One slow frame (a device that warms up) must not rule out all later ones: nothing would be measured again.
        each_us = min(each_us, share_us)
        batch: list[QueuedFrame[Item]] = []
        for robot in [name for name, turn in self._waiting.items() if turn is not None]:
            if len(batch) == most:
                break
            turn = self._waiting[robot]
            self._waiting[robot] = None
            if turn is None or now_us - turn.arrived_us + each_us > self._deadline_us:
                self.tallies[robot].stale += 1
                continue
            self._waiting.move_to_end(robot)
            batch.append(turn)
        return batch
