"""JPEG from a robot -> all of its pixels, bounded as vision bounds it. Pure."""

from functools import lru_cache

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.refusals import RejectReason
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Decoder


def jpeg_pixels(jpeg: bytes) -> NDArray[np.uint8]:
    """BGR in full size. Raises WireError MALFORMED for what is no plain JPEG within the bounds."""
    size = read_jpeg_size(jpeg)
    _checker(size.width_px, size.height_px).check(jpeg)
    try:
        pixels: NDArray[np.uint8] = simplejpeg.decode_jpeg(jpeg, "BGR")
    except ValueError as error:
        raise WireError(RejectReason.MALFORMED, f"picture does not decode: {error}"[:160]) from None
    return pixels


@lru_cache(maxsize=4)
def _checker(width_px: int, height_px: int) -> Decoder:
    return Decoder(width_px, height_px, VisionConfig().max_pixels)
