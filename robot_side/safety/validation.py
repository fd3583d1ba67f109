"""Validates what a command cites against the robot's own record of issued frames. Pure.

Nothing here trusts a sender: a frame is known because this robot issued it, and its age is by the robot's clock.
"""

from collections import OrderedDict
from dataclasses import dataclass

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import AnswerHeader, Echo, State, Twist

_KEPT_PER_CHANNEL = 256  # 8 s of 30 fps frames; anything older is STALE long before
_KEPT_SENDERS = 64


@dataclass(frozen=True, slots=True)
class CommandResult:
    """The result of a command. `reason` is None when it was accepted."""

    reason: RejectReason | None
    detail: str = ""
    age_us: int | None = None

    @property
    def accepted(self) -> bool:
        """Whether it may move the wheels."""
        return self.reason is None


@dataclass(frozen=True, slots=True)
class AcceptedCommand:
    """An accepted command. `echo_us` is when the frame behind it was captured (arrival for a guest)."""

    twist: Twist
    echo_us: int
    arrival_us: int
    life_us: int


@dataclass(frozen=True, slots=True)
class Decision:
    """What the wheels do now, and why."""

    twist: Twist
    state: State
    reason: str


class IssuedRecord:
    """(channel, seq) -> capture time of what this robot session has issued, bounded per channel."""

    def __init__(self, session: str) -> None:
        self.session = session
        self._times: dict[str, OrderedDict[int, int]] = {}
        self._denied_seq = -1

    def add(self, channel: str, seq: int, t_us: int) -> None:
        """Remember it; the caller calls this before it publishes."""
        times = self._times.setdefault(channel, OrderedDict())
        times[seq] = t_us
        if len(times) > _KEPT_PER_CHANNEL:
            times.popitem(last=False)

    def last_seq(self, channel: str) -> int:
        """The newest seq issued on `channel`, -1 before the first."""
        return next(reversed(self._times.get(channel, OrderedDict({-1: 0}))))

    def deny_earlier(self) -> None:
        """From now on no request may cite a status issued before: what it was for has just ended."""
        self._denied_seq = self.last_seq("status")

    def check_request(self, echo: Echo | None, now_us: int, max_age_us: int) -> None:
        """Raise WireError unless `echo` names a status young enough, and issued since requests were last denied."""
        if echo is None or echo.channel != "status":
            raise WireError(RejectReason.MALFORMED, "what lets a robot move again must cite a status")
        self.age_us(echo, now_us, max_age_us)
        if echo.seq <= self._denied_seq:
            raise WireError(RejectReason.STALE, "cites a status from before the last STOP or disarm; ask again")

    def age_us(self, echo: Echo, now_us: int, max_age_us: int) -> int:
        """Age of what `echo` names. Raises WireError OTHER_SESSION, UNKNOWN_FRAME, FROM_FUTURE or STALE."""
        if echo.session != self.session:
            raise WireError(RejectReason.OTHER_SESSION, f"cites robot session {echo.session}, this is {self.session}")
        times = self._times.get(echo.channel, OrderedDict())
        if times.get(echo.seq) != echo.t_us:
            raise WireError(RejectReason.UNKNOWN_FRAME, f"cites {echo.channel} {echo.seq}, which was not issued so")
        age_us = now_us - echo.t_us
        if age_us < 0:
            raise WireError(
                RejectReason.FROM_FUTURE, f"cites {echo.channel} {echo.seq} of {-age_us / 1e3:.0f} ms from now"
            )
        if age_us > max_age_us:
            raise WireError(
                RejectReason.STALE,
                f"{echo.channel} {echo.seq} is {age_us / 1e3:.0f} ms old, at most {max_age_us / 1e3:.0f}",
            )
        return age_us


class FreshnessRecord:
    """Since when the camera's picture has been the same, byte for byte. A live sensor's noise never repeats."""

    def __init__(self) -> None:
        self._fingerprint: int | None = None
        self._newest_us = self._changed_us = 0

    def add(self, t_us: int, fingerprint: int) -> None:
        """A frame captured at `t_us` was issued; `fingerprint` 0 is never compared (a source that is not live)."""
        if fingerprint == 0 or fingerprint != self._fingerprint:
            self._changed_us = t_us
        self._fingerprint, self._newest_us = fingerprint, t_us

    def unchanged_us(self) -> int:
        """For how long the picture has not changed."""
        return self._newest_us - self._changed_us

    def shown_since_us(self, t_us: int) -> int:
        """Since when that has been seen which a frame captured at `t_us` shows: a repeated picture is old sight."""
        return t_us if self._fingerprint is None else min(t_us, self._changed_us)


class SequenceRecord:
    """The newest seq per (source, session); the longest silent sender is forgotten first."""

    def __init__(self) -> None:
        self._last: OrderedDict[tuple[str, str], int] = OrderedDict()

    def check(self, header: AnswerHeader) -> None:
        """Raise WireError OUT_OF_ORDER unless `header.seq` is newer than all of its source and session; keep it."""
        sender = (header.source, header.session)
        last = self._last.get(sender, -1)
        if header.seq <= last:
            raise WireError(RejectReason.OUT_OF_ORDER, f"seq {header.seq} of {header.source} is not newer than {last}")
        self._last[sender] = header.seq
        self._last.move_to_end(sender)
        if len(self._last) > _KEPT_SENDERS:
            self._last.popitem(last=False)
