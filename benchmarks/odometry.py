"""Odometry against the simulated world's truth: straight, turning, and with unequal wheels. Shell (PyBullet)."""

import math
from dataclasses import dataclass

from protocol.messages import Twist
from robot_side.kinematics import DiffDriveConfig, Odometer, wheel_speeds
from sim.robot_model import RobotModel, load_robot
from sim.scenario import Start, load_scenario
from sim.world import STEP_US, World

_TICK_STEPS = 5  # 50 Hz, as the driver reads its encoders
DRIVE = DiffDriveConfig()


@dataclass(frozen=True, slots=True)
class OdometryError:
    """One drive: error in percent of the way or angle; for unequal wheels, of the error that theory predicts."""

    name: str
    percent: float
    bound_percent: float


def measure_odometry() -> list[OdometryError]:
    """Ten metres straight, ten turns in place, and the heading error of a 2 % mismatch over ten metres."""
    way_m, miss_m, _, _ = _drive(load_robot("raspberry"), Twist(linear_mps=0.35, angular_rad_s=0.0), 10 / 0.35)
    turn = Twist(linear_mps=0.0, angular_rad_s=2.0)
    _, _, turned_rad, wrong_rad = _drive(load_robot("raspberry"), turn, 10 * math.tau / 2.0)
    mismatch = 0.02
    ahead = Twist(linear_mps=0.35, angular_rad_s=0.0)
    way, _, _, bent_rad = _drive(_with_mismatch(mismatch), ahead, 10 / 0.35)
    # The left wheel drives mismatch x way further than the right one, across the track width.
    predicted_rad = mismatch * way / DRIVE.track_width_m
    return [
        OdometryError("10 m straight", 100 * miss_m / way_m, 0.1),
        OdometryError("ten turns in place", 100 * wrong_rad / turned_rad, 0.2),
        OdometryError("2 % mismatch, off the prediction", 100 * abs(bent_rad / predicted_rad - 1), 1.0),
    ]


def _with_mismatch(mismatch: float) -> RobotModel:
    robot = load_robot("raspberry")
    return robot.model_copy(update={"wheels": robot.wheels.model_copy(update={"mismatch": mismatch})})


def _drive(robot: RobotModel, twist: Twist, seconds: float) -> tuple[float, float, float, float]:
    """(way, error of position, angle turned, error of heading): metres and radians, of truth."""
    far = Start(distance_m=(50.0, 50.0), bearing_deg=(180.0, 180.0), approach_deg=(0.0, 0.0))
    scenario = load_scenario("static").model_copy(update={"start": far})
    odometer, way_m, turned_rad = Odometer(DRIVE), 0.0, 0.0
    with World(scenario, robot, 1) as world:
        begin = before = world.truth()
        world.set_wheels(*wheel_speeds(DRIVE, twist))
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
