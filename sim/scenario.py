"""Scenarios: paths, things, traffic lights and camera looks, as models of `scenarios/*.toml`. Pure."""

import difflib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError
from sightline.sim.toml_file import check, find, names_in, read_table

__all__ = ["Forced", "OnPath", "Pushed", "Scenario", "Start", "Static", "Wall", "load_scenario", "scenario_names"]


class PathLeg(Config):
    """One segment of a path: its length and its turn angle, left positive."""

    length_m: Annotated[float, Field(gt=0, le=1000)]
    turn_deg: Annotated[float, Field(ge=-3600, le=3600)] = 0.0


class Place(NamedTuple):
    """A point and its heading."""

    x_m: float
    y_m: float
    heading_rad: float


class ClosedPath:
    """Segments repeated forever from `start`. Raises ValueError unless the end meets the start."""

    def __init__(self, start: Place, legs: tuple[PathLeg, ...]) -> None:
        self._legs = legs
        self._starts = [start]
        for leg in legs:
            self._starts.append(_along(self._starts[-1], leg, leg.length_m))
        self.length_m = math.fsum(leg.length_m for leg in legs)
        end = self._starts[-1]
        gap_m = math.hypot(end.x_m - start.x_m, end.y_m - start.y_m)
        bend_rad = abs(math.remainder(end.heading_rad - start.heading_rad, math.tau))
        if gap_m > 0.01 or bend_rad > 0.02:
            off = f"{gap_m:.3f} m and {math.degrees(bend_rad):.1f} degrees"
            raise ValueError(f"the path does not close: it ends {off} from its start")

    def at(self, distance_m: float) -> Place:
        """Return the place at `distance_m` along the path. Laps repeat."""
        left_m = distance_m % self.length_m
        for leg, start in zip(self._legs, self._starts, strict=False):
            if left_m <= leg.length_m:
                return _along(start, leg, left_m)
            left_m -= leg.length_m
        return self._starts[0]


def _along(start: Place, leg: PathLeg, distance_m: float) -> Place:
    """Return the place at `distance_m` into `leg`, from the chord of its arc. A straight is an arc of no turn."""
    half_rad = math.radians(leg.turn_deg) * distance_m / leg.length_m / 2
    chord_m = distance_m * (math.sin(half_rad) / half_rad if abs(half_rad) > 1e-9 else 1.0)
    heading_rad = start.heading_rad + half_rad
    return Place(
        start.x_m + chord_m * math.cos(heading_rad),
        start.y_m + chord_m * math.sin(heading_rad),
        start.heading_rad + 2 * half_rad,
    )


# Things in a scenario: shapes, and how each moves. Pure.
#
# The target is one of them. Others are blocks of a lane, a cylinder in the way, other people.


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
"""A span of values that cannot be negative."""


class LegShape(Config):
    """A human from the knees down: two upright cylinders that walk. A foot stands, or swings twice as fast."""

    apart_m: Side = 0.20
    """Between the centers of the legs."""
    stride_m: Side = 0.9
    """Length of one full step of both legs."""

    def ahead_m(self, way_m: float, is_left: bool) -> float:
        """Return the lead of a leg after `way_m` of walking: a triangle wave, amplitude a quarter stride."""
        turn = (way_m / self.stride_m + (0.0 if is_left else 0.5)) % 1.0
        return self.stride_m * (abs(2.0 * turn - 1.0) - 0.5) / 2.0


class Thing(Config):
    """A shape on the floor, the base of all things."""

    renamed_keys: ClassVar[Mapping[str, str]] = {"colour": "color"}
    shape: Literal["ball", "box", "cylinder", "legs", "place"] = "ball"
    """`place` is a point of the floor without a body."""
    radius_m: Annotated[float, Field(gt=0, le=1)] = 0.10
    """Of a ball, a cylinder, a leg."""
    size_m: tuple[Side, Side, Side] = (0.266, 0.317, 0.281)
    """Of a box: along, across, up."""
    height_m: Side = 0.4
    """Of a cylinder or a leg."""
    legs: LegShape = LegShape()
    color: Color = (0.95, 0.78, 0.05)

    @property
    def middle_m(self) -> float:
        """Return the height of its center, in m."""
        heights = {"ball": 2 * self.radius_m, "box": self.size_m[2], "place": 0.0}
        return heights.get(self.shape, self.height_m) / 2

    @property
    def reach_m(self) -> float:
        """Return the radius of the circle around it, seen from above."""
        if self.shape == "box":
            return math.hypot(self.size_m[0], self.size_m[1]) / 2
        return self.radius_m + (self.legs.apart_m / 2 if self.shape == "legs" else 0.0)

    @property
    def swept_m(self) -> float:
        """Return the radius of the circle that contains it at any time, including a swinging leg."""
        return self.reach_m + (self.legs.stride_m / 4 if self.shape == "legs" else 0.0)


