"""What stands, rolls and walks in a scenario: shapes, and how each moves. Pure.

The target is one of them, and so is whatever else is there: blocks of a lane, a cylinder in the way, other people.
"""

import math
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from sightline.protocol.config import Config
from sightline.sim.path import ClosedPath, Leg, Place

Metres = Annotated[float, Field(ge=-100, le=100)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Unit = Annotated[float, Field(ge=0, le=1)]
Side = Annotated[float, Field(gt=0, le=10)]
Color = tuple[Unit, Unit, Unit]
"""Red, green, blue."""
Point = tuple[Metres, Metres]


def _ordered(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise ValueError(f"lowest first: [{span[1]}, {span[0]}]")
    return span


Span = Annotated[tuple[Degrees, Degrees], AfterValidator(_ordered)]
"""(lowest, highest); the seed draws between them."""
Amount = Annotated[float, Field(ge=0, le=100)]
Amounts = Annotated[tuple[Amount, Amount], AfterValidator(_ordered)]
"""A span of what cannot be negative."""


class Legs(Config):
    """A person from the knees down: two upright cylinders that walk. A foot stands, or swings twice as fast."""

    apart_m: Side = 0.20
    """Between the legs' middles."""
    stride_m: Side = 0.9
    """Way of one whole step of both legs."""

    def ahead_m(self, way_m: float, is_left: bool) -> float:
        """How far a leg is ahead of the person, who has walked `way_m`: a triangle wave of a quarter stride."""
        turn = (way_m / self.stride_m + (0.0 if is_left else 0.5)) % 1.0
        return self.stride_m * (abs(2.0 * turn - 1.0) - 0.5) / 2.0


class Thing(Config):
    """What every one of them has: a shape on the floor."""

    shape: Literal["ball", "box", "cylinder", "legs", "place"] = "ball"
    """`place` is a point of the floor: nothing to see and nothing to touch."""
    radius_m: Annotated[float, Field(gt=0, le=1)] = 0.10
    """Of a ball, a cylinder, a leg."""
    size_m: tuple[Side, Side, Side] = (0.266, 0.317, 0.281)
    """Of a box: along, across, up."""
    height_m: Side = 0.4
    """Of a cylinder or a leg."""
    legs: Legs = Legs()
    colour: Color = (0.95, 0.78, 0.05)

    @property
    def middle_m(self) -> float:
        """How high its middle is."""
        heights = {"ball": 2 * self.radius_m, "box": self.size_m[2], "place": 0.0}
        return heights.get(self.shape, self.height_m) / 2

    @property
    def reach_m(self) -> float:
        """Radius of the circle around it, seen from above."""
        if self.shape == "box":
            return math.hypot(self.size_m[0], self.size_m[1]) / 2
        return self.radius_m + (self.legs.apart_m / 2 if self.shape == "legs" else 0.0)


class Static(Thing):
    """Does not move; nothing can move it."""

    kind: Literal["static"] = "static"
    at_m: Point = (0.0, 0.0)
    heading_deg: Degrees = 0.0
    jitter_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    """The seed moves it by up to this much along each axis."""


class OnPath(Thing):
    """Moves along a closed path at constant speed; nothing can stop it."""

    kind: Literal["path"]
    start_m: Point = (0.0, 0.0)
    heading_deg: Degrees = 0.0
    path: Annotated[tuple[Leg, ...], Field(min_length=1, max_length=64)]
    speed_mps: Annotated[float, Field(ge=0, le=5)]
    phase: Amounts = (0.0, 1.0)
    """Where on the path it begins, as a fraction of a lap."""
    waits_s: Annotated[float, Field(ge=0, le=600)] = 0.0
    """How long it stands there first."""

    @model_validator(mode="after")
    def _closes(self) -> Self:
        self.closed_path()
        return self

    def closed_path(self) -> ClosedPath:
        """The path itself."""
        return ClosedPath(Place(*self.start_m, math.radians(self.heading_deg)), self.path)


class Rolling(Thing):
    """A real ball, which can be bumped."""

    at_m: Point = (0.0, 0.0)
    mass_kg: Annotated[float, Field(gt=0, le=100)] = 0.3
    drag: Annotated[float, Field(ge=0, le=1)] = 0.3
    """Fraction of its speed that rolling loses each second."""

    @model_validator(mode="after")
    def _is_round(self) -> Self:
        if self.shape != "ball":
            raise ValueError(f"only a ball rolls; a {self.shape} is static or on a path")
        return self


class Pushed(Rolling):
    """Rolls where seeded pushes send it."""

    kind: Literal["pushed"]
    push_every_s: Amounts = (2.0, 4.0)
    push_mps: Amounts = (0.15, 0.3)
    """Speed that a push gives a resting ball."""
    arena_m: Annotated[float, Field(gt=0, le=100)] = 1.5
    """Pushes aim at random points within this radius of `at_m`, so that it stays about."""


class Forced(Rolling):
    """Rolls under one constant force, for ever; drag gives it a top speed."""

    kind: Literal["forced"]
    heading_deg: Degrees = 0.0
    force_n: Annotated[float, Field(ge=0, le=100)]
    from_s: Amount = 1.0
    """When the force begins."""


Moving = Annotated[Static | OnPath | Pushed | Forced, Field(discriminator="kind")]
Standing = Annotated[Static | OnPath, Field(discriminator="kind")]
"""What else there is but the target: nothing that the robot could push about."""
