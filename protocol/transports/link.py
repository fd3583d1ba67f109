"""The seam between services and transports: `Link`, `Message`, `LatestSlot`. Shell (a lock and a condition).

A `Link` belongs to one robot id. It promises what `tests/test_link_spec.py` checks on every transport: newest wins,
memory is bounded, both ends may restart, nothing raised in a callback ends anything, `close` does not hang.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Generic, Protocol, Self, TypeVar

from protocol.channels import Channel

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Message:
    """Raw bytes off the wire. `source` is the role in the key ("" from a robot); `header` may be empty."""

    channel: Channel
    source: str
    header: bytes
    payload: bytes


class LatestSlot(Generic[Item]):
    """A one-place box: putting replaces and counts what nobody took. Safe between threads."""

    def __init__(self) -> None:
        self._ready = threading.Condition()
        self._item: Item | None = None
        self.dropped = 0

    def put(self, item: Item) -> None:
        """Replace whatever is there; never blocks."""
        with self._ready:
            self.dropped += self._item is not None
            self._item = item
            self._ready.notify()

    def take(self, timeout_s: float = 0.0) -> Item | None:
        """Remove and return the newest, waiting up to `timeout_s`; None if there is none."""
        if self._item is None and timeout_s <= 0:
            return None
        with self._ready:
            if self._item is None:
                self._ready.wait(timeout_s)
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
