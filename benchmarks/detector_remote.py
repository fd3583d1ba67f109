"""What a detector elsewhere costs beside the same one in this process: time from frame to result. Shell (the clock).

The two are asked in turns about the same frames, so that whatever else the machine does falls on both: hot, one frame
after the other, and paced as a robot sends them, when caches are cold on every side.
"""

import time
from dataclasses import dataclass
from itertools import count
from statistics import median
from typing import Final

from sightline.protocol.channels import FRAME
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.messages import FrameHeader
from sightline.protocol.transports.link import Link
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import DetectFrame, Detector

PACED_S: Final = 1 / 30
HOT_S: Final = 0.0
_WARM: Final = 30
_DEADLINE_US: Final = 500_000


@dataclass(frozen=True, slots=True)
class Cost:
    """Microseconds for one frame, medians; `unanswered` of the frames that were asked about elsewhere."""

    here_us: float
    there_us: float
    unanswered: int

    @property
    def added_us(self) -> float:
        """What it costs to ask elsewhere."""
        return self.there_us - self.here_us


def measure_cost(here: Detector, there: Detector, jpeg: bytes, size_px: tuple[int, int], *, frames: int = 300,
                 period_s: float = HOT_S, robot: Link | None = None) -> Cost:
    """Ask both about `frames` frames. With `robot` they are also published, for a service that hears them itself."""
    decoder, numbers, took = Decoder(*size_px, size_px[0] * size_px[1]), count(1), (list[float](), list[float]())
    unanswered = 0
    next_s = time.monotonic()
    for index in range(_WARM + frames):
        next_s += period_s
        time.sleep(max(0.0, next_s - time.monotonic()))
        for which, one in enumerate((here, there)):
            frame = DetectFrame("r1", _header(next(numbers)), jpeg, decoder)
            us, answered = _timed(one, frame, robot if which else None)
            if index >= _WARM:
                unanswered += not answered
                took[which].append(us)
    return Cost(median(took[0]), median(took[1]), unanswered)


def _timed(detector: Detector, frame: DetectFrame, robot: Link | None) -> tuple[float, bool]:
    began_ns = time.perf_counter_ns()
    if robot is not None:
        robot.publish(FRAME, encode(frame.header), frame.jpeg)
    result = detector.detect([frame], monotonic_us() + _DEADLINE_US)[0]
    return (time.perf_counter_ns() - began_ns) / 1000, result is not None


def _header(number: int) -> FrameHeader:
    return FrameHeader(session="0000abcd", seq=number, t_us=monotonic_us())
