"""A traffic light: what it looks like and when it is which colour. Pure.

Three lamps in a housing on a pole, or one box that changes its colour as a whole. It faces whoever drives along the
lane; the stop line crosses the lane `line_m` before it.
"""

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from sightline.protocol.config import Config
from sightline.sim.things import Amounts, Color, Degrees, Point, Side

State = Literal["red", "yellow", "green"]

LIT: dict[str, Color] = {"red": (0.95, 0.10, 0.08), "yellow": (0.98, 0.80, 0.06), "green": (0.06, 0.80, 0.22)}
UNLIT = 0.22  # of its lit colour: glass that nothing shines behind


class Phase(Config):
    """One colour for a time."""

    state: State
    seconds: Annotated[float, Field(gt=0, le=600)]


class Part(NamedTuple):
    """One body of the light: sizes as its shape needs them; `state` is the colour it shows, "" for what never lights.
    """

    shape: Literal["box", "ball"]
    at_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    state: State | Literal["", "all"]


class Light(Config):
    """One light. The older write-up's schedule is the default: red 5 s, green 5 s, yellow 2 s."""

    kind: Literal["lamps", "box"] = "lamps"
    at_m: Point
    faces_deg: Degrees = 180.0
    """Where it looks: towards those who come."""
    height_m: Side = 0.34
    """Of the housing's middle, which must be in the robots' view."""
    housing_m: tuple[Side, Side, Side] = (0.06, 0.10, 0.26)
    """Deep, wide, high."""
    lamp_radius_m: Side = 0.033
    box_m: tuple[Side, Side, Side] = (0.266, 0.317, 0.281)
    line_m: Side = 0.6
    """The stop line is this far before it."""
    schedule: Annotated[tuple[Phase, ...], Field(min_length=1, max_length=16)] = (
        Phase(state="red", seconds=5.0), Phase(state="green", seconds=5.0), Phase(state="yellow", seconds=2.0),
    )
    begin: Amounts = (0.0, 1.0)
    """Where in its cycle it begins, as a fraction; the seed draws."""

    def state_at(self, begin: float, now_us: int) -> State:
        """Which colour is lit at `now_us` of a run that began at `begin` of the cycle."""
        cycle_s = math.fsum(phase.seconds for phase in self.schedule)
        left_s = (begin * cycle_s + now_us / 1e6) % cycle_s
        for phase in self.schedule:
            if left_s < phase.seconds:
                return phase.state
            left_s -= phase.seconds
        return self.schedule[-1].state

    def parts(self) -> list[Part]:
        """Its bodies, where they are in the world."""
        if self.kind == "box":
            return [Part("box", (*self.at_m, self.box_m[2] / 2), self.box_m, "all")]
        deep, _, high = self.housing_m
        pole_m = self.height_m - high / 2
        parts = [Part("box", (*self.at_m, pole_m / 2), (0.03, 0.03, pole_m), ""),
                 Part("box", (*self.at_m, self.height_m), self.housing_m, "")]
        states: tuple[State, ...] = ("red", "yellow", "green")
        for state, up_m in zip(states, (high / 3, 0.0, -high / 3), strict=True):
            x_m, y_m = self.ahead(deep / 2)
            size_m = (self.lamp_radius_m,) * 3
            parts.append(Part("ball", (x_m, y_m, self.height_m + up_m), size_m, state))
        return parts

    def ahead(self, way_m: float) -> Point:
        """The point `way_m` before the light."""
        faces_rad = math.radians(self.faces_deg)
        return self.at_m[0] + way_m * math.cos(faces_rad), self.at_m[1] + way_m * math.sin(faces_rad)

    def past_line_m(self, x_m: float, y_m: float) -> float:
        """How far a point is beyond the stop line, negative before it."""
        faces_rad = math.radians(self.faces_deg)
        line_x_m, line_y_m = self.ahead(self.line_m)
        return (line_x_m - x_m) * math.cos(faces_rad) + (line_y_m - y_m) * math.sin(faces_rad)


def color_of(part: Part, state: State) -> Color:
    """What a part looks like while `state` is lit."""
    if part.state == "":
        return 0.07, 0.07, 0.08
    if part.state == "all":
        return LIT[state]
    red, green, blue = LIT[part.state]
    share = 1.0 if part.state == state else UNLIT
    return red * share, green * share, blue * share
