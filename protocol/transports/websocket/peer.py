"""What waits for one WebSocket peer: the newest message of each channel and source; STOP before all. Shell (a lock)."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Hashable
from typing import Final, Protocol

from sightline.protocol.channels import CHANNELS, REQUEST, Channel, Priority
from sightline.protocol.codec import decode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import Request
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.security import KNOWN_SOURCES

MAX_UNKNOWN_SOURCES: Final = 16
"""Security limit: places of one channel for sources that are no role's."""

_RANKS: Final = {priority: rank for rank, priority in enumerate(Priority, start=2)}
_HELLO_RANK: Final = 0
_STOP_RANK: Final = 1
_STOP: Final = "stop"


class WireFormat(Protocol):
    """How a message is written for one kind of peer."""

    @property
    def form(self) -> Hashable:
        """Equal for peers that are sent the same bytes."""
        ...

    def write(self, message: Message) -> tuple[bytes, ...]:
        """The message as those bytes, in as many pieces as it is made of."""
        ...


class Publication:
    """One publication, written at most once for all peers that are sent the same bytes."""

    __slots__ = ("_written", "message")

    def __init__(self, message: Message) -> None:
        self.message = message
        self._written: dict[Hashable, tuple[bytes, ...]] = {}

    def written(self, dialect: WireFormat) -> tuple[bytes, ...]:
        """The bytes for a peer of `dialect`. Two threads may both write; they write the same."""
        data = self._written.get(dialect.form)
        if data is None:
            data = self._written[dialect.form] = dialect.write(self.message)
        return data


class Outbox:
    """A place for each channel and source, one for a hello, and for requests one for each verb.

    Where others choose the source, on what is passed on, few of those that are no role's have a place at a time; more
    are left out. None gives way to another made-up one, and a role's source always has its own: nobody is starved by
    who makes up names. Requests are never left out.
    Only a newer message of its own place replaces one: a STOP makes room for nothing but another STOP. The most urgent
    is taken first, a STOP before everything but the hello.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._places: dict[tuple[str, str, str], Publication | str] = {}
        self.dropped = Counter(dict.fromkeys(CHANNELS, 0))  # never grows, so that others may read it meanwhile
        """Publications replaced by a newer one before they were sent, or left out, by channel."""

    def put(self, post: Publication) -> None:
        """Replace what is in the message's place, if it has one; never blocks."""
        message = post.message
        place = (message.channel.name, message.source, _verb(message) if message.channel is REQUEST else "")
        with self._lock:
            has_place = self._has_place(place, message.channel)
            self.dropped[place[0]] += place in self._places or not has_place
            if has_place:
                self._places[place] = post

    def _has_place(self, place: tuple[str, str, str], channel: Channel) -> bool:
        if not channel.passed_on or place[1] in KNOWN_SOURCES or place in self._places:
            return True
        made_up = (name == channel.name and source not in KNOWN_SOURCES for name, source, _ in self._places)
        return sum(made_up) < MAX_UNKNOWN_SOURCES

    def put_hello(self, text: str) -> None:
        """A hello goes before everything else."""
        with self._lock:
            self._places["", "", ""] = text

    @property
    def waiting(self) -> bool:
        """Whether something is there."""
        return bool(self._places)

    def take(self) -> Publication | str | None:
        """Remove and return the most urgent; None if there is nothing."""
        with self._lock:
            if len(self._places) < 2:  # the usual: nothing to choose from
                return self._places.popitem()[1] if self._places else None
            return self._places.pop(min(self._places, key=_rank))


def _verb(request: Message) -> str:
    """Which request it is; one that cannot be read shares a place with others of its kind."""
    try:
        return decode(Request, request.payload, REQUEST.max_payload_bytes).verb
    except WireError:
        return ""


def _rank(place: tuple[str, str, str]) -> int:
    name, _, verb = place
    if not name:
        return _HELLO_RANK
    return _STOP_RANK if verb == _STOP else _RANKS[CHANNELS[name].priority]
