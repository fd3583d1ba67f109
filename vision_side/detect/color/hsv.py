"""Find disks and blobs of configured colors: mask, sharp edge, circle fit. Pure.

The color table is over BGR565, so its cost does not depend on the number of ranges.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.vision_side.config import HsvConfig, HsvRange
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Circle, Detection

COARSE = 4
"""The first search reads every fourth pixel of every fourth row. Each disk of measurable size has such a pixel."""
MARGIN_PX = 10
"""Margin around the found pixels: the smallest disk extends 6 px from its only found pixel; the rest is background."""
_KERNEL = np.ones((3, 3), np.uint8)
LEAST_SHARE = 0.3
"""Least share of pixels with the color, in the middle of a box. Shade and highlights change some pixels of a ball."""
_MIDDLE = 0.6
"""Share of the box that lies fully on a ball, whose disk does not fill the corners."""
_FLOODED_SHARE = 0.25
"""Share of an image from which a color range marks a floor or a wall. Of 365 photographs of places without a target,
the default range marks this share in 2 %."""
_FLOODED_IMAGES = 15
"""Number of flooded images ..."""
_CHECKED_IMAGES = 90
"""... among this number of first images, for a notice."""


@dataclass(frozen=True, slots=True)
class Region:
    """The part of an image that contains all pixels of the color and a margin, with its origin."""

    bgr: NDArray[np.uint8]
    mask: NDArray[Any]
    origin_px: tuple[int, int]


class ColorMask:
    """Marks the configured colors."""

    def __init__(self, ranges: tuple[HsvRange, ...]) -> None:
        self._table = color_table(ranges)

    def region(self, bgr: NDArray[np.uint8]) -> Region | None:
        """Return the region with the color, without speckle, or None."""
        x, y, width, height = cv2.boundingRect(self._coarse(bgr))
        if not width:
            return None
        x1, y1 = max(0, x * COARSE - MARGIN_PX), max(0, y * COARSE - MARGIN_PX)
        part = bgr[y1 : (y + height) * COARSE + MARGIN_PX, x1 : (x + width) * COARSE + MARGIN_PX]
        # Speckle makes findContours a hundred times slower; a 3x3 opening removes it and preserves disks.
        mask = cv2.morphologyEx(cv2.LUT(codes_565(part), self._table), cv2.MORPH_OPEN, _KERNEL)
        return Region(part, mask, (x1, y1))

    def share(self, bgr: NDArray[np.uint8]) -> float:
        """Return the share of the sampled pixels that have the color, 0..1."""
        marked = self._coarse(bgr)
        return cv2.countNonZero(marked) / max(1, marked.size)

    def has_color(self, picture: DecodedImage, one: Detection) -> bool:
        """Return True if enough of the middle of a detection's box has the color."""
        columns = _middle(one.x1_px, one.x2_px, picture.scale, picture.bgr.shape[1])
        rows = _middle(one.y1_px, one.y2_px, picture.scale, picture.bgr.shape[0])
        codes = codes_565(np.ascontiguousarray(picture.bgr[rows, columns]))
        return bool(np.count_nonzero(self._table[codes]) >= LEAST_SHARE * codes.size)

    def _coarse(self, bgr: NDArray[np.uint8]) -> NDArray[Any]:
        return cv2.LUT(codes_565(bgr[COARSE // 2 :: COARSE])[:, COARSE // 2 :: COARSE].copy(), self._table)


class RangeCheck:
    """Checks in the first images whether a color range marks the floor or a wall."""

    def __init__(self, mask: ColorMask) -> None:
        self._mask = mask
        self._checked, self._flooded = 0, list[float]()
        self.is_flooded = False
        """True if the newest of these images is full of the color."""

    def look(self, picture: DecodedImage) -> str:
        """Check one more image. Returns, once, a line for the operator; "" otherwise."""
        self.is_flooded = False
        if self._checked == _CHECKED_IMAGES:  # later images may show a target that is near
            return ""
        self._checked += 1
        share = self._mask.share(picture.bgr)
        self.is_flooded = share >= _FLOODED_SHARE
        self._flooded += [share] if self.is_flooded else []
        if len(self._flooded) < _FLOODED_IMAGES:
            return ""
        self._checked = _CHECKED_IMAGES
        return (f"the color range marks {sum(self._flooded) / _FLOODED_IMAGES:.0%} of the image: the floor or a wall "
                "has that color in this light; pick the target's own with `sightline pick-color`")


def _middle(low_px: float, high_px: float, scale: int, size: int) -> slice:
    """Return the middle of the rows or columns of a box, at least one pixel of the decoded image."""
    cut = (high_px - low_px) * (1 - _MIDDLE) / 2
    first = min(size - 1, max(0, int((low_px + cut) / scale)))
    return slice(first, max(first + 1, min(size, int((high_px - cut) / scale) + 1)))


def codes_565(bgr: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the BGR565 code of each pixel."""
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2BGR565).view(np.uint16)[..., 0]


@cache
def colors_565() -> NDArray[np.float64]:
    """Return the center color (65536, 3) of each BGR565 code: blue, green, red, 0..255."""
    codes = np.arange(65536, dtype=np.uint32)
    blue, green, red = (codes & 31) * 8 + 3.5, (codes >> 5 & 63) * 4 + 1.5, (codes >> 11) * 8 + 3.5
    return _read_only(np.stack([blue, green, red], axis=-1))


@lru_cache(maxsize=32)  # 64 KB each; the robots of a fleet share one table
def color_table(ranges: tuple[HsvRange, ...]) -> NDArray[np.uint8]:
    """Return 255 for each BGR565 code with a color in one of `ranges`, 0 elsewhere; 65536 entries, read-only."""
    bgr = (colors_565() / 255).astype(np.float32)[None]
    hue, saturation, value = cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV)[0].T
    inside = np.zeros(65536, bool)
    for one in ranges:
        above, below = hue >= one.hue_low_deg, hue <= one.hue_high_deg
        turn = above & below if one.hue_low_deg <= one.hue_high_deg else above | below
        inside |= (turn & (saturation >= one.saturation_low) & (saturation <= one.saturation_high)
                   & (value >= one.value_low) & (value <= one.value_high))
    return _read_only(np.where(inside, 255, 0).astype(np.uint8))


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Make an array read-only, because it is cached and shared."""
    values.flags.writeable = False
    return values


# The exact edge of a colored blob: half-way between its color and that of its surroundings. Pure.
#
# A color range selects the blob. The limits of the range lie anywhere between the two colors. With the mask alone, the
# same ball is 7 % smaller in cold light, and larger in warm light. Brightness is ignored, because shade and a dark
# floor must not move the edge.


_MARGIN_PX = 4
_AROUND = np.ones((3, 5), np.uint8)  # two pixels in each direction, on every second row
_MIN_CONTRAST = 200.0  # squared color difference; below it, noise defines the edge

Box = Sequence[int]


def sharp_outline(bgr: NDArray[np.uint8], mask: NDArray[Any], box: Box) -> NDArray[Any] | None:
    """Return the outermost pixels (N, 1, 2) of the blob of `mask` in `box` (x, y, width, height).

    Returns None if the blob's color differs too little from its surroundings.
    """
    x1, y1 = max(0, box[0] - _MARGIN_PX), max(0, box[1] - _MARGIN_PX)
    rows, columns = slice(y1, box[1] + box[3] + _MARGIN_PX), slice(x1, box[0] + box[2] + _MARGIN_PX)
    blob = _blob(bgr[rows, columns], mask[rows, columns])
    if blob is None:
        return None
    outlines, _ = cv2.findContours(blob, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(x1, y1))
    return max(outlines, key=len) if outlines else None


def _blob(bgr: NDArray[np.uint8], inside: NDArray[Any]) -> NDArray[Any] | None:
    """Return nonzero where a pixel is nearer to the color inside the mask than outside, without brightness."""
    inside = inside[::2]  # every second row gives the same mean
    return blob_between(bgr, bgr[::2], inside, cv2.bitwise_not(cv2.dilate(inside, _AROUND)))


def blob_between(
    bgr: NDArray[np.uint8], rows: NDArray[np.uint8], inside: NDArray[Any], outside: NDArray[Any]
) -> NDArray[Any] | None:
    """Return nonzero where a pixel of `bgr` is nearer to the mean color `inside` than `outside`, both of `rows`.

    None if the two colors differ too little.
    """
    blue, green, red, _ = cv2.mean(rows, inside)
    other_blue, other_green, other_red, _ = cv2.mean(rows, outside)
    blue, green, red = blue - other_blue, green - other_green, red - other_red
    brighter = (blue + green + red) / 3
    blue, green, red = blue - brighter, green - brighter, red - brighter
    contrast = blue * blue + green * green + red * red
    if contrast < _MIN_CONTRAST:
        return None
    half_way = blue * other_blue + green * other_green + red * other_red + contrast / 2
    return cv2.transform(bgr, np.array(((blue, green, red, -half_way),)))  # negative values saturate to zero


# Circle fits through the points of an outline, and the part of the outline that is round. Pure.


Outline = NDArray[np.float64]
"""Points (N, 2) in pixels."""
Fit = tuple[float, float, float]
"""Circle: cx, cy, radius."""
Terms = NDArray[np.float64]
"""Columns (4, N) of the linear circle equation for each point: x, y, x^2 + y^2, 1."""

MIN_POINTS = 8
_OVAL = 0.1  # in radii: at the side of a wide image, the outline of a ball is oval and leaves the circle by this much
_TRIMS = 4  # rounds; each removes the points that the last fit shows off the circle
_STAIRS_PX = 1.5  # largest distance of an outline pixel from the circle of a clean disk
_CLEAN = 0.25  # RMS by the limit for one point; below it, too few points are off the circle to change the fit


def fit_round_part(outline: NDArray[Any], min_radius_px: float, max_roughness: float) -> tuple[Fit, Outline] | None:
    """Fit the circle of `outline` without the part that an object in front hides. Returns None if it is not round.

    `max_roughness` limits the RMS distance from the circle, in radii.
    """
    terms = _terms(outline)
    circle, rough_px = _fit(terms)
    for _ in range(_TRIMS):
        limit_px = max(_STAIRS_PX, _OVAL * circle[2])
        if rough_px <= _CLEAN * limit_px or terms.shape[1] < MIN_POINTS:
            break
        off = _off(terms, circle)
        if off.max() <= limit_px:
            break
        terms = terms[:, off <= max(limit_px, 2.0 * float(np.median(off)))]
        circle, rough_px = _fit(terms)
    if terms.shape[1] < MIN_POINTS or circle[2] < min_radius_px:
        return None
    # The pixel grid moves points by up to half a pixel. Without this allowance, distant disks would be rejected.
    return (circle, terms[:2].T) if rough_px <= max_roughness * circle[2] + 0.5 else None


def _terms(points: NDArray[Any]) -> Terms:
    terms = np.empty((4, len(points)))
    x, y, square, one = terms
    terms[:2] = points.T
    np.add(x * x, y * y, out=square)
    one.fill(1.0)
    return terms


def _fit(terms: Terms) -> tuple[Fit, float]:
    """Fit a circle by least squares (Kåsa's linear form).

    Returns the circle, and the RMS distance of the points from it to first order. The radius is 0 for a straight line
    or fewer than three points. One matrix product gives every sum for the normal equations about the mean point.
    """
    count = terms.shape[1]
    if count < 3:
        return (0.0, 0.0, 0.0), math.inf
    (xx, xy, xs, x), (_, yy, ys, y), (_, _, ss, square), _ = (terms @ terms.T).tolist()
    mx, my, mean = x / count, y / count, square / count
    xx, xy, yy = xx - x * mx, xy - x * my, yy - y * my
    bx, by = (xs - x * mean) / 2, (ys - y * mean) / 2
    determinant = xx * yy - xy * xy
    if determinant <= 1e-9 * (xx + yy) ** 2:
        return (mx, my, 0.0), math.inf
    cx, cy = (bx * yy - by * xy) / determinant, (by * xx - bx * xy) / determinant
    radius = math.sqrt(max(0.0, mean - 2 * (cx * mx + cy * my) + cx * cx + cy * cy))
    left = max(0.0, ss - square * mean - 4 * (cx * bx + cy * by))  # squares of d^2 - r^2, about 2r (d - r)
    return (cx, cy, radius), math.sqrt(left / count) / (2 * radius) if radius else math.inf


def _off(terms: Terms, circle: Fit) -> Outline:
    """Return the distance of each point from the circle."""
    cx, cy, radius = circle
    square = np.array((-2 * cx, -2 * cy, 1.0, cx * cx + cy * cy)) @ terms
    away: Outline = np.abs(np.sqrt(np.maximum(square, 0.0)) - radius)
    return away


# Detector of objects of one color, round objects by default: mask, outlines, sharp edge, circle fit. Pure.


Pixels = NDArray[Any]
"""Outline from OpenCV: (N, 1, 2), integers."""

_EDGE_PX = 0.45  # distance of the true edge outside the center of an outermost pixel, mean over all directions


class HsvDetector:
    """Finds disks, or objects of any shape, of the configured colors."""

    def __init__(self, config: HsvConfig, label: str = "target") -> None:
        self._config = config
        self._label = label
        self.mask = ColorMask(config.ranges)

    def detect(self, picture: DecodedImage) -> tuple[Detection, ...]:
        """Return the objects with the color and the configured shape, largest first."""
        region = self.mask.region(picture.bgr)
        return () if region is None else self.measure(picture, region)

    def measure(self, picture: DecodedImage, region: Region) -> tuple[Detection, ...]:
        """Return the objects in `region` of `picture` with the configured shape, largest first."""
        outlines, _ = cv2.findContours(region.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        longest = sorted(outlines, key=len, reverse=True)[: self._config.max_contours]
        look = self._disc if self._config.shape == "disc" else self._thing
        found = [look(picture, region, outline) for outline in longest]
        return tuple(sorted((one for one in found if one), key=_radius, reverse=True))

    def _thing(self, picture: DecodedImage, region: Region, outline: Pixels) -> Detection | None:
        """Return the box around the outline, or None if it is too small."""
        box = cv2.boundingRect(outline)
        if min(box[2], box[3]) < 2 * self._config.min_radius_px:
            return None
        sharp = sharp_outline(region.bgr, region.mask, box)
        x, y, width, height = box if sharp is None else cv2.boundingRect(sharp)
        left, top, scale = region.origin_px[0] + x, region.origin_px[1] + y, picture.scale
        right, bottom = left + width, top + height
        return Detection(left * scale, top * scale, right * scale, bottom * scale, 1.0, self._label)

    def _disc(self, picture: DecodedImage, region: Region, outline: Pixels) -> Detection | None:
        """Return the disk that `outline` encloses, or None if it is too small or not round."""
        box = cv2.boundingRect(outline)
        if max(box[2], box[3]) < 2 * self._config.min_radius_px:
            return None
        sharp = sharp_outline(region.bgr, region.mask, box)
        if sharp is not None:
            outline, box = sharp, cv2.boundingRect(sharp)
        edge = own_edge(outline, box, region.origin_px, picture.bgr.shape)
        fit = fit_round_part(edge, self._config.min_radius_px, self._config.max_roughness)
        if fit is None or len(fit[1]) < self._config.min_outline_kept * len(edge):
            return None
        whose = (len(fit[1]) / len(outline), self._label)
        return disc_detection((box, *fit), whose, region.origin_px, picture.scale)


def disc_detection(shape: tuple[Box, Fit, Outline], whose: tuple[float, str], origin_px: tuple[int, int],
                   scale: int) -> Detection:
    """Convert a disk to a detection, px of the encoded image. Circle and edge use the centers of pixels."""
    box, circle, edge = shape
    x, y = origin_px[0] + box[0], origin_px[1] + box[1]
    cx, cy = origin_px[0] + 0.5 + circle[0], origin_px[1] + 0.5 + circle[1]
    radius = circle[2] + _EDGE_PX
    outwards = radius / circle[2]
    ring = edge.T * (outwards * scale)
    ring[0] += (cx - outwards * circle[0]) * scale
    ring[1] += (cy - outwards * circle[1]) * scale
    return Detection(x * scale, y * scale, (x + box[2]) * scale, (y + box[3]) * scale, *whose,
                     Circle(cx * scale, cy * scale, radius * scale), ring.T)


def own_edge(pixels: Pixels, box: Box, origin_px: tuple[int, int], shape: tuple[int, ...]) -> Pixels:
    """Return the pixels (N, 2) of the outline without those at the border of the image."""
    flat = pixels[:, 0]
    left, top = -origin_px[0], -origin_px[1]  # image origin, in pixels of the region
    right, bottom = left + shape[1] - 1, top + shape[0] - 1
    x, y, width, height = box
    if x <= left or y <= top or x + width > right or y + height > bottom:
        xs, ys = flat.T
        flat = flat[(xs > left) & (ys > top) & (xs < right) & (ys < bottom)]
    return flat


def _radius(detection: Detection) -> float:
    """Return the radius of the circle, or half the height of the box without a circle, in px."""
    return detection.circle.radius_px if detection.circle else (detection.y2_px - detection.y1_px) / 2
