"""Simulate a network in memory and in virtual time: seeded delay and loss, no threads, repeatable. Pure.

    network = MemoryNetwork(seed=7, delay_us=50_000, loss=0.1)
    robot, vision = network.link("r1"), network.link("r1", role="vision")
    robot.publish(FRAME, header, jpeg)
    network.advance(now_us)  # callbacks run here, each at its own due time

Each way between two links has a separate random stream per key, so that more `status` does not change the lost frames.
A way keeps the order of its messages, as a TCP connection does.
"""

import heapq
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from random import Random
from typing import Final, NamedTuple

from sightline.protocol.channels import FRAME, Channel, Direction, parse_key, pattern_for
from sightline.protocol.transports.link import BaseLink, LinkRules, Message

# Limit of messages in flight in one network. Further messages are dropped and counted as `overflow`.
MAX_IN_FLIGHT: Final = 4096


@dataclass(frozen=True, slots=True)
class Leg:
    """The effect of one direction on a message. `loss`: share 0..1; `burst`: mean number lost in a row, >= 1."""

    delay_us: int = 0
    jitter_us: int = 0
    loss: float = 0.0
    burst: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        if self.delay_us < 0 or self.jitter_us < 0 or not 0 <= self.loss <= 1 or not self.burst >= 1:
            raise ValueError(f"invalid {self}: expected delay and jitter >= 0, loss 0..1, burst >= 1")
        if self.burst > 1 and self.loss > self.burst / (self.burst + 1):
            raise ValueError(f"{self}: bursts of {self.burst:g} lose at most {self.burst / (self.burst + 1):.3f}")


