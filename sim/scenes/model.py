"""Define a labeled scene, drawn from its seed. Pure.

A column defines the difficulty of a scene. The scored scenes never repeat trained ones: they have other seeds, other
families of textures, and light from heights in between.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from sightline.sim.scenario import Color, State

SCORED_FROM: Final = 900_000
"""First seed of the scenes for scores only."""
VALIDATED_FROM: Final = 800_000
"""Seeds from here up to `SCORED_FROM` choose thresholds; training draws below."""
LABELS: Final = ("ball", "light-red", "light-yellow", "light-green", "legs")
LATER_FROM: Final = 20_000
"""Training seeds from here on have more texture families: those of the second round."""
HARDER_FROM: Final = 40_000
"""Training seeds from here on have more legs and more boxes of the ball's color: those of the third round."""
STATES: Final[tuple[State, ...]] = ("red", "yellow", "green")

WIDTH_PX, HEIGHT_PX = 320, 240
BALL_PX = (8.0, 120.0)
MOST_HIDDEN = 0.6
"""Largest hidden share of a ball that counts as an object."""
MOST_DISTRACTORS = 5
WITHOUT_BALL_EVERY = 5
"""Each fifth scored scene has no ball."""
LIGHT_SIZES: Final = (0.6, 1.4)  # scale of a traffic light; 1 is that of the simulated lane

Random = np.random.Generator
Span = tuple[float, float]
Box = tuple[float, float, float, float]
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Column:
    """The difficulty of a scene: four values for its contents, the others for the camera."""

    name: str
    same_colour_boxes: float = 0.0
    """Probability that two boxes of the ball's own color are present."""
    lights: float = 0.15
    legs: float = 0.15
    any_colour: float = 0.0
    """Probability that the ball is not yellow."""
    gain: Span = (0.9, 1.0)
    white_balance: float = 0.03
    """Largest error of red, green and blue, in both directions."""
    blurred: float = 0.0
    blur_px: Span = (9.0, 21.0)
    """Width of the kernel: half of them out of focus, half of them moved."""
    noise: Span = (1.0, 3.0)
    quality: tuple[int, int] = (75, 95)


_LIGHT = {"gain": (0.25, 1.0), "white_balance": 0.3}
_HARD: Final = {"same_colour_boxes": 1.0, "blurred": 1.0, "quality": (30, 30), **_LIGHT}

COLUMNS: Final = {one.name: one for one in (
    Column("nominal"),
    Column("same-color boxes", same_colour_boxes=1.0),
    Column("changed light", **_LIGHT),  # type: ignore[arg-type]
    Column("blur", blurred=1.0),
    Column("quality 30", quality=(30, 30)),
    Column("all at once", **_HARD),  # type: ignore[arg-type]
)}
THINGS: Final = Column("lights and legs", lights=1.0, legs=1.0)
"""For traffic lights and legs: one of each in every scene. The three states take turns."""
TRAINED: Final = Column(
    "trained", same_colour_boxes=0.6, lights=0.35, legs=0.4, any_colour=0.2, gain=(0.2, 1.1), white_balance=0.33,
    blurred=0.45, blur_px=(3.0, 21.0), noise=(0.0, 6.0), quality=(25, 95),
)
HARDER: Final = replace(TRAINED, name="trained harder", same_colour_boxes=0.85, legs=0.75, any_colour=0.1)
DEFECTS: Final = (
    TRAINED,
    Column("little at once", gain=(0.85, 1.05), white_balance=0.06, noise=(0.5, 3.5), quality=(25, 95)),
    Column("much at once", gain=(0.22, 1.05), white_balance=0.32, blurred=1.0, blur_px=(7.0, 21.0), noise=(0.5, 4.0),
           quality=(25, 45)),
)
"""Equally likely from the third round on, so that a score means the same in clear and in bad images. Otherwise bad
images would need a higher threshold, and all share one.
"""


