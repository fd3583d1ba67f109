"""Decide when to send a frame: credit, timeouts, rate. Pure.

A frame is captured only with credit, so it is young when it leaves and no queue grows. An answer (an accepted or
rejected twist, or an ack) returns credit. The window starts at one frame in flight. It widens only for the delay of the
link (`congestion_window`), never for a slow detector. With an 80 ms detector, one frame in flight is 81-83 ms old, and
two are 141-175 ms old. On a slow link the images become smaller (`bitrate_control`).

Loss is not a queue. Frames without an answer between two answers at floor delay are lost. Such losses, also as many in
a row as their statistics explain, change nothing: the stream continues at its rate. A queue delays the answers, and an
outage lasts longer. Then the stream slows down.

Sources: BBR (Linux, `net/ipv4/tcp_bbr.c`): the lowest recent delay is that of the path and gives the data in flight.
A loss is not a signal. WebRTC (draft-ietf-rmcat-gcc-02): a growing delay lowers the rate. Its separate controller for
loss ignores a few percent. Here no share of loss counts, because a slower stream loses the same share. Both sources
wait for answers. Here a silence counts, too, because a robot without commands must stop.
"""

from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import Holder
from sightline.robot_side.network.bitrate_control import BitrateControl, EncodingTarget
from sightline.robot_side.network.congestion_window import AckSample, CongestionWindow

_FIRST_TIMEOUT_US = 120_000
_REMEMBERED = 64
_TIMEOUT_SLACK_US = 12_000  # with a quick peer, below one interval at 30 fps: a loss then costs one frame, not two
_PENDING_US = 1_000_000  # a frame without an answer or a newer answer for this long was lost
# One overdue answer can be a loss. A second one, of a frame that was sent after the first timeout, is a queue.
_OVERDUE_IN_A_ROW = 2
# Time without a loss after which the link counts as free of losses again.
_LOSS_MEMORY_US = 30_000_000
# Weight of the earlier losses at each new loss. About the last fifty count.
_LOSS_WEIGHT = 0.98
# Loss explains a silence that is expected at least once in so many losses. Otherwise it is a queue or an outage.
_LOSSES_PER_SILENCE = 10_000
# A longer silence is an outage. The robot holds after the same time without a command.
_LONGEST_LOSS_US = 300_000


class StreamConfig(Config):
    """Flow of frames."""

    max_fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    """Most frames per second."""
    max_window: Annotated[int, Field(ge=1, le=32)] = 12
    """Most frames in flight."""
    max_credit_timeout_ms: Annotated[int, Field(ge=20, le=5_000)] = 500
    """Longest wait for an answer before the credit of a frame returns."""
    owner_life_ms: Annotated[int, Field(ge=100, le=10_000)] = 1_000
    """Silence after which the answers of another peer may return credit."""
    adapt: bool = True
    """True to reduce quality and size of the images on a slow link, if the camera can follow."""


@dataclass(slots=True)
class _Sent:
    at_us: int
    size_bytes: int
    behind: bool
    held_back: bool
    followed: bool = False


class LossRecord:
    """Counts the frames that the link lost, and distinguishes them from frames in a queue."""

    def __init__(self) -> None:
        self._at_floor = False
        self._until_us = 0
        # Sums over the runs of lost frames, the newest with weight 1.
        self._frames, self._runs = 0.5, 0.0

    def add(self, lost: int, at_floor: bool, silence_us: int, now_us: int) -> None:
        """Note an answer.

        Args:
            lost: number of older frames without an answer.
            at_floor: True if the answer took the delay of a link without a queue.
            silence_us: time since the answer before it.
            now_us: monotonic clock.
        """
        was_at_floor, self._at_floor = self._at_floor, at_floor
        if lost and was_at_floor and at_floor and silence_us <= _LONGEST_LOSS_US:
            self._frames = _LOSS_WEIGHT * self._frames + lost
            self._runs = _LOSS_WEIGHT * self._runs + 1
            self._until_us = now_us + _LOSS_MEMORY_US

    def is_recent(self, now_us: int) -> bool:
        """Return True if the link lost frames recently, and has no queue now."""
        return self._at_floor and now_us < self._until_us

    def explains(self, overdue: int, silence_us: int, now_us: int) -> bool:
        """Return True if the link is expected to lose so many frames in a row.

        Args:
            overdue: frames whose answer is overdue, since the last answer.
            silence_us: time since the last answer.
            now_us: monotonic clock.
        """
        if not self.is_recent(now_us):
            return False
        # Share of the lost frames that were followed by another lost frame.
        again = 1 - self._runs / self._frames
        return silence_us <= _LONGEST_LOSS_US and again**overdue * _LOSSES_PER_SILENCE >= 1


