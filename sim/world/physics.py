"""One PyBullet client and the bodies in it. Shell (PyBullet); reads no clock, draws no numbers.

Traps that this file avoids: wheels must be implicit cylinders (faceted ones err by percents); the caster must
have no friction; a body's position is that of its inertial frame; a body without a visual shape is drawn anyway.
"""

import math
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sightline.protocol.errors import ConfigError
from sightline.sim.robot import RobotModel, UrdfBody, urdf_body
from sightline.sim.scenario import Place, Wall
from sightline.sim.urdf import Transform
from sightline.sim.world.engine import pybullet

FLOOR, ROBOT, TARGET, WALL = 1, 2, 4, 8
"""Collision groups. Rays select by them the bodies to hit."""
GRAVITY_MPS2 = 9.81

Vector = tuple[float, float, float]


def open_client(step_us: int) -> int:
    """Open a new empty world. Returns PyBullet's client number."""
    client = int(pybullet.connect(pybullet.DIRECT))
    pybullet.setGravity(0, 0, -GRAVITY_MPS2, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=step_us / 1e6, numSubSteps=0, deterministicOverlappingPairs=1, enableFileCaching=0,
        physicsClientId=client,
    )
    return client


def _unseen(client: int) -> int:
    """Return a shape that costs the renderer nothing. A body without one is drawn by its collision shape."""
    speck = [0.001, 0.001, 0.001]
    return int(pybullet.createVisualShape(
        pybullet.GEOM_BOX, halfExtents=speck, rgbaColor=[0, 0, 0, 0], physicsClientId=client
    ))


def add_floor(client: int) -> int:
    """Add an infinite invisible floor. The camera paints its own, because TinyRenderer's costs 8 ms an image."""
    shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    floor = int(pybullet.createMultiBody(0, shape, _unseen(client), physicsClientId=client))
    pybullet.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
    group(client, floor, FLOOR, ROBOT | TARGET)
    return floor


def add_wall(client: int, wall: Wall) -> int:
    """Add an invisible slab between the wall's two points."""
    (x0, y0), (x1, y1) = wall.start_m, wall.end_m
    half = [math.hypot(x1 - x0, y1 - y0) / 2, wall.thickness_m / 2, wall.height_m / 2]
    turn = pybullet.getQuaternionFromEuler([0, 0, math.atan2(y1 - y0, x1 - x0)])
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
    middle = [(x0 + x1) / 2, (y0 + y1) / 2, half[2]]
    body = int(pybullet.createMultiBody(0, shape, _unseen(client), middle, turn, physicsClientId=client))
    # FLOOR too, although the two never meet: PyBullet gives every ray group 1, and a body must accept it to be hit.
    group(client, body, WALL, FLOOR | ROBOT | TARGET)
    return body


def add_robot(client: int, robot: RobotModel, at: Place) -> "RobotBody":
    """Add the robot with its axle's midpoint at `at`, motors off. Raises ConfigError if PyBullet rejects its URDF."""
    body = urdf_body(robot)
    loaded = _load(client, robot, body, at)
    moving = {
        str(pybullet.getJointInfo(loaded, joint, physicsClientId=client)[1], "utf-8"): joint
        for joint in range(pybullet.getNumJoints(loaded, physicsClientId=client))
    }
    wheels = [moving[name] for name in body.joints]
    for link in (-1, *moving.values()):
        friction = robot.wheels.friction if link in wheels else 0.0
        pybullet.changeDynamics(
            loaded, link, lateralFriction=friction, spinningFriction=0, rollingFriction=0, restitution=0,
            linearDamping=0, angularDamping=0, jointDamping=0, physicsClientId=client,
        )
    if robot.urdf:
        _loosen(client, loaded, [joint for joint in moving.values() if joint not in wheels])
    group(client, loaded, ROBOT, FLOOR | TARGET | WALL)
    return RobotBody(client, loaded, wheels, body, robot.wheels.max_torque_nm)