class Static(Thing):
    """A thing that does not move and cannot be pushed."""

    kind: Literal["static"] = "static"
    at_m: Point = (0.0, 0.0)
    heading_deg: Degrees = 0.0
    jitter_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    """The seed moves it by up to this much along each axis."""


class OnPath(Thing):
    """A thing that moves along a closed path at constant speed. Nothing stops it."""

    kind: Literal["path"]
    start_m: Point = (0.0, 0.0)
    heading_deg: Degrees = 0.0
    path: Annotated[tuple[PathLeg, ...], Field(min_length=1, max_length=64)]
    speed_mps: Annotated[float, Field(ge=0, le=5)]
    phase: Amounts = (0.0, 1.0)
    """Start on the path, as a fraction of a lap."""
    waits_s: Annotated[float, Field(ge=0, le=600)] = 0.0
    """Time for which it stands there first."""

    @model_validator(mode="after")
    def _closes(self) -> Self:
        self.closed_path()
        return self

    def closed_path(self) -> ClosedPath:
        """Return the closed path."""
        return ClosedPath(Place(*self.start_m, math.radians(self.heading_deg)), self.path)


class Rolling(Thing):
    """A real ball that can be bumped."""

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
    """A ball that seeded pushes move."""

    kind: Literal["pushed"]
    push_every_s: Amounts = (2.0, 4.0)
    push_mps: Amounts = (0.15, 0.3)
    """Speed that a push gives a resting ball."""
    arena_m: Annotated[float, Field(gt=0, le=100)] = 1.5
    """Pushes aim at random points within this radius of `at_m`, so that it stays near."""


class Forced(Rolling):
    """A ball under one constant force, forever. Drag limits its speed."""

    kind: Literal["forced"]
    heading_deg: Degrees = 0.0
    force_n: Annotated[float, Field(ge=0, le=100)]
    from_s: Amount = 1.0
    """When the force begins."""


Moving = Annotated[Static | OnPath | Pushed | Forced, Field(discriminator="kind")]
Standing = Annotated[Static | OnPath, Field(discriminator="kind")]
"""Things other than the target. The robot cannot push them."""


# A traffic light: its look and its schedule. Pure.
#
# Three lamps in a housing on a pole, or one box whose color changes. It faces the traffic of the
# lane. The stop line crosses the lane `line_m` before it.


State = Literal["red", "yellow", "green"]

LIT: dict[str, Color] = {"red": (0.95, 0.10, 0.08), "yellow": (0.98, 0.80, 0.06), "green": (0.06, 0.80, 0.22)}
UNLIT = 0.22  # of its lit color: dark glass


LINE_WIDE_M = 1.2
"""Length of the stop line, across the lane."""


class LightPhase(Config):
    """One color for a time."""

    state: State
    seconds: Annotated[float, Field(gt=0, le=600)]


class Part(NamedTuple):
    """One body of the light. Its sizes depend on its shape; `state` is the color it shows, "" if it is never lit."""

    shape: Literal["box", "ball"]
    at_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    state: State | Literal["", "all"]


