"""Detect one target while its color changes with the light: color model, Kalman filter, gate. Pure.

Chromaticity is the share of red and of green in a color. Shade and exposure do not change it. Warm or cold light
changes it slowly, and the color model adapts.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.config import Config as Settings
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.color.hsv import HsvDetector, Region, codes_565, colors_565
from sightline.vision_side.detect.port import Circle, Detection, Label

Shares = NDArray[np.float32]
"""(..., 2): red and green shares."""

_LEAST_SIGMA: Final = 0.012  # JPEG at quality 30 spreads a color by this much
_MOST_SIGMA: Final = 0.05  # a wider distribution contains half of all colors
_DARKEST: Final = 36.0  # of 765; the shares of darker pixels are noise
_MAX_STEP: Final = 0.01  # of the mean in one image: light changes slowly, another object changes the color immediately
_MOVED: Final = 0.25  # sigmas; the color table is computed again after a larger change of the mean
_KERNEL: Final = np.ones((3, 3), np.uint8)


class ColorModel:
    """Mean and covariance of the color of one object."""

    def __init__(self, bgr: NDArray[np.uint8]) -> None:
        """Learn the color from its pixels `bgr` (N, 3)."""
        self._middle, self._spread = _cloud(_shares(bgr)[0])
        self._table: NDArray[np.uint8] | None = None
        self._table_middle = self._middle

    def distance(self, bgr: NDArray[np.uint8]) -> float:
        """Return the distance between the mean color of the pixels `bgr` (N, 3) and this one, in sigmas."""
        middle, _ = _cloud(_shares(bgr)[0])
        return math.sqrt(float(self._square(middle[None])[0]))

    def learn(self, bgr: NDArray[np.uint8], part: float) -> None:
        """Move the model by the share `part` (0..1) toward pixels of the object. The step is limited."""
        middle, spread = _cloud(_shares(bgr)[0])
        step = (middle - self._middle) * part
        length = float(np.hypot(*step))
        self._middle = self._middle + step * min(1.0, _MAX_STEP / length if length else 1.0)
        self._spread = self._spread + (spread - self._spread) * part

    def mask(self, bgr: NDArray[np.uint8], sigmas: float) -> NDArray[Any]:
        """Return 255 where a pixel of `bgr` (rows, columns, 3) has the color, 0 elsewhere, without speckle."""
        if self._table is None or math.sqrt(float(self._square(self._table_middle[None])[0])) > _MOVED:
            shares, bright = _code_shares()
            inside = (self._square(shares) <= sigmas * sigmas) & bright
            self._table, self._table_middle = inside.astype(np.uint8) * np.uint8(255), self._middle
        return cv2.morphologyEx(cv2.LUT(codes_565(bgr), self._table), cv2.MORPH_OPEN, _KERNEL)

    def _square(self, shares: NDArray[Any]) -> NDArray[Any]:
        """Return the squared distance of each color from the mean, in sigmas."""
        (a, b), (_, d) = self._spread.tolist()
        determinant = a * d - b * b
        red, green = shares[..., 0] - float(self._middle[0]), shares[..., 1] - float(self._middle[1])
        square: NDArray[Any] = (d * red * red - 2 * b * red * green + a * green * green) / determinant
        return square


def _shares(bgr: NDArray[Any]) -> tuple[Shares, NDArray[np.bool_]]:
    """Return the red and green share of each pixel, and True for pixels that are bright enough."""
    colours = bgr.astype(np.float32)
    whole = colours[..., 0] + colours[..., 1] + colours[..., 2]
    shares: Shares = colours[..., 2:0:-1] / np.maximum(whole, 1.0)[..., None]
    return shares, whole >= _DARKEST


@lru_cache(maxsize=1)
def _code_shares() -> tuple[Shares, NDArray[np.bool_]]:
    """Return the shares of every BGR565 code."""
    return _shares(colors_565())


def _cloud(shares: Shares) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return mean and covariance, with a lower and an upper limit."""
    middle = np.median(shares, axis=0)
    off = shares - middle
    off = off[np.abs(off).max(axis=-1) <= 3 * _MOST_SIGMA]  # without highlights and objects in front
    (a, b), (_, d) = (off.T @ off / max(1, len(off))).tolist() if len(off) else ((0.0, 0.0), (0.0, 0.0))
    low, high = _LEAST_SIGMA**2, _MOST_SIGMA**2
    a, d = min(high, max(low, a)), min(high, max(low, d))
    limit = 0.8 * math.sqrt(a * d)
    b = min(limit, max(-limit, b))
    return middle, np.array(((a, b), (b, d)))


# Expected place of an object in the image: Kalman filter of its position, smoothed size, gate. Pure.


