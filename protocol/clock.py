"""The clocks of this machine, and the age of times from a robot's clock. Shell (clocks)."""

import time
from typing import Final

# Only Linux has this clock. Other systems use the heartbeat clock.
_WITH_SUSPEND: Final = getattr(time, "CLOCK_BOOTTIME", None)


def monotonic_us() -> int:
    """Return the microseconds since a fixed moment, including suspend, because a frame ages in suspend, too."""
    return heartbeat_us() if _WITH_SUSPEND is None else time.clock_gettime_ns(_WITH_SUSPEND) // 1000


def heartbeat_us() -> int:
    """Return the microseconds for which this machine has run. After a suspend no heartbeat is late."""
    return time.monotonic_ns() // 1000


# The time of a robot's messages, measured on this machine's clock without synchronization. Pure.
#
# The delay of the fastest message of a session cannot be separated from the offset of the clocks. Ages are therefore
# lower bounds: they do not contain the shortest one-way delay of the link.


AHEAD_US: Final = 500_000
"""Largest lead of a message over the fastest one. A larger lead is false, because clocks and links of one robot differ
less. It is short enough to steer again within a second after a forged message."""
_PROVEN_US: Final = 300_000
"""Duration of messages with other times after which they replace the current times, if those are silent meanwhile."""
_DRIFT: Final = 5_000
"""Two quartz clocks differ by less than 1 in 5000."""
_FRAMES_PER_S: Final = 1_000


class _Timeline:
    """Messages of one session whose times agree with this machine's clock."""

    def __init__(self, seq: int, t_us: int, now_us: int) -> None:
        self.offset_us = now_us - t_us
        self.received_us = self._begun_us = now_us
        self._undrifted_us = 0
        """Time whose drift is not added yet, because between two messages the drift may be less than 1 us."""
        self._begun_t_us = self._t_us = t_us
        self._seq = seq

    def fits(self, seq: int, t_us: int, now_us: int) -> bool:
        """Return True unless a message runs ahead, or goes back further than a link can delay it."""
        most = self._seq + _FRAMES_PER_S + (now_us - self.received_us) * _FRAMES_PER_S // 1_000_000
        return self._t_us - AHEAD_US <= t_us <= now_us - self.offset_us + AHEAD_US and seq <= most

    def extend(self, seq: int, t_us: int, now_us: int) -> None:
        drift_us, self._undrifted_us = divmod(self._undrifted_us + now_us - self.received_us, _DRIFT)
        self.offset_us = min(self.offset_us + drift_us, now_us - t_us)
        self.received_us = now_us
        self._t_us, self._seq = max(self._t_us, t_us), max(self._seq, seq)

    @property
    def is_proven(self) -> bool:
        """Return True if its messages cover enough time on both clocks."""
        return min(self.received_us - self._begun_us, self._t_us - self._begun_t_us) >= _PROVEN_US


class RobotClock:
    """Estimates the offset of one robot's clock, separately for each session, and rejects false times."""

    def __init__(self) -> None:
        self._session = ""
        self._current: _Timeline | None = None
        self._other: _Timeline | None = None
        self.replaced = 0
        """Number of replacements of false current times by other times of the same session."""

    def update(self, session: str, t_us: int, now_us: int, seq: int = 0) -> bool:
        """Process the time of a message.

        Args:
            session: session of the robot.
            t_us: its time on the robot's clock.
            now_us: its arrival on this clock.
            seq: its sequence number, 0 if messages of several channels are mixed.

        Returns:
            False for a message whose time or number runs ahead of this clock, or goes back too far.
        """
        if session != self._session:
            self._session, self._current, self._other = session, None, None
        if self._current is None:
            self._current = _Timeline(seq, t_us, now_us)
        if self._current.fits(seq, t_us, now_us):
            self._current.extend(seq, t_us, now_us)
            return True
        return self._replaces(self._current, seq, t_us, now_us)

    def _replaces(self, current: _Timeline, seq: int, t_us: int, now_us: int) -> bool:
        """Collect messages with other times. If they last while the current times are silent, they replace these."""
        if self._other is None or not self._other.fits(seq, t_us, now_us):
            self._other = _Timeline(seq, t_us, now_us)
        self._other.extend(seq, t_us, now_us)
        if not self._other.is_proven or now_us - current.received_us < _PROVEN_US:
            return False
        self._current, self._other = self._other, None
        self.replaced += 1
        return True

    def age_us(self, session: str, t_us: int, now_us: int) -> int | None:
        """Return the lowest possible age of `t_us`, in us, or None for a session other than the current one."""
        if self._current is None or session != self._session:
            return None
        return max(0, now_us - t_us - self._current.offset_us)