class Light(Config):
    """One light. The default is the schedule of the legacy article: red 5 s, green 5 s, yellow 2 s."""

    kind: Literal["lamps", "box"] = "lamps"
    at_m: Point
    faces_deg: Degrees = 180.0
    """Direction that it faces: towards approaching traffic."""
    height_m: Side = 0.34
    """Height of the housing's center, which must be in the robot's field of view."""
    housing_m: tuple[Side, Side, Side] = (0.06, 0.10, 0.26)
    """Deep, wide, high."""
    lamp_radius_m: Side = 0.033
    box_m: tuple[Side, Side, Side] = (0.266, 0.317, 0.281)
    line_m: Side = 0.6
    """The stop line is this far before it."""
    schedule: Annotated[tuple[LightPhase, ...], Field(min_length=1, max_length=16)] = (
        LightPhase(state="red", seconds=5.0),
        LightPhase(state="green", seconds=5.0),
        LightPhase(state="yellow", seconds=2.0),
    )
    begin: Amounts = (0.0, 1.0)
    """Start in its cycle, as a fraction, drawn from the seed."""

    def state_at(self, begin: float, now_us: int) -> State:
        """Return the color at `now_us` of a run that started at the fraction `begin` of the cycle."""
        cycle_s = math.fsum(phase.seconds for phase in self.schedule)
        left_s = (begin * cycle_s + now_us / 1e6) % cycle_s
        for phase in self.schedule:
            if left_s < phase.seconds:
                return phase.state
            left_s -= phase.seconds
        return self.schedule[-1].state

    def parts(self) -> list[Part]:
        """Return its bodies, placed in the world."""
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
        """Return the point at `way_m` in front of the light."""
        faces_rad = math.radians(self.faces_deg)
        return self.at_m[0] + way_m * math.cos(faces_rad), self.at_m[1] + way_m * math.sin(faces_rad)

    def stop_line_m(self) -> tuple[Point, Point]:
        """Return both ends of the stop line."""
        (x_m, y_m), faces_rad = self.ahead(self.line_m), math.radians(self.faces_deg)
        aside_x_m, aside_y_m = -LINE_WIDE_M / 2 * math.sin(faces_rad), LINE_WIDE_M / 2 * math.cos(faces_rad)
        return (x_m - aside_x_m, y_m - aside_y_m), (x_m + aside_x_m, y_m + aside_y_m)

    def past_line_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a point beyond the stop line, negative before it, in m."""
        faces_rad = math.radians(self.faces_deg)
        line_x_m, line_y_m = self.ahead(self.line_m)
        return (line_x_m - x_m) * math.cos(faces_rad) + (line_y_m - y_m) * math.sin(faces_rad)


def color_of(part: Part, state: State) -> Color:
    """Return the color of a part while `state` is lit."""
    if part.state == "":
        return 0.07, 0.07, 0.08
    if part.state == "all":
        return LIT[state]
    red, green, blue = LIT[part.state]
    share = 1.0 if part.state == state else UNLIT
    return red * share, green * share, blue * share


# The look of images: light and camera defects as data (`looks.toml`). Pure.


LOOKS = Path(__file__).parent / "looks.toml"

Gain = Annotated[float, Field(gt=0, le=4)]


DriftPeriod = Annotated[float, Field(gt=0, le=600)]
ShutterTime = Annotated[float, Field(ge=0, le=100)]
TextureName = Literal["plain", "boards", "clouds", "bricks", "marble", "mosaic", "stones", "weave"]


class Look(Config):
    """The look of a scene and of its images. Every option is off by default.

    First the room: its surfaces and added objects. Then the camera, in the order of its effects.
    """

    room_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Distance of the walls of a room from the area that robot and target need; 0: no room."""
    clutter: Annotated[int, Field(ge=0, le=40)] = 0
    """Number of other objects, of colors near the target's and others. They stand around that area."""
    floor: TextureName = "boards"
    floor_likeness: Unit = 0.0
    """Saturation of the floor as a share of the target's, in the hue of the target; 0 is gray."""
    wall: TextureName = "plain"
    """Texture of each wall."""
    wall_likeness: Unit = 0.0
    """The same for walls; 0 keeps the color of each wall."""
    shadows: Unit = 0.0
    """Share of the light that is missing on the floor in the shadow of an object. Objects shade each other, too."""
    latency_ms: Annotated[int, Field(ge=0, le=500)] = 0
    """The image shows the world this long before its capture time, as with a webcam that stamps images late."""
    distortion: Annotated[tuple[Annotated[float, Field(ge=-1, le=1)], ...], Field(max_length=5)] = ()
    """Of the lens: k1, k2, p1, p2, k3 in OpenCV's order."""
    lens_known: bool = False
    """True: the camera model on the channel `camera` has this distortion. False: it is that of an uncalibrated lens."""
    rolling_shutter_ms: ShutterTime = 0.0
    """Time from the exposure of the first row to that of the last. The middle row has the time of the image."""
    motion_blur_ms: ShutterTime = 0.0
    """Exposure time of each row."""
    exposure: Gain = 1.0
    """Brightness factor; above 1 the bright parts burn out."""
    saturation: Annotated[float, Field(ge=0, le=2)] = 1.0
    """Colourfulness: 0 is a gray image."""
    white_balance: tuple[Gain, Gain, Gain] = (1.0, 1.0, 1.0)
    """Factors on red, green, blue."""
    exposure_drift: Annotated[float, Field(ge=0, le=1)] = 0.0
    """The brightness rises and falls by up to this share, from a phase that the seed draws."""
    exposure_period_s: DriftPeriod = 8.0
    white_balance_drift: Annotated[float, Field(ge=0, le=1)] = 0.0
    """The same for red, and for blue the other way round."""
    white_balance_period_s: DriftPeriod = 21.0
    blur_px: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the lens's blur."""
    noise: Annotated[float, Field(ge=0, le=64)] = 2.0
    """Standard deviation, in steps of 0..255."""
    jpeg_quality: Annotated[int, Field(ge=5, le=100)] = 80


