"""What to send and when: credit, its timeout, the window, the rate. Pure.

A frame is captured only while there is credit, so it is young when it leaves and nothing queues behind it. An answer (a
twist accepted or refused, or an ack) returns credit. The window starts at one frame in flight and widens only for the
link's own delay (answer time less the peer's computing), never for a slow detector: with an 80 ms detector one frame
in flight is 81-83 ms old where two are 141-175.
"""

from collections import OrderedDict, deque
from typing import Annotated

from pydantic import Field

from protocol.config import Config
from protocol.messages import Holder, StreamStatus

_FIRST_TIMEOUT_US = 120_000
_REMEMBERED = 64
_DELAYS_KEPT = 12
_TIMEOUT_SLACK_US = 12_000  # with a quick peer, below one interval at 30 fps: a loss then costs one frame, not two


class StreamConfig(Config):
    """Flow of frames."""

    max_fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    max_window: Annotated[int, Field(ge=1, le=32)] = 12
    """Most frames in flight, on a link however long."""
    max_credit_timeout_ms: Annotated[int, Field(ge=20, le=5_000)] = 500
    owner_life_ms: Annotated[int, Field(ge=100, le=10_000)] = 1_000
    """Silence after which another peer's answers may return credit."""


class Stream:
    """Decides for one camera. The caller asks `may_capture`, tells `on_sent`, and hands every answer in."""

    def __init__(self, config: StreamConfig) -> None:
        self._config = config
        self._interval_us = round(1e6 / config.max_fps)
        self._in_flight: dict[int, int] = {}  # seq -> when its credit times out
        self._sent_at_us: OrderedDict[int, int] = OrderedDict()  # also of frames whose credit has timed out
        self._owner: Holder | None = None
        self._owner_until_us = 0
        self._delays_us: deque[int] = deque(maxlen=_DELAYS_KEPT)
        self._answer_us: float | None = None
        self._next_us = 0
        self._sent = self._credit_timeouts = 0
        self._sent_us: deque[int] = deque(maxlen=256)

    # --- sending -------------------------------------------------------------------------------------------------

    def may_capture(self, now_us: int, listening: bool) -> bool:
        """Whether to take the next picture now: somebody listens, it is time, and there is credit."""
        self._expire(now_us)
        return listening and now_us >= self._next_us and len(self._in_flight) < self.window

    def wait_us(self, now_us: int) -> int:
        """How long until time or a credit timeout could change `may_capture`; an answer may change it sooner."""
        blocked_until_us = min(self._in_flight.values()) if len(self._in_flight) >= self.window else 0
        return max(0, max(self._next_us, blocked_until_us) - now_us)

    def on_sent(self, seq: int, t_us: int, now_us: int) -> None:
        """A frame captured at `t_us` left. The next is due by capture time: a late send costs no rate."""
        self._in_flight[seq] = now_us + self._timeout_us()
        self._sent_at_us[seq] = now_us
        if len(self._sent_at_us) > _REMEMBERED:
            self._sent_at_us.popitem(last=False)
        # A tenth of slack: a camera that ticks a hair faster than `max_fps` must not be asked one tick too late.
        self._next_us = t_us + self._interval_us * 9 // 10
        self._sent += 1
        self._sent_us.append(now_us)

    # --- answers -------------------------------------------------------------------------------------------------

    def on_answer(self, who: Holder, seq: int, compute_us: int, now_us: int) -> bool:
        """An answer to frame `seq` came. Returns whether it gave credit back: only its owner's answers do."""
        if not self._owns(who, now_us):
            return False
        sent_us = self._sent_at_us.pop(seq, None)
        if sent_us is not None:
            self._measure(now_us - sent_us, compute_us)
        # Newest wins at the peer: whatever is older than the answered frame will never be answered.
        answered = [old for old in self._in_flight if old <= seq]
        for old in answered:
            del self._in_flight[old]
        return bool(answered)

    def on_holder(self, holder: Holder | None, now_us: int) -> None:
        """The lease changed hands: credit goes to who drives."""
        if holder is not None and holder != self._owner:
            self._owner = holder
            self._owner_until_us = now_us + self._config.owner_life_ms * 1000
            self._in_flight.clear()

    def _owns(self, who: Holder, now_us: int) -> bool:
        if self._owner is None or now_us >= self._owner_until_us:
            self._owner = who
        if who != self._owner:
            return False
        self._owner_until_us = now_us + self._config.owner_life_ms * 1000
        return True

    def _measure(self, answer_us: int, compute_us: int) -> None:
        self._delays_us.append(max(0, answer_us - compute_us))
        self._answer_us = answer_us if self._answer_us is None else 0.9 * self._answer_us + 0.1 * answer_us

    # --- window and timeout --------------------------------------------------------------------------------------

    @property
    def window(self) -> int:
        """Frames that may be in flight: as many as the camera makes while the link alone carries one round trip.

        The smallest of the last delays is taken, because waiting in a peer's slot is no delay of the link.
        """
        if not self._delays_us:
            return 1
        return min(self._config.max_window, 1 + min(self._delays_us) // self._interval_us)

    def _timeout_us(self) -> int:
        longest_us = self._config.max_credit_timeout_ms * 1000
        if self._answer_us is None:
            return min(_FIRST_TIMEOUT_US, longest_us)
        return min(longest_us, round(1.5 * self._answer_us) + _TIMEOUT_SLACK_US)

    def _expire(self, now_us: int) -> None:
        late = [seq for seq, expires_us in self._in_flight.items() if now_us >= expires_us]
        for seq in late:
            del self._in_flight[seq]
            self._credit_timeouts += 1

    def status(self, now_us: int, dropped_commands: int = 0) -> StreamStatus:
        """Counters and the rate over the last second."""
        recent = sum(1 for sent_us in self._sent_us if now_us - sent_us <= 1_000_000)
        return StreamStatus(
            sent=self._sent,
            credit_timeouts=self._credit_timeouts,
            window=self.window,
            fps=float(recent),
            dropped_commands=dropped_commands,
        )
