"""One PyBullet client and the bodies in it. Shell (PyBullet); reads no clock, draws no numbers.

Traps that this file steps round: wheels must be implicit cylinders (faceted ones err by percents); the caster must
have no friction; a body's position is that of its inertial frame; a body without a visual shape is drawn all the same.
"""

import math
import tempfile
from pathlib import Path
from typing import Any

from sim.body import CASTER_JOINT, LEFT_JOINT, RIGHT_JOINT, urdf
from sim.engine import pybullet
from sim.robot_model import RobotModel
from sim.scenario import Ball, Pushed, Wall

FLOOR, ROBOT, TARGET, WALL = 1, 2, 4, 8
"""Collision groups; rays choose by them what they may hit."""
GRAVITY_MPS2 = 9.81

Vector = tuple[float, float, float]


def open_client(step_us: int) -> int:
    """A new empty world; returns PyBullet's client number."""
    client = int(pybullet.connect(pybullet.DIRECT))
    pybullet.setGravity(0, 0, -GRAVITY_MPS2, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=step_us / 1e6, numSubSteps=0, deterministicOverlappingPairs=1, enableFileCaching=0,
        physicsClientId=client,
    )
    return client


def _unseen(client: int) -> int:
    """A shape that costs the renderer nothing; a body without any is drawn in its collision shape."""
    speck = [0.001, 0.001, 0.001]
    return int(pybullet.createVisualShape(
        pybullet.GEOM_BOX, halfExtents=speck, rgbaColor=[0, 0, 0, 0], physicsClientId=client
    ))


def add_floor(client: int) -> int:
    """An endless floor, unseen: the camera paints its own (TinyRenderer's costs 8 ms a picture)."""
    shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    floor = int(pybullet.createMultiBody(0, shape, _unseen(client), physicsClientId=client))
    pybullet.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
    _group(client, floor, FLOOR, ROBOT | TARGET)
    return floor


def add_wall(client: int, wall: Wall) -> int:
    """A slab between the wall's two points, unseen as the floor is."""
    (x0, y0), (x1, y1) = wall.start_m, wall.end_m
    half = [math.hypot(x1 - x0, y1 - y0) / 2, wall.thickness_m / 2, wall.height_m / 2]
    turn = pybullet.getQuaternionFromEuler([0, 0, math.atan2(y1 - y0, x1 - x0)])
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
    middle = [(x0 + x1) / 2, (y0 + y1) / 2, half[2]]
    body = int(pybullet.createMultiBody(0, shape, _unseen(client), middle, turn, physicsClientId=client))
    # FLOOR too, though the two never meet: PyBullet gives every ray group 1, and a body must admit that to be hit.
    _group(client, body, WALL, FLOOR | ROBOT | TARGET)
    return body


def add_ball(client: int, ball: Ball, place: Vector) -> int:
    """The target; only a pushed one has a mass."""
    shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=ball.radius_m, physicsClientId=client)
    normals, triangles = round_mesh()
    visual = pybullet.createVisualShape(
        pybullet.GEOM_MESH, vertices=normals, indices=triangles, normals=normals, meshScale=[ball.radius_m] * 3,
        rgbaColor=[*ball.colour, 1], specularColor=[0, 0, 0], physicsClientId=client,
    )
    mass_kg = ball.mass_kg if isinstance(ball, Pushed) else 0.0
    body = int(pybullet.createMultiBody(mass_kg, shape, visual, place, physicsClientId=client))
    drag = ball.drag if isinstance(ball, Pushed) else 0.0
    pybullet.changeDynamics(
        body, -1, lateralFriction=0.8, restitution=0.0, linearDamping=drag, angularDamping=drag, physicsClientId=client
    )
    _group(client, body, TARGET, FLOOR | ROBOT | WALL)
    return body


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


def add_robot(client: int, robot: RobotModel, place: Vector, yaw_rad: float) -> int:
    """The robot with its axle's midpoint at `place`, motors off."""
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", delete=False) as file:
        file.write(urdf(robot))
    try:
        body = int(pybullet.loadURDF(
            file.name, place, pybullet.getQuaternionFromEuler([0, 0, yaw_rad]),
            flags=pybullet.URDF_USE_IMPLICIT_CYLINDER | pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client,
        ))
    finally:
        Path(file.name).unlink()
    for link in (-1, LEFT_JOINT, RIGHT_JOINT, CASTER_JOINT):
        friction = robot.wheels.friction if link in (LEFT_JOINT, RIGHT_JOINT) else 0.0
        pybullet.changeDynamics(
            body, link, lateralFriction=friction, spinningFriction=0, rollingFriction=0, restitution=0,
            linearDamping=0, angularDamping=0, jointDamping=0, physicsClientId=client,
        )
    _group(client, body, ROBOT, FLOOR | TARGET | WALL)
    return body


def _group(client: int, body: int, group: int, meets: int) -> None:
    links = pybullet.getNumJoints(body, physicsClientId=client)
    for link in range(-1, links):
        pybullet.setCollisionFilterGroupMask(body, link, group, meets, physicsClientId=client)


class RobotBody:
    """The robot's pose, speed and wheels in one client."""

    def __init__(self, client: int, body: int, max_torque_nm: float) -> None:
        self.body = body
        self._client = client
        self._torques = [max_torque_nm, max_torque_nm]
        self._driven: tuple[float, float] | None = None
        info = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        self._from_mass = pybullet.invertTransform(info[3], info[4])

    def drive(self, left_rad_s: float, right_rad_s: float) -> None:
        """Let the wheels' motors strive for these speeds."""
        if self._driven == (left_rad_s, right_rad_s):
            return
        self._driven = (left_rad_s, right_rad_s)
        pybullet.setJointMotorControlArray(
            self.body, [LEFT_JOINT, RIGHT_JOINT], pybullet.VELOCITY_CONTROL, targetVelocities=self._driven,
            forces=self._torques, physicsClientId=self._client,
        )

    def wheel_angles(self) -> tuple[float, float]:
        """How far each wheel has rolled, rad."""
        left, right = pybullet.getJointStates(self.body, [LEFT_JOINT, RIGHT_JOINT], physicsClientId=self._client)
        return float(left[0]), float(right[0])

    def pose(self) -> tuple[Vector, Any]:
        """Axle midpoint on the floor and orientation (quaternion x, y, z, w)."""
        place, turn = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)
        return pybullet.multiplyTransforms(place, turn, *self._from_mass)  # type: ignore[no-any-return]

    def velocity(self) -> tuple[Vector, Vector]:
        """(linear m/s, angular rad/s) in the world's frame."""
        return pybullet.getBaseVelocity(self.body, physicsClientId=self._client)  # type: ignore[no-any-return]
