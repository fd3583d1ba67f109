"""Presence: each peer answers a query with its role, robot, host and version. Shell.

For people: `sightline robots`, the doctor, and a robot's check that nobody else has its id. No frame, no command and no
judgement of either depends on it.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import Field, ValidationError

from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError, LinkError, WireError
from sightline.protocol.messages import Microseconds, SessionId, Source, WireModel
from sightline.protocol.transports.security import PRESENCE_PREFIX, ROBOT_ROLE, certificate_role

if TYPE_CHECKING:
    import zenoh


PRESENCE_PATTERN: Final = f"{PRESENCE_PREFIX}/**"
MAX_BYTES: Final = 512
MAX_PEERS: Final = 256
"""Security limit: no more answers than this are kept, whatever a network claims."""
QUERY_ROUNDS: Final = 3
"""A first answer also pays for routes that nobody used before; the best of a few is the way itself."""

_PRINTED: Final = r"^[^\x00-\x1f\x7f-\x9f]*$"
_Line = Annotated[str, Field(max_length=64, pattern=_PRINTED)]
MAX_ABOUT: Final = 160


class Presence(WireModel):
    """What a peer says of itself. `clock_us` is its wall clock, to be shown and never to be judged by."""

    role: Source
    robot: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.*?-]{1,32}$")]
    session: SessionId
    software: _Line = ""
    host: _Line = ""
    about: Annotated[str | None, Field(max_length=MAX_ABOUT, pattern=_PRINTED)] = None
    """One line of those who serve others: what they run, on what, and how they fare."""
    up_us: Microseconds = 0
    clock_us: Microseconds = 0


@dataclass(frozen=True, slots=True)
class PeerInfo:
    """Somebody who answered, how long that took, and how far its wall clock is ahead of ours."""

    presence: Presence
    round_trip_us: int
    ahead_us: int


def presence_key(role: str, session: str) -> str:
    """Where a peer of `role` answers: under the role of its certificate, so that access rules can hold it to that."""
    return f"{PRESENCE_PREFIX}/{certificate_role(role)}/{session}"


def parse_presence_reply(key: str, payload: bytes, asked_us: int, answered_us: int, clock_us: int) -> PeerInfo | None:
    """The peer behind an answer; None for one that is no presence, or claims a role that its key is not of.

    Times are ours: monotonic when asked and answered, `clock_us` the wall clock of the answer's arrival.
    """
    try:
        presence = decode(Presence, payload, MAX_BYTES)
    except WireError:
        return None
    if key != presence_key(presence.role, presence.session):
        return None
    round_trip_us = max(0, answered_us - asked_us)
    return PeerInfo(presence, round_trip_us, presence.clock_us + round_trip_us // 2 - clock_us)


def best_round_trips(rounds: Iterable[Iterable[PeerInfo]]) -> list[PeerInfo]:
    """Each peer once, as it answered quickest, in the order in which people look for them."""
    best: dict[tuple[str, str], PeerInfo] = {}
    for peer in (peer for answers in rounds for peer in answers):
        name = (peer.presence.role, peer.presence.session)
        known = best.get(name)
        if known is None and len(best) >= MAX_PEERS:
            continue
        if known is None or peer.round_trip_us < known.round_trip_us:
            best[name] = peer
    return sorted(best.values(), key=_order)


def _order(peer: PeerInfo) -> tuple[int, str, str, str]:
    role = peer.presence.role
    known = (ROBOT_ROLE, "vision")
    return known.index(role) if role in known else len(known), role, peer.presence.robot, peer.presence.session


def robot_with_same_id(own: Presence, answers: Iterable[PeerInfo]) -> Presence | None:
    """The robot that had the id of `own` before it; None if nobody else has it.

    Of two that start at once the one that is up for longer stays. Its own session is a robot's earlier self.
    """
    for peer in answers:
        other = peer.presence
        if other.role == ROBOT_ROLE and other.robot == own.robot and other.session != own.session \
                and other.up_us > own.up_us:
            return other
    return None


# Presence over Zenoh: a peer answers one question, and only when it is asked. Shell.  A query that nobody asks costs
# nothing; an answer costs some microseconds. The way of frames and commands knows nothing of it. An answer comes from
# the living process itself, so who has died or hangs is not there.


REPLY_TIMEOUT_S: Final = 0.5
"""Who has not answered by then is not there."""
_SECOND_LOOK_S: Final = 1.0
"""What is left of a robot that has just ended is gone by then: it leaves when its socket closes."""
_HOST_CHARACTERS: Final = 64


class PresenceAnnouncer:
    """This end of a session: what it answers when it is asked. Raises ConfigError for a role that is none."""

    def __init__(self, role: str, robot: str, session: str, about: Callable[[], str] | None = None) -> None:
        """`about` is asked for its line each time, on Zenoh's thread."""
        self.role = role
        self._about = about
        self._began_ns = time.monotonic_ns()
        try:
            self._fixed = Presence(role=role, robot=robot, session=session, software=software_version(), host=_host())
        except ValidationError:
            raise ConfigError(f"role {role!r} of robot {robot!r} cannot be announced: a role is 1 to 16 lower-case "
                              "letters, digits or '_', e.g. vision") from None

    def now(self) -> Presence:
        """Of this moment."""
        up_us = (time.monotonic_ns() - self._began_ns) // 1000
        said = {"about": _printed(self._about())[:MAX_ABOUT]} if self._about else {}
        return self._fixed.model_copy(update={"up_us": up_us, "clock_us": time.time_ns() // 1000, **said})

    def answer_in(self, session: zenoh.Session) -> Callable[[], None]:
        """Answer whoever asks, until what this returns is called."""
        import zenoh

        key = presence_key(self._fixed.role, self._fixed.session)

        def answer(query: zenoh.Query) -> None:
            with suppress(zenoh.ZError):  # it went away, or waits no longer
                query.reply(key, encode(self.now()))

        handler = zenoh.handlers.Callback(answer, indirect=False)
        return session.declare_queryable(key, handler, allowed_origin=zenoh.Locality.REMOTE).undeclare

    def claim(self, session: zenoh.Session) -> None:
        """Raise LinkError if another robot that is reached here has this id; look twice before saying so."""
        other = robot_with_same_id(self.now(), query_presence(session))
        if other is not None:
            time.sleep(_SECOND_LOOK_S)
            other = robot_with_same_id(self.now(), query_presence(session))
        if other is None:
            return
        raise LinkError(
            f"robot id {self._fixed.robot!r} is taken: a robot on {other.host or 'another machine'} has had it for "
            f"{other.up_us / 1e6:.0f} s (session {other.session}); give this one another with --robot"
        )


def query_presence(session: zenoh.Session, timeout_s: float = REPLY_TIMEOUT_S) -> list[PeerInfo]:
    """Everybody else who can be reached, each once; over as soon as all have answered."""
    import zenoh

    answers: list[PeerInfo] = []
    asked_us = monotonic_us()
    replies = session.get(
        PRESENCE_PATTERN, zenoh.handlers.FifoChannel(MAX_PEERS), target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE, timeout=timeout_s,
    )
    for reply in replies:
        sample = reply.ok
        if sample is None or len(answers) >= MAX_PEERS:
            continue
        peer = parse_presence_reply(str(sample.key_expr), sample.payload.to_bytes(), asked_us, monotonic_us(),
                           time.time_ns() // 1000)
        if peer is not None:
            answers.append(peer)
    return answers


def software_version() -> str:
    """This program's name and version."""
    try:
        return f"sightline {metadata.version('sightline-robot')}"
    except metadata.PackageNotFoundError:
        return "sightline"


def _host() -> str:
    return _printed(socket.gethostname())[:_HOST_CHARACTERS]


def _printed(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable())
