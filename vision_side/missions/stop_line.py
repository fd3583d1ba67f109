"""Whether to stop before a traffic light's line: on red, on what cannot be read, and on yellow where it can. Pure."""

import math
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.vision_side.missions.lights import UNKNOWN

_FRAMES = 2  # a colour that lets go must be seen this often, one after the other; one that stops counts at once


_CROSSED_M = 0.15  # nobody who stops for a line ends so far beyond it: the robot has crossed, or began there


class StopConfig(Config):
    """How the robot stops and goes."""

    line_m: Annotated[float, Field(ge=0, le=20)] = 0.6
    """The line is this far before the light."""
    front_m: Annotated[float, Field(ge=0, le=2)] = 0.07
    """The robot's front is this far ahead of its axle: what must not cross the line."""
    margin_m: Annotated[float, Field(ge=0, le=1)] = 0.1
    """It stops this far before the line: what the light's range may be off, and near enough to see all of it."""
    brake_mps2: Annotated[float, Field(gt=0, le=10)] = 0.5
    """How it brakes for a line seen in time."""
    hardest_mps2: Annotated[float, Field(gt=0, le=10)] = 1.2
    """What it counts on when a light turns yellow: it stops if that is enough, and else clears the line."""
    hidden_s: Annotated[float, Field(ge=0, le=10)] = 0.4
    """A light that is not seen for this long counts as red."""
    cleared_m: Annotated[float, Field(ge=0, le=5)] = 0.3
    """With its front this far beyond the line the robot is done with the light."""


class StopLine:
    """One light's line. `colour` is what it goes by; `clearing` is set once it is too late to stop, or once across."""

    def __init__(self, config: StopConfig) -> None:
        self._config = config
        self.colour = UNKNOWN
        self.clearing = False
        self._candidate, self._count = UNKNOWN, 0
        self._unseen_s = 0.0
        self._was_green = False

    def see(self, colour: str, dt_s: float) -> None:
        """One frame: what the light shows, unknown if it is not seen or cannot be read."""
        self._unseen_s = 0.0 if colour != UNKNOWN else self._unseen_s + dt_s
        if colour == UNKNOWN:
            if self._unseen_s > self._config.hidden_s:
                self.colour = UNKNOWN
            return
        self._count = self._count + 1 if colour == self._candidate else 1
        self._candidate = colour
        if colour != "green" or self._count >= _FRAMES:
            self.colour = colour

    def speed(self, left_m: float, moving_mps: float, cruise_mps: float) -> float:
        """How fast to go with `left_m` from the robot's front to the line."""
        self._decide(left_m, moving_mps)
        if self.clearing or self.colour == "green":
            return cruise_mps
        room_m = left_m - self._config.margin_m
        return min(cruise_mps, math.sqrt(2 * self._config.brake_mps2 * max(0.0, room_m)), max(0.0, 3.0 * room_m))

    def _decide(self, left_m: float, moving_mps: float) -> None:
        """Across already, or too late to stop when green ends: the hardest braking would end beyond the line."""
        if left_m < -_CROSSED_M:
            self.clearing = True
        elif self.colour == "green":
            self.clearing = left_m <= 0 and moving_mps > 0
        elif self._was_green and left_m < moving_mps**2 / (2 * self._config.hardest_mps2):
            self.clearing = True
        self._was_green = self.colour == "green"
