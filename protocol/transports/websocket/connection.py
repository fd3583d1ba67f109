"""Whether the other end of a connection still lives: it is heard, or it is slow but takes what it is sent. Pure.

A pong waits behind what its reader has not read yet. So silence alone ends only a connection whose way out is clear;
while it is full, the reader is slow, and stays as long as it goes on taking.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

PING_EVERY_US: Final = 1_000_000
"""A peer that says nothing of its own is asked so often."""
SILENCE_US: Final = 2_000_000
"""A ping, and a second to answer it."""
STALLED_LIMIT_US: Final = 30_000_000
"""A full way out that nobody takes anything from, e.g. a stopped process: it costs one socket buffer and a place."""
_LOOK_AFTER_US: Final = 500_000
"""Silent for so long, the way out is watched."""
_LONG_AGO_US: Final = -(10**12)


@dataclass(frozen=True, slots=True)
class SendPath:
    """What is known of the way to the other end."""

    full: bool
    """Something waits, or may lie unread at the other end, which takes it slowly or not at all."""
    taken_bytes: int
    """What the other end's machine has acknowledged so far."""
    lost: bool
    """Something is under way, and that machine has acknowledged nothing for `SILENCE_US`."""


class Keepalive:
    """One connection's. `look` tells of the way out, and is asked only of who is silent."""

    def __init__(self, now_us: int) -> None:
        self._heard_us = self._pinged_us = self._taken_us = now_us
        self._full_us = _LONG_AGO_US
        self._taken_bytes = -1

    def hear(self, now_us: int) -> None:
        """Something arrived, whatever it was."""
        self._heard_us = now_us

    def is_ping_due(self, now_us: int) -> bool:
        """Whether to send a ping now; then the next is due a second later."""
        due = now_us - max(self._pinged_us, self._heard_us) >= PING_EVERY_US
        if due:
            self._pinged_us = now_us
        return due

    def is_over(self, now_us: int, look: Callable[[], SendPath]) -> bool:
        """Whether to give the other end up."""
        if now_us - self._heard_us < _LOOK_AFTER_US:
            return False
        way = look()
        if way.taken_bytes != self._taken_bytes:
            self._taken_bytes, self._taken_us = way.taken_bytes, now_us
        if way.full:
            self._full_us = now_us
        if now_us - self._heard_us < SILENCE_US:
            return False
        is_slow = now_us - self._full_us < SILENCE_US
        return way.lost or not is_slow or now_us - max(self._heard_us, self._taken_us) >= STALLED_LIMIT_US