def split_legs(delay_us: int, jitter_us: int, loss: float, burst: float) -> dict[Direction, Leg]:
    """Split the total added latency into halves, one per leg. Loss applies to each leg."""
    return {
        Direction.FROM_ROBOT: Leg(delay_us - delay_us // 2, jitter_us - jitter_us // 2, loss, burst),
        Direction.TO_ROBOT: Leg(delay_us // 2, jitter_us // 2, loss, burst),
    }


class _Way:
    """One channel from one link to another, with its random stream, its burst state and its order."""

    def __init__(self, name: str, leg: Leg) -> None:
        self._random = Random(name)
        self._leg = leg
        self._losing = False
        self._last_due_us = 0

    def due_us(self, now_us: int) -> int | None:
        """Return the arrival time of a message sent now, or None if it is lost."""
        # It always draws twice, so that a lost message does not change the random stream.
        lost, jitter_us = self._loses(self._random.random()), int(self._random.random() * (self._leg.jitter_us + 1))
        if lost:
            return None
        # Never before the previous message, because a TCP connection delivers in order.
        self._last_due_us = max(self._last_due_us, now_us + self._leg.delay_us + jitter_us)
        return self._last_due_us

    def _loses(self, draw: float) -> bool:
        loss, burst = self._leg.loss, self._leg.burst
        if burst == 1:
            return draw < loss
        # Gilbert model: leave the state "losing" with probability 1/burst; enter it so that the share is `loss`.
        self._losing = draw >= 1 / burst if self._losing else draw < loss / (burst * (1 - loss))
        return self._losing


@dataclass(frozen=True, slots=True)
class _Packet:
    """A message with its key and direction. `sender` is 0 for a third party."""

    sender: int
    direction: Direction
    key: str
    header: bytes
    payload: bytes


class _Flight(NamedTuple):
    """A packet in flight. Packets with equal due times arrive in order of sending."""

    due_us: int
    number: int
    to: "MemoryLink"
    packet: _Packet


class MemoryNetwork:
    """Links of any robots with one virtual clock.

    `sent`, `delivered`, `dropped` count messages per direction, `dropped` also `overflow`. A message to three links
    counts three times.
    """

    def __init__(
        self,
        seed: int = 0,
        delay_us: int = 0,
        jitter_us: int = 0,
        loss: float = 0.0,
        *,
        burst: float = 1.0,
        legs: Mapping[Direction, Leg] | None = None,
    ) -> None:
        """Create a network.

        Args:
            seed: seed of all random streams.
            delay_us: total delay, half on each leg.
            jitter_us: total jitter, half on each leg.
            loss: share of lost messages on each leg, 0 to 1.
            burst: mean number of messages lost in a row, at least 1.
            legs: separate values for each direction, in place of the others.

        Raises:
            ValueError: a value is invalid.
        """
        self.now_us = 0
        self.sent: Counter[str] = Counter()
        self.delivered: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._seed = seed
        self._legs = dict(legs) if legs is not None else split_legs(delay_us, jitter_us, loss, burst)
        self._links: list[MemoryLink] = []
        self._joined = 0
        self._number = 0
        self._flights: list[_Flight] = []
        self._ways: dict[tuple[int, int, str], _Way] = {}

    def link(self, robot: str, role: str = "", max_frame_bytes: int = FRAME.max_payload_bytes) -> "MemoryLink":
        """Create a link to `robot`. `role` is the default source of its messages toward the robot."""
        self._joined += 1
        link = MemoryLink(self, self._joined, LinkRules(robot, role, max_frame_bytes))
        self._links.append(link)
        return link

    def peers_of(self, link: "MemoryLink") -> list["MemoryLink"]:
        """Return the other open links of the same robot."""
        return [other for other in self._links if other is not link and other.robot == link.robot]

    def declare_token(self, robot: str, token: str) -> Callable[[], None]:
        """Declare a driver token of `robot`. It ends with the returned function."""
        def show(is_present: bool) -> None:
            for link in self._links:
                if link.robot == robot:
                    link.see_token(token, is_present)

        show(True)
        return lambda: show(False)

    def leave(self, link: "MemoryLink") -> None:
        """Remove `link` and all messages in flight to it."""
        # Messages to a closed link must not arrive at a later link of the same robot. Its streams are removed, too, so
        # that their number stays bounded over many restarts.
        self._links = [other for other in self._links if other is not link]
        self._flights = [flight for flight in self._flights if flight.to is not link]
        heapq.heapify(self._flights)
        self._ways = {ends: way for ends, way in self._ways.items() if link.number not in ends[:2]}

    def advance(self, now_us: int) -> None:
        """Move the clock to `now_us`, and deliver every message that is due. Raises ValueError for an earlier time."""
        if now_us < self.now_us:
            raise ValueError(f"the clock cannot go back from {self.now_us} to {now_us} us")
        while self._flights and self._flights[0].due_us <= now_us:
            self._arrive(heapq.heappop(self._flights))
        self.now_us = now_us

    def next_due_us(self) -> int | None:
        """Return the time of the next arrival, or None without a message in flight."""
        return self._flights[0].due_us if self._flights else None

    def put(self, key: str, header: bytes, payload: bytes, sender: "MemoryLink | None" = None) -> bool:
        """Send raw bytes on any key, as a third party can. Returns False without room.

        A key with a wildcard reaches every subscribed link, as on Zenoh. The receivers reject it.
        """
        parsed = parse_key(key)
        takers = [link for link in self._links if link is not sender and link.subscribes_to(key)]
        direction = parsed[1].direction if parsed else Direction.TO_ROBOT
        packet = _Packet(sender.number if sender else 0, direction, key, header, payload)
        results = [self._send(packet, to) for to in takers]
        return all(results)

    def _send(self, packet: _Packet, to: "MemoryLink") -> bool:
        self.sent[packet.direction.name] += 1
        due_us = self._way(packet, to).due_us(self.now_us)
        if due_us is None:
            self.dropped[packet.direction.name] += 1
            # The result is that of a delivered message, because a real sender does not learn of a loss.
            return True
        if len(self._flights) >= MAX_IN_FLIGHT:
            self.dropped["overflow"] += 1
            return False
        self._number += 1
        heapq.heappush(self._flights, _Flight(due_us, self._number, to, packet))
        return True

    def _way(self, packet: _Packet, to: "MemoryLink") -> _Way:
        ends = (packet.sender, to.number, packet.key)
        if ends not in self._ways:
            self._ways[ends] = _Way(f"{self._seed} {ends}", self._legs[packet.direction])
        return self._ways[ends]

    def _arrive(self, flight: _Flight) -> None:
        self.now_us = max(self.now_us, flight.due_us)
        packet = flight.packet
        self.delivered[packet.direction.name] += 1
        flight.to.receive(packet.key, packet.header, packet.payload)


class MemoryLink(BaseLink):
    """A `Link` of a `MemoryNetwork`. It does not receive its own publications."""

    def __init__(self, network: MemoryNetwork, number: int, rules: LinkRules) -> None:
        """Use `MemoryNetwork.link` instead of this constructor."""
        super().__init__(rules)
        self.number = number
        self._network = network
        self._callbacks: list[tuple[Channel, str, Callable[[Message], None]]] = []
        """Channel, pattern of its keys, callback."""
        self._on_token: Callable[[str, bool], None] | None = None

    @property
    def connected(self) -> bool:
        """Return True if another link of the same robot is open."""
        return not self._closed and bool(self._network.peers_of(self))

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Send a message to the other links of the robot, see `Link`."""
        self._rules.check(channel, header, payload)
        key = self._rules.key(channel, source)
        return self.connected and self._network.put(key, header, payload, self)

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback`, inside `MemoryNetwork.advance`, for every message with the exact key and within bounds."""
        self._callbacks.append((channel, pattern_for(self.robot, channel), callback))

    def unsubscribe(self, channel: Channel) -> None:
        """End every subscription to `channel`."""
        self._callbacks = [one for one in self._callbacks if one[0] is not channel]

    def has_listener(self, channel: Channel) -> bool:
        """Return True if another link subscribes to `channel` of this end."""
        key = self._rules.key(channel)
        return not self._closed and any(peer.subscribes_to(key) for peer in self._network.peers_of(self))

    def watch_drivers(self, callback: Callable[[str, bool], None]) -> None:
        """Call `callback` with each token that is declared from now on, and at its end."""
        self._on_token = callback

    @property
    def watches_drivers(self) -> bool:
        """Return True if this end watches driver tokens."""
        return self._on_token is not None

    def see_token(self, token: str, is_present: bool) -> None:
        """Deliver a token immediately."""
        if self._on_token is not None:
            self._on_token(token, is_present)

    def subscribes_to(self, key: str) -> bool:
        """Return True if a subscription matches `key`. As on Zenoh, a key with a wildcard matches all."""
        return any("*" in key or _matches(pattern, key) for _, pattern, _ in self._callbacks)

    def receive(self, key: str, header: bytes, payload: bytes) -> None:
        """Deliver an arrived message. Each subscription checks it, as on Zenoh."""
        # A copy, because a callback may subscribe or unsubscribe.
        for channel, pattern, callback in tuple(self._callbacks):
            if "*" in key or _matches(pattern, key):
                self._rules.deliver(channel, key, header, payload, callback)

    def close(self) -> None:
        """Leave the network. Messages in flight to this end are lost. Idempotent."""
        self._closed = True
        self._network.leave(self)


def _matches(pattern: str, key: str) -> bool:
    return key == pattern or (pattern.endswith("/*") and key.rpartition("/")[0] == pattern[:-2])
