"""How much two boxes have in common. Pure."""

from sightline.vision_side.detect.port import Detection

Corners = tuple[float, float, float, float]
"""x1, y1, x2, y2."""


def corners(one: Detection) -> Corners:
    """Of its box."""
    return one.x1_px, one.y1_px, one.x2_px, one.y2_px


def overlap(one: Corners, other: Corners) -> float:
    """Intersection over union, 0 to 1."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    if width <= 0 or height <= 0:
        return 0.0
    common = width * height
    return common / (_area(one) + _area(other) - common)


def _area(box: Corners) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])
