"""Is an outline round, and which part of it is? Circle fits through outline points. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

Outline = NDArray[np.float64]
"""Points (N, 2) in pixels."""
Fit = tuple[float, float, float]
"""Circle: cx, cy, radius."""

MIN_POINTS = 8
_OVAL = 0.1  # a ball at the side of a wide picture is drawn oval; its outline leaves the circle by this part of it
_TRIMS = 4  # each leaves out what the fit before shows to be off the circle, and so bends the next fit less
_STAIRS_PX = 1.5  # no pixel of a clean disc's outline is further from its circle


def fit_circle(points: Outline) -> Fit:
    """Least-squares circle through `points` (Kåsa's linear form); radius 0 for a straight line or fewer than three."""
    if len(points) < 3:
        return 0.0, 0.0, 0.0
    middle = points.sum(axis=0) / len(points)
    x, y = (points - middle).T
    square = x * x + y * y
    xx, xy, yy = float(x @ x), float(x @ y), float(y @ y)
    bx, by = float(x @ square) / 2, float(y @ square) / 2
    determinant = xx * yy - xy * xy
    mx, my = middle.tolist()
    if determinant <= 1e-9 * (xx + yy) ** 2:
        return mx, my, 0.0
    cx, cy = (bx * yy - by * xy) / determinant, (by * xx - bx * xy) / determinant
    return mx + cx, my + cy, math.sqrt(cx * cx + cy * cy + (xx + yy) / len(points))


def round_part(outline: Outline, min_radius_px: float, max_roughness: float) -> tuple[Fit, Outline] | None:
    """The circle of `outline` and the points on it, less what something in front cut off; None if it is not round.

    `max_roughness` bounds the RMS distance from the circle, in radii.
    """
    circle = fit_circle(outline)
    off = _off(outline, circle)
    for _ in range(_TRIMS):
        limit_px = max(_STAIRS_PX, _OVAL * circle[2])
        if len(outline) < MIN_POINTS or off.max() <= limit_px:
            break
        outline = outline[off <= max(limit_px, 2.0 * float(np.median(off)))]
        circle = fit_circle(outline)
        off = _off(outline, circle)
    if len(outline) < MIN_POINTS or circle[2] < min_radius_px:
        return None
    # Half a pixel of stair-steps is no roughness: without this allowance, distant discs would be refused.
    limit_px = max_roughness * circle[2] + 0.5
    return (circle, outline) if float(off @ off) <= limit_px * limit_px * len(off) else None


def grown(points: Outline, circle: Fit, by_px: float) -> Outline:
    """`points` moved outwards from the circle's centre."""
    factor = 1 + by_px / circle[2]
    moved: Outline = points * factor + (circle[0] * (1 - factor), circle[1] * (1 - factor))
    return moved


def _off(points: Outline, circle: Fit) -> Outline:
    """Distance of each point from the circle."""
    x, y = (points - circle[:2]).T
    away: Outline = np.abs(np.sqrt(x * x + y * y) - circle[2])
    return away
