"""What happens in a simulated run: the models behind `scenarios/*.toml`. Pure."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sightline.protocol.config import Config
from sightline.sim.light import Light
from sightline.sim.look import Look, look_named
from sightline.sim.things import Amounts, Color, Forced, Moving, OnPath, Point, Pushed, Span, Standing, Static
from sightline.sim.toml_file import check, find, names_in, read_table

__all__ = ["Forced", "OnPath", "Pushed", "Scenario", "Start", "Static", "Wall", "load_scenario", "scenario_names"]

SCENARIOS = Path(__file__).parent / "scenarios"

class Start(Config):
    """Where the robot begins, the seed draws within each span: seen from its lens and from the target, or on the map.
    """

    distance_m: Amounts = (0.0, 0.0)
    """Lens to the target's middle."""
    bearing_deg: Span = (0.0, 0.0)
    """Of the target, left positive; beyond 90 it is behind the robot."""
    approach_deg: Span = (180.0, 180.0)
    """Direction from the target to the lens, from the target's heading; 180 = the robot follows it."""
    at_m: Point | None = None
    """On the map: where the axle's midpoint begins; then only this and the two below count."""
    heading_deg: Span = (0.0, 0.0)
    jitter_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    """By how much the seed moves `at_m` along each axis."""

    @model_validator(mode="after")
    def _says_where(self) -> Self:
        seen_from = {"distance_m", "bearing_deg", "approach_deg"}
        if self.at_m is None and not seen_from <= self.model_fields_set:
            raise ValueError("a start is either at_m, or distance_m, bearing_deg and approach_deg")
        return self


class Wall(Config):
    """An upright slab on the floor between two points."""

    start_m: Point
    end_m: Point
    thickness_m: Annotated[float, Field(gt=0, le=10)] = 0.05
    height_m: Annotated[float, Field(gt=0, le=10)] = 0.35
    colour: Color = (0.62, 0.64, 0.68)

    @model_validator(mode="after")
    def _has_length(self) -> Self:
        if math.dist(self.start_m, self.end_m) < 0.001:
            raise ValueError("the wall has no length: start_m and end_m are the same point")
        return self


class Scenario(Config):
    """One scenario. `stand_off_m` is what both the steering and the score go by: lens to the target's middle.

    `robot`, `mission` and `vision` (keys of vision.toml) are what a person would choose for it.
    """

    name: str
    summary: str = ""
    seconds: Annotated[float, Field(gt=0, le=3600)] = 20.0
    stand_off_m: Annotated[float, Field(gt=0, le=20)] = 0.8
    robot: Annotated[str, Field(min_length=1)] = "raspberry"
    mission: Annotated[str, Field(min_length=1)] = "follow"
    vision: dict[str, Any] = Field(default_factory=dict)
    look: Look
    target: Moving
    start: Start
    walls: Annotated[tuple[Wall, ...], Field(max_length=64)] = ()
    things: Annotated[tuple[Standing, ...], Field(max_length=64)] = ()
    light: Light | None = None
    goals_m: Annotated[tuple[Point, ...], Field(max_length=64)] = ()
    """Waypoints on the map, in order, for a robot that is sent to them."""
    reachable: bool = True
    """Whether there is a way to the last of them."""
    labels: Literal["", "legs"] = ""
    """What the simulation itself labels in each picture, for a vision whose detector is `boxes`."""


def scenario_names() -> list[str]:
    """Scenarios that come with Sightline."""
    return names_in(SCENARIOS)


def load_scenario(name: str) -> Scenario:
    """A scenario by its name, or by the path of a `.toml` file. Raises ConfigError with the nearest name."""
    path = find("scenario", name, SCENARIOS)
    table = read_table(path, SCENARIOS)
    look = table.get("look", "plain")
    if isinstance(look, str):
        table["look"] = look_named(look)
    return check(Scenario, {"name": path.stem, **table}, path)
