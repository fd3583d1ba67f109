"""Decode JPEG bytes to a `DecodedImage`, after a check of their bounds. Pure."""

from dataclasses import dataclass

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import MAX_SEGMENTS, read_jpeg_size

cv2.setNumThreads(1)  # one thread per stream: to split images this small only costs time

HALF_SCALE_FROM_PIXELS = 640 * 480
MAX_SCANS = 16
"""Each scan of a progressive JPEG costs one pass over the whole image; real encoders write about ten scans."""
_SOS = b"\xff\xda"
_BASELINE = (b"\xff\xc0", b"\xff\xc1")
_SEGMENTS = frozenset(bytes([0xFF, one]) for one in (0xC0, 0xC1, 0xC4, 0xDB, 0xDD, *range(0xE0, 0xF0), 0xFE))
"""Segments of a baseline header: frame, Huffman and quantization tables, restarts, application, comment."""


@dataclass(frozen=True, slots=True)
class DecodedImage:
    """Decoded pixels, valid until the next decode. `scale` converts their coordinates to those of the encoded image."""

    bgr: NDArray[np.uint8]
    scale: int


class Decoder:
    """Decodes images of one size into one buffer, at half scale from 640x480 up."""

    def __init__(self, width_px: int, height_px: int, max_pixels: int) -> None:
        self.size_px = (width_px, height_px)
        self._max_pixels = max_pixels
        scale = 2 if width_px * height_px >= HALF_SCALE_FROM_PIXELS else 1
        rows, columns = -(-height_px // scale), -(-width_px // scale)
        self._picture = DecodedImage(_cached_pixels(rows, columns), scale)
        self._checked_head: bytes | None = None

    def decode(self, jpeg: bytes) -> DecodedImage:
        """Decode a JPEG. Raises WireError MALFORMED for bytes that are not an image of the camera's size."""
        self.check(jpeg)
        self._fill(jpeg)
        return self._picture

    def check(self, jpeg: bytes) -> None:
        """Raise WireError MALFORMED unless the header of `jpeg` has the size of the camera. Does not decode."""
        if self._checked_head is None or not jpeg.startswith(self._checked_head):
            self._checked_head = self._head_of(jpeg)

    def _head_of(self, jpeg: bytes) -> bytes | None:
        """Return the header if the camera repeats it in each image, so that the next check is skipped, else None."""
        size = read_jpeg_size(jpeg, self._max_pixels)
        if (size.width_px, size.height_px) != self.size_px:
            own = f"{self.size_px[0]}x{self.size_px[1]}"
            raise _bad(f"is {size.width_px}x{size.height_px}, the camera model has {own}")
        head = _head_of_one_scan(jpeg, size.components)
        if head is None and _count_scans(jpeg) > MAX_SCANS:
            raise _bad(f"has more than {MAX_SCANS} scans")
        return head

    def _fill(self, jpeg: bytes) -> None:
        bgr, factor = self._picture.bgr, self._picture.scale
        try:
            simplejpeg.decode_jpeg(jpeg, "BGR", fastdct=True, fastupsample=True, min_height=bgr.shape[0],
                                   min_width=bgr.shape[1], min_factor=factor, buffer=bgr)
        except ValueError as error:
            raise _bad(f"does not decode: {error}"[:160]) from None


def _cached_pixels(rows: int, columns: int) -> NDArray[np.uint8]:
    """Return a buffer 16 bytes off a 32-byte boundary.

    On the boundary libjpeg-turbo stores past the cache. Decoding takes 10 % longer, and each later access to the
    pixels waits for memory.
    """
    size = rows * columns * 3
    block = np.zeros(size + 48, np.uint8)
    start = (16 - block.ctypes.data) % 32
    return block[start : start + size].reshape(rows, columns, 3)


def _head_of_one_scan(jpeg: bytes, components: int) -> bytes | None:
    """Return the bytes before the pixels of a baseline image whose first scan has every component.

    Decoders end after that scan. None for progressive images and for several scans. `read_jpeg_size` has accepted them.
    """
    at, baseline = 2, False
    for _ in range(MAX_SEGMENTS):
        marker, length = jpeg[at : at + 2], int.from_bytes(jpeg[at + 2 : at + 4])
        if marker == _SOS:
            return jpeg[: at + 2 + length] if baseline and jpeg[at + 4 : at + 5] == bytes([components]) else None
        if marker not in _SEGMENTS or length < 2:
            return None
        baseline = baseline or marker in _BASELINE
        at += 2 + length
    return None


def _count_scans(jpeg: bytes) -> int:
    """Count the SOS markers. A vectorized search is five times faster than `bytes.count`."""
    data = np.frombuffer(jpeg, np.uint8)
    return int(np.count_nonzero((data[:-1] == 0xFF) & (data[1:] == 0xDA)))


def _bad(what: str) -> WireError:
    return WireError(RejectReason.MALFORMED, f"image {what}")
