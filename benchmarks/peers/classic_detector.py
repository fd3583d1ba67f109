"""Run the color pipeline of the legacy articles, as a detector that a user would build. Shell (a clock).

The whole image is decoded, blurred, converted to HSV, thresholded and opened. The center of the largest outline
steers, in pixels, with an integral without time and bound. The constants are theirs. OpenCV uses its default threads.
"""

import time
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

_BLUR_PX: Final = (11, 11)
_LOWER_HSV: Final = (20, 25, 25)
_UPPER_HSV: Final = (64, 255, 255)
_SQUARE: Final = np.ones((3, 3), np.uint8)  # OpenCV's default for the `None` that they pass
_MIN_AREA_PX: Final = 40
_LINEAR: Final = 200.0
_ANGULAR: Final = -0.005
_ANGULAR_INTEGRAL: Final = 0.007
_DEAD_BAND: Final = 0.1


class ClassicVision:
    """Converts images to `linear|angular`, slowed by a pause (`delay_ms`) or by work (`busy_ms`)."""

    def __init__(self, delay_ms: float, busy_ms: float) -> None:
        self._delay_s, self._busy_s = delay_ms / 1000, busy_ms / 1000
        self._integral = 0.0

    def answer(self, _t_us: int, jpeg: bytes) -> str:
        """Return the command for an image. Raises ValueError for an image that does not decode."""
        picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise ValueError("the picture does not decode")
        if self._delay_s:
            time.sleep(self._delay_s)
        until_s = time.perf_counter() + self._busy_s
        outline = largest_outline(picture)
        while time.perf_counter() < until_s:
            outline = largest_outline(picture)
        return self._steer(outline, picture.shape[1])

    def _steer(self, outline: NDArray[Any] | None, width_px: int) -> str:
        area = 0.0 if outline is None else cv2.contourArea(outline)
        if outline is None or area <= _MIN_AREA_PX:
            return "0|0"
        moments = cv2.moments(outline)
        off = (moments["m10"] / moments["m00"] - width_px / 2) * _ANGULAR
        self._integral += off
        angular = off + _ANGULAR_INTEGRAL * self._integral if abs(off) > _DEAD_BAND else 0
        return f"{_LINEAR / area}|{angular}"


def largest_outline(picture: NDArray[Any]) -> NDArray[Any] | None:
    """Return the largest outline in the yellow range of the legacy articles, or None."""
    hsv = cv2.cvtColor(cv2.GaussianBlur(picture, _BLUR_PX, 0), cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, _LOWER_HSV, _UPPER_HSV)
    mask = cv2.dilate(cv2.erode(mask, _SQUARE, iterations=2), _SQUARE, iterations=2)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    largest = max(outlines, key=cv2.contourArea, default=None)
    if largest is not None:
        cv2.minEnclosingCircle(largest)  # their measure of distance, which they compute and do not use
    return largest
