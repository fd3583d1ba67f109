"""A bad network, one direction at a time: delay, jitter, loss, bursts, rate, reordering. Pure.

The caller passes the time and the packets, and a seed defines the losses. `sim/tun_emulator.py` carries real packets.
"""

import heapq
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from random import Random
from typing import Annotated, Final

from pydantic import Field

from sightline.protocol.config import Config

IP_HEADER_BYTES: Final = 20
MAX_WAITING: Final = 400
"""Packets in flight on one leg. More are dropped and counted, as in the queue of a radio."""

Chance = Annotated[float, Field(ge=0, le=1)]
Milliseconds = Annotated[float, Field(ge=0, le=60_000)]


class LinkShape(Config):
    """The effects of the network on one direction. The default is a perfect link."""

    delay_ms: Milliseconds = 0
    jitter_ms: Milliseconds = 0
    """Uniform, in both directions; order is kept."""
    loss: Chance = 0
    burst_start: Chance = 0
    """Probability per packet that a burst begins. A burst loses all packets ..."""
    burst_end: Chance = 1
    """... and the probability that it ends."""
    rate_bit_s: Annotated[float, Field(ge=0, le=1e10)] = 0
    """0: unlimited."""
    queue_packets: Annotated[int, Field(ge=1, le=MAX_WAITING)] = 200
    duplicate: Chance = 0
    reorder: Chance = 0
    """Probability that a packet overtakes all waiting packets: it skips delay and queue."""
    corrupt: Chance = 0
    """Probability that one bit after the IP header flips."""
    cut: bool = False
    """Nothing passes, and packets in flight are lost."""


class LinkShapes(Config):
    """Both directions: A to B and back. With `half_duplex` they share one medium."""

    ab: LinkShape = LinkShape()
    ba: LinkShape = LinkShape()
    half_duplex: bool = False
    seed: Annotated[int, Field(ge=0)] | None = None
    """Seed of all random draws from now on."""


@dataclass(slots=True)
class Counts:
    """Counters of one direction."""

    taken: int = 0
    delivered: int = 0
    delivered_bytes: int = 0
    delayed: int = 0
    lost: int = 0
    cut: int = 0
    overflow: int = 0
    duplicated: int = 0
    reordered: int = 0
    corrupted: int = 0


@dataclass(slots=True)
class Medium:
    """A medium that carries one packet at a time. Legs that share it are half duplex."""

    free_us: float = 0.0


class EmulatedLeg:
    """One direction. The caller puts packets in and takes due ones out. Times must not decrease."""

    def __init__(self, seed: str) -> None:
        self.shape = LinkShape()
        self.medium = Medium()
        self.counts = Counts()
        self.random = Random(seed)
        self._waiting: list[tuple[float, int, bytes]] = []
        self._order = 0
        self._last_us = 0.0
        self._in_burst = False

    def put(self, packet: bytes, now_us: int) -> None:
        """Add a packet. Its loss and its delay are drawn now."""
        self.counts.taken += 1
        if self.shape.cut:
            self.counts.cut += 1
        elif self._is_lost():
            self.counts.lost += 1
        elif len(self._waiting) >= self.shape.queue_packets:
            self.counts.overflow += 1
        else:
            self._accept(packet, now_us)

    def _is_lost(self) -> bool:
        shape, draw = self.shape, self.random.random
        chance = shape.burst_end if self._in_burst else shape.burst_start
        if chance and draw() < chance:
            self._in_burst = not self._in_burst
        return self._in_burst or draw() < shape.loss

    def _accept(self, packet: bytes, now_us: int) -> None:
        shape, draw = self.shape, self.random.random
        due_us = self._due_us(len(packet), now_us)
        if draw() < shape.corrupt and len(packet) > IP_HEADER_BYTES:
            packet = _flipped(packet, self.random)
            self.counts.corrupted += 1
        self._wait(packet, due_us)
        if draw() < shape.duplicate:
            self.counts.duplicated += 1
            self._wait(packet, due_us)

    def _due_us(self, size_bytes: int, now_us: int) -> float:
        shape = self.shape
        if self.random.random() < shape.reorder:
            self.counts.reordered += bool(self._waiting)
            return now_us
        sent_us = float(now_us)
        if shape.rate_bit_s:
            sent_us = self.medium.free_us = max(sent_us, self.medium.free_us) + size_bytes * 8e6 / shape.rate_bit_s
        jitter_ms = self.random.uniform(-shape.jitter_ms, shape.jitter_ms)
        self._last_us = max(self._last_us, sent_us + max(0.0, shape.delay_ms + jitter_ms) * 1000)
        self.counts.delayed += self._last_us > now_us
        return self._last_us

    def _wait(self, packet: bytes, due_us: float) -> None:
        self._order += 1
        heapq.heappush(self._waiting, (due_us, self._order, packet))

    def take_due(self, now_us: int) -> Iterator[bytes]:
        """Yield the packets that arrive by now, in order. A cut link loses them."""
        while self._waiting and self._waiting[0][0] <= now_us:
            packet = heapq.heappop(self._waiting)[2]
            if self.shape.cut:
                self.counts.cut += 1
            else:
                self.counts.delivered += 1
                self.counts.delivered_bytes += len(packet)
                yield packet

    @property
    def next_us(self) -> float | None:
        """Return when the next packet is due, or None if none waits."""
        return self._waiting[0][0] if self._waiting else None


def _flipped(packet: bytes, random: Random) -> bytes:
    changed = bytearray(packet)
    changed[random.randrange(IP_HEADER_BYTES, len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


class EmulatedLink:
    """Two legs on one medium, or on one each."""

    def __init__(self) -> None:
        self.ab, self.ba = EmulatedLeg("1 ab"), EmulatedLeg("1 ba")

    def shape(self, shapes: LinkShapes) -> None:
        """Apply `shapes` to packets from now on."""
        self.ab.shape, self.ba.shape = shapes.ab, shapes.ba
        if shapes.seed is not None:
            self.ab.random, self.ba.random = Random(f"{shapes.seed} ab"), Random(f"{shapes.seed} ba")
        if shapes.half_duplex != (self.ab.medium is self.ba.medium):
            self.ba.medium = self.ab.medium if shapes.half_duplex else Medium()

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the counters of both directions since the start."""
        return {"ab": asdict(self.ab.counts), "ba": asdict(self.ba.counts)}
