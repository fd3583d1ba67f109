"""Lets through no more than so many a second of what comes at a rate of its own. Pure."""

from typing import Final

_EARLY: Final = 0.25
"""Share of a period that one may come early: else every second of 30 frames a second would often be a third."""


class RateLimiter:
    """At most `rate_hz` in the mean."""

    def __init__(self, rate_hz: float) -> None:
        self._period_us = 1e6 / rate_hz
        self._due_us = float("-inf")

    def is_due(self, now_us: int) -> bool:
        """Whether one may pass now; then it has."""
        if now_us < self._due_us - _EARLY * self._period_us:
            return False
        # Counted from when it was due, so that neither early nor late ones change the mean; after a pause, from now.
        was_due_us = self._due_us if now_us - self._due_us < self._period_us else now_us
        self._due_us = was_due_us + self._period_us
        return True
