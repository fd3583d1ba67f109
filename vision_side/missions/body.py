"""The robot's outline on the floor, and how fast it may go with what it knows about. Pure."""

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from sightline.protocol.config import Config
from sightline.vision_side.missions.ranging import Points

_STILL_MPS = 1e-6


class Footprint(Config):
    """A rectangle about the axle's midpoint: the Thymio's, if nothing else is said."""

    front_m: Annotated[float, Field(ge=0, le=2)] = 0.08
    rear_m: Annotated[float, Field(ge=0, le=2)] = 0.03
    half_width_m: Annotated[float, Field(gt=0.01, le=2)] = 0.056

    @property
    def radius_m(self) -> float:
        """Of the circle about the axle that holds the robot however it turns."""
        return math.hypot(max(self.front_m, self.rear_m), self.half_width_m)

    def nearest(self, points: Points) -> Points:
        """The place of the outline nearest to each of `points`, which are about the robot."""
        return np.column_stack([np.clip(points[:, 0], -self.rear_m, self.front_m),
                                np.clip(points[:, 1], -self.half_width_m, self.half_width_m)])


def braking_mps(room_m: float, delay_s: float, brake_mps2: float) -> float:
    """The highest speed from which the robot still stops within `room_m`, braking only after `delay_s`."""
    if room_m <= 0:
        return 0.0
    lost = brake_mps2 * delay_s
    return math.sqrt(lost * lost + 2 * brake_mps2 * room_m) - lost


def clear_of(points: Points, body: Footprint, twist: tuple[float, float], keep_m: float, brake_mps2: float) -> float:
    """The part (0..1) of `twist` that lets the robot come no nearer than `keep_m` to any of `points`.

    Speed towards a point is what counts: along a wall and away from it the robot may go as it likes.
    """
    if not len(points):
        return 1.0
    spots = body.nearest(points)
    away = points - spots
    clearance = np.hypot(away[:, 0], away[:, 1])
    normal = away / np.maximum(clearance, 1e-6)[:, None]
    closing = normal[:, 0] * (twist[0] - twist[1] * spots[:, 1]) + normal[:, 1] * twist[1] * spots[:, 0]
    allowed = np.sqrt(2 * brake_mps2 * np.maximum(clearance - keep_m, 0.0))
    towards = closing > _STILL_MPS
    return float(min(1.0, (allowed[towards] / closing[towards]).min(initial=1.0)))
