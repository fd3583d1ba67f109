"""Derives a color range from a place in an image, and tests it. Pure.

The result is one range, or two ranges for a color on both sides of red. The margins cover normal changes: shade scales
the value, haze and warm light lower the saturation, JPEG and noise spread the hue.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.protocol.errors import ConfigError
from sightline.vision_side.config import HsvRange
from sightline.vision_side.detect.color.hsv import ColorMask

Image = NDArray[np.uint8]
Numbers = NDArray[np.float32]
Ranges = tuple[HsvRange, ...]

CLICK_PX: Final = 5
"""A click takes the median color of a square of this side length, and then all pixels of that color around it."""
MIN_SATURATION: Final = 0.2
MIN_VALUE: Final = 0.1
"""Limits of saturation and value below which the hue of a pixel is noise."""
MIN_BOX_SHARE: Final = 0.3
"""Least share of a single color in a box. A disk fills 79 % of the box around it."""
MOST_MARKED: Final = 0.5
"""Share of an image from which a range marks the background."""
_ALIKE_DEG: Final = 20.0  # from the strongest hue; includes the shaded side of the object
_HUE_MARGIN_DEG: Final = 5.0
_NARROWEST_DEG: Final = 8.0  # to each side, because the detector's table has steps of up to 4 degrees
_SATURATION_KEPT: Final = 0.6
_VALUE_KEPT: Final = 0.5
_HUE_BIN_DEG: Final = 5


@dataclass(frozen=True, slots=True)
class Box:
    """A part of an image in pixels; a click is a box without size."""

    x_px: int
    y_px: int
    width_px: int = 0
    height_px: int = 0


@dataclass(frozen=True, slots=True)
class Trial:
    """The marks of a range in several images: shares of all pixels (0..1), and blobs, after the detector's opening."""

    pictures: int
    mean_share: float
    most_share: float
    least_blobs: int
    most_blobs: int
    with_any: int
    """Number of images with a mark."""


def pick(picture: Image, box: Box) -> Ranges:
    """Return the range of the color in the box. Raises ConfigError outside the image, or without a single color."""
    height, width = picture.shape[:2]
    inside = 0 <= box.x_px < width and 0 <= box.y_px < height
    if not inside or box.x_px + box.width_px > width or box.y_px + box.height_px > height:
        raise ConfigError(f"{_where(box)} is outside the image of {width}x{height}; pick inside")
    hsv = _hsv(picture)
    return _range_of(_sample(hsv, box))


def try_out(ranges: Ranges, pictures: Sequence[Image]) -> Trial:
    """Measure the marks of `ranges` in `pictures`, at least one image."""
    masks = [mask_of(ranges, one) for one in pictures]
    shares = [cv2.countNonZero(mask) / mask.size for mask in masks]
    blobs = [cv2.connectedComponents(mask)[0] - 1 for mask in masks]
    return Trial(len(masks), sum(shares) / len(shares), max(shares), min(blobs), max(blobs),
                 sum(count > 0 for count in blobs))


def check_trial(trial: Trial) -> None:
    """Raise ConfigError for a range that marks half of an image, or no pixel."""
    if trial.most_share >= MOST_MARKED:
        raise ConfigError(f"this range marks {trial.most_share:.0%} of an image: the background has the same color; "
                          "pick the target itself, or change the background")
    if trial.with_any == 0:
        raise ConfigError("this range marks only speckle; pick the center of a larger patch")


def mask_of(ranges: Ranges, picture: Image) -> Image:
    """Return 255 for pixels with the color, 0 for others, as the detector does."""
    mask = np.zeros(picture.shape[:2], np.uint8)
    region = ColorMask(ranges).region(picture)
    if region is not None:
        x, y = region.origin_px
        rows, columns = region.mask.shape[:2]
        mask[y : y + rows, x : x + columns] = region.mask
    return mask


def mask_picture(ranges: Ranges, picture: Image) -> Image:
    """Return the image with unmarked parts darkened, next to the mask."""
    mask = mask_of(ranges, picture)
    shaded: Any = cv2.convertScaleAbs(cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR),
                                      alpha=0.35)
    shaded[mask > 0] = picture[mask > 0]
    return np.hstack([shaded, cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR)])


def ranges_text(ranges: Ranges) -> str:
    """Format ranges as text."""
    return " and ".join(
        f"hue {one.hue_low_deg:g} to {one.hue_high_deg:g} degrees, saturation from {one.saturation_low:g}, "
        f"value from {one.value_low:g}" for one in ranges
    )


def trial_text(trial: Trial) -> str:
    """Format a trial as text."""
    least, most = trial.least_blobs, trial.most_blobs
    blobs = f"{most} blob{'' if most == 1 else 's'}" if least == most else f"{least} to {most} blobs"
    return (f"marks {trial.mean_share:.2%} of the image on average, {trial.most_share:.2%} at most, in {blobs}; "
            f"marks in {trial.with_any} of {trial.pictures} images")


