"""Payloads of the legacy protocol: base64 images, and text formats that an owner must enable. Pure.

image     base64 of the JPEG, a newline after every 76 characters and at the end
twist     `linear|angular`, as in `sightline.protocol.text`
dashed    `linear-angular`, opt-in. With the option swapped `angular-linear`, the order of the legacy robot.
          A legacy robot splits it at each `-`, so it cannot read a negative number
boxes     `y_min,x_min,y_max,x_max` or `class,x_min,y_min,x_max,y_max`, joined by `-`, opt-in: fractions of the
          image's height and width. In both forms, a legacy reader finds x in the 2nd and 4th field
"""

import binascii
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import DetectedBox, Detections, Twist
from sightline.protocol.text import MAX_TWIST_BYTES, NUMBER, parse_twist

LINE_CHARACTERS: Final = 76
MAX_BOXES: Final = 16
MAX_BOXES_BYTES: Final = 1024
BOX_LABEL: Final = "box"
"""Label of a box whose text contains no class."""

_DASHED: Final = re.compile(rb"(%b)-(%b)" % (NUMBER, NUMBER))
_FRACTION: Final = rb"(0(?:\.[0-9]{1,17})?|1(?:\.0{1,17})?)"
_BOX: Final = re.compile(rb",".join([_FRACTION] * 4))
_CLASSED_BOX: Final = re.compile(rb"([A-Za-z0-9_ ]{1,32})," + _BOX.pattern)


