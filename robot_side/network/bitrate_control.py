"""Select quality and size of the images, so that each image passes the link in time. Pure.

The bytes per image decrease by a factor on a full link, and increase slowly on a free link. Only a camera that encodes
its images can follow (`sightline.robot_side.ports.Adjustable`). Other cameras ignore the target.
"""

from typing import Final, NamedTuple

from sightline.robot_side.network.congestion_window import LinkCapacity

# Time for which an image may occupy the link. Its age grows by the same time. Thirty images a second pass with reserve.
PICTURE_US: Final = 28_000
# Side lengths. Half of them loses nothing, because the vision service decodes large images at half scale.
SCALES_PERCENT: Final = (100, 50)
# Share of the configured quality. Below it JPEG blocks hide small targets, so a smaller size is better.
LEAST_QUALITY_PERCENT: Final = 25

_LEAST_BYTES: Final = 2_000
_STEP_BYTES: Final = 1_500
_STEP_US: Final = 250_000
# Delay above the lowest recent one that reduces the bytes. Below half of it they may grow.
_EXCESS_US: Final = 40_000
_FACTOR: Final = 0.8
_OVERDUE_FACTOR: Final = 0.5
# Length of each of the two periods with a stored lowest delay. After the second, a longer delay counts as normal.
_FLOOR_US: Final = 5_000_000
# Images that were already captured when the target changed.
_LAG_FRAMES: Final = 2
# Number of delays that show the effect of fewer bytes.
_CHECKED_BY: Final = 3
_IN_VAIN: Final = 1.05
# A new size restarts the pipeline of the vision service, so it must not change more often.
_FROM_SCALE_US: Final = 3_000_000


class EncodingTarget(NamedTuple):
    """Shares of the configured quality and of the side lengths."""

    quality_percent: int = 100
    scale_percent: int = 100


class _Cut(NamedTuple):
    """The cause of a cut: the delay and size of the images, and the estimated time per byte."""

    delay_us: int
    size_bytes: float
    us_per_byte: float


class BitrateControl:
    """Follows the sent frames and their delays. `target` is the encoding for the camera."""

    def __init__(self) -> None:
        self.target = EncodingTarget()
        self._budget_bytes: float | None = None
        self._bytes = 0.0
        self._frames = 0
        self._step_at_us = 0
        self._scaled_at_us = -_FROM_SCALE_US
        self._floors_us: list[int | None] = [None, None]
        self._floor_until_us = 0
        self._made: _Cut | None = None
        self._since_us: list[int] = []

    # --- inputs ------------------------------------------------------------------------------------------------

    def on_sent(self, size_bytes: int, now_us: int) -> None:
        """Note a sent image.

        Args:
            size_bytes: size of the JPEG, or 0 if unknown, which changes nothing.
            now_us: monotonic clock.
        """
        self._frames += 1
        if self._frames <= _LAG_FRAMES or not size_bytes:
            return
        self._bytes = size_bytes if not self._bytes else 0.7 * self._bytes + 0.3 * size_bytes
        self._choose(now_us)

    def on_delay(self, delay_us: int, now_us: int) -> None:
        """Note the delay of a frame that did not wait behind another one.

        Args:
            delay_us: time to the answer without the computing of the peer.
            now_us: monotonic clock.
        """
        self._check_cut(delay_us)
        excess_us = delay_us - self._floor(delay_us, now_us)
        if now_us < self._step_at_us:
            return
        if excess_us > _EXCESS_US and self._bytes:
            self._cut(self._current() * _FACTOR, delay_us, excess_us / self._bytes)
            self._step_at_us = now_us + max(_STEP_US, delay_us)
        elif self._budget_bytes is not None and 2 * excess_us < _EXCESS_US:
            self._budget_bytes += _STEP_BYTES
            self._step_at_us = now_us + _STEP_US

    def on_full(self, full: LinkCapacity, now_us: int) -> None:
        """Cut the bytes to the measured capacity of a full link."""
        self._cut(full.bytes_per_s * PICTURE_US / 1e6, full.delay_us, 1e6 / max(1.0, full.bytes_per_s))
        self._step_at_us = now_us + _STEP_US

    def on_overdue(self, now_us: int) -> None:
        """Cut the bytes after several late answers in a row."""
        self._cut(self._current() * _OVERDUE_FACTOR)
        self._step_at_us = now_us + _STEP_US

    # --- decisions ---------------------------------------------------------------------------------------------

    def _current(self) -> float:
        budget = self._budget_bytes
        return min(self._bytes, budget) if budget is not None and self._bytes else budget or self._bytes

    def _cut(self, wanted_bytes: float, delay_us: int = 0, us_per_byte: float = 0.0) -> None:
        current = self._current()
        if wanted_bytes < current:
            self._budget_bytes = max(float(_LEAST_BYTES), wanted_bytes)
            self._made = _Cut(delay_us, current, us_per_byte) if us_per_byte else None
            self._since_us.clear()

    def _check_cut(self, delay_us: int) -> None:
        """Undo a cut that did not shorten the delay."""
        # If the bytes were the cause, this delay plus the saved time is at most the delay before the cut. A larger sum
        # means a longer link, where fewer bytes do not help.
        if self._made is None or not self._bytes or self._frames < _LAG_FRAMES + _CHECKED_BY:
            return
        self._since_us.append(delay_us)
        if len(self._since_us) < _CHECKED_BY:
            return
        cut, self._made = self._made, None
        spared_us = (cut.size_bytes - self._bytes) * cut.us_per_byte
        if min(self._since_us) + spared_us > _IN_VAIN * cut.delay_us:
            self._budget_bytes = cut.size_bytes
            self._floors_us = [None, min(self._since_us)]

    def _floor(self, delay_us: int, now_us: int) -> int:
        if now_us >= self._floor_until_us:
            self._floors_us = [self._floors_us[1], None]
            self._floor_until_us = now_us + _FLOOR_US
        newest = self._floors_us[1]
        self._floors_us[1] = delay_us if newest is None else min(newest, delay_us)
        return min(one for one in self._floors_us if one is not None)

    def _choose(self, now_us: int) -> None:
        """Move quality and size toward the budget, by the size of the last images."""
        if self._budget_bytes is None:
            return
        quality, scale = self.target
        share = self._budget_bytes / self._bytes
        if quality == 100 and scale == 100 and share > 1.5:
            self._budget_bytes = None
        elif quality == LEAST_QUALITY_PERCENT and share < 0.8 and scale != SCALES_PERCENT[-1]:
            self._rescale(EncodingTarget(60, SCALES_PERCENT[-1]), now_us)
        elif quality == 100 and share > 1.3 and scale != 100:
            self._rescale(EncodingTarget(40, 100), now_us)
        elif not 0.9 < share < 1.1:
            self._set(EncodingTarget(max(LEAST_QUALITY_PERCENT, min(100, round(quality * share))), scale))

    def _rescale(self, wish: EncodingTarget, now_us: int) -> None:
        if now_us - self._scaled_at_us >= _FROM_SCALE_US:
            self._scaled_at_us = now_us
            self._set(wish)

    def _set(self, wish: EncodingTarget) -> None:
        if wish != self.target:
            self.target = wish
            self._frames, self._bytes = 0, 0.0
