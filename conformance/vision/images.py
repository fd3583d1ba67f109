"""The images that the kit's robot sends, the camera that they fit, and damaged images. Shell (files).

The files show a yellow ball in a plain room, so that a peer in another language can be tested on them without the kit.
`tests/conformance/vision/drawing.py` draws them.
"""

import zlib
from functools import cache
from pathlib import Path
from typing import Final

from sightline.protocol.messages import CameraModel

FOLDER: Final = Path(__file__).parent / "pictures"
CAMERA: Final = CameraModel(width_px=320, height_px=240, fx_px=190.7, fy_px=190.7, cx_px=160.0, cy_px=120.0,
                            x_m=0.055, z_m=0.06, calibrated=True)
"""80 degrees wide. A ball of 0.1 m radius at one meter has a radius of 20 px."""
HALF_CAMERA: Final = CAMERA.model_copy(update={"width_px": 160, "height_px": 120, "fx_px": 95.35, "fy_px": 95.35,
                                               "cx_px": 80.0, "cy_px": 60.0})


@cache
def picture(name: str) -> bytes:
    """Read the file `name`. Raises KeyError for an unknown name."""
    return {path.stem: path for path in FOLDER.glob("*.jpg")}[name].read_bytes()


LARGE_CAMERA: Final = CAMERA.model_copy(update={"width_px": 1920, "height_px": 1080, "fx_px": 1144.2,
                                                "fy_px": 1144.2, "cx_px": 960.0, "cy_px": 540.0})
_BLOCK_BITS: Final = 12
"""Bits of a gray block in the kit's files: 4 for the DC code of no difference, 8 for the end of the block, all zero."""


@cache
def gray(camera: CameraModel) -> bytes:
    """Return a gray JPEG of the size of `camera`: the tables of another one, then zeros for each block."""
    jpeg = picture("absent")
    frame, scan = jpeg.find(b"\xff\xc0"), jpeg.find(b"\xff\xda")
    head = bytearray(jpeg[: scan + 2 + int.from_bytes(jpeg[scan + 2 : scan + 4])])
    head[frame + 5 : frame + 9] = camera.height_px.to_bytes(2) + camera.width_px.to_bytes(2)
    blocks = -(-camera.width_px // 8) * -(-camera.height_px // 8) * head[frame + 9]
    return bytes(head) + bytes(-(-blocks * _BLOCK_BITS // 8)) + b"\xff\xd9"


# --- damaged images ---------------------------------------------------------------------------------------------------


def claiming(width_px: int, height_px: int, *, bits: int = 8, components: int = 3, marker: int = 0xC0) -> bytes:
    """Return a JPEG that claims a size and has no pixels: 21 bytes for three components."""
    body = bytes((bits, *height_px.to_bytes(2), *width_px.to_bytes(2), components)) + b"\x01\x11\x00" * components
    return b"\xff\xd8\xff" + bytes((marker,)) + (len(body) + 2).to_bytes(2) + body


def commented(jpeg: bytes, comments: int, size: int = 0) -> bytes:
    """Return `jpeg` with that many comments of `size` bytes before its first segment."""
    return jpeg[:2] + (b"\xff\xfe" + (size + 2).to_bytes(2) + bytes(size)) * comments + jpeg[2:]


def filled(jpeg: bytes, fill: int) -> bytes:
    """Return `jpeg` with that many fill bytes before its first segment."""
    return jpeg[:2] + b"\xff" * fill + jpeg[2:]


def many_scans(jpeg: bytes, scans: int) -> bytes:
    """Return a progressive `jpeg` whose last scan repeats. Each scan costs a decoder a pass over the whole image."""
    last = jpeg.rfind(b"\xff\xda")
    empty = jpeg[last : last + 2 + int.from_bytes(jpeg[last + 2 : last + 4])]
    return jpeg[:-2] + empty * scans + jpeg[-2:]


def png() -> bytes:
    """Return one gray pixel as PNG, a format outside of the protocol."""
    parts = ((b"IHDR", (1).to_bytes(4) * 2 + b"\x08\0\0\0\0"), (b"IDAT", zlib.compress(b"\0\x80")), (b"IEND", b""))
    chunks = (len(body).to_bytes(4) + kind + body + zlib.crc32(kind + body).to_bytes(4) for kind, body in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
