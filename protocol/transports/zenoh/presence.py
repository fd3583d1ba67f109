"""Answer and send presence queries: role, robot, host and version of each peer. Shell.

`sightline robots`, the doctor, and the check for a second robot with the same id use it. No frame, command or
validation depends on it.
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
# Security limit: stored replies to one query, as many as from two full routers.
MAX_PEERS: Final = 2048
# The first reply also contains the setup time of its route. The best of a few replies shows the link alone.
QUERY_ROUNDS: Final = 3

_PRINTED: Final = r"^[^\x00-\x1f\x7f-\x9f]*$"
_Line = Annotated[str, Field(max_length=64, pattern=_PRINTED)]
MAX_ABOUT: Final = 160


class Presence(WireModel):
    """A peer's description of itself. `clock_us` is its wall clock, for display only, never for validation."""

    role: Source
    robot: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.*?-]{1,32}$")]
    session: SessionId
    software: _Line = ""
    host: _Line = ""
    about: Annotated[str | None, Field(max_length=MAX_ABOUT, pattern=_PRINTED)] = None
    """One line from a service: its task, device and state."""
    up_us: Microseconds = 0
    clock_us: Microseconds = 0


@dataclass(frozen=True, slots=True)
class PeerInfo:
    """A peer that replied, its round trip, and the lead of its wall clock over the local clock."""

    presence: Presence
    round_trip_us: int
    ahead_us: int


def presence_key(role: str, session: str) -> str:
    """Return the key of a presence reply. It contains the role of the certificate for the access rules."""
    return f"{PRESENCE_PREFIX}/{certificate_role(role)}/{session}"


def parse_presence_reply(
    key: str, payload: bytes, requested_us: int, answered_us: int, clock_us: int
) -> PeerInfo | None:
    """Parse a presence reply.

    Args:
        key: key of the reply.
        payload: JSON of a `Presence`.
        requested_us: local monotonic time of the query.
        answered_us: local monotonic time of the reply.
        clock_us: local wall clock at the arrival of the reply.

    Returns:
        The peer, or None for an invalid reply, and for a role that differs from its key.
    """
    try:
        presence = decode(Presence, payload, MAX_BYTES)
    except WireError:
        return None
    if key != presence_key(presence.role, presence.session):
        return None
    round_trip_us = max(0, answered_us - requested_us)
    return PeerInfo(presence, round_trip_us, presence.clock_us + round_trip_us // 2 - clock_us)


def best_round_trips(rounds: Iterable[Iterable[PeerInfo]]) -> list[PeerInfo]:
    """Return each peer once, with its shortest round trip: robots first, then vision services, then others."""
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
    """Return the robot that had the id of `own` first, or None.

    Of two robots with the same id, the one that has run longer keeps it. `own` is from the time of the query, and the
    answers are half a round trip younger.
    """
    # The same session is the same robot, seen through an earlier process.
    for peer in answers:
        other = peer.presence
        if other.role == ROBOT_ROLE and other.robot == own.robot and other.session != own.session \
                and other.up_us > own.up_us + peer.round_trip_us // 2:
            return other
    return None


# Presence over Zenoh: a peer replies to a query. Shell.
#
# Without a query it costs nothing. A reply costs some microseconds, and is independent of frames and commands. The
# process itself replies, so a process that died or hangs does not appear.


# Time after which a peer without a reply counts as absent.
REPLY_TIMEOUT_S: Final = 0.5
# A longer time, because on a link with a long delay the first reply takes several round trips. It ends with the last
# reply.
_CLAIM_TIMEOUT_S: Final = 2.0
# Pause before the second query. By then, a robot that has just ended no longer replies.
_SECOND_LOOK_S: Final = 1.0
_HOST_CHARACTERS: Final = 64


class PresenceAnnouncer:
    """Replies to presence queries for this end of a session. Raises ConfigError for an invalid role."""

    def __init__(self, role: str, robot: str, session: str, about: Callable[[], str] | None = None) -> None:
        """Create the reply. A thread of Zenoh calls `about` for each query."""
        self.role = role
        self._about = about
        self._began_ns = time.monotonic_ns()
        try:
            self._fixed = Presence(role=role, robot=robot, session=session, software=software_version(), host=_host())
        except ValidationError:
            raise ConfigError(f"invalid role {role!r} of robot {robot!r}: expected 1 to 16 lower-case "
                              "letters, digits or '_', e.g. vision") from None

    def now(self) -> Presence:
        """Return the current reply."""
        up_us = (time.monotonic_ns() - self._began_ns) // 1000
        extra = {"about": _printed(self._about())[:MAX_ABOUT]} if self._about else {}
        return self._fixed.model_copy(update={"up_us": up_us, "clock_us": time.time_ns() // 1000, **extra})

    def answer_in(self, session: zenoh.Session) -> Callable[[], None]:
        """Reply to queries until the returned function is called."""
        import zenoh

        key = presence_key(self._fixed.role, self._fixed.session)

        def answer(query: zenoh.Query) -> None:
            with suppress(zenoh.ZError):  # the requester is gone
                query.reply(key, encode(self.now()))

        handler = zenoh.handlers.Callback(answer, indirect=False)
        return session.declare_queryable(key, handler, allowed_origin=zenoh.Locality.REMOTE).undeclare

    def claim(self, session: zenoh.Session) -> None:
        """Raise LinkError if another robot on this network has this id. It sends two queries first."""
        other = robot_with_same_id(self.now(), query_presence(session, _CLAIM_TIMEOUT_S))
        if other is not None:
            time.sleep(_SECOND_LOOK_S)
            other = robot_with_same_id(self.now(), query_presence(session, _CLAIM_TIMEOUT_S))
        if other is None:
            return
        raise LinkError(
            f"robot id {self._fixed.robot!r} is in use on host {other.host or 'unknown'} "
            f"(running for {other.up_us / 1e6:.0f} s); pass --robot ID"
        )


def query_presence(session: zenoh.Session, timeout_s: float = REPLY_TIMEOUT_S) -> list[PeerInfo]:
    """Return all other peers, each once. It ends as soon as all have replied."""
    import zenoh

    answers: list[PeerInfo] = []
    requested_us = monotonic_us()
    replies = session.get(
        PRESENCE_PATTERN, zenoh.handlers.FifoChannel(MAX_PEERS), target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE, timeout=timeout_s,
        # By default a router waits until each peer has room for the query, so one peer that hangs would block all.
        congestion_control=zenoh.CongestionControl.DROP,
    )
    # A broken or hostile peer may reply with any data, also more than once. Such replies do not count.
    for reply in replies:
        sample = reply.ok
        if sample is None or len(answers) >= MAX_PEERS:
            continue
        peer = parse_presence_reply(str(sample.key_expr), sample.payload.to_bytes(), requested_us, monotonic_us(),
                           time.time_ns() // 1000)
        if peer is not None:
            answers.append(peer)
    return answers


def software_version() -> str:
    """Return the name and version of this program."""
    try:
        return f"sightline {metadata.version('sightline-robot')}"
    except metadata.PackageNotFoundError:
        return "sightline"


def _host() -> str:
    return _printed(socket.gethostname())[:_HOST_CHARACTERS]


def _printed(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable())
