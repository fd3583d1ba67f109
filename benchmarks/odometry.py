"""Odometry against the simulated world's truth: straight, turning, and with unequal wheels. Shell (PyBullet).

Each robot drives at two thirds of its motors' speed, as its own robot.toml would count its wheels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sightline.protocol.messages import Twist
from sightline.robot_side.kinematics import DiffDriveConfig, Odometer, wheel_speeds
from sightline.sim.robot import RobotModel, load_robot, robot_names
from sightline.sim.scenario import Start, load_scenario
from sightline.sim.world.world import STEP_US, World

_TICK_STEPS = 5  # 50 Hz, as the driver reads its encoders
_SHARE = 2 / 3
_WAY_M, _TURNS = 10.0, 10


@dataclass(frozen=True, slots=True)
class OdometryError:
    """One drive: error in percent of the way or angle; for unequal wheels, of the error that theory predicts."""

    name: str
    percent: float
    bound_percent: float


def measure_odometry(robots: Sequence[str] = ()) -> list[OdometryError]:
    """Ten metres straight, ten turns in place, and the heading error of a 2 % mismatch over ten metres, of each robot.

    `robots` are names or .toml files; none: all that come with Sightline.
    """
    return [error for name in robots or robot_names() for error in _errors(load_robot(name))]


def _errors(robot: RobotModel) -> list[OdometryError]:
    rim_mps = _SHARE * robot.wheels.max_rad_s * robot.wheels.radius_m
    ahead = Twist(linear_mps=rim_mps, angular_rad_s=0.0)
    turn = Twist(linear_mps=0.0, angular_rad_s=2 * rim_mps / robot.wheels.track_m)
    way_m, miss_m, _, _ = _drive(robot, ahead, _WAY_M / rim_mps)
    _, _, turned_rad, wrong_rad = _drive(robot, turn, _TURNS * math.tau / turn.angular_rad_s)
    mismatch = 0.02
    way, _, _, bent_rad = _drive(_with_mismatch(robot, mismatch), ahead, _WAY_M / rim_mps)
    # The left wheel drives mismatch x way further than the right one, across the track width.
    predicted_rad = mismatch * way / robot.wheels.track_m
    return [
        OdometryError(f"{robot.name}: 10 m straight", 100 * miss_m / way_m, 0.1),
        OdometryError(f"{robot.name}: ten turns in place", 100 * wrong_rad / turned_rad, 0.2),
        OdometryError(f"{robot.name}: 2 % mismatch, off the prediction", 100 * abs(bent_rad / predicted_rad - 1), 1.0),
    ]


def _with_mismatch(robot: RobotModel, mismatch: float) -> RobotModel:
    return robot.model_copy(update={"wheels": robot.wheels.model_copy(update={"mismatch": mismatch})})


def _wheels_of(robot: RobotModel) -> DiffDriveConfig:
    """As its robot.toml has them, with all of its motors' speed."""
    wheels = robot.wheels
    return DiffDriveConfig(
        wheel_radius_m=wheels.radius_m, track_width_m=wheels.track_m, max_wheel_rad_s=wheels.max_rad_s
    )


def _drive(robot: RobotModel, twist: Twist, seconds: float) -> tuple[float, float, float, float]:
    """(way, error of position, angle turned, error of heading): metres and radians, of truth."""
    far = Start(distance_m=(50.0, 50.0), bearing_deg=(180.0, 180.0), approach_deg=(0.0, 0.0))
    scenario = load_scenario("static").model_copy(update={"start": far})
    drive = _wheels_of(robot)
    odometer, way_m, turned_rad = Odometer(drive), 0.0, 0.0
    with World(scenario, robot, 1) as world:
        begin = before = world.truth()
        world.set_wheels(*wheel_speeds(drive, twist))
        for _ in range(round(seconds * 1e6 / STEP_US / _TICK_STEPS)):
            odometer.update(world.wheel_angles())
            for _ in range(_TICK_STEPS):
                world.step()
            now = world.truth()
            way_m += math.hypot(now.x_m - before.x_m, now.y_m - before.y_m)
            turned_rad += math.remainder(now.yaw_rad - before.yaw_rad, math.tau)
            before = now
        odometer.update(world.wheel_angles())
    x_m, y_m, yaw_rad = odometer.pose
    cos, sin = math.cos(begin.yaw_rad), math.sin(begin.yaw_rad)
    miss_m = math.hypot(begin.x_m + x_m * cos - y_m * sin - before.x_m, begin.y_m + x_m * sin + y_m * cos - before.y_m)
    wrong_rad = abs(math.remainder(begin.yaw_rad + yaw_rad - before.yaw_rad, math.tau))
    return way_m, miss_m, abs(turned_rad), wrong_rad