@dataclass(frozen=True, slots=True)
class Lens:
    """A camera at the origin, x forward, y left, z up, that looks down by `pitch_rad`."""

    focal_px: float
    pitch_rad: float

    def axes(self) -> npt.NDArray[np.float64]:
        """Return the axes as columns: right, down, forward."""
        cos, sin = math.cos(self.pitch_rad), math.sin(self.pitch_rad)
        return np.array([[0.0, -sin, cos], [-1.0, 0.0, 0.0], [0.0, -cos, -sin]])

    def point(self, u_px: float, v_px: float, ahead_m: float) -> Point:
        """Return the point of a pixel at a depth along the axis."""
        x, y, z = (self.axes() @ self.ray(u_px, v_px) * ahead_m).tolist()
        return x, y, z

    def ray(self, u_px: float, v_px: float) -> npt.NDArray[np.float64]:
        """Return the ray of a pixel to a depth of 1 m: right, down, forward."""
        return np.array([(u_px - WIDTH_PX / 2) / self.focal_px, (v_px - HEIGHT_PX / 2) / self.focal_px, 1.0])

    def horizon_px(self) -> float:
        """Return the row of the horizon."""
        return HEIGHT_PX / 2 - self.focal_px * math.tan(self.pitch_rad)

    def ball_box(self, at_m: Point, radius_m: float) -> Box:
        """Return the exact box around a whole ball, without occlusion and image border."""
        right, down, ahead = np.array(at_m) @ self.axes()
        edges = []
        for aside, middle in ((right, WIDTH_PX / 2), (down, HEIGHT_PX / 2)):
            root = radius_m * math.sqrt(aside * aside + ahead * ahead - radius_m * radius_m)
            under = ahead * ahead - radius_m * radius_m
            edges.append([middle + self.focal_px * (aside * ahead + sign * root) / under for sign in (-1, 1)])
        return edges[0][0], edges[1][0], edges[0][1], edges[1][1]


@dataclass(frozen=True, slots=True)
class Solid:
    """One object of one or more bodies. `label` is empty for an object that is not a target."""

    shape: str
    """`ball`, `box`, `cylinder`, `legs`, `light`"""
    at_m: Point
    """Center of a ball, a box, a cylinder; position of legs; center of a light's housing."""
    size_m: Point
    """Sides of a box; radius, radius, height of a cylinder or a leg; scale of a light."""
    colour: Color
    turn_rad: float = 0.0
    label: str = ""
    step: float = 0.0
    """Of legs: position in their stride."""
    is_like_ball: bool = False
    """A box of the ball's own color, as in the name of its column."""


@dataclass(frozen=True, slots=True)
class Surface:
    """A floor or a wall: texture family, seed, and tile size in meters."""

    family: str
    seed: int
    tile_m: float


@dataclass(frozen=True, slots=True)
class ScenePlan:
    """All contents of one scene before it is drawn."""

    seed: int
    column: Column
    lens: Lens
    floor_m: float
    """Height of the floor, below zero."""
    wall_m: float
    """Distance of the wall, and its turn."""
    wall_turn_rad: float
    floor: Surface
    wall: Surface
    light_from: Point
    ambient: float
    solids: tuple[Solid, ...]
    glow: float
    """Share of a lit lamp's own light."""


@dataclass(frozen=True, slots=True)
class LabelledBox:
    """One labeled object, in pixels."""

    label: str
    box: Box
    """Box around its visible part, from the segmentation mask."""
    seen: float
    """Visible share."""
    whole: Box | None = None
    """Of a ball: box around all of it."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A drawn scene before camera defects: RGB, the contents, and the boxes of all other things."""

    plan: ScenePlan
    rgb: npt.NDArray[np.uint8]
    truths: tuple[LabelledBox, ...]
    others: tuple[Box, ...]
    unclear: tuple[Box, ...]
    """Labeled objects that are barely visible. A detection of them is neither right nor wrong."""


@dataclass(frozen=True, slots=True)
class PhotoScene:
    """A scene over a photograph: RGB (240, 320, 3), and boxes as in `Scene`. The photograph itself is not labeled."""

    rgb: npt.NDArray[np.uint8]
    truths: tuple[LabelledBox, ...]
    others: tuple[Box, ...]
    unclear: tuple[Box, ...]


def trained_column(seed: int) -> Column:
    """Return the column of a training scene."""
    return HARDER if seed >= HARDER_FROM else TRAINED


def is_scored(seed: int) -> bool:
    """Return True for a scene that is for scores only."""
    return seed >= SCORED_FROM
