"""Things, traffic lights and movers as bodies of PyBullet. Shell (PyBullet)."""

import math
from functools import cache
from typing import Protocol

import numpy as np
import numpy.typing as npt

from sightline.sim.scenario import (
    LINE_WIDE_M,
    Color,
    Forced,
    Light,
    OnPath,
    Part,
    Place,
    Pushed,
    Rolling,
    Static,
    Thing,
    color_of,
)
from sightline.sim.world.engine import pybullet
from sightline.sim.world.physics import FLOOR, ROBOT, TARGET, WALL, Vector, group
from sightline.sim.world.start import target_phase, thing_phase, thing_place

_NO_TURN = (0.0, 0.0, 0.0, 1.0)
_AROUND_RAD = np.linspace(0.0, math.tau, 16, endpoint=False)

Points = npt.NDArray[np.float64]
Pose = tuple[Vector, tuple[float, float, float, float]]
"""Position, and orientation as a quaternion."""


def hull_of(client: int, body: int, own: Points) -> Points:
    """Return points `own` (N, 3) of a body in world coordinates."""
    at, turn = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    axes = np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
    return np.asarray(own @ axes.T + np.array(at))


def box_points(size_m: tuple[float, float, float]) -> Points:
    """Return the corners of a box around its center."""
    signs = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    return np.array(signs) * size_m


def _thing_points(thing: Thing) -> Points:
    """Return points around the center of a body. Their convex hull is its shape, or nearly."""
    if thing.shape == "box":
        return box_points(thing.size_m)
    ring = np.stack([np.cos(_AROUND_RAD), np.sin(_AROUND_RAD), np.zeros(len(_AROUND_RAD))], axis=-1) * thing.radius_m
    if thing.shape == "ball":
        return np.concatenate([ring, ring[:, [0, 2, 1]], ring[:, [2, 0, 1]]])
    up = np.array([0.0, 0.0, thing.height_m / 2])
    return np.concatenate([ring - up, ring + up])


class ThingBodies:
    """One thing with its bodies and its center. Legs have two bodies, a place has none."""

    def __init__(self, client: int, thing: Thing, place: Place, way_m: float = 0.0, *, is_target: bool) -> None:
        self.thing = thing
        self._client = client
        count = {"legs": 2, "place": 0}.get(thing.shape, 1)
        self.bodies = tuple(_add(client, thing, is_target) for _ in range(count))
        self._middle: Vector = (place.x_m, place.y_m, thing.middle_m)
        self._own_points = _thing_points(thing)
        self.put(place, way_m)

    @property
    def middle(self) -> Vector:
        """Return its center now."""
        if len(self.bodies) != 1:
            return self._middle
        return pybullet.getBasePositionAndOrientation(self.bodies[0], physicsClientId=self._client)[0]  # type: ignore[no-any-return]

    def hulls(self) -> list[Points]:
        """Return points (N, 3) in the world for each body; their convex hull is its shape."""
        return [hull_of(self._client, body, self._own_points) for body in self.bodies]

    def put(self, place: Place, way_m: float) -> None:
        """Place it at `place`, `way_m` along its way."""
        self._middle = (place.x_m, place.y_m, self.thing.middle_m)
        if self.thing.shape == "legs":
            self._walk(place, way_m)
        elif self.bodies:
            round_ = self.thing.shape == "ball"
            turn = _NO_TURN if round_ else pybullet.getQuaternionFromEuler([0, 0, place.heading_rad])
            self._set(self.bodies[0], self._middle, turn)

    @property
    def pose(self) -> Pose:
        """Return the pose of a rolling ball."""
        return pybullet.getBasePositionAndOrientation(self.bodies[0], physicsClientId=self._client)  # type: ignore[no-any-return]

    def put_pose(self, pose: Pose) -> None:
        """Place a rolling ball at that pose."""
        self._set(self.bodies[0], *pose)

    def _walk(self, place: Place, way_m: float) -> None:
        legs, cos, sin = self.thing.legs, math.cos(place.heading_rad), math.sin(place.heading_rad)
        for body, is_left in zip(self.bodies, (True, False), strict=True):
            ahead_m = legs.ahead_m(way_m, is_left)
            left_m = legs.apart_m / 2 if is_left else -legs.apart_m / 2
            x_m, y_m = place.x_m + ahead_m * cos - left_m * sin, place.y_m + ahead_m * sin + left_m * cos
            self._set(body, (x_m, y_m, self.thing.middle_m), _NO_TURN)

    def _set(self, body: int, at: Vector, turn: tuple[float, float, float, float]) -> None:
        pybullet.resetBasePositionAndOrientation(body, at, turn, physicsClientId=self._client)


