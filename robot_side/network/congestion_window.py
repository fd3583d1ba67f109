"""Estimate from delays alone how many frames may be in flight. Pure.

A frame sent alone shows the delay of the link. A frame behind another one has the same delay on a long link, but waits
on a slow link or for a slow peer. So the window grows while no frame waits. The data rate while a frame waits is the
capacity of the link. After two attempts with the same capacity, the next attempt comes much later: a camera's own JPEG
of 46 kB takes 184 ms at 2 Mbit/s, and a frame behind it is twice as old.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

_ALONE_KEPT: Final = 3
# Three waiting frames in a row are a queue. Fewer can be an effect of the radio.
_BEHIND_KEPT: Final = 3
# At this multiple of the link's own delay, two frames in a row are a queue.
_GROSS: Final = 1.75
_JITTER_US: Final = 5_000
# A change by a sixth of the delay is not a queue.
_JITTER_SHARE: Final = 6
_FIRST_PAUSE_US: Final = 500_000
# Pause after a window that was too wide. An attempt costs age, so the pause doubles each time ...
_LONGEST_PAUSE_US: Final = 4_000_000
# ... unless a wider window worked for this long and this many answers. On a lossy link the width is not the cause.
_HELD_US: Final = 1_000_000
_HELD_ANSWERS: Final = 12
# Time for which a measured rate limits the width. An attempt beyond it only makes a few frames twice as old ...
_THIN_US: Final = 30_000_000
# ... if the last attempt measured the same rate within this factor. The effect of losses seldom repeats ...
_ALIKE: Final = 1.15
# ... unless a frame alone takes less than this share of its former time. The link is then faster than before.
_THINNER: Final = 0.8
# Share of a frame's time at the measured rate, which is inaccurate. A frame cannot pass in less time.
_LEAST: Final = 0.6
# Intervals from which a frame counts as large. Behind a smaller one the next frame may wait briefly.
_LARGE: Final = 2
# Share of the time between answers. A peer that computes for longer is the bottleneck, not the link.
_PEER_BOUND_SHARE: Final = 0.7

# Intervals per frame. A link that carries nearly the camera's rate is not full, even with jitter.
_KEEPS_UP: Final = 1.05


@dataclass(frozen=True, slots=True)
class AckSample:
    """Measurements of one answer. `delay_us` excludes the peer's computing.

    `held_back`: the frame was due before there was credit. `behind`: another frame was in flight when it left.
    `followed`: another frame left before its answer, which waits behind it on a medium for both directions. If neither
    is True, the frame had the link to itself. `gap_us` is the time since the last answer, or since the link began to
    carry the frame. `gap_frames` and `gap_bytes` were carried in that time, including frames that a newer one overtook.
    """

    delay_us: int
    behind: bool
    followed: bool
    held_back: bool
    gap_us: int
    gap_frames: int
    gap_bytes: int
    compute_us: int


@dataclass(frozen=True, slots=True)
class LinkCapacity:
    """The capacity of a full link. A frame took `delay_us` behind others."""

    bytes_per_s: float
    delay_us: int


@dataclass(frozen=True, slots=True)
class _MeasuredRate:
    """The rate of the link while a wider window made frames wait. A frame alone took `own_us` at that time."""

    bytes_per_s: float
    own_us: int
    until_us: int

    def frame_us(self, frame_bytes: float) -> float:
        """Return the time in us for which a frame occupies the link."""
        return frame_bytes * 1e6 / self.bytes_per_s


class CongestionWindow:
    """The number of `frames` that may be in flight, from 1 to `most`: one more for each `interval_us` of delay."""

    def __init__(self, interval_us: int, most: int) -> None:
        self._interval_us, self._most = interval_us, most
        self._alone_us: deque[int] = deque(maxlen=_ALONE_KEPT)
        self._behind: deque[AckSample] = deque(maxlen=_BEHIND_KEPT)
        self._since_change = self._carried_us = self._carried_bytes = 0
        self._compute_us = 0.0
        self._grow_at_us = self._changed_at_us = 0
        self._pause_us = _FIRST_PAUSE_US
        self._failed = False
        self._thin: _MeasuredRate | None = None
        self._rate_bytes_per_s = 0.0
        self._frame_bytes = 0.0
        self.frames = 1

    @property
    def own_delay_us(self) -> int | None:
        """Return the delay of the link without a queue, or None before the first measurement."""
        return min(self._alone_us, default=None)

    def is_floor(self, delay_us: int, jitter_us: float) -> bool:
        """Return True if this is a delay without a queue."""
        own_us = self.own_delay_us
        return own_us is not None and delay_us <= own_us + _slack_us(own_us) + jitter_us

    def on_answer(self, answered: AckSample, now_us: int) -> LinkCapacity | None:
        """Adapt the window to an answer.

        Args:
            answered: the measurements of one answer.
            now_us: monotonic clock.

        Returns:
            The capacity of a link that is slower than the camera, otherwise None.
        """
        self._since_change += 1
        self._compute_us += 0.3 * (answered.compute_us - self._compute_us)
        each_bytes = answered.gap_bytes / answered.gap_frames
        self._frame_bytes = each_bytes if not self._frame_bytes else 0.7 * self._frame_bytes + 0.3 * each_bytes
        self._carried_us += answered.gap_us
        self._carried_bytes += answered.gap_bytes
        if answered.behind or (answered.followed and self._waited(answered.delay_us)):
            self._behind.append(answered)
        if answered.behind or answered.followed:
            self._lower_own_delay(answered.delay_us)
        else:
            self._alone_us.append(answered.delay_us)
        if self._is_queue():
            return self._narrowed(now_us)
        self._widen(now_us)
        return None

    def _lower_own_delay(self, delay_us: int) -> None:
        """Note a shorter link, by a frame that was not alone and still faster."""
        own_us = self.own_delay_us
        if own_us is not None and delay_us < own_us:
            self._alone_us.append(delay_us)

    def _waited(self, delay_us: int) -> bool:
        own_us = self.own_delay_us
        return own_us is not None and delay_us > own_us + _slack_us(own_us)

    def _is_queue(self) -> bool:
        own_us = self.own_delay_us
        if own_us is None or not any(one.held_back for one in self._behind):
            return False  # the camera never waited, so a variation of the delay is only jitter
        waited_us = [one.delay_us for one in self._behind]
        if len(waited_us) >= _BEHIND_KEPT - 1 and min(waited_us[1 - _BEHIND_KEPT :]) > _GROSS * own_us + _JITTER_US:
            return True
        return len(waited_us) == _BEHIND_KEPT and min(waited_us) > own_us + _slack_us(own_us)

    def _waited_us(self) -> int:
        return min(one.delay_us for one in self._behind)

    def _narrowed(self, now_us: int) -> LinkCapacity | None:
        full, own_us = self._full(), self.own_delay_us or 0
        kept = round(self.frames * own_us / max(1, self._waited_us()))
        if kept < self.frames:
            held = now_us - self._changed_at_us >= _HELD_US and self._since_change >= _HELD_ANSWERS
            if held:
                self._pause_us = _FIRST_PAUSE_US
            elif now_us >= self._grow_at_us:  # in a pause these frames belong to the last attempt
                self._pause_us = min(2 * self._pause_us, _LONGEST_PAUSE_US)
            self._grow_at_us = now_us + self._pause_us
            self._failed = True
            self._note_rate(full, own_us, now_us)
            self._set(max(1, kept), now_us)
        self._behind.clear()  # each waiting frame counts once
        return full

    def _note_rate(self, full: LinkCapacity | None, own_us: int, now_us: int) -> None:
        before, now = self._rate_bytes_per_s, self._carried_bytes * 1e6 / max(1, self._carried_us) if full else 0.0
        if min(now, before) * _ALIKE > max(now, before):
            self._thin = _MeasuredRate(now, own_us, now_us + _THIN_US)
        self._rate_bytes_per_s = now

    def _full(self) -> LinkCapacity | None:
        gap_us = sum(one.gap_us for one in self._behind)
        keeps_up = gap_us <= _KEEPS_UP * self._interval_us * sum(one.gap_frames for one in self._behind)
        peer_bound = sum(one.compute_us for one in self._behind) > _PEER_BOUND_SHARE * gap_us
        if keeps_up or peer_bound:
            return None
        return LinkCapacity(sum(one.gap_bytes for one in self._behind) * 1e6 / gap_us, self._waited_us())

    def _widen(self, now_us: int) -> None:
        """Widen the window if no frame waits, by doubling until the first failure."""
        own_us = self.own_delay_us
        if own_us is None or self._since_change < max(2, self.frames) or now_us < self._grow_at_us:
            return
        if self.frames > 1 and (len(self._behind) < _BEHIND_KEPT or self._waited_us() > own_us + _slack_us(own_us)):
            return
        useful = min(self._most, self._useful(own_us), self._fitting(own_us, now_us))
        wider = self.frames + 1 if self._failed else 2 * self.frames
        if useful != self.frames:
            self._set(min(useful, wider), now_us)

    def _useful(self, own_us: int) -> int:
        """Return the number of frames that are captured and processed while one is in flight."""
        # A reserve of half an interval, so that a slightly late answer delays no capture. Not for a peer that is slower
        # than the camera, because the additional frame would only wait for the peer.
        if self._compute_us > self._interval_us:
            return 1 + int(own_us / self._compute_us)
        return 1 + (own_us + self._interval_us // 2) // self._interval_us

    def _fitting(self, own_us: int, now_us: int) -> int:
        """Return the number of frames that the link carries in parallel at its measured rate."""
        thin = self._thin
        frame_us = thin.frame_us(self._frame_bytes) if thin else 0.0
        if thin is None or now_us >= thin.until_us or own_us < max(_THINNER * thin.own_us, _LEAST * frame_us):
            self._thin = None
            return self._most
        return self._most if frame_us < _LARGE * self._interval_us else max(1, round(own_us / frame_us))

    def on_timeout(self, now_us: int) -> None:
        """Narrow the window to one frame after an overdue answer, until the frames in flight have left the link."""
        self._grow_at_us = max(self._grow_at_us, now_us + (self.own_delay_us or 0))
        self._set(1, now_us)

    def _set(self, frames: int, now_us: int) -> None:
        self.frames = frames
        self._since_change = self._carried_us = self._carried_bytes = 0
        self._changed_at_us = now_us
        self._behind.clear()


def _slack_us(own_us: int) -> int:
    """Return the change of delay that does not count as a queue."""
    return max(_JITTER_US, own_us // _JITTER_SHARE)
