"""The transport interface: `Link`, `Message`, slots and queues, and the rules that every link enforces. Shell (locks).

A `Link` belongs to one robot id. It promises what `tests/protocol/transports/test_link.py` checks on every transport:
newest wins, memory is bounded, both ends may restart, nothing raised in a callback ends anything, `close` never hangs.
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
    check_robot_id,
    key_for,
    parse_key,
)
from sightline.protocol.codec import request_verb
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import Verb

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


MAX_UNKNOWN_SOURCES: Final = 16
"""Security limit: items of one channel in a queue from sources that no role has."""
_RANKS: Final = {priority: rank for rank, priority in enumerate(Priority, start=1)}
_FIRST_RANK: Final = -1


def rank(channel: Channel, verb: Verb | None) -> int:
    """Order of sending, the lowest first: a STOP, then by the channel's priority."""
    return 0 if verb is Verb.STOP else _RANKS[channel.priority]


class _Place(NamedTuple):
    """Where an item of a queue waits."""

    rank: int
    channel: str = ""
    source: str = ""
    verb: Verb | None = None


class OutgoingQueue(Generic[Item]):
    """The newest item per channel and source, for requests also per verb; the most urgent leaves first.

    Only a newer item of its own place replaces one, so a STOP yields to nothing but another STOP. Of sources that no
    role has, few fit at a time on channels that are passed on; more are dropped. A role's source always fits.
    """

    def __init__(self, max_items: int = sys.maxsize) -> None:
        """Security limit: `max_items`; in a full queue a STOP takes the place of another request."""
        self._max_items = max_items
        self._lock = threading.Lock()
        self._items: dict[_Place, Item] = {}
        self.dropped = Counter(dict.fromkeys(CHANNELS, 0))  # never grows, so that other threads may read it
        """Items replaced by a newer one before they were sent, or without a place, by channel."""

    def __len__(self) -> int:
        return len(self._items)

    def put(self, message: Message, item: Item) -> bool:
        """Put `item`, which sends `message`; False if it was dropped. Never blocks."""
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
        """Put `item` before everything else; only a newer one replaces it."""
        with self._lock:
            self._items[_Place(_FIRST_RANK)] = item

    def take(self) -> Item | None:
        """Remove and return the most urgent; None if there is nothing."""
        with self._lock:
            return self._items.pop(self._next()) if self._items else None

    def flush(self, send: Callable[[Item], bool]) -> bool:
        """Hand items to `send`, the most urgent first, until it returns False; whether nothing is left."""
        with self._lock:
            while self._items:
                place = self._next()
                if not send(self._items[place]):
                    return False
                del self._items[place]
        return True

    def _next(self) -> _Place:
        return min(self._items, key=lambda place: place.rank) if len(self._items) > 1 else next(iter(self._items))

    def _make_room(self, place: _Place, channel: Channel) -> bool:
        if len(self._items) >= self._max_items:
            return place.verb is Verb.STOP and self._drop_one()
        if not channel.passed_on or place.source in KNOWN_SOURCES:
            return True
        unknown = (one for one in self._items if one.channel == place.channel and one.source not in KNOWN_SOURCES)
        return sum(1 for _ in unknown) < MAX_UNKNOWN_SOURCES

    def _drop_one(self) -> bool:
        """Drop what is no STOP, else the oldest STOP: of many, one stops as well."""
        oldest = next((place for place in self._items if place.verb is not Verb.STOP), next(iter(self._items)))
        self.dropped[oldest.channel] += 1
        del self._items[oldest]
        return True


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
    def unsubscribe(self, channel: Channel) -> None:
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


class FleetLink(Closing):
    """Links to all robots that one session receives."""

    @abstractmethod
    def robots(self) -> list[str]:
        """Ids of all robots received so far, in the order of their first message."""

    @abstractmethod
    def on_new_robot(self, callback: Callable[[], None]) -> None:
        """Call `callback`, on a transport thread, at the first message of each robot."""

    @abstractmethod
    def link(self, robot: str) -> Link:
        """A link to `robot`, closed with this one."""


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

    def unsubscribe(self, channel: Channel) -> None:
        """As `Link`."""
        self._link.unsubscribe(channel)

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
