"""When a picture was captured, from the time a driver wrote on its buffer. Pure.

A stamp taken when the picture is read makes one that lay in the driver's queue look young. Drivers stamp with the
monotonic clock, some with the clock of the day or with the time since boot; some do not stamp at all.
"""

from dataclasses import dataclass

_OLDEST_US = 2_000_000  # until its clock is known, what seems older than this was stamped by another


@dataclass(frozen=True, slots=True)
class Clocks:
    """The same moment on each clock that a driver may stamp with."""

    monotonic_us: int
    boot_us: int
    day_us: int


class CaptureClock:
    """Which clock a device stamps with. One for each opening of a device: another may be plugged in."""

    def __init__(self, delay_us: int) -> None:
        """`delay_us`: how old a picture is taken to be whose stamp tells nothing."""
        self._delay_us = delay_us
        self._known: int | None = None

    def captured_us(self, stamp_us: int, now: Clocks) -> int:
        """Monotonic time of capture of a buffer stamped `stamp_us` and read `now`.

        The first clock on which a stamp lies in the last two seconds is the device's. From then on its stamps are
        believed, however old the pictures have grown in the driver's queue, unless one is from that clock's future.
        """
        ages_us = [clock_us - stamp_us for clock_us in (now.monotonic_us, now.boot_us, now.day_us)]
        if self._known is None or ages_us[self._known] < 0:
            self._known = next((at for at, age_us in enumerate(ages_us) if 0 <= age_us <= _OLDEST_US), self._known)
        age_us = -1 if self._known is None else ages_us[self._known]
        return now.monotonic_us - (age_us if age_us >= 0 else self._delay_us)
