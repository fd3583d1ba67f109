"""A bench in virtual time: the peer is an object, the network is memory, a second takes milliseconds. Pure.

    network = MemoryNetwork()
    bench = VirtualBench(network, [MyPeer(network)], hears=FROM_ROBOT, robot="r1")

The peer makes links of its own in that network; its `tick` is called at every step, its subscriptions as messages come.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Final, Protocol

from sightline.protocol.channels import CHANNELS, Channel, Direction
from sightline.protocol.conformance.bench import Bench
from sightline.protocol.transports.memory import MemoryLink, MemoryNetwork

STEP_US: Final = 5_000
"""Fine enough for ticks of 20 ms and frames of 33 ms, coarse enough that a second costs 200 steps."""
FROM_ROBOT: Final = tuple(one for one in CHANNELS.values() if one.direction is Direction.FROM_ROBOT)
"""What a kit that tests a robot hears."""
TO_ROBOT: Final = tuple(one for one in CHANNELS.values() if one.direction is Direction.TO_ROBOT)
"""What a kit that plays a robot hears."""
_MOST_ANSWERS = 8  # messages that go to and fro within one step, before time goes on


class Ticking(Protocol):
    """A peer in virtual time."""

    def tick(self, now_us: int) -> None:
        """Do what is due."""
        ...


class VirtualBench(Bench):
    """See the module."""

    def __init__(
        self, network: MemoryNetwork, peers: Sequence[Ticking], hears: Sequence[Channel], robot: str = "r1"
    ) -> None:
        super().__init__(robot)
        self._network, self._peers, self._hears = network, peers, hears
        self._link: MemoryLink | None = None
        self._dropped: Counter[str] = Counter()
        self.join()

    @property
    def now_us(self) -> int:
        return self._network.now_us

    @property
    def dropped_here(self) -> Counter[str]:
        return self._dropped + (self._link.refused if self._link else Counter())

    def send(self, channel: Channel, header: bytes, payload: bytes, source: str) -> None:
        if self._link is not None:
            self._link.publish(channel, header, payload, source)

    def put(self, key: str, header: bytes, payload: bytes) -> None:
        self._network.put(key, header, payload, self._link)

    def leave(self) -> None:
        if self._link is not None:
            self._dropped += self._link.refused
            self._link.close()
            self._link = None

    def join(self) -> None:
        self._link = self._network.link(self.robot)
        for channel in self._hears:
            self._link.subscribe(channel, self._hear)

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
