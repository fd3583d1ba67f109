"""The vision service behind a link with added latency and seeded loss. Shell (a thread).

`DelayLine` is the pure part: a bounded queue with the time as an argument. `ShapedLink` puts one on each leg and sends
due messages from a separate thread. It counts its effects, so that a run without injected faults is detected.
"""

import json
import signal
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from random import Random
from typing import Any, Final, Self

from sightline.protocol.channels import Channel, Direction
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.link import Link, LinkWrapper, Message
from sightline.protocol.transports.memory import Leg, split_legs
from sightline.protocol.transports.open import open_link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.pipeline import SOURCE
from sightline.vision_side.serving.process import serve

MAX_WAITING: Final = 256
"""Messages in flight on one leg. More are dropped and counted: 8 s of frames at 30 fps."""


@dataclass(slots=True)
class Count:
    """Messages of one leg, and lost ones."""

    sent: int = 0
    lost: int = 0
    overflow: int = 0


class DelayLine:
    """One leg. Order is kept; loss is drawn for each message from `seed`."""

    def __init__(self, leg: Leg, seed: str) -> None:
        self._leg = leg
        self._random = Random(seed)
        self._waiting: deque[tuple[int, Callable[[], Any]]] = deque()
        self.count = Count()

    def put(self, deliver: Callable[[], Any], now_us: int) -> None:
        """Queue a message: `deliver` is due after the delay of the leg, or never."""
        self.count.sent += 1
        if self._random.random() < self._leg.loss:
            self.count.lost += 1
        elif len(self._waiting) >= MAX_WAITING:
            self.count.overflow += 1
        else:
            self._waiting.append((now_us + self._leg.delay_us, deliver))

    def take_due(self, now_us: int) -> list[Callable[[], Any]]:
        """Remove and return the due messages, in order."""
        due = []
        while self._waiting and self._waiting[0][0] <= now_us:
            due.append(self._waiting.popleft()[1])
        return due

    @property
    def next_us(self) -> int | None:
        """Return when the next message is due, or None if none waits."""
        return self._waiting[0][0] if self._waiting else None


class ShapedLink(LinkWrapper):
    """A link with `latency_ms` added in total, half on each leg, and `loss` (0..1) on each leg.

    Raises ValueError for an impossible delay or loss. Closing it closes `link`.
    """

    def __init__(self, link: Link, latency_ms: float, loss: float, seed: int) -> None:
        super().__init__(link)
        self._lines = {
            direction: DelayLine(leg, f"{seed} {direction.value}")
            for direction, leg in split_legs(round(latency_ms * 1000), 0, loss, 1.0).items()
        }
        self._changed = threading.Condition()
        self._closed = False
        self._releasing = threading.Thread(target=self._release, name="shaped-link", daemon=True)
        self._releasing.start()

    @property
    def counts(self) -> dict[str, Count]:
        """Return the counters of both legs, `from_robot` and `to_robot`."""
        return {direction.name.lower(): line.count for direction, line in self._lines.items()}

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Return True also for a lost message, because a sender on a bad network does not learn of it."""
        self._put(Direction.TO_ROBOT, lambda: self._link.publish(channel, header, payload, source))
        return True

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Subscribe with the delay and the loss of the leg."""
        self._link.subscribe(
            channel, lambda message: self._put(Direction.FROM_ROBOT, lambda: callback(message))
        )

    def close(self) -> None:
        """End the link. Messages in flight are lost."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._releasing.join(1.0)
        self._link.close()

    def _put(self, direction: Direction, deliver: Callable[[], Any]) -> None:
        with self._changed:
            self._lines[direction].put(deliver, monotonic_us())
            self._changed.notify()

    def _release(self) -> None:
        while not self._closed:
            for deliver in self._wait_due():
                deliver()

    def _wait_due(self) -> list[Callable[[], Any]]:
        with self._changed:
            due = [deliver for line in self._lines.values() for deliver in line.take_due(monotonic_us())]
            if not due and not self._closed:
                next_us = min((line.next_us for line in self._lines.values() if line.next_us is not None), default=None)
                self._changed.wait(None if next_us is None else max(0.0, (next_us - monotonic_us()) / 1e6))
            return due


# The vision service on a degraded link, for `demo --latency-ms --loss`. Shell.


INJECTED = "injected: "
"""Prefix of the last line, which contains the counters of the legs."""


@dataclass(frozen=True, slots=True)
class Shape:
    """The added faults: total latency, and loss 0..1 on each leg."""

    latency_ms: float
    loss: float
    seed: int

    def text(self) -> str:
        """Return the text that `parse` reads."""
        return f"{self.latency_ms:g},{self.loss:g},{self.seed}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `latency_ms,loss,seed`. Raises ConfigError."""
        try:
            latency_ms, loss, seed = text.split(",")
            return cls(float(latency_ms), float(loss), int(seed))
        except ValueError:
            raise ConfigError(f"invalid --shape {text!r}: expected latency_ms,loss,seed, e.g. 50,0.1,1") from None


def run_shaped(config: VisionConfig, shape: str) -> int:
    """Serve until SIGTERM or SIGINT, with `shape` between link and service. Raises the errors of the service."""
    wanted = Shape.parse(shape)
    ending = threading.Event()

    def end(_number: int, _frame: Any) -> None:
        ending.set()

    with ShapedLink(
        open_link(config.robot, listen=config.listen, connect=config.connect, role=SOURCE,
                   max_frame_bytes=config.max_frame_bytes),
        wanted.latency_ms, wanted.loss, wanted.seed,
    ) as link:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, end)
        serve(config, link, ending, lambda line: print(line, flush=True))
        print(INJECTED + json.dumps({leg: asdict(count) for leg, count in link.counts.items()}), flush=True)
    return 0