def _load(client: int, robot: RobotModel, body: UrdfBody, at: Place) -> int:
    """Load the URDF through a file, because PyBullet reads only files."""
    place, turn = (at.x_m, at.y_m, 0.0), pybullet.getQuaternionFromEuler([0, 0, at.heading_rad])
    if body.foot is not None:
        place, turn = pybullet.multiplyTransforms(place, turn, *_as_bullet(body.foot.inverse()))
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", delete=False) as file:
        file.write(body.text)
    try:
        return int(pybullet.loadURDF(
            file.name, place, turn,
            flags=pybullet.URDF_USE_IMPLICIT_CYLINDER | pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client,
        ))
    except pybullet.error:
        raise ConfigError(f"{robot.urdf}: PyBullet cannot load it; check its links with `check_urdf`") from None
    finally:
        Path(file.name).unlink()


def _loosen(client: int, body: int, joints: list[int]) -> None:
    """Release the casters and levers of a URDF, because PyBullet brakes every joint by default. They are not drawn."""
    for joint in joints:
        pybullet.setJointMotorControl2(body, joint, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=client)
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        pybullet.changeVisualShape(body, link, rgbaColor=[0, 0, 0, 0], physicsClientId=client)


def _as_bullet(frame: Transform) -> tuple[Vector, tuple[float, float, float, float]]:
    """Return a level frame as position and quaternion."""
    return frame.at, pybullet.getQuaternionFromEuler([0, 0, frame.yaw_rad])


def group(client: int, body: int, own: int, meets: int) -> None:
    """Put all links of a body into a collision group."""
    links = pybullet.getNumJoints(body, physicsClientId=client)
    for link in range(-1, links):
        pybullet.setCollisionFilterGroupMask(body, link, own, meets, physicsClientId=client)


class RobotBody:
    """The robot's pose, speed and wheels in one client."""

    def __init__(self, client: int, body: int, wheels: list[int], drawn: UrdfBody, max_torque_nm: float) -> None:
        self.body = body
        self._client = client
        self._wheels, self._signs = wheels, drawn.signs
        self._torques = [max_torque_nm, max_torque_nm]
        self._driven: tuple[float, float] | None = None
        info = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        self._from_mass = pybullet.invertTransform(info[3], info[4])
        if drawn.foot is not None:
            self._from_mass = pybullet.multiplyTransforms(*self._from_mass, *_as_bullet(drawn.foot))

    def drive(self, left_rad_s: float, right_rad_s: float) -> None:
        """Set the target speeds of the wheel motors."""
        if self._driven == (left_rad_s, right_rad_s):
            return
        self._driven = (left_rad_s, right_rad_s)
        speeds = [speed * sign for speed, sign in zip(self._driven, self._signs, strict=True)]
        pybullet.setJointMotorControlArray(
            self.body, self._wheels, pybullet.VELOCITY_CONTROL, targetVelocities=speeds, forces=self._torques,
            physicsClientId=self._client,
        )

    def pass_through(self, others: Iterable[int]) -> None:
        """Let the robot and other bodies overlap. Masks are not enough: either body can still accept the contact."""
        for other in others:
            for link in range(-1, pybullet.getNumJoints(self.body, physicsClientId=self._client)):
                pybullet.setCollisionFilterPair(self.body, other, link, -1, 0, physicsClientId=self._client)

    def wheel_angles(self) -> tuple[float, float]:
        """Return the angle of each wheel, rad."""
        left, right = pybullet.getJointStates(self.body, self._wheels, physicsClientId=self._client)
        return float(left[0]) * self._signs[0], float(right[0]) * self._signs[1]

    def pose(self) -> tuple[Vector, Any]:
        """Return the axle midpoint on the floor and the orientation (quaternion x, y, z, w)."""
        place, turn = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)
        return pybullet.multiplyTransforms(place, turn, *self._from_mass)  # type: ignore[no-any-return]

    def velocity(self) -> tuple[Vector, Vector]:
        """Return (linear m/s, angular rad/s) in the world frame."""
        return pybullet.getBaseVelocity(self.body, physicsClientId=self._client)  # type: ignore[no-any-return]
