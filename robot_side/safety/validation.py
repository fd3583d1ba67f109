"""Validate the frame that a command cites against the robot's own record. Pure.

No rule trusts the sender. A frame is known because this robot issued it. Its age comes from the robot's own clock.
"""

from collections import OrderedDict
from dataclasses import dataclass

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import AnswerHeader, Echo, State, Twist

# 8 s of frames at 30 fps. An older frame is STALE long before it leaves the record.
_KEPT_PER_CHANNEL = 256
# A peer can invent any number of sessions, so the memory for them is bounded.
_KEPT_SENDERS = 64
_SENDER_MEMORY_US = 10_000_000
_SeqTable = OrderedDict[tuple[str, str], tuple[int, int]]
# A year of commands at 100 Hz, and ten hours of lost commands at 30 Hz. A forged number near 2^53 blocks its owner.
_MAX_FIRST_SEQ, _MAX_SEQ_JUMP = 2**32, 2**20
# 8 s at 30 fps. A camera that repeats its buffers has up to 32 of them.
_KEPT_IMAGES = 256


@dataclass(frozen=True, slots=True)
class CommandResult:
    """The result of a command. `reason` is None for an accepted command. `age_us` is the age of the cited frame."""

    reason: RejectReason | None
    detail: str = ""
    age_us: int | None = None

    @property
    def accepted(self) -> bool:
        """Return True if the command may move the wheels."""
        return self.reason is None


@dataclass(frozen=True, slots=True)
class AcceptedCommand:
    """An accepted command.

    Args:
        twist: limited twist, m/s and rad/s.
        echo_us: capture time of the cited frame; for a guest the arrival time.
        arrival_us: arrival time.
        life_us: time after arrival for which the command is valid.
        cites_frame: False for a command without a header, whose image has an unknown age.
    """

    twist: Twist
    echo_us: int
    arrival_us: int
    life_us: int
    cites_frame: bool


@dataclass(frozen=True, slots=True)
class Decision:
    """The twist for the wheels now, with the state and the reason."""

    twist: Twist
    state: State
    reason: str


class IssuedRecord:
    """Stores the time of each message of this robot session by channel and sequence number, bounded per channel."""

    def __init__(self, session: str) -> None:
        self.session = session
        self._times: dict[str, OrderedDict[int, int]] = {}
        self._denied_seq = -1

    def add(self, channel: str, seq: int, t_us: int) -> None:
        """Store a message. Call this before publishing it, so that no answer can arrive earlier.

        Args:
            channel: name of the channel, e.g. "frame".
            seq: its sequence number.
            t_us: capture time of a frame, otherwise the time of publication.
        """
        times = self._times.setdefault(channel, OrderedDict())
        times[seq] = t_us
        if len(times) > _KEPT_PER_CHANNEL:
            times.popitem(last=False)

    def last_seq(self, channel: str) -> int:
        """Return the newest sequence number issued on `channel`, or -1 before the first."""
        return next(reversed(self._times.get(channel, OrderedDict({-1: 0}))))

    def deny_earlier(self) -> None:
        """Reject requests that cite a status issued before this call."""
        # Such a request answers a situation that has just ended. After a STOP it would arm the robot again.
        self._denied_seq = self.last_seq("status")

    def check_request(self, echo: Echo | None, now_us: int, max_age_us: int) -> None:
        """Check the status that a request cites.

        Args:
            echo: the cited status, or None.
            now_us: time on the robot's clock.
            max_age_us: largest age of the status.

        Raises:
            WireError: MALFORMED without a status, STALE before the last STOP or disarm, or any reason of `age_us`.
        """
        if echo is None or echo.channel != "status":
            raise WireError(RejectReason.MALFORMED, "a request that permits motion must cite a status")
        self.age_us(echo, now_us, max_age_us)
        if echo.seq <= self._denied_seq:
            raise WireError(
                RejectReason.STALE, "cites a status from before the last STOP or disarm; repeat the request"
            )

    def age_us(self, echo: Echo, now_us: int, max_age_us: int) -> int:
        """Compute the age of a cited message from this robot's own record.

        Args:
            echo: channel, session, sequence number and time as the sender cites them.
            now_us: time on the robot's clock.
            max_age_us: largest permitted age.

        Returns:
            The age in us.

        Raises:
            WireError: OTHER_SESSION, UNKNOWN_FRAME, FROM_FUTURE or STALE.
        """
        if echo.session != self.session:
            raise WireError(RejectReason.OTHER_SESSION, f"cites robot session {echo.session}, this is {self.session}")
        times = self._times.get(echo.channel, OrderedDict())
        # The time must match, too, because a peer that guesses a sequence number must not choose the age.
        if times.get(echo.seq) != echo.t_us:
            raise WireError(RejectReason.UNKNOWN_FRAME, f"cites {echo.channel} {echo.seq}, unknown to this robot")
        age_us = now_us - echo.t_us
        if age_us < 0:
            raise WireError(
                RejectReason.FROM_FUTURE, f"cites {echo.channel} {echo.seq}, {-age_us / 1e3:.0f} ms in the future"
            )
        if age_us > max_age_us:
            raise WireError(
                RejectReason.STALE,
                f"{echo.channel} {echo.seq} is {age_us / 1e3:.0f} ms old, at most {max_age_us / 1e3:.0f}",
            )
        return age_us


