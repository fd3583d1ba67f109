"""Makes sure that a detector's answer is one: of this frame, finite, within the picture, not too many. Pure.

The detector may be a plug-in or another machine; whatever it says, no more than this gets to a mission.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from vision_side.detect.port import DetectFrame, Detection, DetectionResult, Detector, clipped

MAX_DETECTIONS: Final = 256
"""Security limit: as many as the channel `detections` takes; more is no answer."""
_LONGEST_LABEL: Final = 64
_LONGEST_WHY: Final = 160


def asked(detector: Detector, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | str]:
    """What `detector` sees in each frame, or why that is no answer; whatever a plug-in does ends here."""
    try:
        results = detector.detect(frames, deadline_us)
        if len(results) != len(frames):
            raise ValueError(f"{len(results)} results for {len(frames)} frames")
    except Exception as error:  # a plug-in's own
        return [_why(error)] * len(frames)
    return [_answer(frame, result) for frame, result in zip(frames, results, strict=True)]


def _answer(frame: DetectFrame, result: DetectionResult | None) -> DetectionResult | str:
    try:
        return checked(frame, result) if result is not None else "the detector gave no answer in time"
    except Exception as error:  # of what may be no result at all
        return _why(error)


def _why(error: Exception) -> str:
    return f"the detector's answer is none: {type(error).__name__}: {error}"[:_LONGEST_WHY]


def checked(frame: DetectFrame, result: DetectionResult) -> DetectionResult:
    """`result` with its boxes clipped to the picture, those outside of it left out.

    Raises ValueError, with the reason, for what is no answer to `frame`.
    """
    header, named = frame.header, (result.robot, result.session, result.seq, result.t_us)
    if named != (frame.robot, header.session, header.seq, header.t_us):
        raise ValueError("it answers another frame")
    if (result.width_px, result.height_px) != (frame.width_px, frame.height_px):
        raise ValueError(f"it is about a {result.width_px}x{result.height_px} picture")
    found = result.detections
    if len(found) > MAX_DETECTIONS:
        raise ValueError(f"{len(found)} boxes; {MAX_DETECTIONS} is the most")
    inside = tuple(part for one in found if (part := _checked(one, frame.width_px, frame.height_px)))
    unchanged = len(found) == len(inside) and all(one is part for one, part in zip(found, inside, strict=True))
    return result if unchanged else replace(result, detections=inside)


def _checked(one: Detection, width_px: int, height_px: int) -> Detection | None:
    numbers = [one.x1_px, one.y1_px, one.x2_px, one.y2_px, one.score]
    if one.circle is not None:
        numbers += [one.circle.cx_px, one.circle.cy_px, one.circle.radius_px]
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError("a box with a number that is none")
    if not 0 <= one.score <= 1:
        raise ValueError(f"a score of {one.score:g}; it is between 0 and 1")
    if len(one.label) > _LONGEST_LABEL:
        raise ValueError(f"a label of {len(one.label)} characters; {_LONGEST_LABEL} is the most")
    return clipped(one, width_px, height_px)
