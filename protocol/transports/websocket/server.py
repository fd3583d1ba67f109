"""The places of one WebSocket endpoint: a few for strangers, and apart from them those of clients. Shell (a lock).

A stranger is who has not yet said what it is. None takes the places of another address, and nobody who only watches
takes the last ones of who may say STOP.
"""

import threading
from dataclasses import dataclass
from typing import Final

from sightline.protocol.channels import FRAME, REQUEST, TWIST

MAX_CLIENTS: Final = 16
"""Security limit: open connections of one endpoint that have said what they are."""
RESERVED_SLOTS: Final = 4
"""Security limit: of these, for who may steer or ask."""
MAX_HANDSHAKES: Final = 16
"""Security limit: connections beyond these that have not yet said what they are; more are closed unheard."""
MAX_HANDSHAKES_PER_ADDRESS: Final = 8
"""Security limit: of these, from one address. A browser opens up to six connections to one host at a time."""

_CONTROL_CHANNELS: Final = (TWIST.name, REQUEST.name, FRAME.name)


def may_control(granted: frozenset[tuple[str, ...]]) -> bool:
    """Whether who may publish `granted` steers, asks or is the robot; all others only watch, or say what they see."""
    return any(key[0] in _CONTROL_CHANNELS for key in granted)


@dataclass(eq=False, slots=True)
class Slot:
    """One connection's."""

    address: str
    acts: bool | None = None
    """Whether it may act, see `may_act`; None for a stranger."""


class ConnectionLimits:
    """Who has a place at one endpoint."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._taken: set[Slot] = set()

    def knock(self, address: str) -> Slot | None:
        """A stranger's place for who comes from `address`; None if there is none."""
        with self._lock:
            strangers = [one.address for one in self._taken if one.acts is None]
            if len(strangers) >= MAX_HANDSHAKES or strangers.count(address) >= MAX_HANDSHAKES_PER_ADDRESS:
                return None
            place = Slot(address)
            self._taken.add(place)
            return place

    def problem(self, acts: bool) -> str:
        """Why one more client that `acts`, or only watches, has no place; "" if it has."""
        with self._lock:
            return self._problem(acts)

    def settle(self, place: Slot, acts: bool) -> str:
        """Give a client's place to the stranger at `place`; returns why not, or ""."""
        with self._lock:
            problem = self._problem(acts)
            if not problem:
                place.acts = acts
            return problem

    def leave(self, place: Slot) -> None:
        """Its connection has ended."""
        with self._lock:
            self._taken.discard(place)

    def _problem(self, acts: bool) -> str:
        clients = [one.acts for one in self._taken if one.acts is not None]
        if len(clients) >= MAX_CLIENTS:
            return f"{MAX_CLIENTS} clients are connected, which is the limit"
        most = MAX_CLIENTS - RESERVED_SLOTS
        if not acts and clients.count(False) >= most:
            return f"{most} clients watch, which is the limit: the other places are kept for who may steer or ask"
        return ""
