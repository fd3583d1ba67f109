"""The vision service on a link made worse on purpose: `demo --latency-ms --loss` runs it. Shell."""

import json
import signal
import threading
from dataclasses import asdict, dataclass
from typing import Any, Self

from sightline.evaluation.demo.shaped_vision import ShapedLink
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.open import open_link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.pipeline import SOURCE
from sightline.vision_side.serving.process import serve

INJECTED = "injected: "
"""How the line begins that says, at the end, what the legs did."""


@dataclass(frozen=True, slots=True)
class Shape:
    """What to add to the network: latency in all, loss 0..1 on each leg."""

    latency_ms: float
    loss: float
    seed: int

    def text(self) -> str:
        """As `parse` reads it."""
        return f"{self.latency_ms:g},{self.loss:g},{self.seed}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `latency_ms,loss,seed`. Raises ConfigError."""
        try:
            latency_ms, loss, seed = text.split(",")
            return cls(float(latency_ms), float(loss), int(seed))
        except ValueError:
            raise ConfigError(f"--shape {text!r} is none: write latency_ms,loss,seed, e.g. 50,0.1,1") from None


def run_shaped(config: VisionConfig, shape: str) -> int:
    """Serve until SIGTERM or SIGINT, with `shape` between the link and the service. Raises as the service does."""
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
