"""Define the transport interface: `Link`, `Message`, slots, queues, and the rules of every link. Shell (locks).

A `Link` belongs to one robot id. `tests/protocol/transports/test_link.py` checks its promises on every transport:
newest wins, memory is bounded, both ends may restart, a callback error ends nothing, `close` never hangs.
"""

import sys
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Generic, NamedTuple, Self, TypeVar

from sightline.protocol.channels import (
    CHANNELS,
    FRAME,
    KNOWN_SOURCES,
    MAX_HEADER_BYTES,
    REQUEST,
    Channel,
    Priority,
    key_for,
    parse_key,
)
from sightline.protocol.codec import request_verb
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import report_fault
from sightline.protocol.messages import Verb
from sightline.protocol.transports.endpoints import check_robot_id
from sightline.protocol.transports.tokens import AnyToken, DetectorToken, Token

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Message:
    """Raw bytes from the wire.

    Args:
        channel: the channel.
        source: role in the key; "" from a robot.
        header: encoded header, at most 512 bytes, may be empty.
        payload: encoded payload, within the bound of the channel.
    """

    channel: Channel
    source: str
    header: bytes
    payload: bytes


class LatestSlot(Generic[Item]):
    """Stores the newest item. A new item replaces one that no thread took, and counts it. Thread-safe."""

    def __init__(self) -> None:
        # Two plain locks, because a condition wakes the taker a third slower, for every frame and command.
        self._guard = threading.Lock()
        # Released while there is an item. The thread that acquires it takes the item.
        self._full = threading.Lock()
        self._full.acquire()
        self._item: Item | None = None
        self.dropped = 0

    def put(self, item: Item) -> None:
        """Store `item`, in place of an older one. Never blocks."""
        with self._guard:
            waiting = self._item is not None
            self._item = item
            self.dropped += waiting
            if not waiting:
                self._full.release()

    def take(self, timeout_s: float = 0.0) -> Item | None:
        """Remove and return the newest item.

        Args:
            timeout_s: longest wait, s.

        Returns:
            The item, or None if no item arrived in time.
        """
        if not self._full.acquire(timeout=max(0.0, timeout_s)):
            return None
        with self._guard:
            item, self._item = self._item, None
            return item


# Security limit: queued items of one channel from sources without a role.
MAX_UNKNOWN_SOURCES: Final = 16
_RANKS: Final = {priority: rank for rank, priority in enumerate(Priority, start=1)}
_FIRST_RANK: Final = -1


def rank(channel: Channel, verb: Verb | None) -> int:
    """Return the order of sending, the lowest first: a STOP, then by the priority of the channel."""
    return 0 if verb is Verb.STOP else _RANKS[channel.priority]


class _Place(NamedTuple):
    """The place of an item in a queue. A newer item replaces only the item in the same place."""

    rank: int
    channel: str = ""
    source: str = ""
    verb: Verb | None = None


class OutgoingQueue(Generic[Item]):
    """Queues the newest item per channel and source, for requests also per verb. The most urgent item leaves first.

    Only another STOP replaces a STOP. Sources without a role share a few places on relayed channels. A source with a
    role always has a place.
    """

    def __init__(self, max_items: int = sys.maxsize) -> None:
        """Limit the queue to `max_items` (security limit). In a full queue a STOP replaces another request."""
        self._max_items = max_items
        self._lock = threading.Lock()
        self._items: dict[_Place, Item] = {}
        # The keys are fixed, so that other threads may read it without the lock.
        self.dropped = Counter(dict.fromkeys(CHANNELS, 0))
        """Items that were replaced before they were sent, or had no place, by channel."""

    def __len__(self) -> int:
        return len(self._items)

    def put(self, message: Message, item: Item) -> bool:
        """Queue an item. Never blocks.

        Args:
            message: its channel, source and verb give place and order.
            item: the form in which the transport sends the message.

        Returns:
            False if the queue dropped the item.
        """
        channel = message.channel
        verb = request_verb(message.payload) if channel is REQUEST else None
        place = _Place(rank(channel, verb), channel.name, message.source, verb)
        with self._lock:
            is_newer = place in self._items
            fits = is_newer or self._make_room(place, channel)
            self.dropped[channel.name] += is_newer or not fits
            if fits:
                self._items[place] = item
        return fits

    def put_first(self, item: Item) -> None:
        """Queue `item` before all others. Only a newer call replaces it."""
        with self._lock:
            self._items[_Place(_FIRST_RANK)] = item

    def take(self) -> Item | None:
        """Remove and return the most urgent item, or None from an empty queue."""
        with self._lock:
            return self._items.pop(self._next()) if self._items else None

    def flush(self, send: Callable[[Item], bool]) -> bool:
        """Send items, the most urgent first.

        Args:
            send: sends one item; returns False if the transport has no room. The item then stays in the queue.

        Returns:
            True if the queue is empty now.
        """
        with self._lock:
            while self._items:
                place = self._next()
                # The item leaves the queue only after it was sent, so that a full transport loses no STOP.
                if not send(self._items[place]):
                    return False
                del self._items[place]
        return True

    def _next(self) -> _Place:
        return min(self._items, key=lambda place: place.rank) if len(self._items) > 1 else next(iter(self._items))

    def _make_room(self, place: _Place, channel: Channel) -> bool:
        if len(self._items) >= self._max_items:
            return place.verb is Verb.STOP and self._drop_one()
        # A relayed channel accepts any source. Without this limit, a peer with invented sources could fill the queue.
        if not channel.passed_on or place.source in KNOWN_SOURCES:
            return True
        unknown = (one for one in self._items if one.channel == place.channel and one.source not in KNOWN_SOURCES)
        return sum(1 for _ in unknown) < MAX_UNKNOWN_SOURCES

    def _drop_one(self) -> bool:
        """Drop an item that is not a STOP, otherwise the oldest STOP."""
        # Every STOP has the same effect, so one of several is sufficient.
        oldest = next((place for place in self._items if place.verb is not Verb.STOP), next(iter(self._items)))
        self.dropped[oldest.channel] += 1
        del self._items[oldest]
        return True