_ACCELERATION: Final = 6.0  # image widths per s^2: the robot starts to turn at its limit
_FIRST_SPEED: Final = 1.5  # image widths per s: the robot turns at its highest rate
_NOISE_PX: Final = 0.7
_SIGMAS: Final = 4.0
_GATE_RADII, _GATE_WIDTHS = 1.5, 0.06  # upper limit of the gate
_LEAST_SIZE, _MOST_SIZE = 0.65, 1.55  # of the radius, from one image to the next
_SIZE_PART: Final = 0.4  # weight of a new radius; a partly hidden object looks smaller for a while


class PixelTrack:
    """Position of one object. Both axes share one covariance, because their noise is equal."""

    def __init__(self, circle: Circle, width_px: int) -> None:
        self.cx_px, self.cy_px, self.radius_px = circle.cx_px, circle.cy_px, circle.radius_px
        self._vx, self._vy = 0.0, 0.0
        self._width_px = width_px
        self._variance = (_NOISE_PX**2, 0.0, (_FIRST_SPEED * width_px) ** 2)

    @property
    def gate_px(self) -> float:
        """Return the largest distance at which the target may reappear, in px."""
        most = _GATE_RADII * self.radius_px + _GATE_WIDTHS * self._width_px
        return min(most, _SIGMAS * math.sqrt(self._variance[0]) + 0.5 * self.radius_px)

    def away_px(self, circle: Circle) -> float:
        """Return the distance from its expected position, px."""
        return math.hypot(circle.cx_px - self.cx_px, circle.cy_px - self.cy_px)

    def admits(self, circle: Circle) -> bool:
        """Return True if place and size of a circle fit the target."""
        size = circle.radius_px / self.radius_px
        return self.away_px(circle) <= self.gate_px and _LEAST_SIZE <= size <= _MOST_SIZE

    def advance(self, dt_s: float) -> None:
        """Predict with constant velocity and white acceleration."""
        position, both, velocity = self._variance
        power = (_ACCELERATION * self._width_px) ** 2 * dt_s
        self._variance = (position + dt_s * (2 * both + dt_s * velocity) + power * dt_s**2 / 3,
                          both + dt_s * velocity + power * dt_s / 2, velocity + power)
        self.cx_px += self._vx * dt_s
        self.cy_px += self._vy * dt_s

    def correct(self, circle: Circle) -> None:
        """Correct the prediction with the detected circle."""
        position, both, velocity = self._variance
        gain, gain_velocity = position / (position + _NOISE_PX**2), both / (position + _NOISE_PX**2)
        dx, dy = circle.cx_px - self.cx_px, circle.cy_px - self.cy_px
        self.cx_px, self.cy_px = self.cx_px + gain * dx, self.cy_px + gain * dy
        self._vx, self._vy = self._vx + gain_velocity * dx, self._vy + gain_velocity * dy
        self.radius_px += _SIZE_PART * (circle.radius_px - self.radius_px)
        self._variance = (position * (1 - gain), both * (1 - gain), velocity - gain_velocity * both)


# Color detector for one object under changing light. It learns the color and searches near the expected position. It
# loses the target rather than jump to another object. Pure: the clock is the capture time of the frames. First the
# configured ranges must find the object in several images in a row. Then the detector follows its learned color near
# the position that a Kalman filter predicts. It ignores the same color elsewhere.


_CLEAR: Final = 0.8  # least visible share of the outline from which the color is learned
_SAMPLES: Final = 400  # pixels: enough for a mean and a covariance
_CORE: Final = 0.7  # of the radius: pixels at the edge are mixed with the floor


