"""Says when something periodic is due. Pure."""


class PeriodicTimer:
    """On average exactly at its rate, whatever the steps in which it is asked."""

    def __init__(self, period_us: float) -> None:
        self._period_us = period_us
        self._count = 0

    def due(self, now_us: int) -> bool:
        """Whether it is due at `now_us`; each period answers once."""
        count = int(now_us / self._period_us)
        is_due, self._count = count > self._count, count
        return is_due
