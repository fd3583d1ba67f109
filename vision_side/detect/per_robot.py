"""What a detector remembers of each robot, begun anew with each of its sessions. Pure."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Final, Generic, TypeVar

Memory = TypeVar("Memory")

MAX_ROBOTS: Final = 256
"""Of which something is remembered, as many as a site meets: with fewer, robots that take turns would each be forgotten
just before theirs. The robot that was not seen for the longest is forgotten first."""


class PerSession(Generic[Memory]):
    """One memory for each robot."""

    def __init__(self, begin: Callable[[], Memory]) -> None:
        self._begin = begin
        self._kept: OrderedDict[str, tuple[str, Memory]] = OrderedDict()

    def of(self, robot: str, session: str) -> Memory:
        """That of the robot's session."""
        before = self._kept.pop(robot, None)
        memory = before[1] if before is not None and before[0] == session else self._begin()
        self._kept[robot] = session, memory
        if len(self._kept) > MAX_ROBOTS:
            self._kept.popitem(last=False)
        return memory
