"""Odometry against the simulated world's truth: straight, turning, and with unequal wheels.

Each robot drives at two thirds of its motors' speed, as its own robot.toml would count its wheels.
"""

import math

import pytest

from sightline.protocol.messages import Twist
from sightline.robot_side.kinematics import DiffDriveConfig, Odometer, wheel_speeds
from sightline.sim.robot import load_robot
from sightline.sim.scenario import Start, load_scenario
from sightline.sim.world.world import STEP_US, World
from tests.fixtures.sim import robot_names

pytestmark = pytest.mark.computes

TICK_STEPS = 5  # 50 Hz, as the driver reads its encoders
SHARE = 2 / 3
WAY_M, TURNS = 10.0, 10


@pytest.fixture(params=robot_names())
def robot(request):
    return load_robot(request.param)


def rim_mps(robot):
    return SHARE * robot.wheels.max_rad_s * robot.wheels.radius_m


def ahead(robot):
    return Twist(linear_mps=rim_mps(robot), angular_rad_s=0.0)


def test_ten_meters_straight_end_where_odometry_shows_them(robot):
    way_m, miss_m, _, _ = drive(robot, ahead(robot), WAY_M / rim_mps(robot))
    assert miss_m <= 0.001 * way_m


def test_ten_turns_in_place_are_counted_as_ten(robot):
    turn = Twist(linear_mps=0.0, angular_rad_s=2 * rim_mps(robot) / robot.wheels.track_m)
    _, _, turned_rad, wrong_rad = drive(robot, turn, TURNS * math.tau / turn.angular_rad_s)
    assert wrong_rad <= 0.002 * turned_rad


def test_unequal_wheels_bend_the_path_as_theory_predicts(robot):
    """The left wheel drives mismatch x way further than the right one, across the track width."""
    mismatch = 0.02
    way_m, _, _, bent_rad = drive(with_mismatch(robot, mismatch), ahead(robot), WAY_M / rim_mps(robot))
    assert bent_rad == pytest.approx(mismatch * way_m / robot.wheels.track_m, rel=0.01)


def with_mismatch(robot, mismatch):
    return robot.model_copy(update={"wheels": robot.wheels.model_copy(update={"mismatch": mismatch})})


def wheels_of(robot):
    """Return the limits of its robot.toml, with the full speed of its motors."""
    wheels = robot.wheels
    return DiffDriveConfig(
        wheel_radius_m=wheels.radius_m, track_width_m=wheels.track_m, max_wheel_rad_s=wheels.max_rad_s
    )


def drive(robot, twist, seconds):
    """(way, error of position, angle turned, error of heading): metres and radians, of truth."""
    far = Start(distance_m=(50.0, 50.0), bearing_deg=(180.0, 180.0), approach_deg=(0.0, 0.0))
    scenario = load_scenario("static").model_copy(update={"start": far})
    wheels = wheels_of(robot)
    odometer, way_m, turned_rad = Odometer(wheels), 0.0, 0.0
    with World(scenario, robot, 1) as world:
        begin = before = world.truth()
        world.set_wheels(*wheel_speeds(wheels, twist))
        for _ in range(round(seconds * 1e6 / STEP_US / TICK_STEPS)):
            odometer.update(world.wheel_angles())
            for _ in range(TICK_STEPS):
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
