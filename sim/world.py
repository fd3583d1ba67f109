"""The simulated world: robot, ball, walls, one clock. Shell (PyBullet); reads no clock of its own.

Bit for bit the same for the same scenario, robot, seed and calls. Lockstep steps it; the real-time service steps it
against deadlines.
"""

import math
from types import TracebackType
from typing import Any, Self

import numpy as np

from robot_side.ports import Ranges, WheelAngles
from sim.camera import Defects, SceneCamera
from sim.engine import pybullet
from sim.lidar import Lidar
from sim.motors import Motor
from sim.path import Place
from sim.physics import WALL, RobotBody, Vector, add_ball, add_floor, add_robot, add_wall, open_client
from sim.robot_model import RobotModel
from sim.scenario import Scenario, Start
from sim.target import begin
from sim.truth import Truth

STEP_US = 4000
"""250 Hz: every time in the world is a whole number of these."""
STANDING_MPS = 0.01  # a robot slower than this touches nothing by its own doing


class World:
    """One run of a scenario."""

    def __init__(self, scenario: Scenario, robot: RobotModel, seed: int) -> None:
        self.scenario, self.robot, self.seed = scenario, robot, seed
        self.walls = scenario.walls
        self.camera_model = robot.camera.camera_model()
        self.now_us = 0
        self._client = client = open_client(STEP_US)
        self._mover, ball_at = begin(client, scenario.target, seed)
        self._add_bodies(ball_at)
        self._motors = [Motor(robot.wheels, STEP_US / 1e6, f"{seed} {side}") for side in ("left", "right")]
        self._scene = SceneCamera(client, self.camera_model, scenario.walls, seed)
        self._defects = Defects(scenario.look, robot.camera.width_px, robot.camera.height_px, seed)
        self._lidar = Lidar(client, robot.lidar, seed)
        self._target_velocity: Vector = (0.0, 0.0, 0.0)
        self._wall_contacts = self._target_contacts = self._target_contacts_by_robot = 0

    def _add_bodies(self, ball_at: Place) -> None:
        client, scenario, robot = self._client, self.scenario, self.robot
        self._floor = add_floor(client)
        for wall in scenario.walls:
            add_wall(client, wall)
        self._ball_at: Vector = (ball_at.x_m, ball_at.y_m, scenario.target.radius_m)
        self._ball = add_ball(client, scenario.target, self._ball_at)
        at = robot_start(scenario.start, ball_at, robot.camera.x_m, self.seed)
        body = add_robot(client, robot, (at.x_m, at.y_m, 0.0), at.heading_rad)
        self._body = RobotBody(client, body, robot.wheels.max_torque_nm)

    def set_wheels(self, left_rad_s: float, right_rad_s: float) -> None:
        """Give wheel speeds, forward positive; they hold until others are given. Raises ValueError unless finite."""
        self._motors[0].set(left_rad_s)
        self._motors[1].set(right_rad_s)

    def step(self) -> None:
        """Advance by `STEP_US`."""
        self._mover.move(self._ball, self.now_us + STEP_US)
        self._body.drive(self._motors[0].step(), self._motors[1].step())
        pybullet.stepSimulation(physicsClientId=self._client)
        self.now_us += STEP_US
        for motor, angle_rad in zip(self._motors, self._body.wheel_angles(), strict=True):
            motor.rolled(angle_rad)
        self._follow_ball()
        self._count_contacts()

    def _follow_ball(self) -> None:
        before = self._ball_at
        self._ball_at, _ = pybullet.getBasePositionAndOrientation(self._ball, physicsClientId=self._client)
        rate = 1e6 / STEP_US
        x, y, z = ((now - then) * rate for now, then in zip(self._ball_at, before, strict=True))
        self._target_velocity = (x, y, z)

    def _count_contacts(self) -> None:
        touched = {
            point[2]
            for point in pybullet.getContactPoints(self._body.body, physicsClientId=self._client)
            if point[8] <= 0
        } - {self._floor, self._body.body}
        self._wall_contacts += bool(touched - {self._ball})
        if self._ball in touched:
            self._target_contacts += 1
            self._target_contacts_by_robot += self._is_robots_doing()

    def _is_robots_doing(self) -> bool:
        """Whether the robot moves towards the ball faster than the ball towards the robot."""
        (x_m, y_m, _), _ = self._body.pose()
        ahead_x_m, ahead_y_m = self._ball_at[0] - x_m, self._ball_at[1] - y_m
        gap_m = math.hypot(ahead_x_m, ahead_y_m)
        mine, _ = self._body.velocity()
        other = self._target_velocity
        mine_mps = (mine[0] * ahead_x_m + mine[1] * ahead_y_m) / gap_m
        other_mps = -(other[0] * ahead_x_m + other[1] * ahead_y_m) / gap_m
        return mine_mps > max(other_mps, STANDING_MPS)

    def wheel_angles(self) -> WheelAngles:
        """What the encoders count."""
        return WheelAngles(self._motors[0].angle_rad, self._motors[1].angle_rad, self.now_us)

    def wheels_turned(self) -> tuple[float, float]:
        """How far each wheel has rolled over the floor, rad; not quantised, for logs."""
        return self._body.wheel_angles()

    def scan(self) -> Ranges:
        """What the lidar sees now."""
        lidar = self.robot.lidar
        place, turn = self._mounted(lidar.x_m, lidar.z_m)
        return self._lidar.scan(place, _yaw(turn), self.now_us)

    def render(self, quality_percent: int = 100, scale_percent: int = 100) -> bytes:
        """What the camera sees now, as JPEG; shares of the look's quality and of the side lengths."""
        camera = self.robot.camera
        picture = self._scene.draw(*self._mounted(camera.x_m, camera.z_m))
        return self._defects.jpeg(picture, quality_percent, scale_percent)

    def _mounted(self, x_m: float, z_m: float) -> tuple[Vector, Any]:
        """Position and orientation of something mounted on the robot."""
        return pybullet.multiplyTransforms(*self._body.pose(), (x_m, 0, z_m), (0, 0, 0, 1))  # type: ignore[no-any-return]

    def truth(self) -> Truth:
        """What is really so now."""
        place, turn = self._body.pose()
        yaw_rad = _yaw(turn)
        linear, angular = self._body.velocity()
        lens, _ = self._mounted(self.robot.camera.x_m, self.robot.camera.z_m)
        x_m, y_m = self._ball_at[0] - lens[0], self._ball_at[1] - lens[1]
        bearing_rad = math.remainder(math.atan2(y_m, x_m) - yaw_rad, math.tau)
        return Truth(
            t_us=self.now_us, x_m=place[0], y_m=place[1], yaw_rad=yaw_rad,
            linear_mps=linear[0] * math.cos(yaw_rad) + linear[1] * math.sin(yaw_rad), angular_rad_s=angular[2],
            target_x_m=self._ball_at[0], target_y_m=self._ball_at[1], target_z_m=self._ball_at[2],
            bearing_rad=bearing_rad, distance_m=math.hypot(x_m, y_m), visible=self._sees(lens, bearing_rad),
            wall_contacts=self._wall_contacts, target_contacts=self._target_contacts,
            target_contacts_by_robot=self._target_contacts_by_robot,
        )

    def _sees(self, lens: Vector, bearing_rad: float) -> bool:
        if abs(bearing_rad) > math.radians(self.robot.camera.hfov_deg) / 2:
            return False
        hit = pybullet.rayTest(lens, self._ball_at, collisionFilterMask=WALL, physicsClientId=self._client)[0]
        return bool(hit[0] < 0)

    def close(self) -> None:
        """Free PyBullet's memory; idempotent."""
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _yaw(turn: Any) -> float:
    return float(pybullet.getEulerFromQuaternion(turn)[2])


def robot_start(start: Start, ball: Place, lens_x_m: float, seed: int) -> Place:
    """Where the axle's midpoint begins, so that the lens sees the ball as `start` says."""
    draw = np.random.default_rng([seed, 2])
    distance_m = float(draw.uniform(*start.distance_m))
    bearing_rad = math.radians(draw.uniform(*start.bearing_deg))
    from_ball_rad = ball.heading_rad + math.radians(draw.uniform(*start.approach_deg))
    yaw_rad = math.remainder(from_ball_rad + math.pi - bearing_rad, math.tau)
    return Place(
        ball.x_m + distance_m * math.cos(from_ball_rad) - lens_x_m * math.cos(yaw_rad),
        ball.y_m + distance_m * math.sin(from_ball_rad) - lens_x_m * math.sin(yaw_rad),
        yaw_rad,
    )
