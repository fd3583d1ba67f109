"""Capture times from driver stamps, a frame timer for files, and the slot of the latest image. Shell (clocks).

A time taken at the reading of an image hides the time that it waited in the driver's queue. Most drivers stamp with the
monotonic clock, some with the wall clock or the time since boot. Some drivers do not stamp at all.
"""

import time
from dataclasses import dataclass

from sightline.protocol.clock import heartbeat_us, monotonic_us
from sightline.protocol.transports.link import LatestSlot
from sightline.robot_side.ports import Picture

_RUNNING = 0  # index of the clock that stops in suspend; clocks are tried in this order
_SHORTEST_SUSPEND_US = 50_000  # a shorter suspend is ignored
_OLDEST_US = 2_000_000  # while the clock is unknown, a larger age means another clock


@dataclass(frozen=True, slots=True)
class Clocks:
    """The same moment on each clock of drivers: since boot, without suspend, wall clock."""

    boot_us: int
    running_us: int
    day_us: int


class CaptureClock:
    """Detects the clock of a device's stamps. Each opening of a device needs a new object."""

    def __init__(self, delay_us: int) -> None:
        """Take `delay_us`, the assumed age of an image without a usable stamp."""
        self._delay_us = delay_us
        self._known: int | None = None
        self._suspended_us: int | None = None
        self._resumed_us: int | None = None

    def captured_us(self, stamp_us: int, now: Clocks) -> int:
        """Return the capture time on the robot's clock of a buffer with `stamp_us`, read at `now`.

        The device uses the first clock on which a stamp is at most two seconds old. From then on any age of its stamps
        is accepted, even after a long wait in the driver's queue, but not a stamp in the future.
        """
        ages_us = [now.running_us - stamp_us, now.boot_us - stamp_us, now.day_us - stamp_us]
        if self._known is None or ages_us[self._known] < 0:
            self._known = next((at for at, age_us in enumerate(ages_us) if 0 <= age_us <= _OLDEST_US), self._known)
        age_us = -1 if self._known is None else ages_us[self._known]
        if self._known == _RUNNING and age_us >= 0:
            age_us += self._asleep_us(stamp_us, now)
        return now.boot_us - (age_us if age_us >= 0 else self._delay_us)

    def _asleep_us(self, stamp_us: int, now: Clocks) -> int:
        """Return the time in suspend since `stamp_us`, which the clock of that stamp does not count.

        A buffer that was filled before the first reading after a suspend may be older, and counts as older.
        """
        suspended_us = now.boot_us - now.running_us
        if self._suspended_us is None or suspended_us - self._suspended_us <= _SHORTEST_SUSPEND_US:
            self._suspended_us = suspended_us
        elif self._resumed_us is None:
            self._resumed_us = now.running_us
        if self._resumed_us is not None and stamp_us > self._resumed_us:
            self._suspended_us, self._resumed_us = suspended_us, None
        return suspended_us - self._suspended_us


# The robot's clocks, and a frame timer for sources without a clock, such as files. Shell (clocks).


class FrameTimer:
    """Tick `fps` times a second. Missed ticks are not repeated, and a late caller does not shift the next tick."""

    def __init__(self, fps: float) -> None:
        self._interval_s = 1 / fps
        self._next_s = time.monotonic()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the next tick; False if it is not due within `timeout_s`."""
        now_s = time.monotonic()
        due_s = self._next_s + self._interval_s
        if due_s - now_s > timeout_s:
            time.sleep(timeout_s)
            return False
        time.sleep(max(0.0, due_s - now_s))
        self._next_s = due_s if now_s - due_s < self._interval_s / 2 else now_s
        return True


def read_clocks() -> Clocks:
    """Read all clocks that a driver may use for its stamps."""
    return Clocks(monotonic_us(), heartbeat_us(), time.time_ns() // 1000)


# The newest image of a camera with its own capture thread. Shell (a lock and a clock).


JUST_NOW_S = 0.008
"""Largest age of a stored image that `read` returns. With a longer time it returns old images instead of the next one.
With a shorter time, a reader that is slightly late gets only every second image."""


class LatestPicture:
    """Slot for one image: the reader thread calls `put`, `take` waits."""

    def __init__(self) -> None:
        self._slot: LatestSlot[tuple[float, Picture]] = LatestSlot()

    @property
    def dropped(self) -> int:
        """Return the number of images that were replaced before a reader took them."""
        return self._slot.dropped

    def put(self, picture: Picture) -> None:
        """Replace the stored image; never blocks."""
        self._slot.put((time.monotonic(), picture))

    def take(self, timeout_s: float) -> Picture | None:
        """Take an image that has just arrived, otherwise the next one. Returns None if none arrives in `timeout_s`."""
        stored = self._slot.take()
        if stored is not None and time.monotonic() - stored[0] <= JUST_NOW_S:
            return stored[1]
        fresh = self._slot.take(timeout_s)
        return fresh[1] if fresh else None
