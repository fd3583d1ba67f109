"""The detectors `hsv` and `adaptive` behind the port. Shell (a clock)."""

from collections.abc import Sequence
from typing import Final

from sightline.protocol.config import Config as Settings
from sightline.protocol.messages import MAX_DETECTED_BOXES
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.color.adaptive import AdaptiveConfig, AdaptiveTracker
from sightline.vision_side.detect.color.hsv import HsvDetector, RangeCheck
from sightline.vision_side.detect.per_robot import PerSession
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Label, Maker
from sightline.vision_side.detect.timing import timed

_CPU: Final = "cpu"

class Hsv:
    """The color detector. It has no memory of earlier frames."""

    class Config(Settings):
        """The section `hsv` of the vision configuration, and the label of the detections."""

        hsv: HsvConfig = HsvConfig()
        label: Label = "target"

    maker = Maker("hsv", device=_CPU)

    def __init__(self, config: Config) -> None:
        self._hsv_detector = HsvDetector(config.hsv, config.label)
        self._check = RangeCheck(self._hsv_detector.mask)
        self._notices: list[str] = []

    def notices(self) -> list[str]:
        """Return, once, a line if the range marks more than a target."""
        notices, self._notices = self._notices, []
        return notices

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """Return a result for each frame. One takes well under a millisecond, so the deadline does not matter."""
        return [timed(frame, self.maker, self._largest) for frame in frames]

    def _largest(self, picture: DecodedImage) -> tuple[Detection, ...]:
        if line := self._check.look(picture):
            self._notices.append(f"{line}, or use `--detector onnx`")
        return self._hsv_detector.detect(picture)[:MAX_DETECTED_BOXES]


class Adaptive:
    """The color detector that learns the color of the target, separately for each robot."""

    Config = AdaptiveConfig
    maker = Maker("adaptive", device=_CPU)

    def __init__(self, config: AdaptiveConfig) -> None:
        self._trackers = PerSession(lambda: AdaptiveTracker(config))

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """Return a result for each frame. One takes two or three times as long as a plain color range."""
        return [self._look(frame) for frame in frames]

    def _look(self, frame: DetectFrame) -> DetectionResult | None:
        # A track is in pixels. In an image of another size it would expect the target elsewhere.
        tracker = self._trackers.of(frame.robot, (frame.header.session, frame.width_px, frame.height_px))
        t_us = frame.header.t_us
        return timed(frame, self.maker, lambda picture: tracker.detect(picture, t_us))


