"""The shipped robots in the simulated world: odometry against truth, guards against walls; none sees itself."""

import math
from itertools import product

import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

import numpy as np
import simplejpeg

from sightline.evaluation.scenario_config import robot_config
from sightline.protocol.messages import Twist
from sightline.robot_side.kinematics import Odometer, wheel_speeds
from sightline.robot_side.safety.guard import RangeGuard
from sightline.sim.robot import load_robot
from sightline.sim.scenario import Start, Wall, load_scenario
from sightline.sim.world.world import World
from tests.fixtures.sim import empty, robot_names

pytestmark = pytest.mark.computes

ROBOTS = [name for name in robot_names() if name != "chaser-small"]  # it differs in nothing that these tests look at


def alone(*walls: Wall):
    """A world with nothing in it but walls, the robot at the origin, looking along x."""
    nothing = {"things": (), "goals_m": (), "walls": walls, "start": Start(at_m=(0.0, 0.0))}
    return load_scenario("thymio").model_copy(update=nothing)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("curve", [(1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.7, 0.3)])
def test_odometry_by_the_robots_own_configuration_agrees_with_truth(name, curve):
    model = load_robot(name)
    drive = robot_config(model).wheels
    rim_mps = 0.5 * drive.max_wheel_rad_s * drive.wheel_radius_m
    twist = Twist(linear_mps=curve[0] * rim_mps, angular_rad_s=curve[1] * 2 * rim_mps / drive.track_width_m)
    odometer, turned_rad, way_m = Odometer(drive), 0.0, 0.0
    with World(alone(), model, 4) as world:
        before = world.truth()
        world.set_wheels(*wheel_speeds(drive, twist))
        for _ in range(300):
            odometer.update(world.wheel_angles())
            for _ in range(5):
                world.step()
            now = world.truth()
            turned_rad += math.remainder(now.yaw_rad - before.yaw_rad, math.tau)
            way_m += math.hypot(now.x_m - before.x_m, now.y_m - before.y_m)
            before = now
        odometer.update(world.wheel_angles())
    x_m, y_m, yaw_rad = odometer.pose
    slack_m = 0.002 * abs(turned_rad) * model.wheels.track_m + 1e-3
    assert math.hypot(x_m - now.x_m, y_m - now.y_m) <= 0.001 * way_m + slack_m
    assert abs(math.remainder(yaw_rad - now.yaw_rad, math.tau)) <= 0.002 * abs(turned_rad) + 2e-3
    assert way_m > 0.5 or abs(turned_rad) > 1.0, "it did drive"


@pytest.mark.parametrize(("name", "aside_deg"), [
    (name, aside_deg) for name, aside_deg in product(ROBOTS, (0.0, 30.0))
    if not (name == "gazebo-raspi" and aside_deg)  # its five rays look straight ahead only
])  # fmt: skip
def test_the_guard_stops_every_robot_before_a_wall(name, aside_deg):
    model, wall = load_robot(name), Wall(start_m=(1.5, -3.0), end_m=(1.5, 3.0))
    config = robot_config(model)
    world_of = alone(wall).model_copy(update={"start": Start(at_m=(0.0, 0.0), heading_deg=(aside_deg, aside_deg))})
    guard, applied = RangeGuard(config.guard), Twist(linear_mps=0.0, angular_rad_s=0.0)
    step_mps = config.safety.max_acceleration_mps2 * 0.02
    with World(world_of, model, 1) as world:
        for tick in range(700):
            if tick % round(50 / model.lidar.rate_hz) == 0:
                guard.see(world.scan())
            asked = min(config.safety.max_linear_mps, applied.linear_mps + step_mps)
            applied = guard.limit(Twist(linear_mps=asked, angular_rad_s=0.0), world.now_us)
            world.set_wheels(*wheel_speeds(config.wheels, applied))
            for _ in range(5):
                world.step()
        truth = world.truth()
    assert truth.wall_contacts == 0
    assert abs(truth.linear_mps) < 0.03, "it came to rest"
    assert truth.x_m > 0.5, "it did drive up to the wall"


