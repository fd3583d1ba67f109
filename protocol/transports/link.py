"""The seam between services and transports: `Link`, `Message`, `LatestSlot`. Shell (locks).

A `Link` belongs to one robot id. It promises what `tests/protocol/transports/test_link.py` checks on every transport: newest wins,
memory is bounded, both ends may restart, nothing raised in a callback ends anything, `close` does not hang.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Generic, Protocol, Self, TypeVar

from sightline.protocol.channels import Channel

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Message:
    """Raw bytes off the wire. `source` is the role in the key ("" from a robot); `header` may be empty."""

    channel: Channel
    source: str
    header: bytes
    payload: bytes


class LatestSlot(Generic[Item]):
    """A one-place box: putting replaces and counts what nobody took. Safe between threads.

    Two plain locks: a condition would wake the taker a third slower, on a path that every frame and command takes.
    """

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._full = threading.Lock()  # free while there is an item; whoever gets hold of it takes the item out
        self._full.acquire()
        self._item: Item | None = None
        self.dropped = 0

    def put(self, item: Item) -> None:
        """Replace whatever is there; never blocks."""
        with self._guard:
            waiting = self._item is not None
            self._item = item
            self.dropped += waiting
            if not waiting:
                self._full.release()

    def take(self, timeout_s: float = 0.0) -> Item | None:
        """Remove and return the newest, waiting up to `timeout_s`; None if there is none."""
        if not self._full.acquire(timeout=max(0.0, timeout_s)):
            return None
        with self._guard:
            item, self._item = self._item, None
            return item


class Link(Protocol):
    """One robot's channels on one transport. Callbacks run on a transport thread: store and return, nothing more."""

    robot: str

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Send now or drop; never block on a slow peer. False if it was dropped or nobody is connected.

        Raises ValueError for parts over the channel's bounds.
        """
        ...

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback` for every message of `channel` with the exact key and within its bounds."""
        ...

    def latest(self, channel: Channel) -> LatestSlot[Message]:
        """Subscribe with a slot that holds the newest message of `channel`."""
        ...

    def ignore(self, channel: Channel) -> None:
        """End every subscription of this link to `channel`; the other ends see that nobody listens here."""
        ...

    def has_listener(self, channel: Channel) -> bool:
        """Whether somebody subscribes to what this end publishes on `channel`; display and economy only."""
        ...

    def close(self) -> None:
        """End it; idempotent, returns within two seconds."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