class AdaptiveConfig(Settings):
    """Color ranges of the first detection, and the speed of adaptation."""

    renamed_keys: ClassVar[Mapping[str, str]] = {"colour_sigmas": "color_sigmas"}
    hsv: HsvConfig = HsvConfig()
    label: Label = "target"
    confirm: Annotated[int, Field(ge=1, le=30)] = 3
    """Images in a row with the object at one place before it is the target."""
    lost_after_s: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Time without a detection after which the target is lost and the whole image is searched again."""
    remembered_s: Annotated[float, Field(ge=0, le=60)] = 5.0
    """Time in which a lost target is accepted again only with the learned color."""
    color_sigmas: Annotated[float, Field(gt=1, le=8)] = 4.0
    """Largest distance of a target pixel from the learned color."""
    adapt_s: Annotated[float, Field(gt=0.05, le=60)] = 0.3
    """Time constant of the color adaptation. A lamp that turns from warm to cold in 3 s does not lose the target."""


class AdaptiveTracker:
    """Follows one object in the images of one robot."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self._config = config
        self._everywhere = HsvDetector(config.hsv, config.label)
        self._track: PixelTrack | None = None
        self._candidate: tuple[PixelTrack, int] | None = None
        self._color_model: ColorModel | None = None
        self._seen_us = 0
        self._last_us: int | None = None

    def detect(self, picture: DecodedImage, t_us: int) -> tuple[Detection, ...]:
        """Detect the target in an image captured at `t_us`."""
        dt_s = max(0.0, (t_us - self._last_us) / 1e6) if self._last_us is not None else 0.0
        self._last_us = t_us
        if self._track is not None and t_us - self._seen_us > self._config.lost_after_s * 1e6:
            self._track = None
        found = self._acquire(picture, t_us, dt_s) if self._track is None else self._follow(self._track, picture, dt_s)
        if found is None:
            return ()
        self._seen_us = t_us
        self._learn(picture, found, dt_s)
        return (found,)

    def _follow(self, track: PixelTrack, picture: DecodedImage, dt_s: float) -> Detection | None:
        """Return the object nearest to the expected position, with the learned color and about the same size."""
        track.advance(dt_s)
        region = self._region(picture, track)
        if region is None:
            return None
        found = [one for one in self._everywhere.measure(picture, region) if track.admits(_circle(one))]
        best = min(found, key=lambda one: track.away_px(_circle(one)), default=None)
        if best is not None:
            track.correct(_circle(best))
        return best

    def _region(self, picture: DecodedImage, track: PixelTrack) -> Region | None:
        """Return the region around the expected position, with the learned color marked."""
        if self._color_model is None:
            return None
        half = track.gate_px + 1.4 * track.radius_px + 4
        columns = _cut(track.cx_px - half, track.cx_px + half, picture.scale, picture.bgr.shape[1])
        rows = _cut(track.cy_px - half, track.cy_px + half, picture.scale, picture.bgr.shape[0])
        part = picture.bgr[rows, columns]
        if not part.size:
            return None
        return Region(part, self._color_model.mask(part, self._config.color_sigmas), (columns.start, rows.start))

    def _acquire(self, picture: DecodedImage, t_us: int, dt_s: float) -> Detection | None:
        """Return the largest object of the configured color after some images in a row at one place."""
        known = self._color_model if t_us - self._seen_us <= self._config.remembered_s * 1e6 else None
        found = next((one for one in self._everywhere.detect(picture) if self._is_it(picture, one, known)), None)
        if found is None:
            self._candidate = None
            return None
        circle, width_px = _circle(found), picture.bgr.shape[1] * picture.scale
        track, times = self._candidate or (PixelTrack(circle, width_px), 0)
        track.advance(dt_s if times else 0.0)
        if not track.admits(circle):
            track, times = PixelTrack(circle, width_px), 0
        track.correct(circle)
        self._candidate = (track, times + 1)
        if times + 1 < self._config.confirm:
            return None
        self._track, self._candidate, self._color_model = track, None, known
        return found

    def _is_it(self, picture: DecodedImage, found: Detection, known: ColorModel | None) -> bool:
        pixels = _pixels(picture, _circle(found))
        return len(pixels) > 0 and (known is None or known.distance(pixels) <= self._config.color_sigmas)

    def _learn(self, picture: DecodedImage, found: Detection, dt_s: float) -> None:
        pixels = _pixels(picture, _circle(found))
        if not len(pixels):
            return
        if self._color_model is None:
            self._color_model = ColorModel(pixels)
        elif found.score >= _CLEAR:
            self._color_model.learn(pixels, 1 - math.exp(-dt_s / self._config.adapt_s))


def _circle(one: Detection) -> Circle:
    """Return the circle of a detection, or the circle in its box."""
    if one.circle is not None:
        return one.circle
    width, height = one.x2_px - one.x1_px, one.y2_px - one.y1_px
    return Circle(*one.center_px, min(width, height) / 2)


def _cut(low_px: float, high_px: float, scale: int, size: int) -> slice:
    """Return this part of the rows or columns of the decoded image."""
    first = min(size, max(0, math.floor(low_px / scale)))
    return slice(first, min(size, max(first, math.ceil(high_px / scale))))


def _pixels(picture: DecodedImage, circle: Circle) -> NDArray[np.uint8]:
    """Return some of the pixels (N, 3) well inside the circle."""
    reach = circle.radius_px * _CORE
    rows = _cut(circle.cy_px - reach, circle.cy_px + reach, picture.scale, picture.bgr.shape[0])
    columns = _cut(circle.cx_px - reach, circle.cx_px + reach, picture.scale, picture.bgr.shape[1])
    part = picture.bgr[rows, columns]
    down, right = np.ogrid[rows, columns]
    scale = picture.scale
    away = np.hypot((right + 0.5) * scale - circle.cx_px, (down + 0.5) * scale - circle.cy_px)
    pixels = part[away <= reach]
    return pixels[:: max(1, len(pixels) // _SAMPLES)]
