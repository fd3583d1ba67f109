"""The recorded images of `bench loop`: a ball moving in a circle in a textured room. Shell (files).

Their size is that of a camera's own JPEG (about 46 kB at 640x480), because the transport has to carry this size.
"""

import math
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.protocol.messages import CameraModel

COUNT: Final = 30
_BYTES_PER_PIXEL: Final = 0.15
_BALL_BGR: Final = (13, 199, 242)


def write_pictures(folder: Path, width_px: int, height_px: int) -> float:
    """Write `COUNT` JPEGs in name order into `folder`; returns their mean size in bytes."""
    room = _room(width_px, height_px)
    quality = _fitting_quality(_picture(room, 0), _BYTES_PER_PIXEL * width_px * height_px)
    jpegs = [_encoded(_picture(room, number), quality) for number in range(COUNT)]
    for number, jpeg in enumerate(jpegs):
        (folder / f"{number:03}.jpg").write_bytes(jpeg)
    return sum(map(len, jpegs)) / COUNT


def camera_of(width_px: int, height_px: int) -> CameraModel:
    """Return the lens of the images, 80 degrees wide, as the folder camera guesses it."""
    focal_px = width_px / 2 / math.tan(math.radians(40))
    return CameraModel(
        width_px=width_px, height_px=height_px, fx_px=focal_px, fy_px=focal_px, cx_px=width_px / 2, cy_px=height_px / 2
    )


def _room(width_px: int, height_px: int) -> NDArray[np.uint8]:
    rough = np.random.default_rng(1).normal(130, 22, (height_px, width_px, 1)).repeat(3, axis=2)
    return np.asarray(cv2.GaussianBlur(np.clip(rough, 0, 255).astype(np.uint8), (3, 3), 0))


def _picture(room: NDArray[np.uint8], number: int) -> NDArray[np.uint8]:
    height_px, width_px = room.shape[:2]
    angle_rad = math.tau * number / COUNT
    right, down = 0.5 + 0.1 * math.cos(angle_rad), 0.5 + 0.05 * math.sin(angle_rad)
    picture = room.copy()
    center = round(width_px * right), round(height_px * down)
    cv2.circle(picture, center, width_px // 13, _BALL_BGR, -1, cv2.LINE_AA)
    return picture


def _fitting_quality(picture: NDArray[np.uint8], wanted_bytes: float) -> int:
    return min(range(40, 96, 2), key=lambda quality: abs(len(_encoded(picture, quality)) - wanted_bytes))


def _encoded(picture: NDArray[Any], quality: int) -> bytes:
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes())
