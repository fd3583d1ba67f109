"""The detectors `hsv` and `adaptive` behind the port. Shell (a clock)."""

from collections.abc import Sequence
from typing import Final

from sightline.protocol.config import Config as Settings
from sightline.protocol.messages import MAX_DETECTED_BOXES
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.color.adaptive import AdaptiveConfig, AdaptiveTracker
from sightline.vision_side.detect.color.hsv import HsvDetector
from sightline.vision_side.detect.per_robot import PerSession
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Label, Maker
from sightline.vision_side.detect.timing import timed

_CPU: Final = "cpu"
_FLOODED_SHARE: Final = 0.25
"""Of an image: a range that marks so much of it marks a floor or a wall. Of 365 photographs of places without a target,
the default range marks that much in 2 %."""
_FLOODED_IMAGES: Final = 15
"""So many ..."""
_CHECKED_IMAGES: Final = 90
"""... of the first images, for a notice."""


class Hsv:
    """The color detector; it remembers nothing from frame to frame."""

    class Config(Settings):
        """The section `hsv` of vision's configuration, and what its detections are called."""

        hsv: HsvConfig = HsvConfig()
        label: Label = "target"

    maker = Maker("hsv", device=_CPU)

    def __init__(self, config: Config) -> None:
        self._hsv_detector = HsvDetector(config.hsv, config.label)
        self._checked, self._flooded = 0, list[float]()
        self._notices: list[str] = []

    def notices(self) -> list[str]:
        """Return, once, that the range marks more than a target."""
        notices, self._notices = self._notices, []
        return notices

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """Return a result for each frame. One takes well under a millisecond, so the deadline does not matter."""
        return [timed(frame, self.maker, self._largest) for frame in frames]

    def _largest(self, picture: DecodedImage) -> tuple[Detection, ...]:
        if self._checked < _CHECKED_IMAGES:
            self._check_range(picture)
        return self._hsv_detector.detect(picture)[:MAX_DETECTED_BOXES]

    def _check_range(self, picture: DecodedImage) -> None:
        """Note that the first images are full of the color. Later ones may show a target that is near."""
        self._checked += 1
        share = self._hsv_detector.mask.share(picture.bgr)
        if share >= _FLOODED_SHARE:
            self._flooded.append(share)
        if len(self._flooded) == _FLOODED_IMAGES:
            self._checked = _CHECKED_IMAGES
            self._notices.append(f"the color range marks {sum(self._flooded) / _FLOODED_IMAGES:.0%} of the image: the "
                                 "floor or a wall has that color in this light; pick the target's own with `sightline "
                                 "pick-color`, or use `--detector onnx`")


class Adaptive:
    """The color detector that learns the target's color as it goes, one memory for each robot."""

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


