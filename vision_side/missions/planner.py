"""Costmap of the echoes of the range sensors, and the path over it. Pure.

Sensors with a range of 0.2 m detect a wall only next to it. The costmap stores the echoes in the odometry frame. It
removes an echo when rays pass through its place: after odometry drift, or when the obstacle is gone.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.vision_side.missions.ranges import Points

Cells = NDArray[np.int64]
"""(N, 2), integer cell coordinates."""

CELL_M = 0.03
"""Cell size. Fine enough for a robot of 0.11 m; a plan over 6 x 6 m still takes a few milliseconds."""
MAX_CELLS = 20_000
"""Security limit: 18 square meters of solid echoes; above it the costmap removes the oldest."""
_ECHO, _SUREST = 3, 6  # one echo fills a cell; after two echoes, six rays through the cell clear it
_SHY_CELLS = 2.5  # a ray clears no cells this near to its echo: a wall at a grazing angle fills several
_PROGRESS_CELL_M = 0.12  # progress: a cell of this size is occupied for the first time


class Costmap:
    """Occupied cells. `version` changes when one is added or removed."""

    def __init__(self) -> None:
        self._sure: dict[tuple[int, int], int] = {}
        self._known: set[tuple[int, int]] = set()
        self.version = 0
        self.discoveries = 0
        """Number of coarse cells that were ever occupied. It stops growing when the robot makes no progress."""

    def see(self, sensor: tuple[float, float], echoes: Points) -> None:
        """Add the echoes of a sensor at `sensor`.

        Only a ray with an echo shows free floor in front of the echo. In a merged scan of several sensors, a number
        without an echo may belong to no ray at all.
        """
        filled = {(x, y) for x, y in cells_of(echoes).tolist()}
        for cell in _passed(np.array([sensor]), echoes, self.cells()) - filled:
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
        if self._sure[cell] > 1:
            self._sure[cell] -= 1
        else:
            del self._sure[cell]
            self.version += 1

    def cells(self) -> Cells:
        """Return the filled cells."""
        return np.array(list(self._sure), np.int64).reshape(-1, 2)

    def points(self) -> Points:
        """Return the centers of the filled cells."""
        middles: Points = (self.cells().astype(np.float64) + 0.5) * CELL_M
        return middles


def cells_of(points: Points) -> Cells:
    """Return the cell of each point."""
    return np.floor(points / CELL_M).astype(np.int64)


def _passed(sensor: Points, ends: Points, cells: Cells) -> set[tuple[int, int]]:
    """Return the cells that the rays passed through well before their ends, within the horizon."""
    # Rays that end in one cell cross the same floor.
    ends = ends[np.unique(cells_of(ends), axis=0, return_index=True)[1]]
    along = ends - sensor
    length_m = np.hypot(along[:, 0], along[:, 1])
    clear_m = np.minimum(length_m - _SHY_CELLS * CELL_M, HORIZON_M)
    steps = math.ceil(clear_m.max(initial=0.0) / CELL_M)
    way_m = np.arange(steps) * CELL_M
    share = way_m / np.maximum(length_m, 1e-9)[:, None]
    points = (sensor[:, None] + share[..., None] * along[:, None])[way_m < clear_m[:, None]]
    corner, size = cells_of(sensor) - steps - 1, 2 * steps + 3
    seen = np.zeros((size, size), bool)
    seen[tuple((cells_of(points) - corner).T)] = True
    near = cells[((cells >= corner) & (cells < corner + size)).all(axis=1)]
    return {(x, y) for x, y in near[seen[tuple((near - corner).T)]].tolist()}


# The path to a goal over the known floor; the unknown floor counts as free. Pure. A wave spreads from the goal over all
# cells that the center of the robot may enter. A robot that moves against the wave takes a shortest path to the goal.
# If the wave does not reach the robot, known obstacles block every path, and unknown floor cannot open one. Each new
# plan comes from new observations, so a robot that follows the plans cannot circle forever.


Point = tuple[float, float]
Cell = tuple[int, int]

HORIZON_M = 6.0
"""Half the width of the largest plan. The way to a further goal leads over the border of the plan."""
_UNREACHED = np.int32(2**30)
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
_SQUARE = np.ones((3, 3), np.uint8)  # alternates with the cross: circles become octagons, at most 6 % off
_TIGHT_STEPS = 3
_AROUND = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))
_LOOK_AHEAD_CELLS = 48
_NEAREST_CELLS = 6  # steering toward a nearer point oscillates
_TRIED_EVERY = 3  # only every third cell of the path is tested for a straight line


class Planner:
    """One plan, valid for any place of the robot until the costmap changes.

    `keep_m`: least distance between the centers of a filled cell and of the robot. `roomy_m`: preferred distance, if
    it needs no long detour.
    """

    def __init__(self, filled: Cells, robot: Point, goal: Point, keep_m: float, roomy_m: float) -> None:
        self.goal = goal
        low, high = _window(filled, robot, goal, roomy_m)
        size = high - low + 1
        self._corner: Cell = (int(low[0]), int(low[1]))
        self._size: Cell = (int(size[0]), int(size[1]))
        self._next: dict[Cell, Cell | None] = {}
        away_m = _away(filled - low, size)
        self._blocked, self._tight = away_m < keep_m, away_m < roomy_m
        self._beyond_m = 0.0
        self._steps = _flooded(self._blocked, self._tight, self._seeds(size))

    def _seeds(self, size: NDArray[np.int64]) -> list[tuple[int, Cell]]:
        """Return (step, cell) of each start of the wave: the goal, or border cells by their distance to the goal."""
        i, j = self._cell(self.goal)
        if 0 <= i < size[0] and 0 <= j < size[1]:
            return [(0, (i, j))]
        border = [(a, b) for a in range(int(size[0])) for b in (0, int(size[1]) - 1)]
        border += [(a, b) for a in (0, int(size[0]) - 1) for b in range(int(size[1]))]
        away = {one: round(math.hypot(one[0] - i, one[1] - j)) for one in border if not self._blocked[one]}
        nearest = min(away.values(), default=0)
        self._beyond_m = nearest * CELL_M
        return [(steps - nearest, one) for one, steps in away.items()]

    def _cell(self, point: Point) -> Cell:
        return math.floor(point[0] / CELL_M) - self._corner[0], math.floor(point[1] / CELL_M) - self._corner[1]

    def covers(self, point: Point) -> bool:
        """Return True if `point` is inside the plan."""
        i, j = self._cell(point)
        return 0 <= i < self._size[0] and 0 <= j < self._size[1]

    def middle(self, cell: Cell) -> Point:
        """Return the center of a cell of the plan."""
        return (cell[0] + self._corner[0] + 0.5) * CELL_M, (cell[1] + self._corner[1] + 0.5) * CELL_M

    def entry(self, robot: Point, within_m: float) -> Cell | None:
        """Return the robot's cell, or the nearest cell with a way to the goal, or None."""
        i, j = self._cell(robot)
        if self.covers(robot) and self._steps[i, j] < _UNREACHED:
            return i, j
        reach = math.ceil(within_m / CELL_M)
        a, b = max(0, i - reach), max(0, j - reach)
        part = self._steps[a : max(0, i + reach + 1), b : max(0, j + reach + 1)]
        cells = np.argwhere(part < _UNREACHED) + np.array([a, b])
        if not len(cells):
            return None
        away = np.hypot(cells[:, 0] - i, cells[:, 1] - j)
        nearest = int(np.argmin(away))
        return (int(cells[nearest, 0]), int(cells[nearest, 1])) if away[nearest] <= reach else None

    def left_m(self, entry: Cell) -> float:
        """Return the length of the way from `entry`, within 6 %. Beyond the plan's border it is a straight line."""
        return float(self._steps[entry]) * CELL_M + self._beyond_m

    def carrot(self, robot: Point, entry: Cell) -> Point:
        """Return the farthest point of the way in direct line of sight from the robot."""
        skip = 1.5 + math.dist(self.middle(entry), robot) / CELL_M
        if self.sees(robot, self.goal, skip):
            return self.goal
        way = self._way(entry)
        for cell in way[:_NEAREST_CELLS:-_TRIED_EVERY]:
            point = self.middle(cell)
            if self.sees(robot, point, skip):
                return point
        return self.middle(way[min(len(way) - 1, _NEAREST_CELLS)])

    def left_from(self, point: Point) -> float:
        """Return the length of the way from `point`, or inf without a way."""
        steps = self._steps[self._cell(point)] if self.covers(point) else _UNREACHED
        return float(steps) * CELL_M + self._beyond_m if steps < _UNREACHED else math.inf

    def _way(self, entry: Cell) -> list[Cell]:
        way = [entry]
        while len(way) < _LOOK_AHEAD_CELLS:
            cell = way[-1]
            if cell not in self._next:
                self._next[cell] = self._after(cell)
            after = self._next[cell]
            if after is None:
                break
            way.append(after)
        return way

    def _after(self, cell: Cell) -> Cell | None:
        """Return the neighbor of `cell` that the wave reached first, nearest to the goal, or None at its source."""
        steps = self._steps
        i, j = cell
        near = [(int(steps[i + a, j + b]), (i + a, j + b)) for a, b in _AROUND
                if 0 <= i + a < self._size[0] and 0 <= j + b < self._size[1]]
        fewest = min(count for count, _ in near)
        if fewest >= steps[cell]:
            return None
        best = [one for count, one in near if count == fewest]
        return best[0] if len(best) == 1 else min(best, key=lambda one: math.dist(self.middle(one), self.goal))

    def sees(self, start: Point, end: Point, skip_cells: float = 1.5) -> bool:
        """Return True if a straight line crosses only free cells. The first `skip_cells` and cells outside the plan do
        not count. A line that starts in a tight place may cross tight cells, but no blocked ones.
        """
        count = max(2, math.ceil(2 * math.dist(start, end) / CELL_M))
        first = min(count, math.ceil(2 * skip_cells))
        share = np.arange(first, count + 1) / count
        rest = 1 - share
        i = np.floor((start[0] * rest + end[0] * share) / CELL_M).astype(np.int64) - self._corner[0]
        j = np.floor((start[1] * rest + end[1] * share) / CELL_M).astype(np.int64) - self._corner[1]
        inside = (i >= 0) & (i < self._size[0]) & (j >= 0) & (j < self._size[1])
        i, j = i[inside], j[inside]
        own = self._cell(start)
        closed = self._blocked if self.covers(start) and self._tight[own] else self._tight
        return not closed[i, j].any()