def _add(client: int, thing: Thing, is_target: bool) -> int:
    mass_kg = thing.mass_kg if isinstance(thing, Rolling) else 0.0
    drag = thing.drag if isinstance(thing, Rolling) else 0.0
    body = int(pybullet.createMultiBody(
        mass_kg, _collision(client, thing), _visual(client, thing), (0.0, 0.0, thing.middle_m), physicsClientId=client
    ))
    pybullet.changeDynamics(
        body, -1, lateralFriction=0.8, restitution=0.0, linearDamping=drag, angularDamping=drag, physicsClientId=client
    )
    if is_target:
        group(client, body, TARGET, FLOOR | ROBOT | WALL)
    else:
        # FLOOR too, although the two never meet: PyBullet gives every ray group 1, and a body must accept it to be hit.
        group(client, body, WALL, FLOOR | ROBOT | TARGET)
    return body


def _collision(client: int, thing: Thing) -> int:
    if thing.shape == "ball":
        return int(pybullet.createCollisionShape(
            pybullet.GEOM_SPHERE, radius=thing.radius_m, physicsClientId=client
        ))
    if thing.shape == "box":
        half = [side / 2 for side in thing.size_m]
        return int(pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client))
    return int(pybullet.createCollisionShape(
        pybullet.GEOM_CYLINDER, radius=thing.radius_m, height=thing.height_m, physicsClientId=client
    ))


def _visual(client: int, thing: Thing) -> int:
    if thing.shape == "ball":
        return ball_visual(client, thing.radius_m, thing.color)
    look = {"rgbaColor": [*thing.color, 1], "specularColor": [0, 0, 0], "physicsClientId": client}
    if thing.shape == "box":
        return int(pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=[side / 2 for side in thing.size_m], **look
        ))
    return int(pybullet.createVisualShape(
        pybullet.GEOM_CYLINDER, radius=thing.radius_m, length=thing.height_m, **look
    ))


def ball_visual(client: int, radius_m: float, colour: Color) -> int:
    """Create the visual shape of a smooth ball."""
    normals, triangles = round_mesh()
    return int(pybullet.createVisualShape(
        pybullet.GEOM_MESH, vertices=normals, indices=triangles, normals=normals, meshScale=[radius_m] * 3,
        rgbaColor=[*colour, 1], specularColor=[0, 0, 0], physicsClientId=client,
    ))


@cache
def round_mesh(rings: int = 24, sides: int = 48) -> tuple[list[Vector], list[int]]:
    """Return points and triangles of a unit ball. PyBullet's own is so coarse that it looks 2.5 % too small."""
    points: list[Vector] = []
    triangles: list[int] = []
    for ring in range(rings + 1):
        polar_rad = math.pi * ring / rings
        for side in range(sides):
            around_rad = math.tau * side / sides
            across = math.sin(polar_rad)
            points.append((across * math.cos(around_rad), across * math.sin(around_rad), math.cos(polar_rad)))
            here, beside = ring * sides + side, ring * sides + (side + 1) % sides
            if ring < rings:
                triangles += [here, here + sides, beside, beside, here + sides, beside + sides]
    return points, triangles


# A traffic light and its stop line as bodies of one PyBullet client. Shell (PyBullet); reads no clock.


LINE_RGB = (0.92, 0.92, 0.92)
_LINE_DEEP_M = 0.05
_LINE_HIGH_M = 0.002
_NOTHING = -1


class LightBodies:
    """Housing, pole and lamps, or one box, lit by the schedule."""

    def __init__(self, client: int, light: Light, begin: float) -> None:
        self._client, self._light, self._begin = client, light, begin
        self.state = light.state_at(begin, 0)
        self._turn = pybullet.getQuaternionFromEuler([0, 0, math.radians(light.faces_deg)])
        self._parts = [(part, self._add(part)) for part in light.parts()]
        self._add_line()

    @property
    def bodies(self) -> frozenset[int]:
        """Return all bodies that can be touched or are lit."""
        return frozenset(body for _, body in self._parts)

    def hulls(self) -> list[Points]:
        """Return the corners of pole and housing, or of the box, in the world."""
        return [hull_of(self._client, body, box_points(part.size_m)) for part, body in self._parts
                if part.shape == "box"]

    def move(self, now_us: int) -> None:
        """Change the color when it is due."""
        state = self._light.state_at(self._begin, now_us)
        if state == self.state:
            return
        self.state = state
        for part, body in self._parts:
            rgba = [*color_of(part, state), 1]
            pybullet.changeVisualShape(body, -1, rgbaColor=rgba, physicsClientId=self._client)

    def _add(self, part: Part) -> int:
        client, half, colour = self._client, [side / 2 for side in part.size_m], color_of(part, self.state)
        if part.shape == "ball":
            visual = ball_visual(client, part.size_m[0], colour)
            return int(pybullet.createMultiBody(0, _NOTHING, visual, part.at_m, self._turn, physicsClientId=client))
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
        visual = self._box_visual(half, colour)
        body = int(pybullet.createMultiBody(0, shape, visual, part.at_m, self._turn, physicsClientId=client))
        group(client, body, WALL, FLOOR | ROBOT | TARGET)
        return body

    def _add_line(self) -> None:
        """Add the stop line, a strip on the floor without collisions."""
        visual = self._box_visual([_LINE_DEEP_M / 2, LINE_WIDE_M / 2, _LINE_HIGH_M / 2], LINE_RGB)
        at = (*self._light.ahead(self._light.line_m), _LINE_HIGH_M / 2)
        pybullet.createMultiBody(0, _NOTHING, visual, at, self._turn, physicsClientId=self._client)

    def _box_visual(self, half: list[float], colour: tuple[float, float, float]) -> int:
        return int(pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=half, rgbaColor=[*colour, 1], specularColor=[0, 0, 0],
            physicsClientId=self._client,
        ))


