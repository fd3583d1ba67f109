"""The additions of a look to a scenario: a room, objects, colors and textures of floor and walls. Pure (NumPy, OpenCV).

All of it stands outside the area that robot and target need, so a look does not change the paths of a scenario.
Walls and objects are bodies: a range sensor measures them, and a robot that leaves its way touches them.
"""

import colorsys
import math
from typing import Final, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from sightline.sim.scenario import (
    Color,
    Forced,
    Look,
    OnPath,
    Point,
    Pushed,
    Scenario,
    Static,
    TextureName,
    Wall,
)
from sightline.sim.scenes.textures import SIDE, texture
from sightline.sim.world.camera import TILE_TEXELS, Surfaces, floor_tile

Picture = npt.NDArray[np.uint8]
Pattern = npt.NDArray[np.float32]
Random = np.random.Generator

NEEDED_M: Final = 1.0
"""Area around each place of target and robot, in addition to the largest distance at the start."""
CEILING_M: Final = 2.4
LEAST_HUE_OFF_DEG: Final = 25.0
"""From the target's hue, because color alone cannot separate two objects of one hue."""
_NEAR_HUE_OFF_DEG: Final = 60.0  # half of the objects are within this
_ROOM_COLOR: Final[Color] = (0.80, 0.79, 0.77)
_FLOOR_DARK, _FLOOR_LIGHT = 0.42, 0.66  # HSV value at the darkest and the lightest part of a texture
_WALL_VALUE: Final = 0.78
_WALL_CONTRAST: Final = 0.3
_LEAST_CONTRAST: Final = 16.0  # steps; a texture with less keeps its contrast
_ROLLS_S: Final = 60.0
_FURTHEST_M: Final = 20.0  # a ball that nothing brakes rolls forever
_SOLID_BALL: Final = 1.4
_REACH_M: Final = 0.32  # of the largest object, from its center
_CLUTTER, _FLOOR, _WALLS = 15, 16, 17  # streams of random numbers


class Rectangle(NamedTuple):
    """A rectangle along the axes of the map."""

    left_m: float
    bottom_m: float
    right_m: float
    top_m: float

    def grown(self, by_m: float) -> "Rectangle":
        """Return the rectangle with each side moved outward."""
        return Rectangle(self.left_m - by_m, self.bottom_m - by_m, self.right_m + by_m, self.top_m + by_m)

    @property
    def corners(self) -> tuple[Point, Point, Point, Point]:
        """Return the corners counter-clockwise, from the lower left."""
        left, bottom, right, top = self
        return (left, bottom), (right, bottom), (right, top), (left, top)


class Surroundings(NamedTuple):
    """The added walls and objects."""

    walls: tuple[Wall, ...] = ()
    things: tuple[Static, ...] = ()


def surroundings(scenario: Scenario, seed: int) -> Surroundings:
    """Return the room and the objects of the scenario's look, drawn from the seed."""
    look = scenario.look
    if not (look.room_m or look.clutter):
        return Surroundings()
    area = needed_area(scenario)
    walls = _room(area.grown(look.room_m)) if look.room_m else ()
    return Surroundings(walls, _clutter(scenario, area, seed))


def needed_area(scenario: Scenario) -> Rectangle:
    """Return the area in which robot and target move and everything of the scenario stands."""
    points = [*_places(scenario.target), *scenario.goals_m]
    points += [point for thing in scenario.things for point in _places(thing)]
    points += [point for wall in scenario.walls for point in (wall.start_m, wall.end_m)]
    points += [scenario.light.at_m] if scenario.light else []
    points += [scenario.start.at_m] if scenario.start.at_m else []
    x, y = np.array(points).T
    around = Rectangle(float(x.min()), float(y.min()), float(x.max()), float(y.max()))
    return around.grown(NEEDED_M + scenario.start.distance_m[1] + scenario.start.jitter_m)


def _places(thing: Static | OnPath | Pushed | Forced) -> list[Point]:
    """Return places that bound the path of a thing."""
    if isinstance(thing, OnPath):
        path = thing.closed_path()
        places = [path.at(share * path.length_m) for share in np.linspace(0, 1, 64, endpoint=False).tolist()]
        return [(place.x_m, place.y_m) for place in places]
    x_m, y_m = thing.at_m
    if isinstance(thing, Forced):
        loss = -math.log(max(1e-9, 1.0 - thing.drag))
        speed_mps = thing.force_n / (_SOLID_BALL * thing.mass_kg * loss) if loss else math.inf
        heading_rad, way_m = math.radians(thing.heading_deg), min(_FURTHEST_M, speed_mps * _ROLLS_S)
        return [(x_m, y_m), (x_m + way_m * math.cos(heading_rad), y_m + way_m * math.sin(heading_rad))]
    reach_m = thing.arena_m if isinstance(thing, Pushed) else thing.jitter_m + thing.reach_m
    return [(x_m - reach_m, y_m - reach_m), (x_m + reach_m, y_m + reach_m)]


def _room(around: Rectangle) -> tuple[Wall, ...]:
    corners = around.corners
    ends = zip(corners, (*corners[1:], corners[0]), strict=True)
    return tuple(Wall(start_m=start, end_m=end, height_m=CEILING_M, color=_ROOM_COLOR) for start, end in ends)


