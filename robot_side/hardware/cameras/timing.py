"""Capture times from driver stamps, a frame timer for files, and the slot of the latest image. Shell (clocks).

A stamp taken when the image is read makes one that lay in the driver's queue look young. Drivers stamp with the
monotonic clock, some with the clock of the day or with the time since boot; some do not stamp at all.
"""

import time
from dataclasses import dataclass

from sightline.protocol.clock import heartbeat_us, monotonic_us
from sightline.protocol.transports.link import LatestSlot
from sightline.robot_side.ports import Picture

_RUNNING = 0  # the clock that stops in suspend, in the order in which clocks are tried
_SHORTEST_SUSPEND_US = 50_000  # a shorter one makes no image look young
_OLDEST_US = 2_000_000  # until its clock is known, what seems older than this was stamped by another


@dataclass(frozen=True, slots=True)
class Clocks:
    """The same moment on each clock that a driver may stamp with: since boot, less suspend, of the day."""

    boot_us: int
    running_us: int
    day_us: int


class CaptureClock:
    """Which clock a device stamps with. One for each opening of a device: another may be plugged in."""

    def __init__(self, delay_us: int) -> None:
        """Take `delay_us`, the assumed age of an image without a usable stamp."""
        self._delay_us = delay_us
        self._known: int | None = None
        self._suspended_us: int | None = None
        self._resumed_us: int | None = None

    def captured_us(self, stamp_us: int, now: Clocks) -> int:
        """Time of capture, on the robot's clock, of a buffer stamped `stamp_us` and read `now`.

        The first clock on which a stamp lies in the last two seconds is the device's. From then on its stamps are
        believed, however old the images have grown in the driver's queue, unless one is from that clock's future.
        """
        ages_us = [now.running_us - stamp_us, now.boot_us - stamp_us, now.day_us - stamp_us]
        if self._known is None or ages_us[self._known] < 0:
            self._known = next((at for at, age_us in enumerate(ages_us) if 0 <= age_us <= _OLDEST_US), self._known)
        age_us = -1 if self._known is None else ages_us[self._known]
        if self._known == _RUNNING and age_us >= 0:
            age_us += self._asleep_us(stamp_us, now)
        return now.boot_us - (age_us if age_us >= 0 else self._delay_us)

    def _asleep_us(self, stamp_us: int, now: Clocks) -> int:
        """Return the time in suspend since `stamp_us`, which the clock of that stamp lacks.

        A buffer that was filled before the first reading after a suspend may be from before it, and counts as such.
        """
        suspended_us = now.boot_us - now.running_us
        if self._suspended_us is None or suspended_us - self._suspended_us <= _SHORTEST_SUSPEND_US:
            self._suspended_us = suspended_us
        elif self._resumed_us is None:
            self._resumed_us = now.running_us
        if self._resumed_us is not None and stamp_us > self._resumed_us:
            self._suspended_us, self._resumed_us = suspended_us, None
        return suspended_us - self._suspended_us


# The robot's clocks, and a rhythm for sources that have none of their own, such as files. Shell (clocks).


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


# The newest image of a camera that captures by itself. Shell (a lock and a clock).


_JUST_NOW_S = 0.008
"""Maximum age of a stored image that `read` still returns. A longer time returns old images instead of the next one.
With a shorter time, a reader that is slightly late gets only every second image."""


class LatestPicture:
    """One place: the reader thread puts, `take` waits."""

    def __init__(self) -> None:
        self._slot: LatestSlot[tuple[float, Picture]] = LatestSlot()

    @property
    def dropped(self) -> int:
        """Return the number of images that were replaced before a reader took them."""
        return self._slot.dropped

    def put(self, picture: Picture) -> None:
        """Replace whatever is there; never blocks."""
        self._slot.put((time.monotonic(), picture))

    def take(self, timeout_s: float) -> Picture | None:
        """Take the image that has just arrived, else the next one. Returns None if none arrives within `timeout_s`."""
        stored = self._slot.take()
        if stored is not None and time.monotonic() - stored[0] <= _JUST_NOW_S:
            return stored[1]
        fresh = self._slot.take(timeout_s)
        return fresh[1] if fresh else None
