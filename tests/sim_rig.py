"""Rigs for tests of the simulated world: a scenario and robot as wanted, and dead reckoning as a robot does it."""

import math

from sightline.sim.look import look_named
from sightline.sim.robot import RobotModel, load_robot
from sightline.sim.scenario import Scenario, Start, load_scenario
from sightline.sim.world.world import World

RADIUS_M, TRACK_M = 0.035, 0.174


def robot_with(**wheels) -> RobotModel:
    """The Raspberry robot with other wheels."""
    robot = load_robot("raspberry")
    return robot.model_copy(update={"wheels": robot.wheels.model_copy(update=wheels)})


def seen_at(distance_m: float, bearing_deg: float, name: str = "static", look: str = "clean") -> Scenario:
    """A scenario in which the robot begins exactly so."""
    start = Start(
        distance_m=(distance_m, distance_m), bearing_deg=(bearing_deg, bearing_deg), approach_deg=(30.0, 30.0)
    )
    return load_scenario(name).model_copy(update={"start": start, "look": look_named(look)})


def empty() -> Scenario:
    """Nothing within 50 m: the ball is far behind."""
    return seen_at(50.0, 180.0)


class DeadReckoning:
    """Pose from encoder angles at 50 Hz, as the robot's side has it; `yaw_true_rad` unwraps the world's yaw."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._angles = world.wheel_angles()
        truth = world.truth()
        self.x_m, self.y_m, self.yaw_rad = truth.x_m, truth.y_m, truth.yaw_rad
        self.yaw_true_rad = truth.yaw_rad

    def drive(self, left_rad_s: float, right_rad_s: float, seconds: float) -> None:
        """Give speeds and integrate for that long."""
        self._world.set_wheels(left_rad_s, right_rad_s)
        for _ in range(round(seconds * 50)):
            for _ in range(5):
                self._world.step()
            self._integrate()

    def _integrate(self) -> None:
        angles = self._world.wheel_angles()
        left_m = (angles.left_rad - self._angles.left_rad) * RADIUS_M
        right_m = (angles.right_rad - self._angles.right_rad) * RADIUS_M
        self._angles = angles
        middle_rad = self.yaw_rad + (right_m - left_m) / TRACK_M / 2
        self.x_m += (left_m + right_m) / 2 * math.cos(middle_rad)
        self.y_m += (left_m + right_m) / 2 * math.sin(middle_rad)
        self.yaw_rad += (right_m - left_m) / TRACK_M
        self.yaw_true_rad += math.remainder(self._world.truth().yaw_rad - self.yaw_true_rad, math.tau)
