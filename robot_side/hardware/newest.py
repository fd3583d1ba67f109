"""The newest picture of a camera that captures by itself. Shell (a lock and a clock)."""

import time

from sightline.protocol.transports.link import LatestSlot
from sightline.robot_side.ports import Picture

_JUST_NOW_S = 0.008
"""A picture that arrived this long ago may still be handed over. Longer, and it is better to wait for the next: a
stored picture is old sight. Shorter, and a reader late by a hair would get every second picture only."""


class LatestPicture:
    """One place: the reader thread puts, `take` waits."""

    def __init__(self) -> None:
        self._slot: LatestSlot[tuple[float, Picture]] = LatestSlot()

    @property
    def dropped(self) -> int:
        """Pictures replaced before anybody took them."""
        return self._slot.dropped

    def put(self, picture: Picture) -> None:
        """Replace whatever is there; never blocks."""
        self._slot.put((time.monotonic(), picture))

    def take(self, timeout_s: float) -> Picture | None:
        """A picture that has just arrived, else the next one; None if none arrives within `timeout_s`."""
        stored = self._slot.take()
        if stored is not None and time.monotonic() - stored[0] <= _JUST_NOW_S:
            return stored[1]
        fresh = self._slot.take(timeout_s)
        return fresh[1] if fresh else None