class Closing(ABC):
    """Base of context managers that close themselves at the end of `with`."""

    @abstractmethod
    def close(self) -> None:
        """Close the object. Idempotent, returns within two seconds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Link(Closing):
    """The channels of one robot on one transport. A callback runs on a transport thread and only stores the message."""

    robot: str
    is_routed = False
    """True if the peers of this end receive each other's messages without this end."""

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Return True if at least one peer is connected. Never blocks."""

    @abstractmethod
    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Send a message now, or drop it. Never blocks on a slow peer.

        Args:
            channel: the channel.
            header: encoded header, may be empty.
            payload: encoded payload.
            source: role of the sender toward the robot. The default is the role of the link.

        Returns:
            False if it was dropped or no peer is connected.

        Raises:
            ValueError: a part is above the bound of the channel.
        """

    @abstractmethod
    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback` for every message of `channel` with the exact key and within its bounds.

        Args:
            channel: the channel.
            callback: called on a transport thread, so it must only store the message. The link logs and counts an
                error in it, and continues.
        """

    @abstractmethod
    def unsubscribe(self, channel: Channel) -> None:
        """End every subscription of this link to `channel`. The peers see the change."""

    @abstractmethod
    def has_listener(self, channel: Channel) -> bool:
        """Return True if a peer subscribes to `channel`. Use it to save work, never for safety."""

    def watch_drivers(self, callback: Callable[[str, bool], None]) -> None:
        """Call `callback` with each driver token of this robot, and True if it appeared or False if it ended.

        Only Zenoh has tokens (`protocol/transports/tokens.py`). On other links only the lease ends.
        """

    @property
    def dropped(self) -> Counter[str]:
        """Return the publications that newer ones replaced before they were sent, by channel, if they are counted."""
        return Counter()

    @property
    def rejected(self) -> Counter[str]:
        """Return the rejected messages and peers, by reason."""
        return Counter()

    def latest(self, channel: Channel) -> LatestSlot[Message]:
        """Subscribe to `channel` with a slot.

        Returns:
            The slot with the newest message that no thread took.
        """
        slot: LatestSlot[Message] = LatestSlot()
        self.subscribe(channel, slot.put)
        return slot


class FleetLink(Closing):
    """The links to all robots of one session."""

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Return True if at least one peer is connected."""

    @property
    @abstractmethod
    def losses(self) -> int:
        """Return how many times the last peer was lost. The count increases after the tokens of that peer ended."""

    @abstractmethod
    def robots(self) -> list[str]:
        """Return the ids of the present robots, in the order of their first message. A silent robot is forgotten."""

    @abstractmethod
    def on_new_robot(self, callback: Callable[[], None]) -> None:
        """Call `callback` on a transport thread at the first message of each robot, also after it was forgotten."""

    @abstractmethod
    def link(self, robot: str) -> Link:
        """Return a new link to one robot. It closes with this object, if not before.

        Args:
            robot: robot id, also of a robot that has not sent a message yet.

        Raises:
            ConfigError: the robot id is invalid.
        """

    @abstractmethod
    def declare_token(self, token: AnyToken) -> Callable[[], None]:
        """Declare a token, which ends with the session or process.

        Returns:
            A function that ends the token. The caller must store it.
        """

    @abstractmethod
    def watch_tokens(self, callback: Callable[[Token, bool], None]) -> Callable[[], None]:
        """Call `callback` on a transport thread with each token of robots and vision services, True for present.

        Returns:
            A function that ends the watch. The watch also ends with the session.
        """

    @abstractmethod
    def find_robots(self) -> set[str]:
        """Query the ids of all robots, also without a token or status, within half a second."""

    @abstractmethod
    def watch_detectors(self, group: str, callback: Callable[[DetectorToken, bool], None]) -> Callable[[], None]:
        """Call `callback` on a transport thread with each token in `group`, and True if it is present.

        Returns:
            A function that ends the watch. The watch also ends with the session.
        """


class LinkWrapper(Link):
    """Forwards every call to another link. A subclass overrides only the methods that differ."""

    def __init__(self, link: Link) -> None:
        self.robot = link.robot
        self._link = link

    @property
    def connected(self) -> bool:
        """Forward to the link."""
        return self._link.connected

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Forward to the link."""
        return self._link.publish(channel, header, payload, source)

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Forward to the link."""
        self._link.subscribe(channel, callback)

    def unsubscribe(self, channel: Channel) -> None:
        """Forward to the link."""
        self._link.unsubscribe(channel)

    def has_listener(self, channel: Channel) -> bool:
        """Forward to the link."""
        return self._link.has_listener(channel)

    def watch_drivers(self, callback: Callable[[str, bool], None]) -> None:
        """Forward to the link."""
        self._link.watch_drivers(callback)

    @property
    def dropped(self) -> Counter[str]:
        """Forward to the link."""
        return self._link.dropped

    @property
    def rejected(self) -> Counter[str]:
        """Forward to the link."""
        return self._link.rejected

    def close(self) -> None:
        """Forward to the link."""
        self._link.close()


# The rules of every link on any transport: exact keys, size limits, contained callback errors. Shell (a lock).
#
# A bad message, or an error in a callback, is counted and dropped. Neither ends a link.


# Counter of keys that differ from that of the robot and channel: a wildcard, another robot, an invalid role.
INEXACT_KEY = "INEXACT_KEY"
# Counter of headers or payloads above the limit of the channel.
OVERSIZE = "OVERSIZE"
# Counter of samples that are not publications, e.g. Zenoh's delete.
NOT_A_PUT = "NOT_A_PUT"


class LinkRules:
    """The rules of one link to `robot` with role `role`. `rejected` never decreases."""

    def __init__(self, robot: str, role: str = "", max_frame_bytes: int = FRAME.max_payload_bytes) -> None:
        """Create the rules of one link.

        Args:
            robot: robot id.
            role: default source of messages toward the robot.
            max_frame_bytes: security limit for the payload of a frame, 1 to the bound of the channel.

        Raises:
            ConfigError: the robot id or the limit is invalid.
        """
        if not 1 <= max_frame_bytes <= FRAME.max_payload_bytes:
            raise ConfigError(f"invalid max_frame_bytes {max_frame_bytes}: expected 1 to {FRAME.max_payload_bytes}")
        self.robot = check_robot_id(robot)
        self.role = role
        self.rejected: Counter[str] = Counter()
        self._max_frame_bytes = max_frame_bytes
        self._counting = threading.Lock()

    def payload_bound(self, channel: Channel) -> int:
        """Return the largest payload of `channel` on this link, in bytes."""
        return min(channel.max_payload_bytes, self._max_frame_bytes) if channel is FRAME else channel.max_payload_bytes

    def key(self, channel: Channel, source: str = "") -> str:
        """Return the key for publishing.

        Args:
            channel: the channel.
            source: role of the sender toward the robot. The default is the role of the link.

        Raises:
            ValueError: the channel needs a source, and the link has no role.
        """
        return key_for(self.robot, channel, source or (self.role if channel.has_source else ""))

    def check(self, channel: Channel, header: bytes, payload: bytes) -> None:
        """Raise ValueError for a header or payload above its bound."""
        bound = self.payload_bound(channel)
        if len(header) > MAX_HEADER_BYTES or len(payload) > bound:
            raise ValueError(
                f"{channel.name}: header {len(header)} and payload {len(payload)} bytes, "
                f"at most {MAX_HEADER_BYTES} and {bound}"
            )

    def deliver(
        self, channel: Channel, key: str, header: bytes, payload: bytes, callback: Callable[[Message], None]
    ) -> None:
        """Pass the message to `callback` if its key is exact and its parts are within bounds. Never raises.

        Args:
            channel: channel of the subscription.
            key: key of the message on the wire.
            header: header bytes.
            payload: payload bytes.
            callback: callback of the subscription.
        """
        # A subscription with a wildcard also matches keys with a wildcard, which a third party may publish.
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
        # An error in a callback must not end the thread of the transport, which serves all channels.
        except Exception as error:
            report_fault("callback", error, message.channel.name)


class BaseLink(Link):
    """Base class of the links of a transport, with rules and counters."""

    def __init__(self, rules: LinkRules) -> None:
        self.robot = rules.robot
        self._rules = rules
        self._closed = False

    @property
    def rejected(self) -> Counter[str]:
        """Return the rejected messages and peers, by reason."""
        return self._rules.rejected