@pytest.mark.parametrize("name", ROBOTS)
def test_no_robot_sees_itself(name):
    model = load_robot(name)
    with World(empty(), model, 1) as world:
        seen = simplejpeg.decode_jpeg(world.render(), "RGB").astype(int)
        bare = [world._scene._mask.sum()]
    assert bare == [0], "only the floor and the sky"
    assert np.abs(seen[0, 0] - (196, 199, 204)).max() < 12, "the sky at the top"


@pytest.mark.parametrize(("name", "rays", "least_deg", "most_deg"), [
    ("raspberry", 360, -180.0, 179.0), ("gazebo-raspi", 5, -2.0, 2.0), ("chaser", 360, -90.0, 90.0),
    ("thymio", 120, -180.0, 177.0),
])
def test_scans_span_the_arc_that_the_robot_has(name, rays, least_deg, most_deg):
    model = load_robot(name)
    with World(alone(Wall(start_m=(1.0, -9.0), end_m=(1.0, 9.0))), model, 1) as world:
        scan = world.scan()
    assert len(scan.ranges_m) == rays
    assert math.degrees(scan.angle_min_rad) == pytest.approx(least_deg)
    last_rad = scan.angle_min_rad + (rays - 1) * scan.angle_increment_rad
    assert math.degrees(last_rad) == pytest.approx(most_deg)


GAPS_M = {"raspberry": 0.3, "gazebo-raspi": 0.3, "chaser": 0.9, "thymio": 0.2}


@pytest.mark.parametrize(("name", "gap_m"), GAPS_M.items())
def test_a_wall_ahead_is_as_far_as_it_is(name, gap_m):
    model = load_robot(name)
    face_m = model.lidar.x_m + gap_m
    wall = Wall(start_m=(face_m + 0.05, -3.0), end_m=(face_m + 0.05, 3.0), thickness_m=0.1)
    with World(alone(wall), model, 1) as world:
        scan = world.scan()
    hits = [(scan.angle_min_rad + index * scan.angle_increment_rad, away_m)
            for index, away_m in enumerate(scan.ranges_m) if away_m < math.inf]
    assert len(hits) >= 3
    half_step_rad = scan.angle_increment_rad / 2
    for angle_rad, away_m in hits:  # a merged echo lies up to half a ray beside the ray that it is put in
        near, far = (gap_m / math.cos(abs(angle_rad) + side * half_step_rad) for side in (-1, 1))
        assert near - 0.035 <= away_m <= far + 0.035


def test_small_sensors_beside_see_what_is_beside_and_what_is_between_is_inf():
    thymio = load_robot("thymio")
    wall = Wall(start_m=(-3.0, 0.25), end_m=(3.0, 0.25), thickness_m=0.1)
    with World(alone(wall), thymio, 1) as world:
        scan = world.scan()
    seen_deg = [math.degrees(scan.angle_min_rad + index * scan.angle_increment_rad)
                for index, away_m in enumerate(scan.ranges_m) if away_m < math.inf]
    assert seen_deg, "the left one sees the wall"
    assert all(0 < angle < 180 for angle in seen_deg)
    beside = min(away_m for away_m in scan.ranges_m)
    assert beside == pytest.approx(0.20, abs=0.01)
    assert len(seen_deg) < 30, "of 120 rays, most are between"


@pytest.mark.parametrize("name", [name for name in robot_names() if name != "chaser-small"])  # extends one itself
def test_a_robot_of_ones_own_extends_any_that_comes_along(name, tmp_path):
    """Also one with a urdf, which lies beside the one that is extended."""
    mine = tmp_path / "mine.toml"
    mine.write_text(f'extends = "{name}"\n[camera]\nfps = 15\n')
    model, base = load_robot(str(mine)), load_robot(name)
    assert model.camera.fps == 15 and model.wheels == base.wheels and model.urdf == base.urdf
