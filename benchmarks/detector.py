"""A detector that takes a given time for each frame, as a busy GPU does, and always sees the same. Shell (sleeps)."""

import time
from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config as Settings
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Maker, result_of


class SlowDetector:
    """`--serve sightline.benchmarks.detector:SlowDetector`."""

    class Config(Settings):
        """How slow."""

        each_us: Annotated[int, Field(ge=0, le=1_000_000)] = 1_667
        """The time that one frame takes, in a batch or alone: 600 a second."""

    def __init__(self, config: Config) -> None:
        self._each_s = config.each_us / 1e6
        self._found = (Detection(10, 10, 30, 30, 0.9, "thing"),)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """As the port says; the pixels are not looked at."""
        time.sleep(self._each_s * len(frames))
        return [result_of(frame, self._found, Maker("slow", device="cpu")) for frame in frames]
