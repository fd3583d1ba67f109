"""Is an outline round, and which part of it is? Circle fits through outline points. Pure."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Outline = NDArray[np.float64]
"""Points (N, 2) in pixels."""
Fit = tuple[float, float, float]
"""Circle: cx, cy, radius."""
Terms = NDArray[np.float64]
"""Of each point, the columns (4, N) that a circle is linear in: x, y, x^2 + y^2, 1."""

MIN_POINTS = 8
_OVAL = 0.1  # a ball at the side of a wide picture is drawn oval; its outline leaves the circle by this part of it
_TRIMS = 4  # each leaves out what the fit before shows to be off the circle, and so bends the next fit less
_STAIRS_PX = 1.5  # no pixel of a clean disc's outline is further from its circle
_CLEAN = 0.25  # RMS, by the limit for a single point: so few points off it bend no circle, and none is looked for


def fit_circle(points: Outline) -> Fit:
    """Least-squares circle through `points` (Kåsa's linear form); radius 0 for a straight line or fewer than three."""
    return _fit(_terms(points))[0]


def fit_round_part(outline: NDArray[Any], min_radius_px: float, max_roughness: float) -> tuple[Fit, Outline] | None:
    """The circle of `outline` and the points on it, less what something in front cut off; None if it is not round.

    `max_roughness` bounds the RMS distance from the circle, in radii.
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
    # Half a pixel of stair-steps is no roughness: without this allowance, distant discs would be refused.
    return (circle, terms[:2].T) if rough_px <= max_roughness * circle[2] + 0.5 else None


def _terms(points: NDArray[Any]) -> Terms:
    terms = np.empty((4, len(points)))
    x, y, square, one = terms
    terms[:2] = points.T
    np.add(x * x, y * y, out=square)
    one.fill(1.0)
    return terms


def _fit(terms: Terms) -> tuple[Fit, float]:
    """The circle, and the RMS distance of the points from it, to first order.

    One product of matrices holds every sum; the rest is plain numbers: normal equations about the points' middle.
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
    left = max(0.0, ss - square * mean - 4 * (cx * bx + cy * by))  # squares of d^2 - r^2, which is 2r (d - r)
    return (cx, cy, radius), math.sqrt(left / count) / (2 * radius) if radius else math.inf


def _off(terms: Terms, circle: Fit) -> Outline:
    """Distance of each point from the circle."""
    cx, cy, radius = circle
    square = np.array((-2 * cx, -2 * cy, 1.0, cx * cx + cy * cy)) @ terms
    away: Outline = np.abs(np.sqrt(np.maximum(square, 0.0)) - radius)
    return away