def text_bound(picture_bytes: int) -> int:
    """Return the largest number of characters of an image as text, including line ends of two characters."""
    characters = (picture_bytes + 2) // 3 * 4
    return characters + 2 * (characters // LINE_CHARACTERS + 1)


def encode_picture(jpeg: bytes, newlines: bool = True) -> bytes:
    """Encode an image as base64 text.

    Args:
        jpeg: the image.
        newlines: True for a newline after every 76 characters and at the end, as the legacy robot sends it.
    """
    text = binascii.b2a_base64(jpeg, newline=False)
    if not newlines:
        return text
    return b"".join(text[at : at + LINE_CHARACTERS] + b"\n" for at in range(0, len(text), LINE_CHARACTERS))


def decode_picture(text: bytes, max_bytes: int) -> bytes:
    """Decode base64 text with or without line ends.

    Args:
        text: the text.
        max_bytes: security limit for the image.

    Raises:
        WireError: MALFORMED for invalid base64, or for an image above the limit.
    """
    if len(text) > text_bound(max_bytes):
        raise WireError(
            RejectReason.MALFORMED, f"image text is {len(text)} characters, at most {text_bound(max_bytes)}"
        )
    try:
        jpeg = binascii.a2b_base64(text.replace(b"\r", b"").replace(b"\n", b""), strict_mode=True)
    except binascii.Error as error:
        raise WireError(RejectReason.MALFORMED, f"image text is not base64: {error}") from None
    if len(jpeg) > max_bytes:
        raise WireError(RejectReason.MALFORMED, f"image is {len(jpeg)} bytes, at most {max_bytes}")
    return jpeg


def parse_dashed(text: bytes, swapped: bool = False) -> Twist:
    """Read `linear-angular` (m/s, rad/s). Either number may be negative: `0.2--0.35`.

    Args:
        text: at most 64 bytes.
        swapped: True for `angular-linear`.

    Raises:
        WireError: as in `parse_twist`.
    """
    match = _DASHED.fullmatch(text) if len(text) <= MAX_TWIST_BYTES else None
    if match is None:
        raise WireError(
            RejectReason.MALFORMED, f"twist {text[:MAX_TWIST_BYTES]!r} is not `linear-angular`, e.g. 0.2--0.35"
        )
    first, second = match.groups()
    return parse_twist(second + b"|" + first if swapped else first + b"|" + second)


@dataclass(frozen=True, slots=True)
class LegacyBox:
    """A bounding box in fractions 0..1 of the image, from its top-left corner."""

    y_min: float
    x_min: float
    y_max: float
    x_max: float
    label: str = BOX_LABEL

    def __post_init__(self) -> None:
        """Raise ValueError for a box that is not inside the image."""
        if not (0 <= self.y_min <= self.y_max <= 1 and 0 <= self.x_min <= self.x_max <= 1):
            raise ValueError(f"{self} is outside the image")


def format_dashed(twist: bytes, swapped: bool, nonnegative: bool) -> bytes:
    """Convert `linear|angular`, as Sightline writes it, to `linear-angular`.

    Args:
        twist: the text, m/s and rad/s with four decimals.
        swapped: True for `angular-linear`.
        nonnegative: True to write zero in place of a negative number.
    """
    numbers = [b"0.0000" if nonnegative and number.startswith(b"-") else number for number in twist.split(b"|")]
    return b"-".join(reversed(numbers) if swapped else numbers)


def boxes_from_detections(found: Detections) -> tuple[LegacyBox, ...]:
    """Convert boxes in pixels to fractions of the image, without labels: the best 16, clipped to the image."""
    def share(px: float, whole_px: int) -> float:
        return min(1.0, max(0.0, px / whole_px))

    wide, high = found.width_px, found.height_px
    return tuple(
        LegacyBox(share(box.y1_px, high), share(box.x1_px, wide), share(box.y2_px, high), share(box.x2_px, wide))
        for box in found.boxes[:MAX_BOXES]
    )


def format_boxes(boxes: Sequence[LegacyBox]) -> bytes:
    """Write boxes as text with four decimals, without labels. Raises ValueError for more than 16."""
    if len(boxes) > MAX_BOXES:
        raise ValueError(f"{len(boxes)} boxes, at most {MAX_BOXES}")
    return "-".join(f"{box.y_min:.4f},{box.x_min:.4f},{box.y_max:.4f},{box.x_max:.4f}" for box in boxes).encode("ascii")


def parse_boxes(text: bytes) -> tuple[LegacyBox, ...]:
    """Read boxes joined by `-`. Raises WireError MALFORMED for text outside the grammar or above a bound."""
    parts = text.split(b"-") if text else []
    if len(text) > MAX_BOXES_BYTES or len(parts) > MAX_BOXES:
        raise WireError(RejectReason.MALFORMED, f"{len(parts)} boxes in {len(text)} bytes, at most {MAX_BOXES}")
    return tuple(_parse_box(part) for part in parts)


def detections_from_boxes(boxes: Sequence[LegacyBox], size: JpegSize) -> Detections:
    """Convert boxes to pixels of an image of `size`, in their order. They have no score."""
    width_px, height_px = size.width_px, size.height_px
    found = tuple(
        DetectedBox(label=box.label, score=1.0, x1_px=box.x_min * width_px, y1_px=box.y_min * height_px,
                    x2_px=box.x_max * width_px, y2_px=box.y_max * height_px)
        for box in boxes
    )  # fmt: skip
    return Detections(width_px=width_px, height_px=height_px, boxes=found)


def _parse_box(text: bytes) -> LegacyBox:
    try:
        if plain := _BOX.fullmatch(text):
            y_min, x_min, y_max, x_max = (float(number) for number in plain.groups())
            return LegacyBox(y_min, x_min, y_max, x_max)
        if classed := _CLASSED_BOX.fullmatch(text):
            x_min, y_min, x_max, y_max = (float(number) for number in classed.groups()[1:])
            return LegacyBox(y_min, x_min, y_max, x_max, classed[1].decode("ascii"))
    except ValueError:
        pass
    detail = f"box {text[:80]!r} is neither y_min,x_min,y_max,x_max nor class,x_min,y_min,x_max,y_max within 0..1"
    raise WireError(RejectReason.MALFORMED, detail)
