"""Requests that the driver's socket had no room for: kept until it has, STOP ahead of all. Pure.

A twist that finds no room is dropped, for a newer one follows. A request comes once or is a person's STOP: it waits.
"""

from collections.abc import Callable
from typing import Final

from sightline.protocol.codec import decode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import Request, Verb
from sightline.protocol.transports.link import Message

MAX_PENDING: Final = 32


class PendingRequests:
    """The newest request per (source, verb), at most 32; a STOP always finds a place."""

    def __init__(self) -> None:
        self._waiting: dict[tuple[str, Verb], Message] = {}

    def __len__(self) -> int:
        """How many wait."""
        return len(self._waiting)

    def hold(self, message: Message) -> bool:
        """Keep a request; False for what is none, and when there is no room."""
        try:
            verb = decode(Request, message.payload).verb
        except WireError:
            return False
        name = (message.source, verb)
        if len(self._waiting) >= MAX_PENDING and name not in self._waiting and not self._gives_way(verb):
            return False
        self._waiting[name] = message
        return True

    def _gives_way(self, verb: Verb) -> bool:
        """Make room for a STOP: it may cost anything but itself."""
        if verb is not Verb.STOP:
            return False
        others = [name for name in self._waiting if name[1] is not Verb.STOP]
        del self._waiting[others[0] if others else next(iter(self._waiting))]  # STOP is a level: one of 32 is as good
        return True

    def flush(self, send: Callable[[Message], bool]) -> bool:
        """Send what waits, STOP first, until there is no room; whether nothing waits any more."""
        for name in sorted(self._waiting, key=lambda name: name[1] is not Verb.STOP):
            if not send(self._waiting[name]):
                return False
            del self._waiting[name]
        return True