def look_named(name: str) -> Look:
    """Return a look of `looks.toml`. Raises ConfigError with the nearest name."""
    table = read_table(LOOKS)
    if name not in table:
        near = difflib.get_close_matches(name, table, n=1)
        hint = f", did you mean {near[0]!r}?" if near else ""
        raise ConfigError(f"no look called {name!r}{hint}; there are {', '.join(sorted(table))}")
    return check(Look, table[name], LOOKS)


# The evaluation of a scenario: its figures and their bounds. Pure.


AT_LEAST = "least_"
"""A figure whose name begins so must not fall below its bound. All others must not exceed it."""
OFF = "off"
"""In `[bounds]`: drops a bound of the file that is extended."""


class Figure(NamedTuple):
    """One figure of a run.

    Args:
        unit: its unit.
        course: how it changes while the run continues. A `count` only rises, an `extreme` only gets worse, a `moment`
            is one point in time, `rms` and `share` are averages since the acquisition, `other` may change either way.
        needs: part of the scenario that it is about: light, goals, legs, things, or empty.
        is_exact: True if a real machine gets no room beyond its bound.
    """

    unit: str
    course: Literal["count", "extreme", "moment", "rms", "share", "other"]
    needs: Literal["", "light", "goals", "legs", "things"] = ""
    is_exact: bool = False


FIGURES: Mapping[str, Figure] = {
    "acquired_s": Figure("s", "moment"),
    "found_s": Figure("s", "moment"),
    "bearing_rms_deg": Figure("deg", "rms"),
    "distance_rms_m": Figure("m", "rms"),
    "lost_percent": Figure("%", "share", is_exact=True),
    "wrong_percent": Figure("%", "share", is_exact=True),
    "lost_after_s": Figure("s", "extreme"),
    "found_again_s": Figure("s", "extreme"),
    "wall_contacts": Figure("steps", "count", is_exact=True),
    "wall_contact_s": Figure("s", "count", is_exact=True),
    "target_contacts": Figure("steps", "count", is_exact=True),
    "commanded_m": Figure("m", "count"),
    "least_travelled_m": Figure("m", "count"),
    "least_distance_m": Figure("m", "extreme", "legs"),
    "most_distance_m": Figure("m", "extreme", "legs"),
    "least_ever_m": Figure("m", "extreme", "legs"),
    "reached_s": Figure("s", "moment", "goals"),
    "given_up_s": Figure("s", "moment", "goals"),
    "least_clearance_m": Figure("m", "extreme", "goals"),
    "least_around_deg": Figure("deg", "count", "goals"),
    "crossed_on_red": Figure("times", "count", "light", is_exact=True),
    "crossed_late": Figure("times", "count", "light", is_exact=True),
    "least_crossings": Figure("times", "count", "light", is_exact=True),
    "least_red_stops": Figure("times", "count", "light", is_exact=True),
    "most_aside_m": Figure("m", "extreme", "light"),
    "start_s": Figure("s", "extreme", "light"),
    "least_passes": Figure("times", "count", "things", is_exact=True),
    "wrong_states_percent": Figure("%", "other", "light", is_exact=True),
}
"""Every figure that `[bounds]` of a scenario may name."""
_CONTRADICTING = (("least_distance_m", "most_distance_m"), ("least_ever_m", "most_distance_m"))
"""Pairs of (lower, upper) bounds of the same quantity."""


def _without_off(given: Any) -> Any:
    """Drop the bounds that are off. Rejects unknown figures."""
    if not isinstance(given, Mapping):
        return given
    for name in given:
        if name not in FIGURES:
            near = difflib.get_close_matches(str(name), FIGURES, n=1, cutoff=0.4)
            raise ValueError(f"unknown figure {name!r}" + (f", did you mean {near[0]!r}?" if near else ""))
    return {name: bound for name, bound in given.items() if bound != OFF}


