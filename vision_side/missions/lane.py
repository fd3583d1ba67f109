"""Position of a lane, marked by a row of blocks, in the odometry frame. Pure.

Blocks stand on one or both sides of the lane. The position of each block is stored. The center line passes a block at a
set distance, on the side where the robot first saw it. So the robot drives along the row, never toward a block.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import Pose

_MAX_BLOCKS = 64
_SAME_M = 0.20  # two blocks have a larger distance; the measured place of a far block is off by this
_SAME_SHARE = 0.12  # ... plus this share of its distance
_BEHIND_M, _AHEAD_M = 1.2, 2.5  # part of the row that defines the local direction of the lane
_MIN_SPREAD_M = 0.4  # blocks with a smaller distance along the lane define no direction
_MOST_WEIGHT = 1e4


class LaneConfig(Config):
    """The position of the lane relative to its blocks."""

    pass_m: Annotated[float, Field(gt=0.05, le=5)] = 0.5
    """Distance from the center of a block to the center of the lane."""
    in_the_way: Annotated[str, Field(pattern="^(left|right)$")] = "left"
    """Assumed side of a block straight ahead. The robot passes it on the other side."""
    straight_m: Annotated[float, Field(ge=0, le=5)] = 0.12
    """Largest distance from the center line that counts as straight ahead."""
    beyond_m: Annotated[float, Field(ge=0, le=20)] = 0.8
    """The lane ends this far after its last block."""
    max_aside_m: Annotated[float, Field(gt=0.1, le=10)] = 1.5
    """A block further from the lane does not belong to it."""


@dataclass(frozen=True, slots=True)
class Block:
    """One block: place in the odometry frame, weight, and side of the lane: 1 left, -1 right."""

    x_m: float
    y_m: float
    weight: float
    side: float


@dataclass(frozen=True, slots=True)
class Line:
    """A straight part of the center line."""

    x_m: float
    y_m: float
    heading_rad: float

    def along_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a point along the lane, ahead positive, in m."""
        return (x_m - self.x_m) * math.cos(self.heading_rad) + (y_m - self.y_m) * math.sin(self.heading_rad)

    def aside_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a point from the center of the lane, left positive, in m."""
        return (y_m - self.y_m) * math.cos(self.heading_rad) - (x_m - self.x_m) * math.sin(self.heading_rad)

    def at(self, along_m: float) -> tuple[float, float]:
        """Return the point of the center line at this distance along it."""
        return self.x_m + along_m * math.cos(self.heading_rad), self.y_m + along_m * math.sin(self.heading_rad)


class Lane:
    """Stores the blocks. `line` is None before the first block."""

    def __init__(self, config: LaneConfig) -> None:
        self._config = config
        self._blocks: list[Block] = []
        self.line: Line | None = None

    def see(self, pose: Pose, places: Iterable[tuple[float, float]]) -> None:
        """Add block positions in the odometry frame, seen from `pose`, and fit the line again."""
        before = self.line or Line(*pose)
        for x_m, y_m in places:
            if abs(before.aside_m(x_m, y_m)) <= self._config.max_aside_m:
                self._meet(before, math.hypot(x_m - pose[0], y_m - pose[1]), x_m, y_m)
        if self._blocks:
            self.line = self._laid(pose, before.heading_rad)

    def _meet(self, line: Line, away_m: float, x_m: float, y_m: float) -> None:
        """Add a block, or update the place of a known block. Near measurements have the largest weight."""
        weight = 1.0 / max(away_m, 0.1) ** 4
        same_m = _SAME_M + _SAME_SHARE * away_m
        for index, one in enumerate(self._blocks):
            if math.hypot(one.x_m - x_m, one.y_m - y_m) < same_m:
                share = weight / (one.weight + weight)
                self._blocks[index] = replace(one, x_m=one.x_m + share * (x_m - one.x_m),
                                              y_m=one.y_m + share * (y_m - one.y_m),
                                              weight=min(one.weight + weight, _MOST_WEIGHT))
                return
        aside_m = line.aside_m(x_m, y_m)
        side = math.copysign(1.0, aside_m)
        if abs(aside_m) < self._config.straight_m:
            side = 1.0 if self._config.in_the_way == "left" else -1.0
        self._blocks = [*self._blocks[-_MAX_BLOCKS + 1 :], Block(x_m, y_m, weight, side)]

    def _laid(self, pose: Pose, heading_rad: float) -> Line:
        """Compute the center line next to the near blocks. A single block keeps the old direction."""
        here = Line(pose[0], pose[1], heading_rad)
        near = [one for one in self._blocks if -_BEHIND_M <= here.along_m(one.x_m, one.y_m) <= _AHEAD_M]
        near = near or [min(self._blocks, key=lambda one: math.hypot(one.x_m - pose[0], one.y_m - pose[1]))]
        heading_rad = self._turned(near, heading_rad)
        cos, sin = math.cos(heading_rad), math.sin(heading_rad)
        middles = [(one.x_m + one.side * self._config.pass_m * sin, one.y_m - one.side * self._config.pass_m * cos)
                   for one in near]
        return Line(sum(x for x, _ in middles) / len(middles), sum(y for _, y in middles) / len(middles), heading_rad)

    @staticmethod
    def _turned(near: list[Block], heading_rad: float) -> float:
        """Fit the common direction of the rows by least squares. Short rows keep the old direction."""
        xx = xy = 0.0
        cos, sin = math.cos(heading_rad), math.sin(heading_rad)
        spread: list[float] = []
        for side in (1.0, -1.0):
            row = [(one.x_m * cos + one.y_m * sin, one.y_m * cos - one.x_m * sin) for one in near if one.side == side]
            if len(row) < 2:
                continue
            along, aside = sum(one[0] for one in row) / len(row), sum(one[1] for one in row) / len(row)
            xx += sum((one[0] - along) ** 2 for one in row)
            xy += sum((one[0] - along) * (one[1] - aside) for one in row)
            spread.append(max(one[0] for one in row) - min(one[0] for one in row))
        return heading_rad + math.atan2(xy, xx) if max(spread, default=0.0) >= _MIN_SPREAD_M else heading_rad

    def left_m(self, pose: Pose) -> float:
        """Return the remaining length of the lane, slightly beyond the last known block, in m."""
        line = self.line
        if line is None:
            return 0.0
        last = max(line.along_m(one.x_m, one.y_m) for one in self._blocks)
        return last + self._config.beyond_m - line.along_m(pose[0], pose[1])
