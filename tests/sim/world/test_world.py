"""The simulated world: odometry against truth, imperfect wheels, repeatability, lidar, contacts, pushes."""

import hashlib
import math

import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

from sightline.sim.robot import load_robot
from sightline.sim.scenario import OnPath, PathLeg, Start, Wall, load_scenario, scenario_names
from sightline.sim.world.world import STEP_US, World
from tests.fixtures.sim import RADIUS_M, TRACK_M, DeadReckoning, empty, robot_with, seen_at

pytestmark = pytest.mark.computes


def test_ten_metres_straight_odometry_errs_less_than_a_thousandth():
    with World(empty(), robot_with(), 3) as world:
        begin, odometry = world.truth(), DeadReckoning(world)
        odometry.drive(10, 10, 10 / (10 * RADIUS_M))
        odometry.drive(0, 0, 1)
        truth = world.truth()
        gone_m = math.hypot(truth.x_m - begin.x_m, truth.y_m - begin.y_m)
        assert gone_m == pytest.approx(10, rel=0.01)
        assert math.hypot(odometry.x_m - truth.x_m, odometry.y_m - truth.y_m) / gone_m < 0.001


@pytest.mark.parametrize("direction", [-1, 1])
def test_ten_turns_in_place_odometry_errs_less_than_two_thousandths(direction):
    with World(empty(), robot_with(), 3) as world:
        odometry = DeadReckoning(world)
        begin_rad = odometry.yaw_true_rad
        wheel_rad_s = direction * TRACK_M / RADIUS_M
        odometry.drive(-wheel_rad_s, wheel_rad_s, 10 * math.tau / 2)
        odometry.drive(0, 0, 1)
        turned_rad = odometry.yaw_true_rad - begin_rad
        assert turned_rad == pytest.approx(direction * 10 * math.tau, rel=0.01)
        assert odometry.yaw_rad - begin_rad == pytest.approx(turned_rad, rel=0.002)


@pytest.mark.parametrize("mismatch", [0.02, -0.02, 0.05])
def test_mismatched_wheels_show_the_predicted_error(mismatch):
    with World(empty(), robot_with(mismatch=mismatch), 3) as world:
        odometry = DeadReckoning(world)
        odometry.drive(10, 10, 10)
        odometry.drive(0, 0, 1)
        rolled_m = RADIUS_M * world.wheel_angles().left_rad
        predicted_rad = -mismatch * rolled_m / TRACK_M  # the larger left wheel bends the robot to the right
        assert odometry.yaw_true_rad - odometry.yaw_rad == pytest.approx(predicted_rad, rel=0.01)


def test_slip_loses_its_share_of_the_way():
    with World(empty(), robot_with(slip=0.1), 3) as world:
        begin, odometry = world.truth(), DeadReckoning(world)
        odometry.drive(10, 10, 20)
        truth, counted_m = world.truth(), world.wheel_angles().left_rad * RADIUS_M
        gone_m = math.hypot(truth.x_m - begin.x_m, truth.y_m - begin.y_m)
        assert 1 - gone_m / counted_m == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize("name", ["pushed", "walls"])
def test_a_run_repeats_bit_for_bit_and_only_with_its_seed(name):
    def run(seed: int) -> str:
        digest = hashlib.sha256()
        with World(load_scenario(name), robot_with(slip=0.05), seed) as world:
            for count in range(500):
                world.set_wheels(count % 7, 5 - count % 3)
                world.step()
                digest.update(repr((world.truth(), world.wheel_angles())).encode())
                if count % 100 == 0:
                    digest.update(world.render())
                    digest.update(world.scan().ranges_m.tobytes())
        return digest.hexdigest()

    first = run(5)
    assert run(5) == first
    assert run(6) != first


def test_worlds_in_one_process_do_not_touch_each_other():
    def angles(others: int) -> list[float]:
        worlds = [World(load_scenario("static"), robot_with(), 1) for _ in range(1 + others)]
        for count in range(100):
            worlds[0].set_wheels(4, 6)
            for world in worlds[: 1 + count % (1 + others)]:
                world.step()
        truth = worlds[0].truth()
        for world in worlds:
            world.close()
        return [truth.x_m, truth.y_m, truth.yaw_rad]

    assert angles(0) == angles(2)


def test_motors_latch():
    with World(empty(), robot_with(), 1) as world:
        world.set_wheels(8, 8)
        for _ in range(1000):
            world.step()
        assert world.now_us == 1000 * STEP_US
        assert world.truth().linear_mps == pytest.approx(8 * RADIUS_M, rel=0.01)


def test_stop_from_half_a_meter_per_second_matches_the_bound():
    with World(empty(), robot_with(), 1) as world:
        odometry = DeadReckoning(world)
        odometry.drive(0.5 / RADIUS_M, 0.5 / RADIUS_M, 2)
        before = world.truth()
        odometry.drive(0, 0, 1)
        after = world.truth()
        gone_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
        assert gone_m == pytest.approx(0.5**2 / 2 / 2.0 + 0.5 * 0.05, rel=0.1)  # v2 / 2a, and the motor's lag
        assert abs(after.linear_mps) < 0.001


