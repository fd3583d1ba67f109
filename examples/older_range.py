"""Run the color detector with the legacy article's range for "yellow": from orange to pure green, and any beige. Shell.

    sightline score detectors hsv examples.older_range:OlderRange

It is (20, 25, 25) to (64, 255, 255) in OpenCV's units: half degrees, and 25 of 255. The rest is as in `hsv`, including
the test for round objects, which the article did not have.
"""

from sightline.vision_side.config import HsvRange
from sightline.vision_side.detect.color.detectors import Hsv

RANGE = HsvRange(hue_low_deg=40, hue_high_deg=128, saturation_low=0.098, value_low=0.098)


class OlderRange(Hsv):
    """The detector `hsv` with a fixed range, independent of the configuration."""

    def __init__(self, config: Hsv.Config) -> None:
        super().__init__(config.model_copy(update={"hsv": config.hsv.model_copy(update={"ranges": (RANGE,)})}))
