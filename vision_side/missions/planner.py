"""What range sensors told of the floor: a bounded memory of cells that something stands in. Pure.

Sensors that reach 0.2 m see a wall only while they are beside it. What they saw is kept in the odometry frame, and
given up again when rays pass where it was: after a drift of the odometry, or when the thing went away.
"""

import numpy as np
from numpy.typing import NDArray

from sightline.vision_side.missions.ranging import Points

Cells = NDArray[np.int64]
"""(N, 2), whole numbers of cells."""

CELL_M = 0.03
"""Fine enough for a robot of 0.11 m; a plan over 6 x 6 m still takes a few milliseconds."""
MAX_CELLS = 20_000
"""Security limit: 18 square metres of solid echoes; beyond it the oldest are forgotten."""
_ECHO, _SUREST = 3, 6  # one echo counts at once; after two it takes six rays through the cell to give it up
_SHY_CELLS = 2.5  # a ray says nothing of the cells this near to its echo: a wall at a grazing angle fills several
_PROGRESS_CELL_M = 0.12  # something new was learned when a cell of this size is seen filled for the first time


class Costmap:
    """Cells that something stands in. `version` changes whenever one comes or goes."""

    def __init__(self) -> None:
        self._sure: dict[tuple[int, int], int] = {}
        self._known: set[tuple[int, int]] = set()
        self.version = 0
        self.discoveries = 0
        """How many coarse cells were ever found filled: what a robot that makes no progress stops adding to."""

    def see(self, sensor: tuple[float, float], echoes: Points) -> None:
        """Take in the echoes that a sensor at `sensor` met.

        Only a ray with an echo shows that the floor before it is free: of several sensors merged into one scan, a
        number without an echo may stand for a ray that nobody sends.
        """
        filled = {(int(x), int(y)) for x, y in cells_of(echoes)}
        for cell in _passed(np.array([sensor]), echoes) - filled:
            self._doubt(cell)
        for cell in filled:
            self._fill(cell)

    def _fill(self, cell: tuple[int, int]) -> None:
        before = self._sure.get(cell, 0)
        self._sure[cell] = min(_SUREST, before + _ECHO)
        if before:
            return
        self.version += 1
        if len(self._sure) > MAX_CELLS:
            self._sure.pop(next(iter(self._sure)))
        coarse = (int(cell[0] * CELL_M // _PROGRESS_CELL_M), int(cell[1] * CELL_M // _PROGRESS_CELL_M))
        if coarse not in self._known and len(self._known) < MAX_CELLS:
            self._known.add(coarse)
            self.discoveries += 1

    def _doubt(self, cell: tuple[int, int]) -> None:
        sure = self._sure.get(cell)
        if sure is None:
            return
        if sure > 1:
            self._sure[cell] = sure - 1
        else:
            del self._sure[cell]
            self.version += 1

    def cells(self) -> Cells:
        """The filled cells."""
        return np.array(list(self._sure), np.int64).reshape(-1, 2)

    def points(self) -> Points:
        """The middles of the filled cells."""
        middles: Points = (self.cells().astype(np.float64) + 0.5) * CELL_M
        return middles


def cells_of(points: Points) -> Cells:
    """The cells that hold `points`."""
    return np.floor(points / CELL_M).astype(np.int64)


def _passed(sensor: Points, ends: Points) -> set[tuple[int, int]]:
    """Cells that the rays went through well before they ended."""
    along = ends - sensor
    length_m = np.hypot(along[:, 0], along[:, 1])
    steps = int(max(length_m.max(initial=0.0) / CELL_M, 0.0))
    if not steps:
        return set()
    way_m = np.arange(steps)[None] * CELL_M
    sure = way_m < (length_m - _SHY_CELLS * CELL_M)[:, None]
    share = way_m / np.maximum(length_m, 1e-9)[:, None]
    points = sensor[:, None] + share[..., None] * along[:, None]
    return {(int(x), int(y)) for x, y in np.unique(cells_of(points[sure]), axis=0)}
