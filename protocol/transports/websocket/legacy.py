"""Which of several clients of the older dialect drives: the first with a valid twist; the rest are viewers. Pure.

They all are the same `guest` to the robot, which so cannot tell two that contradict each other from one.
"""

from typing import Final

DRIVER_SLOT_US: Final = 1_000_000
"""A driver that has said nothing valid for so long has left its seat; as long as the robot's own lease."""


class DriverSlot:
    """The one seat of a link."""

    def __init__(self) -> None:
        self._driver = ""
        self._until_us = 0

    def claim(self, who: str, now_us: int) -> str:
        """Who drives after `who` said something valid: `who` itself if the seat was its own, or free."""
        if who == self._driver or now_us >= self._until_us:
            self._driver, self._until_us = who, now_us + DRIVER_SLOT_US
        return self._driver

    def leave(self, who: str) -> None:
        """`who` is gone."""
        if who == self._driver:
            self._driver, self._until_us = "", 0
