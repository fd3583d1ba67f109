"""Check the size of a JPEG from its header, before a decoder reads it. Pure.

A JPEG of some hundred bytes can cost a decoder half a minute and gigabytes of memory. Reading its header costs
microseconds. Marker layout: ITU-T T.81, annex B.
"""

from dataclasses import dataclass

from sightline.protocol.errors import RejectReason, WireError

MAX_SEGMENTS = 64
_SOF_BASELINE_AND_PROGRESSIVE = (0xC0, 0xC1, 0xC2)
_SOF_OTHER = (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)
_ALONE = (0x01, *range(0xD0, 0xD9))


@dataclass(frozen=True, slots=True)
class JpegSize:
    """Size from the frame header, with the number of color components (1 gray, 3 color)."""

    width_px: int
    height_px: int
    components: int


def read_jpeg_size(data: bytes, max_pixels: int = 1920 * 1080) -> JpegSize:
    """Read the image size without decoding.

    Args:
        data: the JPEG, or its beginning.
        max_pixels: security limit, width x height.

    Returns:
        Width and height in px, and the number of color components.

    Raises:
        WireError: MALFORMED unless the data is a baseline or progressive JPEG within the limit.

    Source: ITU-T T.81, annex B.
    """
    if data[:2] != b"\xff\xd8":
        raise _bad("not a JPEG, no SOI marker at its start")
    at = 2
    for _ in range(MAX_SEGMENTS):
        if at + 4 > len(data) or data[at] != 0xFF:
            raise _bad(f"broken segment at byte {at}")
        marker = data[at + 1]
        if marker in _SOF_BASELINE_AND_PROGRESSIVE:
            return _size_from_sof(data, at, max_pixels)
        if marker in _SOF_OTHER or marker == 0xDA:
            raise _bad(f"marker 0x{marker:02X} before a baseline or progressive frame header")
        at = _next_segment(data, at, marker)
    raise _bad(f"more than {MAX_SEGMENTS} segments before the frame header")


def _next_segment(data: bytes, at: int, marker: int) -> int:
    if marker == 0xFF:
        return at + 1
    if marker in _ALONE:
        return at + 2
    length = int.from_bytes(data[at + 2 : at + 4])
    if length < 2:
        raise _bad(f"segment of length {length} at byte {at}")
    return at + 2 + length


def _size_from_sof(data: bytes, at: int, max_pixels: int) -> JpegSize:
    if at + 10 > len(data):
        raise _bad("frame header cut short")
    height, width = int.from_bytes(data[at + 5 : at + 7]), int.from_bytes(data[at + 7 : at + 9])
    components = data[at + 9]
    if data[at + 4] != 8 or components not in (1, 3):
        raise _bad(f"{data[at + 4]} bits and {components} components; 8 bits and 1 or 3 are supported")
    if not width or not height or width * height > max_pixels:
        raise _bad(f"{width}x{height} pixels, at most {max_pixels} in total")
    return JpegSize(width, height, components)


def _bad(what: str) -> WireError:
    return WireError(RejectReason.MALFORMED, f"image: {what}")