SEEN = [name for name in scenario_names() if load_scenario(name).start.at_m is None]
ON_THE_MAP = [name for name in scenario_names() if name not in SEEN]


@pytest.mark.parametrize("name", ON_THE_MAP)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_run_starts_at_the_configured_place_and_rests(name, seed):
    scenario = load_scenario(name)
    start = scenario.start
    with World(scenario, load_robot(scenario.robot), seed) as world:
        truth = world.truth()
        assert max(abs(truth.x_m - start.at_m[0]), abs(truth.y_m - start.at_m[1])) <= start.jitter_m + 1e-6
        low, high = start.heading_deg
        assert low - 1e-6 <= math.degrees(truth.yaw_rad) <= high + 1e-6
        for _ in range(250):
            world.step()
        after = world.truth()
        assert math.hypot(after.x_m - truth.x_m, after.y_m - truth.y_m) < 1e-3
        assert after.contacts == 0


@pytest.mark.parametrize("name", SEEN)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_run_starts_as_configured_and_rests(name, seed):
    scenario = load_scenario(name)
    with World(scenario, load_robot(scenario.robot), seed) as world:
        truth = world.truth()
        low, high = scenario.start.distance_m
        assert low - 1e-6 <= truth.distance_m <= high + 1e-6
        assert abs(truth.distance_m - scenario.stand_off_m) > 0.075 or name != "static"
        low, high = scenario.start.bearing_deg
        assert low - 1e-6 <= math.degrees(truth.bearing_rad) % 360 - 360 * (low < 0 and truth.bearing_rad < 0) <= high
        assert truth.visible == (abs(truth.bearing_rad) < math.radians(40))
        for _ in range(250):
            world.step()
        after = world.truth()
        assert math.hypot(after.x_m - truth.x_m, after.y_m - truth.y_m) < 1e-3
        assert after.contacts == 0


def test_lidar_sees_a_wall_at_its_distance_and_not_the_robot():
    wall = Wall(start_m=(-20.0, -20.0), end_m=(20.0, -20.0), thickness_m=0.1)
    scenario = empty().model_copy(update={"walls": (wall,)})
    with World(scenario, robot_with(), 3) as world:
        truth, lidar = world.truth(), world.robot.lidar
        sensor_y_m = truth.y_m + lidar.x_m * math.sin(truth.yaw_rad)
        gap_m = sensor_y_m + 19.95
        assert world.scan().ranges_m.count(math.inf) == lidar.rays  # out of range
        near = scenario.model_copy(update={"walls": (wall.model_copy(update={
            "start_m": (-99.0, sensor_y_m - 2.05), "end_m": (99.0, sensor_y_m - 2.05)}),)})
    assert gap_m > lidar.range_max_m
    with World(near, robot_with(), 3) as world:
        scan = world.scan()
        seen = 0
        for index, range_m in enumerate(scan.ranges_m):
            down = -math.sin(scan.angle_min_rad + index * scan.angle_increment_rad + truth.yaw_rad)
            expected_m = 2.0 / down if down > 0.01 else math.inf
            if expected_m < lidar.range_max_m * 0.999:
                assert range_m == pytest.approx(expected_m, rel=1e-3)
                seen += 1
            elif expected_m > lidar.range_max_m * 1.001:
                assert range_m == math.inf
        assert seen > lidar.rays / 4


def test_lidar_sees_the_ball_where_it_is():
    with World(seen_at(1.0, 35.0), robot_with(), 1) as world:
        scan, truth = world.scan(), world.truth()
        index = min(range(360), key=lambda each: scan.ranges_m[each])
        assert scan.angle_min_rad + index * scan.angle_increment_rad == pytest.approx(truth.bearing_rad, abs=0.02)
        edge_m = math.sqrt(0.10**2 - (truth.target_z_m - world.robot.lidar.z_m) ** 2)
        assert scan.ranges_m[index] == pytest.approx(1.0 - edge_m, abs=0.002)


def test_driving_into_the_ball_is_charged_to_the_robot():
    with World(seen_at(0.4, 0.0), robot_with(), 1) as world:
        world.set_wheels(8, 8)
        for _ in range(500):
            world.step()
        truth = world.truth()
        assert truth.target_contacts > 0
        assert truth.target_contacts_by_robot > 0
        assert truth.wall_contacts == 0