class Stream:
    """Controls the flow of one camera. The caller checks `may_capture`, and calls `on_sent` and `on_answer`."""

    def __init__(self, config: StreamConfig) -> None:
        self._config = config
        self._interval_us = round(1e6 / config.max_fps)
        self._in_flight: dict[int, int] = {}  # seq -> timeout of its credit
        self._sent_frames: OrderedDict[int, _Sent] = OrderedDict()  # also frames after the timeout of their credit
        self._owner: Holder | None = None
        self._owner_until_us = 0
        self._congestion_window = CongestionWindow(self._interval_us, config.max_window)
        self._bitrate_control = BitrateControl()
        self._answer_us: float | None = None
        self._spread_us = 0.0
        self._answered_at_us = 0
        self._overdue = self._overdue_at_us = 0
        self._may_probe = False
        self._losses = LossRecord()
        self._held_back = False
        self._next_us = 0
        self.sent = self.credit_timeouts = self.overtaken = 0
        self._sent_us: deque[int] = deque(maxlen=256)

    @property
    def window(self) -> int:
        """Return the number of frames that may be in flight."""
        return self._congestion_window.frames

    @property
    def _has_credit(self) -> bool:
        """Return True if one more frame may be sent."""
        # While answers are overdue, one frame per timeout tests the link. More frames would only lengthen the queue.
        if self._overdue:
            return self._may_probe or not self._in_flight
        return len(self._in_flight) < self.window

    @property
    def encoding_target(self) -> EncodingTarget:
        """Return the encoding of the next image."""
        return self._bitrate_control.target if self._config.adapt else EncodingTarget()

    # --- sending -------------------------------------------------------------------------------------------------

    def may_capture(self, now_us: int, listening: bool) -> bool:
        """Return True if a peer listens, the frame interval is over and the stream has credit."""
        self._expire(now_us)
        if not listening or now_us < self._next_us:
            return False
        free = self._has_credit
        self._held_back |= not free
        return free

    def wait_us(self, now_us: int) -> int:
        """Return the time in us after which the interval or a credit timeout can change `may_capture`."""
        blocked_until_us = min(self._in_flight.values(), default=0) if not self._has_credit else 0
        return max(0, max(self._next_us, blocked_until_us) - now_us)

    def early_us(self, now_us: int) -> int:
        """Return the time in us until the interval is over. Until then no answer permits a frame."""
        return max(0, self._next_us - now_us)

    def on_sent(self, seq: int, t_us: int, now_us: int, size_bytes: int = 0) -> None:
        """Note a sent frame.

        Args:
            seq: its sequence number.
            t_us: capture time.
            now_us: monotonic clock.
            size_bytes: size of the JPEG, or 0 if unknown.
        """
        self._in_flight[seq] = now_us + self._timeout_us(now_us)
        self._may_probe = False
        pending = [one for one in self._sent_frames.values() if now_us - one.at_us <= _PENDING_US]
        for one in pending:
            one.followed = True
        self._sent_frames[seq] = _Sent(now_us, size_bytes, bool(pending), self._held_back)
        self._held_back = False
        if len(self._sent_frames) > _REMEMBERED:
            self._sent_frames.popitem(last=False)
        # The next frame is due by capture time, so that a late send does not reduce the rate. With a tenth of slack, a
        # camera that is slightly faster than `max_fps` is not read one tick too late.
        self._next_us = t_us + self._interval_us * 9 // 10
        self.sent += 1
        self._sent_us.append(now_us)
        self._bitrate_control.on_sent(size_bytes, now_us)

    # --- answers -------------------------------------------------------------------------------------------------

    def on_answer(self, who: Holder, seq: int, compute_us: int, now_us: int) -> bool:
        """Note an answer.

        Args:
            who: sender of the answer.
            seq: answered frame.
            compute_us: computing time of the sender.
            now_us: monotonic clock.

        Returns:
            True if it returned credit. Only the owner of the credit can.
        """
        if not self._owns(who, now_us):
            return False
        # The peer uses only the newest frame, so frames older than the answered one never get an answer.
        passed = {old: self._sent_frames.pop(old) for old in tuple(self._sent_frames) if old <= seq}
        if seq in passed:
            self.overtaken += len(passed) - 1
            self._measure(passed[seq], list(passed.values()), compute_us, now_us)
        answered = [old for old in self._in_flight if old <= seq]
        for old in answered:
            del self._in_flight[old]
        return bool(answered)

    def release(self) -> None:
        """Return the credit of all frames in flight, because a new driver did not receive them."""
        self._in_flight.clear()

    def on_holder(self, holder: Holder | None, now_us: int) -> None:
        """Pass the credit to a new holder of the lease."""
        if holder is not None and holder != self._owner:
            self._hand_over(holder)
            self._owner_until_us = now_us + self._config.owner_life_ms * 1000
            self._in_flight.clear()

    def _owns(self, who: Holder, now_us: int) -> bool:
        if who != self._owner and (self._owner is None or now_us >= self._owner_until_us):
            self._hand_over(who)
        if who != self._owner:
            return False
        self._owner_until_us = now_us + self._config.owner_life_ms * 1000
        return True

    def _hand_over(self, owner: Holder) -> None:
        """Pass the credit to another peer."""
        # The times and the capacity of the former peer do not apply to a successor on another link.
        self._owner = owner
        self._losses = LossRecord()
        self._answer_us, self._spread_us, self._overdue = None, 0.0, 0
        self._congestion_window = CongestionWindow(self._interval_us, self._config.max_window)

    def _measure(self, sent: _Sent, passed: list[_Sent], compute_us: int, now_us: int) -> None:
        # A negative computing time would look like a longer link, and widen the window.
        compute_us, answer_us = max(0, compute_us), max(0, now_us - sent.at_us)
        delay_us = max(0, answer_us - compute_us)
        if self._answer_us is None or answer_us <= self._usual_us():
            self._overdue = self._overdue_at_us = 0
        self._remember_answer(answer_us)
        silence_us = now_us - self._answered_at_us
        carrying_since_us = max(self._answered_at_us, passed[0].at_us)
        carried = sum(one.size_bytes for one in passed)
        self._answered_at_us = now_us
        gap_us = now_us - carrying_since_us
        answered = AckSample(
            delay_us, sent.behind, sent.followed, sent.held_back, gap_us, len(passed), carried, compute_us
        )
        full = self._congestion_window.on_answer(answered, now_us)
        at_floor = self._congestion_window.is_floor(delay_us, self._spread_us)
        self._losses.add(len(passed) - 1, at_floor, silence_us, now_us)
        if full is None:
            self._bitrate_control.on_delay(delay_us, now_us)
        else:
            self._bitrate_control.on_full(full, now_us)

    def _remember_answer(self, answer_us: int) -> None:
        """Update the mean and the spread of the answer time. Source: RFC 6298."""
        if self._answer_us is None:
            self._answer_us, self._spread_us = float(answer_us), answer_us / 8
            return
        self._spread_us = 0.75 * self._spread_us + 0.25 * abs(answer_us - self._answer_us)
        self._answer_us = 0.875 * self._answer_us + 0.125 * answer_us

    # --- timeouts ------------------------------------------------------------------------------------------------

    def _timeout_us(self, now_us: int) -> int:
        """Return the timeout of the next frame in us."""
        longest_us = self._config.max_credit_timeout_ms * 1000
        usual_us = self._usual_us(is_lossy=not self._overdue and self._losses.is_recent(now_us))
        # It doubles with each further timeout, because a late answer may wait behind the frames in flight.
        return min(longest_us, round(usual_us * (1 << min(max(0, self._overdue - 1), 8))))

    def _usual_us(self, *, is_lossy: bool = False) -> float:
        """Return the answer time in us above which a frame is overdue."""
        if self._answer_us is None:
            return float(_FIRST_TIMEOUT_US)
        if is_lossy:
            # A lost frame must not hold its credit for longer than an answer takes.
            return self._answer_us + max(_TIMEOUT_SLACK_US, 2 * self._spread_us)
        patient_us = max(1.5 * self._answer_us, self._answer_us + 4 * self._spread_us)
        return min(patient_us, 2 * self._answer_us) + _TIMEOUT_SLACK_US

    def _sent_at_us(self, seq: int) -> int:
        sent = self._sent_frames.get(seq)
        return 0 if sent is None else sent.at_us

    def _expire(self, now_us: int) -> None:
        late = [seq for seq, expires_us in self._in_flight.items() if now_us >= expires_us]
        for seq in late:
            del self._in_flight[seq]
            self.credit_timeouts += 1
        overdue = len(self._sent_frames) - len(self._in_flight)
        is_loss = self._losses.explains(overdue, now_us - self._answered_at_us, now_us)
        if is_loss or self._answer_us is None:
            return
        if any(self._sent_at_us(seq) >= self._overdue_at_us for seq in late):
            self._overdue += 1
            self._overdue_at_us = now_us
            self._may_probe = True
            if self._overdue >= _OVERDUE_IN_A_ROW:
                self._congestion_window.on_timeout(now_us)
                self._bitrate_control.on_overdue(now_us)

    def fps(self, now_us: int) -> float:
        """Return the number of frames of the last second."""
        return float(sum(1 for sent_us in self._sent_us if now_us - sent_us <= 1_000_000))