# Motion of a thing: none, a path, pushes, or one constant force. Shell (PyBullet); reads no clock.


PUSH_S = 0.4
SOLID_BALL = 1.4  # a rolling solid ball resists a push at its center as 7/5 of its mass would


class Mover(Protocol):
    """Moves a thing before each physics step."""

    def move(self, bodies: ThingBodies, now_us: int) -> None: ...


class Still:
    """Leaves a thing where it is."""

    def move(self, bodies: ThingBodies, now_us: int) -> None:
        """Do nothing."""


class PathMover:
    """Moves a thing along its path."""

    def __init__(self, thing: OnPath, phase: float) -> None:
        self._thing = thing
        self._path = thing.closed_path()
        self._begin_m = phase * self._path.length_m

    def way_m(self, now_us: int) -> float:
        """Return the distance along its path at `now_us`, in m."""
        return self._begin_m + self._thing.speed_mps * max(0.0, now_us / 1e6 - self._thing.waits_s)

    def place(self, now_us: int) -> Place:
        """Return its place at `now_us`."""
        return self._path.at(self.way_m(now_us))

    def move(self, bodies: ThingBodies, now_us: int) -> None:
        """Place the thing on its path."""
        bodies.put(self.place(now_us), self.way_m(now_us))


class Pusher:
    """Pushes the ball from time to time, towards a random point of its arena."""

    def __init__(self, client: int, target: Pushed, seed: int) -> None:
        self._client, self._target = client, target
        self._draw = np.random.default_rng([seed, 6])
        self._begin_us = round(self._draw.uniform(0.5, 1.5) * 1e6)
        self._force: Vector | None = None

    def move(self, bodies: ThingBodies, now_us: int) -> None:
        """Push during a push."""
        if now_us < self._begin_us:
            return
        place = bodies.middle
        if self._force is None:
            self._force = self._force_from(place)
        _push(self._client, bodies, self._force)
        if now_us >= self._begin_us + PUSH_S * 1e6:
            self._begin_us = now_us + round(self._draw.uniform(*self._target.push_every_s) * 1e6)
            self._force = None

    def _force_from(self, place: Vector) -> Vector:
        target = self._target
        angle_rad, share = self._draw.uniform(0, math.tau), math.sqrt(self._draw.uniform())
        aim_x = target.at_m[0] + target.arena_m * share * math.cos(angle_rad) - place[0]
        aim_y = target.at_m[1] + target.arena_m * share * math.sin(angle_rad) - place[1]
        force_n = SOLID_BALL * target.mass_kg * self._draw.uniform(*target.push_mps) / PUSH_S
        far_m = math.hypot(aim_x, aim_y) or 1.0
        return (force_n * aim_x / far_m, force_n * aim_y / far_m, 0.0)


class Force:
    """Pushes the ball in one direction forever."""

    def __init__(self, client: int, target: Forced) -> None:
        self._client, self._from_us = client, target.from_s * 1e6
        heading_rad = math.radians(target.heading_deg)
        self._force: Vector = (target.force_n * math.cos(heading_rad), target.force_n * math.sin(heading_rad), 0.0)

    def move(self, bodies: ThingBodies, now_us: int) -> None:
        """Push once the force has begun."""
        if now_us >= self._from_us:
            _push(self._client, bodies, self._force)


def _push(client: int, bodies: ThingBodies, force: Vector) -> None:
    pybullet.applyExternalForce(
        bodies.bodies[0], -1, force, bodies.middle, pybullet.WORLD_FRAME, physicsClientId=client
    )


def begin(client: int, target: Static | OnPath | Pushed | Forced, seed: int) -> tuple[Mover, Place, float]:
    """Return the mover of the target, its first place, and its first distance along the path."""
    if isinstance(target, OnPath):
        return _on_path(target, target_phase(target, seed))
    if isinstance(target, Pushed):
        return Pusher(client, target, seed), Place(*target.at_m, 0.0), 0.0
    if isinstance(target, Forced):
        return Force(client, target), Place(*target.at_m, math.radians(target.heading_deg)), 0.0
    return Still(), thing_place(target, 0, seed), 0.0


def begin_thing(thing: Static | OnPath, number: int, seed: int) -> tuple[Mover, Place, float]:
    """Return the same for a thing other than the target."""
    if isinstance(thing, OnPath):
        return _on_path(thing, thing_phase(thing, number, seed))
    return Still(), thing_place(thing, number, seed), 0.0


def _on_path(thing: OnPath, phase: float) -> tuple[Mover, Place, float]:
    mover = PathMover(thing, phase)
    return mover, mover.place(0), mover.way_m(0)
