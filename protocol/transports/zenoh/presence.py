"""Who is where, told to whoever asks: what a peer says of itself, and what is made of the answers. Pure.

For people: `sightline robots`, the doctor, and a robot's check that nobody else has its id. No frame, no command and no
judgement of either depends on it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field

from sightline.protocol.codec import decode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import Microseconds, SessionId, Source, WireModel
from sightline.protocol.transports.security import PRESENCE_PREFIX, ROBOT_ROLE, certificate_role

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
