"""The vision service with a tap: keeps what the frames' headers say, and may be made slow. Shell.

`python -m sightline.benchmarks.loop_vision SETTINGS`. The service is `sightline.vision_side.service.Service` as it is; the tap costs an
append per frame, and only a detector made slow is put into its pipeline.
"""

import json
import signal
import sys
import threading
from pathlib import Path

from sightline.benchmarks.loop.vision import build_pipeline
from sightline.protocol.channels import MAX_HEADER_BYTES
from sightline.protocol.codec import decode
from sightline.protocol.messages import CameraModel, FrameHeader
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import open_link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.pipeline import SOURCE
from sightline.vision_side.service import Service

_WAIT_S = 0.2


def _say(line: str) -> None:
    print(line, flush=True)


class TappedService(Service):
    """Remembers the header of every frame it was given."""

    def __init__(self, config: VisionConfig, link: Link, delay_ms: float, busy_ms: float) -> None:
        self._delay_ms, self._busy_ms = delay_ms, busy_ms
        super().__init__(config, link, _say)
        self.headers: list[bytes] = []

    def _use(self, camera: CameraModel) -> None:
        super()._use(camera)
        if self._delay_ms or self._busy_ms:
            self._pipeline = build_pipeline(self._config, camera, self._delay_ms, self._busy_ms)

    def _frame(self, message: Message, started_ns: int) -> None:
        self.headers.append(message.header)
        super()._frame(message, started_ns)


def main(settings: dict[str, object]) -> None:
    """Serve until SIGTERM, then write the headers as (seq, t_us, latency_us)."""
    config = VisionConfig.model_validate(settings["config"])
    ending = threading.Event()
    with open_link(config.robot, connect=config.connect, role=SOURCE) as link:
        signal.signal(signal.SIGTERM, lambda *_: ending.set())
        delay_ms, busy_ms = float(str(settings["delay_ms"])), float(str(settings["busy_ms"]))
        service = TappedService(config, link, delay_ms, busy_ms)
        while not ending.is_set():
            service.turn(_WAIT_S)
    headers = [decode(FrameHeader, header, MAX_HEADER_BYTES) for header in service.headers]
    rows = [(header.seq, header.t_us, header.latency_us) for header in headers]
    Path(str(settings["tally"])).write_text(json.dumps(rows))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