def test_a_ball_that_comes_is_not_charged_to_a_robot_that_stands():
    circle = load_scenario("circle")
    on_its_way = math.degrees(0.5 / 2 / 1.2)  # half the arc that a chord of 0.5 m cuts off
    into_its_way = Start(distance_m=(0.5, 0.5), bearing_deg=(0.0, 0.0), approach_deg=(on_its_way, on_its_way))
    with World(circle.model_copy(update={"start": into_its_way}), robot_with(), 1) as world:
        before = world.truth()
        for _ in range(1000):
            world.step()
        after = world.truth()
    assert after.target_contacts > 100
    assert after.target_contacts_by_robot == 0
    assert math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) < 1e-3, "it must not push the robot"
    assert abs(after.yaw_rad - before.yaw_rad) < 1e-3


def test_walker_that_comes_counts_as_a_contact_and_does_not_push_the_robot():
    scenario = seen_at(3.0, 180.0)
    with World(scenario, robot_with(), 1) as world:
        at = world.truth()
    legs = {"shape": "legs", "radius_m": 0.055, "height_m": 0.42, "speed_mps": 0.5, "phase": (0.0, 0.0)}
    around = (PathLeg(length_m=math.tau, turn_deg=360.0),)
    walker = OnPath(kind="path", start_m=(at.x_m - 1.0, at.y_m + 1.0), heading_deg=-90.0, path=around, **legs)
    with World(scenario.model_copy(update={"things": (walker,)}), robot_with(), 1) as world:
        for _ in range(1500):
            world.step()
        after = world.truth()
    assert after.wall_contacts > 50 and after.target_contacts == 0
    assert math.hypot(after.x_m - at.x_m, after.y_m - at.y_m) < 1e-3


@pytest.mark.parametrize(("ahead_m", "passes"), [(0.5, 1), (-0.5, 0), (1.5, 0)])
def test_thing_on_a_path_passes_where_it_goes_through_between_lens_and_target(ahead_m, passes):
    scenario = seen_at(1.0, 0.0)
    with World(scenario, robot_with(), 1) as world:
        at = world.truth()
    cos, sin = math.cos(at.yaw_rad), math.sin(at.yaw_rad)
    lens_x_m, lens_y_m = at.target_x_m - cos, at.target_y_m - sin
    begin_m = (lens_x_m + ahead_m * cos + sin, lens_y_m + ahead_m * sin - cos)  # 1 m to the right
    across = (PathLeg(length_m=4.0), PathLeg(length_m=math.pi, turn_deg=180.0)) * 2
    walker = OnPath(kind="path", radius_m=0.05, start_m=begin_m, heading_deg=math.degrees(at.yaw_rad) + 90.0,
                    path=across, speed_mps=0.5, phase=(0.0, 0.0))
    with World(scenario.model_copy(update={"things": (walker,)}), robot_with(), 1) as world:
        counts = []
        for _ in range(900):
            world.step()
            counts.append(world.truth().passes if len(counts) % 50 == 0 else -1)
        assert world.truth().passes == passes
        assert counts[400] == 0, "not before it is there"


def test_driving_into_a_wall_counts_and_a_wall_hides_the_ball():
    scenario = seen_at(1.0, 0.0)
    with World(scenario, robot_with(), 1) as world:
        truth = world.truth()
    middle = ((truth.x_m + truth.target_x_m) / 2, (truth.y_m + truth.target_y_m) / 2)
    across = truth.yaw_rad + math.pi / 2
    ends = [(middle[0] + s * math.cos(across) / 2, middle[1] + s * math.sin(across) / 2) for s in (-1, 1)]
    walled = scenario.model_copy(update={"walls": (Wall(start_m=ends[0], end_m=ends[1]),)})
    with World(walled, robot_with(), 1) as world:
        assert not world.truth().visible
        world.set_wheels(8, 8)
        for _ in range(500):
            world.step()
        assert world.truth().wall_contacts > 0
        assert world.truth().target_contacts == 0


@pytest.mark.parametrize("seed", range(4))
def test_a_pushed_ball_rolls_about_and_stays_in_its_arena(seed):
    scenario = seen_at(20.0, 180.0, "pushed")
    with World(scenario, robot_with(), seed) as world:
        fastest_mps, before = 0.0, world.truth()
        for _ in range(30):
            for _ in range(250):
                world.step()
            now = world.truth()
            fastest_mps = max(fastest_mps, math.hypot(now.target_x_m - before.target_x_m,
                                                      now.target_y_m - before.target_y_m))
            assert math.hypot(now.target_x_m, now.target_y_m) < 2.5
            assert now.target_z_m == pytest.approx(0.10, abs=0.002)
            before = now
        assert 0.05 < fastest_mps < 0.5


def test_a_target_on_a_path_keeps_its_speed():
    with World(load_scenario("circle"), robot_with(), 1) as world:
        before = world.truth()
        for _ in range(250):
            world.step()
        after = world.truth()
        gone_m = math.hypot(after.target_x_m - before.target_x_m, after.target_y_m - before.target_y_m)
        assert gone_m == pytest.approx(0.25, rel=0.01)


def test_close_twice():
    world = World(load_scenario("static"), robot_with(), 1)
    world.close()
    world.close()
