"""The world from above as a picture, drawn from truth: walls, the ways so far, robot and target. Pure."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.evaluation.plots import wall_corners
from sightline.sim.scenario import Scenario
from sightline.sim.things import Static
from sightline.sim.truth import Truth

Image = NDArray[np.uint8]
Point = tuple[int, int]
Colour = tuple[int, int, int]

_PAPER, _WALL, _ROBOT, _TARGET = (245, 245, 245), (150, 150, 150), (180, 110, 30), (20, 170, 230)  # BGR
_MARGIN_M = 0.4
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel


class TopView:
    """A square picture that grows a way: call `draw` with the index of each next sample."""

    def __init__(self, samples: Sequence[Truth], scenario: Scenario, size_px: int) -> None:
        """Raises ValueError for no samples."""
        self._samples, self._radius_m, self._size_px = samples, scenario.target.reach_m, size_px
        corners = [corner for wall in scenario.walls for corner in wall_corners(wall)]
        xs = [x for t in samples for x in (t.x_m, t.target_x_m)] + [x for x, _ in corners]
        ys = [y for t in samples for y in (t.y_m, t.target_y_m)] + [y for _, y in corners]
        span_m = max(max(xs) - min(xs), max(ys) - min(ys)) + 2 * _MARGIN_M
        self._scale = size_px / span_m
        self._middle = ((max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2)
        self._drawn = 0
        self._paper = np.full((size_px, size_px, 3), _PAPER, np.uint8)
        for wall in scenario.walls:
            outline = np.array([self._at(*corner) for corner in wall_corners(wall)], np.int32)
            cv2.fillPoly(self._paper, [outline], _WALL, cv2.LINE_AA, _SHIFT)
        for thing in scenario.things:
            if isinstance(thing, Static):
                self._disc(self._paper, thing.at_m, thing.reach_m, _WALL)

    def draw(self, index: int) -> Image:
        """The picture at sample `index`, which never goes back."""
        for at in range(self._drawn, index):
            now, then = self._samples[at], self._samples[at + 1]
            self._line((now.x_m, now.y_m), (then.x_m, then.y_m), _ROBOT)
            self._line((now.target_x_m, now.target_y_m), (then.target_x_m, then.target_y_m), _TARGET)
        self._drawn = max(self._drawn, index)
        picture = self._paper.copy()
        truth = self._samples[index]
        self._disc(picture, (truth.target_x_m, truth.target_y_m), self._radius_m, _TARGET)
        self._robot(picture, truth)
        return picture

    def _robot(self, picture: Image, truth: Truth) -> None:
        """An arrowhead on the axle, as long as the robot."""
        corners = [(0.1, 0.0), (-0.08, 0.08), (-0.04, 0.0), (-0.08, -0.08)]
        cos, sin = math.cos(truth.yaw_rad), math.sin(truth.yaw_rad)
        outline = [self._at(truth.x_m + x * cos - y * sin, truth.y_m + x * sin + y * cos) for x, y in corners]
        cv2.fillPoly(picture, [np.array(outline, np.int32)], _ROBOT, cv2.LINE_AA, _SHIFT)

    def _disc(self, picture: Image, centre: tuple[float, float], radius_m: float, colour: Colour) -> None:
        radius_px = max(2.0, radius_m * self._scale)
        cv2.circle(picture, self._at(*centre), round(radius_px * 2**_SHIFT), colour, -1, cv2.LINE_AA, _SHIFT)

    def _line(self, start: tuple[float, float], end: tuple[float, float], colour: Colour) -> None:
        cv2.line(self._paper, self._at(*start), self._at(*end), colour, 1, cv2.LINE_AA, _SHIFT)

    def _at(self, x_m: float, y_m: float) -> Point:
        """World to sixteenths of pixels: x right, y up."""
        half = self._size_px / 2
        x_px = half + (x_m - self._middle[0]) * self._scale
        y_px = half - (y_m - self._middle[1]) * self._scale
        return round(x_px * 2**_SHIFT), round(y_px * 2**_SHIFT)
