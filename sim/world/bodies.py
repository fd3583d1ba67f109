"""Balls, boxes, cylinders and legs as bodies of one PyBullet client. Shell (PyBullet); reads no clock."""

import math
from functools import cache

from sightline.sim.world.engine import pybullet
from sightline.sim.path import Place
from sightline.sim.world.physics import FLOOR, ROBOT, TARGET, WALL, Vector, group
from sightline.sim.things import Color, Rolling, Thing

_NO_TURN = (0.0, 0.0, 0.0, 1.0)


class ThingBodies:
    """One thing: its bodies, and where its middle is. Legs are two bodies, a mere place is none."""

    def __init__(self, client: int, thing: Thing, place: Place, way_m: float = 0.0, *, is_target: bool) -> None:
        self.thing = thing
        self._client = client
        count = {"legs": 2, "place": 0}.get(thing.shape, 1)
        self.bodies = tuple(_add(client, thing, is_target) for _ in range(count))
        self._middle: Vector = (place.x_m, place.y_m, thing.middle_m)
        self.put(place, way_m)

    @property
    def middle(self) -> Vector:
        """Where its middle is now."""
        if len(self.bodies) != 1:
            return self._middle
        return pybullet.getBasePositionAndOrientation(self.bodies[0], physicsClientId=self._client)[0]  # type: ignore[no-any-return]

    def put(self, place: Place, way_m: float) -> None:
        """Set it down at `place`, having come `way_m`."""
        self._middle = (place.x_m, place.y_m, self.thing.middle_m)
        if self.thing.shape == "legs":
            self._walk(place, way_m)
        elif self.bodies:
            round_ = self.thing.shape == "ball"
            turn = _NO_TURN if round_ else pybullet.getQuaternionFromEuler([0, 0, place.heading_rad])
            self._set(self.bodies[0], self._middle, turn)

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
        # FLOOR too, though the two never meet: PyBullet gives every ray group 1, and a body must admit that to be hit.
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
        return ball_visual(client, thing.radius_m, thing.colour)
    look = {"rgbaColor": [*thing.colour, 1], "specularColor": [0, 0, 0], "physicsClientId": client}
    if thing.shape == "box":
        return int(pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=[side / 2 for side in thing.size_m], **look
        ))
    return int(pybullet.createVisualShape(
        pybullet.GEOM_CYLINDER, radius=thing.radius_m, length=thing.height_m, **look
    ))


def ball_visual(client: int, radius_m: float, colour: Color) -> int:
    """A smooth ball to look at."""
    normals, triangles = round_mesh()
    return int(pybullet.createVisualShape(
        pybullet.GEOM_MESH, vertices=normals, indices=triangles, normals=normals, meshScale=[radius_m] * 3,
        rgbaColor=[*colour, 1], specularColor=[0, 0, 0], physicsClientId=client,
    ))


@cache
def round_mesh(rings: int = 24, sides: int = 48) -> tuple[list[Vector], list[int]]:
    """A unit ball's points and triangles; PyBullet's own is so coarse that it looks 2.5 % too small."""
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
