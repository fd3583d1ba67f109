"""What families of textures are made of: colours, mixing, smooth noise. Pure (NumPy, OpenCV)."""

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

SIDE: Final = 128
"""Pixels of a tile, each way."""
Random = np.random.Generator
Texture = npt.NDArray[np.uint8]
Field = npt.NDArray[np.float32]


def any_rgb(draw: Random, saturation: tuple[float, float] = (0.0, 1.0), value: tuple[float, float] = (0.2, 1.0),
            hue_deg: tuple[float, float] = (0.0, 360.0)) -> tuple[float, float, float]:
    """A colour, 0..1."""
    hsv = np.array([[[draw.uniform(*hue_deg), draw.uniform(*saturation), draw.uniform(*value)]]], np.float32)
    red, green, blue = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


def rgb(draw: Random) -> Field:
    """A floor's or a wall's colour: half of them dull, as most rooms are."""
    high = 1.0 if draw.random() < 0.5 else 0.3
    return np.array(any_rgb(draw, (0.0, high)), np.float32) * 255


def mixed(share: Field, low: Field, high: Field) -> Field:
    """From one colour to the other by `share` (SIDE, SIDE)."""
    return np.asarray(low + share[..., None] * (high - low), np.float32)


def near(draw: Random, colour: Field) -> Field:
    """The same colour, a little lighter or darker."""
    return np.asarray(np.clip(colour * draw.uniform(0.6, 1.3) + draw.uniform(-15, 15, 3), 0, 255), np.float32)


def soft(draw: Random, sigma: float) -> Field:
    """Smooth tileable noise, 0..1."""
    small = max(4, int(SIDE / max(sigma, 1.0)))
    coarse = np.tile(draw.random((small, small), np.float32), (3, 3))
    big = cv2.resize(coarse, (3 * SIDE, 3 * SIDE), interpolation=cv2.INTER_CUBIC)[SIDE : 2 * SIDE, SIDE : 2 * SIDE]
    return np.asarray((big - big.min()) / max(float(np.ptp(big)), 1e-6), np.float32)


def grid() -> tuple[Field, Field]:
    steps = np.arange(SIDE, dtype=np.float32) / SIDE
    return np.broadcast_to(steps, (SIDE, SIDE)), np.broadcast_to(steps[:, None], (SIDE, SIDE))
