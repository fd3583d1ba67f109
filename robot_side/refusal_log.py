"""Refusals in words for the robot's log, so that neither a flood nor a vision left running fills it. Pure."""

from collections import Counter
from typing import Final

from sightline.protocol.messages import LastRejection

_FIRST_PERIOD_US: Final = 1_000_000
_LONGEST_PERIOD_US: Final = 60_000_000
_FORGOTTEN_US: Final = 10_000_000
"""A reason that was not given for so long is news again."""


class RejectionLog:
    """Per reason a line at once, then after 1, 2, 4 ... 60 s for as long as it goes on, each with how often."""

    def __init__(self) -> None:
        self._untold: Counter[str] = Counter()
        self._period_us: dict[str, int] = {}
        self._told_us: dict[str, int] = {}
        self._seen_us: dict[str, int] = {}

    def line(self, refusal: LastRejection, now_us: int, times: int = 1) -> str:
        """What to log of a refusal, given `times` since the last call; "" while its reason has had its share."""
        reason = refusal.reason
        self._untold[reason] += times
        if not self._is_due(reason, now_us):
            return ""
        count = self._untold.pop(reason)
        often = f" ({count} times)" if count > 1 else ""
        return f"refused {reason} from {refusal.source or 'somebody'}{often}: {refusal.detail}"

    def _is_due(self, reason: str, now_us: int) -> bool:
        silent_us = now_us - self._seen_us.get(reason, now_us - _FORGOTTEN_US)
        self._seen_us[reason] = now_us
        if silent_us >= _FORGOTTEN_US:
            self._period_us[reason] = _FIRST_PERIOD_US
        elif now_us - self._told_us[reason] < self._period_us[reason]:
            return False
        else:
            self._period_us[reason] = min(2 * self._period_us[reason], _LONGEST_PERIOD_US)
        self._told_us[reason] = now_us
        return True