class FreshnessRecord:
    """Stores when the image of each frame first appeared, byte for byte, and the time of the newest new image."""

    def __init__(self) -> None:
        self._first_us: OrderedDict[int, int] = OrderedDict()  # by fingerprint
        self._shown_us: OrderedDict[int, int] = OrderedDict()  # by capture time
        self._newest_us = self._changed_us = 0

    def add(self, t_us: int, fingerprint: int) -> None:
        """Record an issued frame.

        Args:
            t_us: capture time.
            fingerprint: checksum of the image; 0 for a source that is not live and may repeat an image.
        """
        # The noise of a live sensor never repeats, so an earlier image means a frozen camera or repeated buffers.
        if fingerprint == 0 or fingerprint not in self._first_us:
            self._changed_us = self._first_us[fingerprint] = t_us
            if len(self._first_us) > _KEPT_IMAGES:
                self._first_us.popitem(last=False)
        self._newest_us = t_us
        # For each frame, because a late command may cite the frozen image after the camera delivers new ones again.
        self._shown_us[t_us] = self._first_us[fingerprint]
        if len(self._shown_us) > _KEPT_IMAGES:
            self._shown_us.popitem(last=False)

    def unchanged_us(self) -> int:
        """Return the time in us since the last new image."""
        return self._newest_us - self._changed_us

    def shown_since_us(self, t_us: int) -> int:
        """Return the time at which the image of the frame captured at `t_us` first appeared."""
        return self._shown_us.get(t_us, t_us)


class RepeatRecord:
    """Stores how long, and how far, the robot has driven with one unchanged command without a header."""

    def __init__(self) -> None:
        self._twist: Twist | None = None
        self._since_us = 0
        self._driven_m = 0.0

    def add(self, twist: Twist, now_us: int) -> None:
        """Record an accepted command at its arrival. Only a different command restarts the record."""
        # A pause does not restart it, because a client that sends in bursts may repeat one old image, too.
        if twist != self._twist:
            self._twist, self._since_us, self._driven_m = twist, now_us, 0.0

    def drive(self, linear_mps: float, elapsed_us: int) -> None:
        """Add the distance of one step."""
        self._driven_m += abs(linear_mps) * elapsed_us / 1e6

    def is_over(self, max_us: int, max_m: float, now_us: int) -> bool:
        """Return True if the command has been the same for more than `max_us` or `max_m`."""
        return now_us - self._since_us > max_us or self._driven_m > max_m


class SequenceRecord:
    """Stores the newest sequence number of each (source, session), for a bounded number of senders.

    The senders that held the lease have a separate table, so that rejected senders never remove them.
    """

    def __init__(self) -> None:
        self._drivers: _SeqTable = OrderedDict()
        self._others: _SeqTable = OrderedDict()

    def check(self, header: AnswerHeader, now_us: int) -> None:
        """Store the sequence number of a command.

        Raises:
            WireError: OUT_OF_ORDER if it is not newer than all others of this source and session, or jumps too far.
        """
        sender = (header.source, header.session)
        table = self._drivers if sender in self._drivers else self._others
        seq, stored_us = table.get(sender, (-1, 0))
        # An older frame is STALE, so a replay is impossible.
        is_known = seq >= 0 and now_us - stored_us <= _SENDER_MEMORY_US
        if is_known and header.seq <= seq:
            raise WireError(RejectReason.OUT_OF_ORDER, f"seq {header.seq} of {header.source} is not newer than {seq}")
        if header.seq > (seq + _MAX_SEQ_JUMP if is_known else _MAX_FIRST_SEQ):
            raise WireError(
                RejectReason.OUT_OF_ORDER, f"seq {header.seq} of {header.source} jumps too far; start a new session"
            )
        _store(table, sender, (header.seq, now_us))

    def promote(self, sender: tuple[str, str]) -> None:
        """Move a sender to the drivers, after its command took or renewed the lease."""
        if sender in self._others:
            _store(self._drivers, sender, self._others.pop(sender))


def _store(table: _SeqTable, sender: tuple[str, str], entry: tuple[int, int]) -> None:
    table[sender] = entry
    table.move_to_end(sender)
    if len(table) > _KEPT_SENDERS:
        table.popitem(last=False)
