"""A painted lane: a row of blue blocks, a traffic light on a pole or one box that changes colour. For missions' tests.

Flat colours and straight edges: what a mission must read, not what a simulator can draw. Defects are the simulator's.
"""

import math
from dataclasses import dataclass, field

import cv2
import numpy as np

from sightline.protocol.messages import Pose
from sightline.sim.camera import Defects
from sightline.sim.light import LIT, UNLIT
from sightline.sim.look import Look, look_named
from tests.vision_rig import camera
from sightline.vision_side.decode import Decoder, Picture
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.track import from_odometry

LENS = camera()
BLUE, HOUSING, SKY, FLOOR = (20, 36, 190), (18, 18, 20), (196, 199, 204), (118, 116, 112)
BLOCK_M = 0.14
Corner = tuple[float, float, float]


@dataclass
class LaneWorld:
    """Blocks at `blocks`, a light at `light`: `state` is lit at a time."""

    blocks: tuple[tuple[float, float], ...] = tuple((0.6 * one, 0.5) for one in range(1, 8))
    light: tuple[float, float] = (3.0, -0.45)
    is_box: bool = False
    state: object = field(default=lambda t_s: "green")
    look: Look = field(default_factory=lambda: look_named("plain"))
    seed: int = 1

    def __post_init__(self) -> None:
        self._defects = Defects(self.look, LENS.width_px, LENS.height_px, self.seed)
        self._decoder = Decoder(LENS.width_px, LENS.height_px, 10**6)

    def sight(self, pose: Pose, t_s: float) -> tuple[tuple[Detection, ...], Picture]:
        """The blocks in view, exactly, and the picture, decoded anew."""
        picture = self.picture(pose, self.state(t_s))
        decoded = self._decoder.decode(self._defects.jpeg(picture))
        found = [self._box(self._corners((*one, BLOCK_M / 2), (BLOCK_M,) * 3), pose) for one in self.blocks]
        boxes = tuple(Detection(*one, 1.0, "target") for one in found if one)
        return boxes, Picture(decoded.bgr.copy(), decoded.scale)

    def picture(self, pose: Pose, state: str) -> np.ndarray:
        """RGB, before the defects."""
        picture = np.empty((LENS.height_px, LENS.width_px, 3), np.uint8)
        picture[: LENS.height_px // 2], picture[LENS.height_px // 2 :] = SKY, FLOOR
        far_first = sorted(self.blocks, key=lambda one: -math.dist(one, pose[:2]))
        for one in far_first:
            self._fill(picture, self._corners((*one, BLOCK_M / 2), (BLOCK_M,) * 3), pose, BLUE)
        if self.is_box:
            corners = self._corners((*self.light, 0.14), (0.266, 0.317, 0.281))
            self._fill(picture, corners, pose, _shade(LIT[state], 1.0))
        else:
            self._paint_light(picture, pose, state)
        return picture

    def _paint_light(self, picture: np.ndarray, pose: Pose, state: str) -> None:
        self._fill(picture, self._corners((*self.light, 0.105), (0.03, 0.03, 0.21)), pose, HOUSING)
        self._fill(picture, self._corners((*self.light, 0.34), (0.06, 0.10, 0.26)), pose, HOUSING)
        for name, up_m in (("red", 0.0867), ("yellow", 0.0), ("green", -0.0867)):
            spot = self._pixel((self.light[0] - 0.03, self.light[1], 0.34 + up_m), pose)
            if spot is not None:
                radius = 0.033 * LENS.fx_px / spot[2]
                colour = _shade(LIT[name], 1.0 if name == state else UNLIT)
                cv2.circle(picture, (round(spot[0] * 16), round(spot[1] * 16)), round(radius * 16), colour, -1,
                           cv2.LINE_AA, 4)

    @staticmethod
    def _corners(middle: Corner, size: Corner) -> list[Corner]:
        signs = [(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
        return [tuple(at + sign * side / 2 for at, sign, side in zip(middle, one, size, strict=True)) for one in signs]

    @staticmethod
    def _pixel(corner: Corner, pose: Pose) -> tuple[float, float, float] | None:
        ahead, left = from_odometry(pose, corner[0], corner[1])
        ahead -= LENS.x_m
        if ahead < 0.08:
            return None
        return (LENS.cx_px - LENS.fx_px * left / ahead, LENS.cy_px - LENS.fy_px * (corner[2] - LENS.z_m) / ahead, ahead)

    def _fill(self, picture: np.ndarray, corners: list[Corner], pose: Pose, colour: tuple[int, int, int]) -> None:
        spots = [self._pixel(one, pose) for one in corners]
        if any(one is None for one in spots):
            return
        points = np.array([[round(one[0] * 16), round(one[1] * 16)] for one in spots], np.int32)
        cv2.fillConvexPoly(picture, cv2.convexHull(points), colour, cv2.LINE_AA, 4)

    def _box(self, corners: list[Corner], pose: Pose) -> tuple[float, float, float, float] | None:
        """Its bounding box, cut off at the picture's border."""
        spots = [self._pixel(one, pose) for one in corners]
        if any(one is None for one in spots):
            return None
        xs, ys = [one[0] for one in spots], [one[1] for one in spots]
        left, right = max(0.0, min(xs)), min(float(LENS.width_px), max(xs))
        top, bottom = max(0.0, min(ys)), min(float(LENS.height_px), max(ys))
        return (left, top, right, bottom) if right - left > 3 and bottom - top > 3 else None


def _shade(colour: tuple[float, float, float], share: float) -> tuple[int, int, int]:
    return tuple(round(255 * share * one) for one in colour)
