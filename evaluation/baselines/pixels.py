"""What the laws of the older write-ups go by: the largest detection as centre, radius and area in pixels. Pure."""

import math
from dataclasses import dataclass

from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.port import View


@dataclass(frozen=True, slots=True)
class Blob:
    """In pixels of the encoded picture; without a circle the box's middle and half of its longer side."""

    detection: Detection
    x_px: float
    radius_px: float
    area_px: float


def largest(view: View) -> Blob | None:
    """The detection with the largest area; None if nothing was seen."""
    blobs = [_blob(one) for one in view.detections]
    return max(blobs, key=lambda blob: blob.area_px, default=None)


def _blob(one: Detection) -> Blob:
    if one.circle is not None:
        radius = one.circle.radius_px
        return Blob(one, one.circle.cx_px, radius, math.pi * radius * radius)
    width, height = one.x2_px - one.x1_px, one.y2_px - one.y1_px
    return Blob(one, (one.x1_px + one.x2_px) / 2, max(width, height) / 2, width * height)