def _clutter(scenario: Scenario, area: Rectangle, seed: int) -> tuple[Static, ...]:
    """Draw objects that stand around the area, about evenly."""
    look, draw = scenario.look, np.random.default_rng([seed, _CLUTTER])
    deep_m = max(look.room_m - _REACH_M, 2 * _REACH_M)
    hue_deg = _hsv(scenario.target.color)[0]
    things = []
    for number in range(look.clutter):
        share = (number + draw.uniform(0.15, 0.85)) / look.clutter
        at_m = _outside(area, share, draw.uniform(_REACH_M, deep_m))
        color = _near_hue(draw, hue_deg) if number % 2 else _other_hue(draw, hue_deg)
        things.append(_object(draw, at_m, color))
    return tuple(things)


def _outside(area: Rectangle, share: float, off_m: float) -> Point:
    """Return a point `off_m` outside of the area, at a share of the way around it."""
    wide_m, high_m = area.right_m - area.left_m, area.top_m - area.bottom_m
    way_m = share * 2 * (wide_m + high_m)
    if way_m < wide_m:
        return area.left_m + way_m, area.bottom_m - off_m
    if way_m < wide_m + high_m:
        return area.right_m + off_m, area.bottom_m + way_m - wide_m
    if way_m < 2 * wide_m + high_m:
        return area.right_m - (way_m - wide_m - high_m), area.top_m + off_m
    return area.left_m - off_m, area.top_m - (way_m - 2 * wide_m - high_m)


def _object(draw: Random, at_m: Point, color: Color) -> Static:
    shape = ("box", "cylinder", "ball")[int(draw.choice(3, p=(0.5, 0.3, 0.2)))]
    sides = draw.uniform((0.12, 0.12, 0.12), (0.42, 0.42, 0.8)).tolist()
    return Static.model_validate({
        "shape": shape, "at_m": at_m, "heading_deg": draw.uniform(0, 360), "color": color, "size_m": sides,
        "radius_m": draw.uniform(0.06, 0.16), "height_m": sides[2],
    })


def _near_hue(draw: Random, hue_deg: float) -> Color:
    off_deg = draw.uniform(LEAST_HUE_OFF_DEG, _NEAR_HUE_OFF_DEG) * draw.choice((-1.0, 1.0))
    return _rgb(hue_deg + off_deg, draw.uniform(0.6, 0.95), draw.uniform(0.5, 0.95))


def _other_hue(draw: Random, hue_deg: float) -> Color:
    off_deg = draw.uniform(_NEAR_HUE_OFF_DEG, 360 - _NEAR_HUE_OFF_DEG)
    return _rgb(hue_deg + off_deg, draw.uniform(0.1, 0.9), draw.uniform(0.2, 0.9))


def _hsv(color: Color) -> tuple[float, float, float]:
    """Return hue in degrees, saturation, value."""
    hue, saturation, value = colorsys.rgb_to_hsv(*color)
    return 360 * hue, saturation, value


def _rgb(hue_deg: float, saturation: float, value: float) -> Color:
    return colorsys.hsv_to_rgb(hue_deg % 360 / 360, saturation, value)


def surfaces(scenario: Scenario, seed: int) -> Surfaces:
    """Return floor and walls of the look. None means unchanged."""
    look = scenario.look
    hue_deg, saturation, _ = _hsv(scenario.target.color)
    has_floor = look.floor != "boards" or look.floor_likeness
    floor = _floor(look, hue_deg, saturation, seed) if has_floor else None
    pattern = _wall_pattern(look.wall, seed) if look.wall != "plain" else None
    color = _rgb(hue_deg, saturation * look.wall_likeness, _WALL_VALUE) if look.wall_likeness else None
    return Surfaces(floor, pattern, color, look.shadows)


def _floor(look: Look, hue_deg: float, saturation: float, seed: int) -> Picture:
    """Return a tile whose dark parts are more saturated, as of wood, stone and cloth."""
    share = _pattern(look.floor, seed, _FLOOR)[..., None]
    wanted = saturation * look.floor_likeness
    dark, light = (
        255 * np.array(_rgb(hue_deg, min(1.0, wanted * more), value), np.float32)
        for more, value in ((1.2, _FLOOR_DARK), (0.8, _FLOOR_LIGHT))
    )
    tile = np.rint(dark + share * (light - dark)).astype(np.uint8)
    count = TILE_TEXELS // tile.shape[0]
    return np.ascontiguousarray(np.tile(tile, (count, count, 1)))


def _wall_pattern(name: TextureName, seed: int) -> Pattern:
    """Return factors about 1. A finer tile would flicker on walls, which are meters away."""
    share = cv2.resize(_pattern(name, seed, _WALLS), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return np.asarray(1 + _WALL_CONTRAST * (share - 0.5), np.float32)


def _pattern(name: TextureName, seed: int, stream: int) -> Pattern:
    """Return the brightness of a texture, 0 to 1, a side of `TILE_TEXELS` (boards) or of twice `SIDE`."""
    own = int(np.random.default_rng([seed, stream]).integers(2**31))
    if name == "boards":
        gray = cv2.cvtColor(floor_tile(own), cv2.COLOR_RGB2GRAY)
    else:
        tile = cv2.cvtColor(texture(name, own), cv2.COLOR_RGB2GRAY)
        gray = cv2.resize(tile, (2 * SIDE, 2 * SIDE), interpolation=cv2.INTER_LINEAR)
    low, high = np.quantile(gray, (0.02, 0.98))
    spread = max(float(high - low), _LEAST_CONTRAST)
    middle = (float(low) + float(high)) / 2
    return np.asarray(np.clip((gray.astype(np.float32) - middle) / spread + 0.5, 0, 1), np.float32)
