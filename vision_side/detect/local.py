"""Detectors of one decoded picture, behind the port: who made the result, and how long it took. Shell (a clock)."""

import time
from collections.abc import Callable, Sequence
from typing import Final

from protocol.config import Config as Settings
from protocol.errors import WireError
from protocol.messages import MAX_DETECTED_BOXES
from vision_side.config import HsvConfig
from vision_side.decode import Picture
from vision_side.detect.adaptive import AdaptiveConfig, AdaptiveEye
from vision_side.detect.by_session import BySession
from vision_side.detect.hsv import HsvDetector
from vision_side.detect.labels import Label
from vision_side.detect.port import DetectFrame, Detection, DetectionResult, Maker, PictureDetector, clipped, result_of

_CPU: Final = "cpu"


class Hsv:
    """The colour detector; it remembers nothing from frame to frame."""

    class Config(Settings):
        """The section `hsv` of vision's configuration, and what its detections are called."""

        hsv: HsvConfig = HsvConfig()
        label: Label = "target"

    maker = Maker("hsv", device=_CPU)

    def __init__(self, config: Config) -> None:
        self._eye = HsvDetector(config.hsv, config.label)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """A result for each; it takes well under a millisecond, whatever the deadline."""
        return [timed(frame, self.maker, self._largest) for frame in frames]

    def _largest(self, picture: Picture) -> tuple[Detection, ...]:
        return self._eye.detect(picture)[:MAX_DETECTED_BOXES]


class Adaptive:
    """The colour detector that learns the target's colour as it goes, one memory for each robot."""

    Config = AdaptiveConfig
    maker = Maker("adaptive", device=_CPU)

    def __init__(self, config: AdaptiveConfig) -> None:
        self._eyes = BySession(lambda: AdaptiveEye(config))

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """A result for each; one takes two or three times as long as by plain colour, whatever the deadline."""
        return [self._look(frame) for frame in frames]

    def _look(self, frame: DetectFrame) -> DetectionResult | None:
        eye, t_us = self._eyes.of(frame.robot, frame.header.session), frame.header.t_us
        return timed(frame, self.maker, lambda picture: eye.detect(picture, t_us))


class Clocked:
    """A detector of one picture, and how long it looked the last time; None before the first."""

    def __init__(self, inner: PictureDetector) -> None:
        self._inner = inner
        self.took_us: int | None = None

    def detect(self, picture: Picture) -> tuple[Detection, ...]:
        """What the one inside finds."""
        started_ns = time.perf_counter_ns()
        found = self._inner.detect(picture)
        self.took_us = (time.perf_counter_ns() - started_ns) // 1000
        return found


def timed(
    frame: DetectFrame, maker: Maker, look: Callable[[Picture], Sequence[Detection]]
) -> DetectionResult | None:
    """What `look` finds in the picture of `frame`, and how long it looked; None for what is no picture."""
    return timed_together([frame], maker, lambda pictures: [look(one) for one in pictures])[0]


def timed_together(
    frames: Sequence[DetectFrame], maker: Maker, look: Callable[[Sequence[Picture]], list[Sequence[Detection]]]
) -> list[DetectionResult | None]:
    """The same of several pictures at once, each with its share of the time."""
    pictures = [_picture_of(frame) for frame in frames]
    there = [one for one in pictures if one is not None]
    started_ns = time.perf_counter_ns()
    found = iter(look(there) if there else [])
    each_us = (time.perf_counter_ns() - started_ns) // 1000 // max(1, len(there))
    return [None if picture is None else result_of(frame, _inside(frame, next(found)), maker, each_us)
            for frame, picture in zip(frames, pictures, strict=True)]


def _inside(frame: DetectFrame, found: Sequence[Detection]) -> list[Detection]:
    """A picture of odd size that was decoded at half scale is a pixel larger than the encoded one."""
    return [part for one in found if (part := clipped(one, frame.width_px, frame.height_px))]


def _picture_of(frame: DetectFrame) -> Picture | None:
    try:
        return frame.picture()
    except WireError:
        return None
