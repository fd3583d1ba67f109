"""What the camera and the link do to a scene's picture: light, colour cast, blur, noise, JPEG. Pure."""

import math

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from sightline.sim.scenes.model import Column, Random, Scene

Picture = npt.NDArray[np.uint8]
_SOFT_PX = (0.3, 0.7)  # standard deviation of any lens's own softness
_POOL_SIDE = 1024


def as_seen(scene: Scene) -> bytes:
    """The scene's JPEG, with the defects that its seed draws from its column."""
    return with_defects(scene.rgb, scene.plan.column, np.random.default_rng([scene.plan.seed, 13]))


def with_defects(rgb: Picture, column: Column, draw: Random) -> bytes:
    """`rgb` as JPEG, as bad as the column says."""
    gains = draw.uniform(*column.gain) * (1 + draw.uniform(-column.white_balance, column.white_balance, 3))
    steps = np.clip(np.rint(np.arange(256)[:, None] * gains), 0, 255).astype(np.uint8)
    picture: Picture = np.asarray(cv2.LUT(rgb, steps.reshape(1, 256, 3)), np.uint8)
    if draw.random() < column.blurred:
        picture = _blurred(picture, draw.uniform(*column.blur_px), draw)
    else:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), draw.uniform(*_SOFT_PX)), np.uint8)
    noise = draw.normal(0.0, 1.0, (_POOL_SIDE,)).astype(np.float32) * draw.uniform(*column.noise)
    grain = noise[draw.integers(0, _POOL_SIDE, picture.shape, dtype=np.uint16)]
    cv2.add(picture, np.rint(grain).astype(np.int16), picture, dtype=cv2.CV_8U)
    quality = int(draw.integers(column.quality[0], column.quality[1] + 1))
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(picture), quality, "RGB", "420"))


def _blurred(picture: Picture, across_px: float, draw: Random) -> Picture:
    """Out of focus, or moved while it was taken: a kernel that wide."""
    if draw.random() < 0.5:
        side = 2 * int(across_px / 2) + 1
        return np.asarray(cv2.GaussianBlur(picture, (side, side), 0), np.uint8)
    return np.asarray(cv2.filter2D(picture, -1, streak(across_px, draw.uniform(0.0, math.pi))), np.uint8)


def streak(long_px: float, angle_rad: float) -> npt.NDArray[np.float32]:
    """Kernel of an even motion over `long_px`, about its middle."""
    side = 2 * math.ceil(long_px / 2) + 1
    kernel = np.zeros((side, side), np.float32)
    along = np.linspace(-long_px / 2, long_px / 2, 8 * side)
    x, y = side // 2 + along * math.cos(angle_rad), side // 2 + along * math.sin(angle_rad)
    np.add.at(kernel, (np.rint(y).astype(int).clip(0, side - 1), np.rint(x).astype(int).clip(0, side - 1)), 1.0)
    return np.asarray(kernel / kernel.sum(), np.float32)
