"""When a picture was captured, from the time a driver wrote on its buffer. Pure.

A stamp taken when the picture is read makes one that lay in the driver's queue look young. Drivers stamp with the
monotonic clock, some with the clock of the day or with the time since boot; some do not stamp at all.
"""

from dataclasses import dataclass

_OLDEST_US = 2_000_000  # what seems older than this was stamped by another clock


@dataclass(frozen=True, slots=True)
class Clocks:
    """The same moment on each clock that a driver may stamp with."""

    monotonic_us: int
    boot_us: int
    day_us: int


def captured_us(stamp_us: int, now: Clocks, delay_us: int) -> int:
    """Monotonic time of capture of a buffer stamped `stamp_us` and read `now`.

    The first clock on which the stamp lies in the last two seconds is taken to be its clock; if there is none, the
    picture is taken to be `delay_us` old.
    """
    for clock_us in (now.monotonic_us, now.boot_us, now.day_us):
        age_us = clock_us - stamp_us
        if 0 <= age_us <= _OLDEST_US:
            return now.monotonic_us - age_us
    return now.monotonic_us - delay_us
