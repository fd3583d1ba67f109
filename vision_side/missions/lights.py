"""Read traffic lights in an image. Pure.

A lamp counts if place and color agree: the brightest of three places in a dark upright housing, with the hue of that
place. The color ranges are two-sided and do not touch, so tinted light does not turn one color into another.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.config import Config
from sightline.vision_side.config import Fraction, HsvRange
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.color.hsv import color_table, sharp_outline
from sightline.vision_side.detect.port import Detection

Box = tuple[float, float, float, float]
"""left, top, right, bottom, in pixels of the decoded image."""
Bgr = NDArray[np.uint8]

COLOURS: Final = ("red", "yellow", "green")
"""From top to bottom."""
UNKNOWN: Final = "unknown"
_MAX_SHAPES = 24  # security limit: number of examined dark shapes, the largest first
_MOST_TINT = 1.5  # largest tint of room light; more means a colored object that fills the image
_PALEST = 0.08  # below it hue is noise; JPEG spreads the color of a lamp of 5 pixels over 16
_FLAT = 0.6  # rows of a housing that are narrower than this share of its widest row are the pole
_DISC = 0.85  # of a lamp's radius: its edge is mixed with the housing
_BRIGHT_SHARE = 0.4  # share of the brightest pixels of a lamp, which give its color


class LampConfig(Config):
    """Size and colors of the light."""

    housing_width_m: Annotated[float, Field(gt=0.01, le=3)] = 0.10
    housing_height_m: Annotated[float, Field(gt=0.01, le=3)] = 0.26
    housing_depth_m: Annotated[float, Field(ge=0, le=3)] = 0.06
    lamp_radius_m: Annotated[float, Field(gt=0.005, le=1)] = 0.033
    lamp_pitch_m: Annotated[float, Field(gt=0.005, le=1)] = 0.0867
    """Distance between the centers of two neighboring lamps."""
    box_width_m: Annotated[float, Field(gt=0.01, le=3)] = 0.317
    box_height_m: Annotated[float, Field(gt=0.01, le=3)] = 0.281
    box_depth_m: Annotated[float, Field(ge=0, le=3)] = 0.266
    """Depth of a box light, which changes its color as a whole."""
    red: HsvRange = HsvRange(hue_low_deg=335, hue_high_deg=24, saturation_low=0.3, value_low=0.1)
    yellow: HsvRange = HsvRange(hue_low_deg=34, hue_high_deg=72, saturation_low=0.3, value_low=0.1)
    green: HsvRange = HsvRange(hue_low_deg=90, hue_high_deg=172, saturation_low=0.3, value_low=0.1)
    dark: Fraction = 0.4
    """Largest brightness of the housing, relative to the median brightness of the image."""
    contrast: Annotated[float, Field(gt=1, le=10)] = 1.3
    """Brightness of a lit lamp, relative to the next brightest."""
    min_height_px: Annotated[float, Field(ge=6, le=500)] = 13.0
    """Least height of a housing. In a smaller one the three lamps cannot be distinguished."""


@dataclass(frozen=True, slots=True)
class DetectedLight:
    """One light: its color, and its box in pixels of the encoded image."""

    colour: str
    box: Detection


class HousingLightReader:
    """Reads lights with three lamps in a dark housing."""

    def __init__(self, config: LampConfig) -> None:
        self._config = config
        self._ranges = _ranges(config)
        self._lit = color_table(tuple(self._ranges.values()))

    def read(self, picture: DecodedImage, not_these: Iterable[Detection] = ()) -> list[DetectedLight]:  # noqa: ARG002
        """Return every visible housing, largest first. The color is unknown if place and hue disagree."""
        bgr = balanced(picture.bgr)
        bright = _brightest_channel(bgr)
        dark = bright < self._config.dark * float(np.median(bright[::4, ::4]))
        lights = [self._light(bgr, bright, box, picture.scale) for box in self._housings(bgr, dark)]
        return sorted(lights, key=lambda one: one.box.y2_px - one.box.y1_px, reverse=True)

    def _housings(self, bgr: Bgr, dark: NDArray[np.bool_]) -> list[Box]:
        """Return the dark shapes with the proportions of a housing. An object may have merged with a lamp."""
        codes = cv2.cvtColor(bgr, cv2.COLOR_BGR2BGR565).view(np.uint16)[..., 0]
        boxes = self._upright_shapes(dark | (cv2.LUT(codes, self._lit) > 0), dark)
        alone = self._upright_shapes(dark, dark)
        return boxes + [one for one in alone if not any(_overlap(one, other) for other in boxes)]

    def _upright_shapes(self, mask: NDArray[np.bool_], dark: NDArray[np.bool_]) -> list[Box]:
        closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        shapes, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        largest = sorted(shapes, key=len, reverse=True)[:_MAX_SHAPES]
        boxes = (self._upright(shape, closed.shape) for shape in largest)
        return [box for box in boxes if box is not None and self._is_dark(box, dark)]

    def _upright(self, shape: NDArray[Any], size: tuple[int, ...]) -> Box | None:
        """Return the housing of `shape` without its pole, extended by the top that the image border cuts off."""
        x, y, width, height = cv2.boundingRect(shape)
        if height < self._config.min_height_px:
            return None
        drawn = np.zeros((height, width), np.uint8)
        cv2.drawContours(drawn, [shape], -1, 1, cv2.FILLED, offset=(-x, -y))
        across = drawn.sum(axis=1)
        rows = np.flatnonzero(across >= _FLAT * across.max())
        part = drawn[rows[0] : rows[-1] + 1]
        columns = np.flatnonzero(part.sum(axis=0) >= len(part) / 2)
        if not len(columns):
            return None
        left, right = x + int(columns[0]), x + int(columns[-1]) + 1
        top, bottom = y + int(rows[0]), y + int(rows[-1]) + 1
        tall = self._config.housing_height_m / self._config.housing_width_m
        if top <= 0:
            top = min(0, round(bottom - tall * (right - left)))
        if bottom - top < self._config.min_height_px:
            return None
        if bottom >= size[0] or not 0.6 * tall <= (bottom - top) / (right - left) <= 1.5 * tall:
            return None
        return float(left), float(top), float(right), float(bottom)

    def _is_dark(self, box: Box, dark: NDArray[np.bool_]) -> bool:
        """Return True if the box is dark enough and its surroundings are not. It rejects the corner of a shadow."""
        left, top, right, bottom = (round(side) for side in box)
        inside = dark[max(0, top) : bottom, left:right]
        margin = max(2, (right - left) // 3)
        beside = np.hstack([dark[max(0, top) : bottom, max(0, left - margin) : max(0, left - 1)],
                            dark[max(0, top) : bottom, right + 1 : right + margin]])
        return bool(inside.size) and inside.mean() > 0.2 and (not beside.size or beside.mean() < 0.4)

    def _light(self, bgr: Bgr, bright: Bgr, box: Box, scale: int) -> DetectedLight:
        lamps = [self._lamp(bgr, bright, box, place) for place in (-1, 0, 1)]
        shine = [one[0] for one in lamps]
        order = sorted(range(3), key=lambda one: shine[one], reverse=True)
        best = order[0]
        stands_out = shine[best] > self._config.contrast * shine[order[1]]
        sure = stands_out and _is(lamps[best][1], self._ranges[COLOURS[best]])
        return DetectedLight(COLOURS[best] if sure else UNKNOWN, _detection(box, scale, "light"))

    def _lamp(self, bgr: Bgr, bright: Bgr, box: Box, place: int) -> tuple[float, NDArray[np.float64]]:
        """Return the brightness of the lamp at `place` (-1 top, 0 center, 1 bottom), and its color (B, G, R)."""
        config, height = self._config, box[3] - box[1]
        per_m = height / config.housing_height_m
        cx, cy = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2 + place * config.lamp_pitch_m * per_m
        radius = max(1.0, _DISC * config.lamp_radius_m * per_m)
        left, top = max(0, int(cx - radius)), max(0, int(cy - radius))
        rows, columns = slice(top, int(cy + radius) + 1), slice(left, int(cx + radius) + 1)
        level, colours = bright[rows, columns].reshape(-1), bgr[rows, columns].reshape(-1, 3)
        if not len(level) or cy < 0:
            return 0.0, np.zeros(3)
        count = max(1, round(_BRIGHT_SHARE * len(level)))
        brightest = np.argpartition(level, -count)[-count:]
        return float(level[brightest].mean()), colours[brightest].mean(axis=0)


class BoxLightReader:
    """Reads lights that are one box, which changes its color as a whole."""

    def __init__(self, config: LampConfig) -> None:
        self._config = config
        self._tables = {name: color_table((one,)) for name, one in _ranges(config).items()}

    def read(self, picture: DecodedImage, not_these: Iterable[Detection] = ()) -> list[DetectedLight]:
        """Return every box of one of the three colors, largest first, without `not_these`."""
        codes = cv2.cvtColor(balanced(picture.bgr), cv2.COLOR_BGR2BGR565).view(np.uint16)[..., 0]
        others = [one.center_px for one in not_these]
        lights = [light for colour, table in self._tables.items()
                  for light in self._boxes(codes, colour, table, picture)]
        own = [one for one in lights if not any(_holds(one.box, spot) for spot in others)]
        return sorted(own, key=lambda one: one.box.y2_px - one.box.y1_px, reverse=True)

    def _boxes(
        self, codes: NDArray[np.uint16], colour: str, table: NDArray[np.uint8], picture: DecodedImage
    ) -> list[DetectedLight]:
        mask = cv2.morphologyEx(cv2.LUT(codes, table), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        shapes, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        lights: list[DetectedLight] = []
        for rough in sorted(shapes, key=len, reverse=True)[:_MAX_SHAPES]:
            sharp = sharp_outline(picture.bgr, mask, cv2.boundingRect(rough))
            shape = rough if sharp is None else sharp
            x, y, width, height = cv2.boundingRect(shape)
            is_box = cv2.contourArea(shape) > 0.7 * (width - 1) * (height - 1)
            if height >= self._config.min_height_px and is_box and 0.4 < width / height < 2.0:
                box = (float(x), float(y), float(x + width), float(y + height))
                lights.append(DetectedLight(colour, _detection(box, picture.scale, "light")))
        return lights


def balanced(bgr: Bgr) -> Bgr:
    """Remove the tint of the light. Most of an image is floor and wall, so its median tint is the tint of the light.

    Without it a floor in lamplight is as yellow as a yellow lamp. Tints are computed per pixel, because the medians of
    two channels may come from different surfaces, e.g. floor and sky.
    """
    some = bgr[::8, ::8].reshape(-1, 3).astype(np.float64) + 1.0
    tint = np.median(some[:, 1:2] / some, axis=0)
    gains = np.clip(tint, 1 / _MOST_TINT, _MOST_TINT)
    steps = np.clip(np.rint(np.arange(256)[:, None] * gains), 0, 255).astype(np.uint8).reshape(1, 256, 3)
    return np.asarray(cv2.LUT(bgr, steps), np.uint8)


def _brightest_channel(bgr: Bgr) -> Bgr:
    """Return the largest channel of each pixel. It takes a tenth of the time of NumPy's maximum along an axis."""
    blue, green, red = cv2.split(bgr)
    return np.asarray(cv2.max(cv2.max(blue, green), red), np.uint8)


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _ranges(config: LampConfig) -> dict[str, HsvRange]:
    return {"red": config.red, "yellow": config.yellow, "green": config.green}


def _is(bgr: NDArray[np.float64], one: HsvRange) -> bool:
    """Return True if a color has the hue of a range.

    It may be paler, because the edge of a small lamp is mixed with the housing.
    """
    pixel = (bgr / 255).astype(np.float32)[None, None]
    hue, saturation, value = cv2.cvtColor(pixel, cv2.COLOR_BGR2HSV)[0, 0].tolist()
    above, below = hue >= one.hue_low_deg, hue <= one.hue_high_deg
    turn = (above and below) if one.hue_low_deg <= one.hue_high_deg else (above or below)
    return bool(turn and _PALEST <= saturation <= one.saturation_high and one.value_low <= value <= one.value_high)


def _detection(box: Box, scale: int, label: str) -> Detection:
    left, top, right, bottom = (side * scale for side in box)
    return Detection(left, top, right, bottom, 1.0, label)


def _holds(box: Detection, spot: tuple[float, float]) -> bool:
    return box.x1_px <= spot[0] <= box.x2_px and box.y1_px <= spot[1] <= box.y2_px
