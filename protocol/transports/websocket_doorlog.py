"""Lines about who was turned away, for the log: few, however many knock. Pure."""

from typing import Final

MAX_LINES_PER_S: Final = 10
_SECOND_US: Final = 1_000_000


class BurstLimiter:
    """At most ten lines a second; what is left out is counted in the next."""

    def __init__(self) -> None:
        self._begin_us = -_SECOND_US
        self._lines = self._left_out = 0

    def line(self, text: str, now_us: int) -> str:
        """What to print for `text`; "" for nothing."""
        if now_us - self._begin_us >= _SECOND_US:
            self._begin_us, self._lines = now_us, 0
        if self._lines >= MAX_LINES_PER_S:
            self._left_out += 1
            return ""
        self._lines += 1
        more, self._left_out = f" ({self._left_out} more before)" if self._left_out else "", 0
        return text + more
