"""The robot's clocks, and a rhythm for sources that have none of their own, such as files. Shell (clocks)."""

import time

from sightline.protocol.clock import monotonic_us
from sightline.robot_side.hardware.cameras.timing import Clocks


class FrameTimer:
    """Ticks `fps` times a second. Ticks that nobody waited for are not made up for, and who is late shifts none."""

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
    """Every clock that a driver may stamp with, now."""
    boot_us = time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000
    return Clocks(monotonic_us(), boot_us, time.time_ns() // 1000)
