"""The clocks of this machine, and the age of stamps from a robot's clock. Shell (clocks)."""

import time
from typing import Final

# Linux alone has this clock. On other systems the clock of heartbeats is all there is.
_WITH_SUSPEND: Final = getattr(time, "CLOCK_BOOTTIME", None)


def monotonic_us() -> int:
    """Return the microseconds since a fixed moment, those in suspend included: a frame ages while the robot sleeps."""
    return heartbeat_us() if _WITH_SUSPEND is None else time.clock_gettime_ns(_WITH_SUSPEND) // 1000


def heartbeat_us() -> int:
    """Return the microseconds for which this machine has run. In suspend neither end of a heartbeat is late."""
    return time.monotonic_ns() // 1000


# The age of a robot's stamp without synchronized clocks, estimated from its fastest message. Pure.
#
# The delay of the fastest message of a session cannot be separated from the offset of the clocks. Ages are therefore
# lower bounds; they lack the shortest one-way delay of the link.


class RobotClock:
    """Estimates the offset of one robot's monotonic clock, separately for each session."""

    def __init__(self) -> None:
        self._session = ""
        self._offset_us = 0

    def update(self, session: str, t_us: int, now_us: int) -> None:
        """Learn from a message that left at `t_us` on the robot's clock and arrived at `now_us` on this clock."""
        offset_us = now_us - t_us
        if session != self._session:
            self._session, self._offset_us = session, offset_us
        self._offset_us = min(self._offset_us, offset_us)

    def age_us(self, session: str, t_us: int, now_us: int) -> int | None:
        """Return the lowest possible age of `t_us`, in us, or None for a session other than the current one."""
        if not session or session != self._session:
            return None
        return max(0, now_us - t_us - self._offset_us)
