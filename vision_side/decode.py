"""JPEG bytes -> `Picture`, bounded before any decoder sees them. Pure."""

from dataclasses import dataclass

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from protocol.errors import WireError
from protocol.jpeg import read_jpeg_size
from protocol.refusals import Refusal

cv2.setNumThreads(1)  # one stream, one thread: pictures this small only lose by being split

HALF_SCALE_FROM_PIXELS = 640 * 480
MAX_SCANS = 16
"""A progressive JPEG of 20-byte scans costs a whole-picture pass each; real encoders write about ten."""


@dataclass(frozen=True, slots=True)
class Picture:
    """Decoded pixels, valid until the next decode. `scale` turns their pixels into those of the encoded picture."""

    bgr: NDArray[np.uint8]
    scale: int


class Decoder:
    """Decodes pictures of one size into one buffer; half scale from 640x480 up."""

    def __init__(self, width_px: int, height_px: int, max_pixels: int) -> None:
        self._size = (width_px, height_px)
        self._max_pixels = max_pixels
        scale = 2 if width_px * height_px >= HALF_SCALE_FROM_PIXELS else 1
        rows, columns = -(-height_px // scale), -(-width_px // scale)
        self._picture = Picture(np.zeros((rows, columns, 3), np.uint8), scale)

    def decode(self, jpeg: bytes) -> Picture:
        """The pixels of `jpeg`. Raises WireError MALFORMED for anything that is not a picture of the camera's size."""
        size = read_jpeg_size(jpeg, self._max_pixels)
        if (size.width_px, size.height_px) != self._size:
            raise _bad(f"is {size.width_px}x{size.height_px}, the camera model says {self._size[0]}x{self._size[1]}")
        if _count_scans(jpeg) > MAX_SCANS:
            raise _bad(f"has more than {MAX_SCANS} scans")
        self._fill(jpeg)
        return self._picture

    def _fill(self, jpeg: bytes) -> None:
        bgr, factor = self._picture.bgr, self._picture.scale
        try:
            simplejpeg.decode_jpeg(jpeg, "BGR", fastdct=True, fastupsample=True, min_height=bgr.shape[0],
                                   min_width=bgr.shape[1], min_factor=factor, buffer=bgr)
        except ValueError as error:
            raise _bad(f"does not decode: {error}"[:160]) from None


def _count_scans(jpeg: bytes) -> int:
    """SOS markers; as vectors, since `bytes.count` would cost five times as much on every picture."""
    data = np.frombuffer(jpeg, np.uint8)
    return int(np.count_nonzero((data[:-1] == 0xFF) & (data[1:] == 0xDA)))


def _bad(what: str) -> WireError:
    return WireError(Refusal.MALFORMED, f"picture {what}")
