"""What happens in a simulated run: the models behind `scenarios/*.toml`. Pure."""

import math
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from protocol.config import Config
from sim.look import Look, look_named
from sim.path import ClosedPath, Leg, Place
from sim.toml_file import check, find, names_in, read_table

SCENARIOS = Path(__file__).parent / "scenarios"

Metres = Annotated[float, Field(ge=-100, le=100)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Unit = Annotated[float, Field(ge=0, le=1)]
Colour = tuple[Unit, Unit, Unit]
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


class Ball(Config):
    """What every target is: a ball on the floor."""

    radius_m: Annotated[float, Field(gt=0, le=1)] = 0.10
    colour: Colour = (0.95, 0.78, 0.05)


class Static(Ball):
    """Does not move; nothing can move it."""

    kind: Literal["static"]
    at_m: Point = (0.0, 0.0)


class OnPath(Ball):
    """Moves along a closed path at constant speed; nothing can stop it."""

    kind: Literal["path"]
    start_m: Point = (0.0, 0.0)
    heading_deg: Degrees = 0.0
    path: Annotated[tuple[Leg, ...], Field(min_length=1, max_length=64)]
    speed_mps: Annotated[float, Field(ge=0, le=5)]
    phase: Amounts = (0.0, 1.0)
    """Where on the path it begins, as a fraction of a lap."""

    @model_validator(mode="after")
    def _closes(self) -> Self:
        self.closed_path()
        return self

    def closed_path(self) -> ClosedPath:
        """The path itself."""
        return ClosedPath(Place(*self.start_m, math.radians(self.heading_deg)), self.path)


class Pushed(Ball):
    """A real ball that rolls where seeded pushes send it, and can be bumped."""

    kind: Literal["pushed"]
    at_m: Point = (0.0, 0.0)
    mass_kg: Annotated[float, Field(gt=0, le=100)] = 0.3
    drag: Annotated[float, Field(ge=0, le=1)] = 0.3
    """Fraction of its speed that rolling loses each second."""
    push_every_s: Amounts = (2.0, 4.0)
    push_mps: Amounts = (0.15, 0.3)
    """Speed that a push gives a resting ball."""
    arena_m: Annotated[float, Field(gt=0, le=100)] = 1.5
    """Pushes aim at random points within this radius of `at_m`, so that it stays about."""


class Start(Config):
    """Where the robot begins, seen from its lens and from the target; the seed draws within each span."""

    distance_m: Amounts
    """Lens to the ball's centre."""
    bearing_deg: Span
    """Of the ball, left positive; beyond 90 it is behind the robot."""
    approach_deg: Span
    """Direction from the ball to the lens, from the ball's heading; 180 = the robot follows it."""


class Wall(Config):
    """An upright slab on the floor between two points."""

    start_m: Point
    end_m: Point
    thickness_m: Annotated[float, Field(gt=0, le=10)] = 0.05
    height_m: Annotated[float, Field(gt=0, le=10)] = 0.35
    colour: Colour = (0.62, 0.64, 0.68)

    @model_validator(mode="after")
    def _has_length(self) -> Self:
        if math.dist(self.start_m, self.end_m) < 0.001:
            raise ValueError("the wall has no length: start_m and end_m are the same point")
        return self


class Scenario(Config):
    """One scenario. `stand_off_m` is what both the steering and the score go by: lens to the ball's centre."""

    name: str
    summary: str = ""
    seconds: Annotated[float, Field(gt=0, le=3600)] = 20.0
    stand_off_m: Annotated[float, Field(gt=0, le=20)] = 0.8
    look: Look
    target: Annotated[Static | OnPath | Pushed, Field(discriminator="kind")]
    start: Start
    walls: Annotated[tuple[Wall, ...], Field(max_length=64)] = ()


def scenario_names() -> list[str]:
    """Scenarios that come with Sightline."""
    return names_in(SCENARIOS)


def load_scenario(name: str) -> Scenario:
    """A scenario by its name, or by the path of a `.toml` file. Raises ConfigError with the nearest name."""
    path = find("scenario", name, SCENARIOS)
    table = read_table(path)
    look = table.get("look", "plain")
    if isinstance(look, str):
        table["look"] = look_named(look)
    return check(Scenario, {"name": path.stem, **table}, path)