def _window(filled: Cells, robot: Point, goal: Point, keep_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the corner cells of the plan: around robot, goal and obstacles with a margin, within the horizon."""
    own, margin = cells_of(np.array([robot]))[0], math.ceil(keep_m / CELL_M) + 4
    horizon = round(HORIZON_M / CELL_M)
    near = filled[(np.abs(filled - own) < horizon - margin).all(axis=1)]
    ends = np.vstack([own, near, np.clip(cells_of(np.array([goal])), own - horizon, own + horizon)])
    inside = (np.abs(cells_of(np.array([goal]))[0] - own) <= horizon).all()
    low = np.maximum(ends.min(axis=0) - margin, own - horizon - (margin if inside else 0))
    high = np.minimum(ends.max(axis=0) + margin, own + horizon + (margin if inside else 0))
    return low, high


def _away(filled: Cells, size: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the distance of the center of each cell from the nearest filled cell, in m."""
    room = np.ones(size, np.uint8)
    inside = ((filled >= 0) & (filled < size)).all(axis=1)
    room[tuple(filled[inside].T)] = 0
    if room.all():
        return np.full(size, np.inf, np.float32)
    away: NDArray[np.float32] = cv2.distanceTransform(room, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * np.float32(CELL_M)
    return away


def _flooded(blocked: NDArray[np.bool_], tight: NDArray[np.bool_], seeds: list[tuple[int, Cell]]
             ) -> NDArray[np.int32]:
    """Return the number of wave steps to each cell. The wave enters tight cells only every third step."""
    free, roomy = (~blocked).astype(np.uint8), (~(blocked | tight)).astype(np.uint8)
    wave, waited = np.zeros_like(free), np.zeros(free.shape, np.int32)
    pending = sorted((one for one in seeds if free[one[1]]), reverse=True)
    step, counts = 0, [-1] * _TIGHT_STEPS
    while True:
        while pending and pending[-1][0] <= step:
            wave[pending.pop()[1]] = 1
        reached = cv2.countNonZero(wave)
        if reached == counts[0] and not pending:
            break
        counts = [*counts[1:], reached]
        waited += wave ^ 1
        step += 1
        grown = np.asarray(cv2.dilate(wave, _SQUARE if step % 2 else _CROSS), np.uint8)
        wave |= grown & (free if step % _TIGHT_STEPS == 0 else roomy)
    waited[wave == 0] = _UNREACHED
    return waited
