"""The bench in real time over a link, and in virtual time over a network in memory. Shell (threads, a clock)."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Final, Protocol, Self

from sightline.conformance.case import Access, Bench, NotApplicableError
from sightline.conformance.raw_peers import RawZenoh
from sightline.protocol.channels import CHANNELS, Channel, Direction
from sightline.protocol.clock import monotonic_us
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.memory import MemoryLink, MemoryNetwork
from sightline.protocol.transports.security import certificate_role
from sightline.protocol.transports.tokens import DriverToken, RobotToken

_WAITING: Final = 1024  # messages that a case has not yet handled; it handles them every few milliseconds
_NAP_S: Final = 0.005


class LiveBench(Bench):
    """A context manager. Callbacks of the link only store messages; the thread of the case handles them."""

    def __init__(
        self,
        robot: str,
        open_it: Callable[[str], Link],
        channels: Sequence[Channel],
        put_it: Callable[[str, bytes, bytes], None] | None = None,
        *,
        third_party: RawZenoh | None = None,
        roles: Sequence[str] = ("vision",),
        endpoint: str = "",
        legacy: str = "",
        access: Access | None = None,
    ) -> None:
        """Set up links. `open_it(role)` opens one, also after each `leave`; `put_it` sends messages that links reject.

        `third_party` declares tokens.

        With keys for sources, each of `roles` has a separate link. The first one receives, and sends everything that
        no other may send. Raises the errors of `open_it`.
        """
        super().__init__(robot, endpoint, legacy, access)
        self._open_it, self._channels, self._put_it, self._roles = open_it, channels, put_it, roles
        self._third_party = third_party
        self._links: dict[str, Link] = {}
        self._news = threading.Condition()
        self._waiting: deque[Message] = deque(maxlen=_WAITING)
        self._dropped: Counter[str] = Counter()
        self.join()

    @property
    def now_us(self) -> int:
        return monotonic_us()

    @property
    def dropped_here(self) -> Counter[str]:
        return sum((link.rejected for link in self._links.values()), self._dropped)

    def send(self, channel: Channel, header: bytes, payload: bytes, source: str) -> None:
        link = self._links.get(certificate_role(source)) or self._links.get(self._roles[0])
        if link is not None:
            link.publish(channel, header, payload, source)

    def put(self, key: str, header: bytes, payload: bytes) -> None:
        if self._put_it is None:
            raise NotApplicableError("over WebSocket nothing is sent under a key")
        self._put_it(key, header, payload)

    def declare_token(self, token: str) -> Callable[[], None]:
        if self._third_party is None or not self._third_party.has_token(RobotToken(self.robot)):
            raise NotApplicableError("the robot declares no liveliness token")
        return self._third_party.declare_token(DriverToken(self.robot, "kit", token))

    def leave(self) -> None:
        for role in tuple(self._links):
            link = self._links.pop(role)
            link.close()
            self._dropped += link.rejected

    def join(self) -> None:
        opened: dict[str, Link] = {}
        try:
            for role in self._roles:
                opened[role] = self._open_it(role)
        except BaseException:
            for link in opened.values():
                link.close()
            raise
        self._links = opened
        for channel in self._channels:
            self._links[self._roles[0]].subscribe(channel, self._store)

    def restore(self) -> None:
        if not self._links:
            self.join()

    def _store(self, message: Message) -> None:
        with self._news:
            self._waiting.append(message)
            self._news.notify()

    def _pass_time(self, until_us: int) -> None:
        with self._news:
            if not self._waiting:
                self._news.wait(min(_NAP_S, max(0, until_us - self.now_us) / 1e6))
            waiting = list(self._waiting)
            self._waiting.clear()
        for message in waiting:
            self._receive(message)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self.leave()


# A bench in virtual time: the peer is an object, the network is memory, a second takes milliseconds. Pure.
# network = MemoryNetwork()     bench = VirtualBench(network, [MyPeer(network)], receives=FROM_ROBOT, robot="r1")  The
# peer creates links in that network. Its `tick` runs at every step, its subscriptions as messages arrive.


STEP_US: Final = 5_000
"""Fine enough for ticks of 20 ms and frames of 33 ms; a second takes 200 steps."""
FROM_ROBOT: Final = tuple(one for one in CHANNELS.values() if one.direction is Direction.FROM_ROBOT)
"""Channels that a kit receives when it tests a robot."""
TO_ROBOT: Final = tuple(one for one in CHANNELS.values() if one.direction is Direction.TO_ROBOT)
"""Channels that a kit receives when it plays a robot."""
_MOST_ANSWERS = 8  # messages back and forth within one step


class Ticking(Protocol):
    """A peer in virtual time."""

    def tick(self, now_us: int) -> None:
        """Do the due work."""
        ...


class VirtualBench(Bench):
    """A bench in virtual time; see the module."""

    def __init__(
        self, network: MemoryNetwork, peers: Sequence[Ticking], channels: Sequence[Channel], robot: str = "r1",
        access: Access | None = None,
    ) -> None:
        super().__init__(robot, access=access)
        self._network, self._peers, self._channels = network, peers, channels
        self._link: MemoryLink | None = None
        self._dropped: Counter[str] = Counter()
        self.join()

    @property
    def now_us(self) -> int:
        return self._network.now_us

    @property
    def dropped_here(self) -> Counter[str]:
        return self._dropped + (self._link.rejected if self._link else Counter())

    def send(self, channel: Channel, header: bytes, payload: bytes, source: str) -> None:
        if self._link is not None:
            self._link.publish(channel, header, payload, source)

    def put(self, key: str, header: bytes, payload: bytes) -> None:
        self._network.put(key, header, payload, self._link)

    def declare_token(self, token: str) -> Callable[[], None]:
        if self._link is None or not any(link.watches_drivers for link in self._network.peers_of(self._link)):
            raise NotApplicableError("the robot declares no liveliness token")
        return self._network.declare_token(self.robot, token)

    def leave(self) -> None:
        if self._link is not None:
            self._dropped += self._link.rejected
            self._link.close()
            self._link = None

    def join(self) -> None:
        self._link = self._network.link(self.robot)
        for channel in self._channels:
            self._link.subscribe(channel, self._receive)

    def _pass_time(self, until_us: int) -> None:
        now_us = min(until_us, self.now_us + STEP_US)
        self._network.advance(now_us)
        for peer in self._peers:
            peer.tick(now_us)
        for _ in range(_MOST_ANSWERS):
            due_us = self._network.next_due_us()
            if due_us is None or due_us > now_us:
                break
            self._network.advance(now_us)
