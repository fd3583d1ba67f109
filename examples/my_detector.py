"""A custom detector: the brightest spot in the image. Shell (a clock).

    sightline detector check examples.my_detector:BrightestSpot
    sightline vision --detector examples.my_detector:BrightestSpot --set detector.options.least=220
"""

import time
from collections.abc import Sequence

import cv2
from pydantic import Field

from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import WireError
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Maker, clipped, result_of

SPOT_PX = 16
WHO = Maker("brightest-spot", device="cpu")


class BrightestSpot:
    """Finds the brightest spot, if it is bright enough."""

    class Config(Settings):
        """`[detector.options]`."""

        least: int = Field(200, ge=0, le=255)

    def __init__(self, config: Config) -> None:
        self.config = config

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """Return one result for each frame, in order; None is "no answer"."""
        return [self.look(frame) for frame in frames]

    def look(self, frame: DetectFrame) -> DetectionResult | None:
        """Find objects in one frame."""
        started_ns = time.perf_counter_ns()
        try:
            picture = frame.picture()
        except WireError:
            return None
        gray = cv2.blur(cv2.cvtColor(picture.bgr, cv2.COLOR_BGR2GRAY), (9, 9))
        _, brightest, _, (x, y) = cv2.minMaxLoc(gray)
        found = [self.spot(x * picture.scale, y * picture.scale, brightest)] if brightest >= self.config.least else []
        inside = [part for one in found if (part := clipped(one, frame.width_px, frame.height_px))]
        return result_of(frame, inside, WHO, (time.perf_counter_ns() - started_ns) // 1000)

    def spot(self, x_px: float, y_px: float, brightness: float) -> Detection:
        """Return a box around the spot, in pixels of the encoded image."""
        return Detection(x_px - SPOT_PX, y_px - SPOT_PX, x_px + SPOT_PX, y_px + SPOT_PX, brightness / 255, "spot")
