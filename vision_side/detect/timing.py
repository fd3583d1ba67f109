"""Measure the time of a detection function, and build its results. Shell (a clock)."""

import time
from collections.abc import Callable, Sequence

from sightline.protocol.errors import WireError
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import (
    DetectFrame,
    Detection,
    DetectionResult,
    Maker,
    clipped,
    result_of,
)


def _picture_of(frame: DetectFrame) -> DecodedImage | None:
    try:
        return frame.picture()
    except WireError:
        return None


def _inside(frame: DetectFrame, found: Sequence[Detection]) -> list[Detection]:
    """Clip boxes to the encoded image. The half-scale image of an odd size is one pixel larger."""
    return [part for one in found if (part := clipped(one, frame.width_px, frame.height_px))]


def timed_together(
    frames: Sequence[DetectFrame], maker: Maker,
    look: Callable[[Sequence[tuple[DetectFrame, DecodedImage]]], list[Sequence[Detection]]],
) -> list[DetectionResult | None]:
    """Measure a batch, and assign each image its share of the time. Frames with an invalid image get None."""
    pictures = [_picture_of(frame) for frame in frames]
    there = [(frame, picture) for frame, picture in zip(frames, pictures, strict=True) if picture is not None]
    started_ns = time.perf_counter_ns()
    found = iter(look(there) if there else [])
    each_us = (time.perf_counter_ns() - started_ns) // 1000 // max(1, len(there))
    return [None if picture is None else result_of(frame, _inside(frame, next(found)), maker, each_us)
            for frame, picture in zip(frames, pictures, strict=True)]


def timed(
    frame: DetectFrame, maker: Maker, look: Callable[[DecodedImage], Sequence[Detection]]
) -> DetectionResult | None:
    """Return the detections of `look` in `frame` with its time, or None if the bytes are not an image."""
    return timed_together([frame], maker, lambda there: [look(picture) for _, picture in there])[0]
