"""Colour detector for one thing whose light changes: it learns the colour, looks where the thing should be, and would
rather lose it than jump to another. Pure: the clock is the frames' capture time.

Found by the configured ranges in several pictures in a row, the thing is then followed by its own colour, near where a
Kalman filter of its place in the picture expects it. What else has the colour elsewhere is not looked at.
"""

import math
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.config import Config as Settings
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import Picture
from sightline.vision_side.detect.color.adaptive import ColorModel
from sightline.vision_side.detect.color.hsv import Region
from sightline.vision_side.detect.hsv import HsvDetector
from sightline.vision_side.detect.labels import Label
from sightline.vision_side.detect.pixel_track import PixelTrack
from sightline.vision_side.detect.port import Circle, Detection

_CLEAR: Final = 0.8  # of the outline in view: of a thing more hidden than this, no colour is learned
_SAMPLES: Final = 400  # pixels: enough for a middle and a spread
_CORE: Final = 0.7  # of the radius: the rim's pixels are half the floor's


class AdaptiveConfig(Settings):
    """The ranges to begin with, and how much it goes along with."""

    hsv: HsvConfig = HsvConfig()
    label: Label = "target"
    confirm: Annotated[int, Field(ge=1, le=30)] = 3
    """Pictures in a row with the thing at one place before it is believed."""
    lost_after_s: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Not seen for this long, it is lost, and is looked for everywhere again."""
    remembered_s: Annotated[float, Field(ge=0, le=60)] = 5.0
    """What was lost is only taken up again if it has the learned colour, for this long."""
    colour_sigmas: Annotated[float, Field(gt=1, le=8)] = 4.0
    """A pixel further than this from the learned colour is none of the thing's."""
    adapt_s: Annotated[float, Field(gt=0.05, le=60)] = 0.3
    """How slowly the colour goes along with the light. A lamp that turns from warm to cold in 3 s is not lost yet."""


class AdaptiveTracker:
    """Follows one thing in one robot's pictures."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self._config = config
        self._everywhere = HsvDetector(config.hsv, config.label)
        self._track: PixelTrack | None = None
        self._candidate: tuple[PixelTrack, int] | None = None
        self._chroma: ColorModel | None = None
        self._seen_us = 0
        self._last_us: int | None = None

    def detect(self, picture: Picture, t_us: int) -> tuple[Detection, ...]:
        """The thing, or nothing, in a picture captured at `t_us`."""
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

    def _follow(self, track: PixelTrack, picture: Picture, dt_s: float) -> Detection | None:
        """The nearest to where it should be, of its colour and about its size."""
        track.advance(dt_s)
        region = self._region(picture, track)
        if region is None:
            return None
        found = [one for one in self._everywhere.measure(picture, region) if track.admits(_circle(one))]
        best = min(found, key=lambda one: track.away_px(_circle(one)), default=None)
        if best is not None:
            track.correct(_circle(best))
        return best

    def _region(self, picture: Picture, track: PixelTrack) -> Region | None:
        """Around where it should be, with what has its colour marked."""
        if self._chroma is None:
            return None
        half = track.gate_px + 1.4 * track.radius_px + 4
        columns = _cut(track.cx_px - half, track.cx_px + half, picture.scale, picture.bgr.shape[1])
        rows = _cut(track.cy_px - half, track.cy_px + half, picture.scale, picture.bgr.shape[0])
        part = picture.bgr[rows, columns]
        if not part.size:
            return None
        return Region(part, self._chroma.mask(part, self._config.colour_sigmas), (columns.start, rows.start))

    def _acquire(self, picture: Picture, t_us: int, dt_s: float) -> Detection | None:
        """The largest of the configured colour, once it was at one place for some pictures in a row."""
        known = self._chroma if t_us - self._seen_us <= self._config.remembered_s * 1e6 else None
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
        self._track, self._candidate, self._chroma = track, None, known
        return found

    def _is_it(self, picture: Picture, found: Detection, known: ColorModel | None) -> bool:
        pixels = _pixels(picture, _circle(found))
        return len(pixels) > 0 and (known is None or known.distance(pixels) <= self._config.colour_sigmas)

    def _learn(self, picture: Picture, found: Detection, dt_s: float) -> None:
        pixels = _pixels(picture, _circle(found))
        if not len(pixels):
            return
        if self._chroma is None:
            self._chroma = ColorModel(pixels)
        elif found.score >= _CLEAR:
            self._chroma.learn(pixels, 1 - math.exp(-dt_s / self._config.adapt_s))


def _circle(one: Detection) -> Circle:
    """Its own, or the one in its box."""
    if one.circle is not None:
        return one.circle
    width, height = one.x2_px - one.x1_px, one.y2_px - one.y1_px
    return Circle((one.x1_px + one.x2_px) / 2, (one.y1_px + one.y2_px) / 2, min(width, height) / 2)


def _cut(low_px: float, high_px: float, scale: int, size: int) -> slice:
    """That part of the decoded picture's rows or columns."""
    first = min(size, max(0, math.floor(low_px / scale)))
    return slice(first, min(size, max(first, math.ceil(high_px / scale))))


def _pixels(picture: Picture, circle: Circle) -> NDArray[np.uint8]:
    """Some of the pixels (N, 3) well within the circle."""
    reach = circle.radius_px * _CORE
    rows = _cut(circle.cy_px - reach, circle.cy_px + reach, picture.scale, picture.bgr.shape[0])
    columns = _cut(circle.cx_px - reach, circle.cx_px + reach, picture.scale, picture.bgr.shape[1])
    part = picture.bgr[rows, columns]
    down, right = np.ogrid[rows, columns]
    scale = picture.scale
    away = np.hypot((right + 0.5) * scale - circle.cx_px, (down + 0.5) * scale - circle.cy_px)
    pixels = part[away <= reach]
    return pixels[:: max(1, len(pixels) // _SAMPLES)]
