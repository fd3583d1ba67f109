"""Presence over Zenoh: a peer answers one question, and only when it is asked. Shell.

A query that nobody asks costs nothing; an answer costs some microseconds. The way of frames and commands knows nothing
of it. An answer comes from the living process itself, so who has died or hangs is not there.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import metadata
from typing import TYPE_CHECKING, Final

from pydantic import ValidationError

from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.zenoh.presence import (
    MAX_ABOUT,
    MAX_PEERS,
    PRESENCE_PATTERN,
    PeerInfo,
    Presence,
    parse_presence_reply,
    presence_key,
    robot_with_same_id,
)

if TYPE_CHECKING:
    import zenoh

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
        return f"sightline {metadata.version('sightline')}"
    except metadata.PackageNotFoundError:
        return "sightline"


def _host() -> str:
    return _printed(socket.gethostname())[:_HOST_CHARACTERS]


def _printed(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable())