def _consistent(bounds: dict[str, float]) -> dict[str, float]:
    """Return the bounds. Raises ValueError if no run can satisfy them."""
    if {"reached_s", "given_up_s"} <= bounds.keys():
        raise ValueError(f'reached_s and given_up_s exclude each other; set one to "{OFF}"')
    for lower, upper in _CONTRADICTING:
        if {lower, upper} <= bounds.keys() and bounds[lower] > bounds[upper]:
            raise ValueError(f"{lower} {bounds[lower]:g} exceeds {upper} {bounds[upper]:g}; no run is within both")
    return bounds


Bounds = Annotated[
    dict[str, Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]],
    BeforeValidator(_without_off), AfterValidator(_consistent),
]
"""Bound by the name of its figure."""


# The events of a simulated run: the models behind `scenarios/*.toml`. Pure.


SCENARIOS = Path(__file__).parent / "scenarios"
_LONGEST_NAME_BYTES = 200  # of the 255 that a file system allows

class Start(Config):
    """The start of the robot, drawn within each span: relative to lens and target, or on the map."""

    distance_m: Amounts = (0.0, 0.0)
    """Lens to the target's center."""
    except_m: Amounts | None = None
    """Distances at which no run starts. One that is drawn within moves to the nearer end."""
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
    def _names_place(self) -> Self:
        seen_from = {"distance_m", "bearing_deg", "approach_deg"}
        if self.at_m is None and not seen_from <= self.model_fields_set:
            raise ValueError("a start is either at_m, or distance_m, bearing_deg and approach_deg")
        return self


class Wall(Config):
    """An upright slab on the floor between two points."""

    renamed_keys: ClassVar[Mapping[str, str]] = {"colour": "color"}
    start_m: Point
    end_m: Point
    thickness_m: Annotated[float, Field(gt=0, le=10)] = 0.05
    height_m: Annotated[float, Field(gt=0, le=10)] = 0.35
    color: Color = (0.62, 0.64, 0.68)

    @model_validator(mode="after")
    def _has_length(self) -> Self:
        if math.dist(self.start_m, self.end_m) < 0.001:
            raise ValueError("the wall has no length: start_m and end_m are the same point")
        return self


def _part_of_a_file_name(name: str) -> str:
    if not name or not name.isprintable() or "/" in name or len(name.encode()) > _LONGEST_NAME_BYTES:
        raise ValueError("the folder of a run is named so; use up to 200 bytes of printable text without '/'")
    return name


class Scenario(Config):
    """One scenario. Both steering and score use `stand_off_m`: lens to the target's center.

    `robot`, `mission` and `vision` (keys of vision.toml) are the settings that an operator chooses for it.
    """

    name: Annotated[str, AfterValidator(_part_of_a_file_name)]
    summary: str = ""
    seconds: Annotated[float, Field(ge=1, le=3600)] = 20.0
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
    """True if there is a way to the last of them."""
    labels: Literal["", "legs"] = ""
    """Objects that the simulation labels in each image, for a vision service with the detector `boxes`."""
    acquired_within_deg: Annotated[float, Field(gt=0, le=30)] = 2.0
    """Bearing within which the target counts as acquired."""
    bounds: Bounds = Field(default_factory=dict)
    """Bounds that score a run. Without bounds it is not evaluated."""

    @model_validator(mode="after")
    def _has_what_its_bounds_need(self) -> Self:
        parts = {
            "light": self.light is not None, "goals": bool(self.goals_m), "legs": self.target.shape == "legs",
            "things": any(isinstance(thing, OnPath) for thing in self.things),
        }
        for name in self.bounds:
            needs = FIGURES[name].needs
            if needs and not parts[needs]:
                raise ValueError(f"bounds.{name} needs {_PARTS[needs]}, which this scenario does not have")
        return self


_PARTS = {"light": "a [light]", "goals": "goals_m", "legs": 'a target of shape "legs"', "things": "things on a path"}


def scenario_names() -> list[str]:
    """Return the names of the scenarios that come with Sightline."""
    return names_in(SCENARIOS)


def load_scenario(name: str) -> Scenario:
    """Load a scenario by name or by the path of a `.toml` file. Raises ConfigError with the nearest name."""
    path = find("scenario", name, SCENARIOS)
    table = read_table(path, SCENARIOS)
    look = table.get("look", "plain")
    if isinstance(look, str):
        table["look"] = look_named(look)
    return check(Scenario, {"name": path.stem, **table}, path)
