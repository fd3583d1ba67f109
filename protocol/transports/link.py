"""The transport interface: `Link`, `Message`, `LatestSlot`, and the rules that every link enforces. Shell (locks).

A `Link` belongs to one robot id. It promises what `tests/protocol/transports/test_link.py` checks on every transport:
newest wins, memory is bounded, both ends may restart, nothing raised in a callback ends anything, `close` never hangs.
"""

import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Generic, Self, TypeVar

from sightline.protocol.channels import FRAME, MAX_HEADER_BYTES, Channel, check_robot_id, key_for, parse_key
from sightline.protocol.errors import ConfigError

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


class Closing(ABC):
    """Used in a `with`, whose end closes it."""

    @abstractmethod
    def close(self) -> None:
        """End it; idempotent, returns within two seconds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Link(Closing):
    """One robot's channels on one transport. Callbacks run on a transport thread: store and return, nothing more."""

    robot: str

    @abstractmethod
    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Send now or drop; never block on a slow peer. False if it was dropped or no peer is connected.

        Towards the robot `source` defaults to the link's role. Raises ValueError for parts over the channel's bounds.
        """

    @abstractmethod
    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback` for every message of `channel` with the exact key and within its bounds."""

    @abstractmethod
    def ignore(self, channel: Channel) -> None:
        """End every subscription of this link to `channel`; the other ends see that it has none."""

    @abstractmethod
    def has_listener(self, channel: Channel) -> bool:
        """Whether a peer subscribes to what this end publishes on `channel`; display and economy only."""

    @property
    def dropped(self) -> Counter[str]:
        """Publications replaced by newer ones before they left, by channel, where the link counts them."""
        return Counter()

    @property
    def rejected(self) -> Counter[str]:
        """Messages and peers rejected, by reason."""
        return Counter()

    def latest(self, channel: Channel) -> LatestSlot[Message]:
        """Subscribe with a slot that holds the newest message of `channel`."""
        slot: LatestSlot[Message] = LatestSlot()
        self.subscribe(channel, slot.put)
        return slot


class LinkWrapper(Link):
    """A link that forwards to `link`; a subclass overrides only what it changes."""

    def __init__(self, link: Link) -> None:
        self.robot = link.robot
        self._link = link

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """As `Link`."""
        return self._link.publish(channel, header, payload, source)

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """As `Link`."""
        self._link.subscribe(channel, callback)

    def ignore(self, channel: Channel) -> None:
        """As `Link`."""
        self._link.ignore(channel)

    def has_listener(self, channel: Channel) -> bool:
        """As `Link`."""
        return self._link.has_listener(channel)

    @property
    def dropped(self) -> Counter[str]:
        """As `Link`."""
        return self._link.dropped

    @property
    def rejected(self) -> Counter[str]:
        """As `Link`."""
        return self._link.rejected

    def close(self) -> None:
        """As `Link`."""
        self._link.close()


# What every link enforces, whatever carries it: exact keys, bounds, contained callbacks. Shell (a lock).
#
# A bad message or a raising callback is counted and dropped; neither ends anything.


INEXACT_KEY = "INEXACT_KEY"
"""Counted for a key that is not exactly that of the robot and channel: a wildcard, another robot, a bad role."""
OVERSIZE = "OVERSIZE"
"""Counted for a header or payload over the channel's bound."""
NOT_A_PUT = "NOT_A_PUT"
"""Counted for anything that is not a publication, e.g. Zenoh's delete."""


class LinkRules:
    """The rules of one link to `robot`, used by `role`. `rejected` and `callback_errors` only grow."""

    def __init__(self, robot: str, role: str = "", max_frame_bytes: int = FRAME.max_payload_bytes) -> None:
        """Security limit: `max_frame_bytes` (1 up to the channel's bound) for the payload of a frame.

        Raises ConfigError for a robot id or a limit that is none.
        """
        if not 1 <= max_frame_bytes <= FRAME.max_payload_bytes:
            raise ConfigError(f"max_frame_bytes {max_frame_bytes} is out of range: 1 to {FRAME.max_payload_bytes}")
        self.robot = check_robot_id(robot)
        self.role = role
        self.rejected: Counter[str] = Counter()
        self.callback_errors = 0
        self._max_frame_bytes = max_frame_bytes
        self._counting = threading.Lock()

    def payload_bound(self, channel: Channel) -> int:
        """The largest payload of `channel` that this link carries, in bytes."""
        return min(channel.max_payload_bytes, self._max_frame_bytes) if channel is FRAME else channel.max_payload_bytes

    def key(self, channel: Channel, source: str = "") -> str:
        """The key to publish on; towards the robot `source` defaults to the role. Raises ValueError if it has none."""
        return key_for(self.robot, channel, source or (self.role if channel.has_source else ""))

    def check(self, channel: Channel, header: bytes, payload: bytes) -> None:
        """Raise ValueError for parts that this end must not send."""
        bound = self.payload_bound(channel)
        if len(header) > MAX_HEADER_BYTES or len(payload) > bound:
            raise ValueError(
                f"{channel.name}: header {len(header)} and payload {len(payload)} bytes, "
                f"at most {MAX_HEADER_BYTES} and {bound}"
            )

    def deliver(
        self, channel: Channel, key: str, header: bytes, payload: bytes, callback: Callable[[Message], None]
    ) -> None:
        """Give the message to `callback` if its key is exactly right and it is within bounds; never raises."""
        parsed = parse_key(key)
        if parsed is None or parsed[0] != self.robot or parsed[1] is not channel:
            self.reject(INEXACT_KEY)
        elif len(header) > MAX_HEADER_BYTES or len(payload) > self.payload_bound(channel):
            self.reject(OVERSIZE)
        else:
            self._call(callback, Message(channel, parsed[2], header, payload))

    def reject(self, reason: str) -> None:
        """Count one rejected message."""
        with self._counting:
            self.rejected[reason] += 1

    def _call(self, callback: Callable[[Message], None], message: Message) -> None:
        try:
            callback(message)
        except Exception:  # whatever a callback raises must not reach the transport's thread
            with self._counting:
                self.callback_errors += 1


class BaseLink(Link):
    """A link of a transport: its rules and what they counted."""

    def __init__(self, rules: LinkRules) -> None:
        self.robot = rules.robot
        self._rules = rules
        self._closed = False

    @property
    def rejected(self) -> Counter[str]:
        """As `Link`."""
        return self._rules.rejected

    @property
    def callback_errors(self) -> int:
        """How often a subscriber's callback raised."""
        return self._rules.callback_errors

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Whether at least one peer is connected; never blocks."""