# --- from pixels to a range ----------------------------------------------------------------------------------------


def _hsv(picture: Image) -> Numbers:
    """Return hue in degrees (0..360), saturation and value (0..1), as in the detector's table."""
    return np.asarray(cv2.cvtColor(picture.astype(np.float32) / 255, cv2.COLOR_BGR2HSV), np.float32)


def _sample(hsv: Numbers, box: Box) -> Numbers:
    """Return the pixels (N, 3) of the color in the box. Raises ConfigError without a single color."""
    if box.width_px and box.height_px:
        part = hsv[box.y_px : box.y_px + box.height_px, box.x_px : box.x_px + box.width_px].reshape(-1, 3)
        return _of_one_hue(part, box)
    half = CLICK_PX // 2
    around = hsv[max(0, box.y_px - half) : box.y_px + half + 1, max(0, box.x_px - half) : box.x_px + half + 1]
    seed = _of_one_hue(around.reshape(-1, 3), box)
    return np.concatenate([seed, _grown(hsv, box, _mean_hue_deg(seed))])


def _of_one_hue(pixels: Numbers, box: Box) -> Numbers:
    """Return the pixels near the strongest hue. Raises ConfigError without a single color."""
    colored = pixels[_has_hue(pixels)]
    if len(colored) < MIN_BOX_SHARE * len(pixels):
        _, saturation, value = (float(one) for one in np.median(pixels, axis=0))
        why = f"too dark (value {value:.2f})" if value < MIN_VALUE else f"gray (saturation {saturation:.2f})"
        raise ConfigError(f"no color at {_where(box)}: it is {why}; pick a colored place")
    near = colored[_off_deg(colored[:, 0], _strongest_hue_deg(colored)) <= _ALIKE_DEG]
    if len(near) < MIN_BOX_SHARE * len(pixels):
        raise ConfigError(f"several colors at {_where(box)}: the most common covers "
                          f"{len(near) / len(pixels):.0%} of it; box a smaller part")
    return near


def _grown(hsv: Numbers, box: Box, hue_deg: float) -> Numbers:
    """Return the pixels of similar hue that are connected to the clicked pixel."""
    alike = (_off_deg(hsv[..., 0], hue_deg) <= _ALIKE_DEG) & _has_hue(hsv)
    _, labels = cv2.connectedComponents(alike.astype(np.uint8))
    own = labels[box.y_px, box.x_px]
    return hsv[labels == own] if own else hsv[:0].reshape(-1, 3)


def _has_hue(hsv: Numbers) -> NDArray[np.bool_]:
    return (hsv[..., 1] >= MIN_SATURATION) & (hsv[..., 2] >= MIN_VALUE)


def _strongest_hue_deg(pixels: Numbers) -> float:
    """Return the hue of the bin that, with its neighbors, has the most color."""
    color = pixels[:, 1] * pixels[:, 2]
    weights, _ = np.histogram(pixels[:, 0], bins=360 // _HUE_BIN_DEG, range=(0, 360), weights=color)
    smooth = weights + np.roll(weights, 1) + np.roll(weights, -1)
    return float(np.argmax(smooth)) * _HUE_BIN_DEG + _HUE_BIN_DEG / 2


def _mean_hue_deg(pixels: Numbers) -> float:
    angles = np.radians(pixels[:, 0])
    return float(np.degrees(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean()))) % 360


def _off_deg(hues_deg: Numbers, hue_deg: float) -> Numbers:
    return np.asarray(np.abs((hues_deg - hue_deg + 180) % 360 - 180), np.float32)


def _range_of(pixels: Numbers) -> Ranges:
    middle = _mean_hue_deg(pixels)
    off = (pixels[:, 0] - middle + 180) % 360 - 180
    low, high = (float(one) for one in np.percentile(off, (2, 98)))
    low, high = min(low - _HUE_MARGIN_DEG, -_NARROWEST_DEG), max(high + _HUE_MARGIN_DEG, _NARROWEST_DEG)
    saturation, value = (float(one) for one in np.percentile(pixels[:, 1:], 5, axis=0))
    common = {"saturation_low": round(max(MIN_SATURATION / 2, saturation * _SATURATION_KEPT), 2),
              "value_low": round(max(MIN_VALUE / 2, value * _VALUE_KEPT), 2)}
    first, last = round(middle + low), round(middle + high)
    if first < 0 or last > 360:  # the range includes red
        return (HsvRange(hue_low_deg=first % 360, hue_high_deg=360, **common),
                HsvRange(hue_low_deg=0, hue_high_deg=last % 360, **common))
    return (HsvRange(hue_low_deg=first, hue_high_deg=last, **common),)


def _where(box: Box) -> str:
    place = f"{box.x_px},{box.y_px}"
    return f"{place},{box.width_px},{box.height_px}" if box.width_px and box.height_px else place
