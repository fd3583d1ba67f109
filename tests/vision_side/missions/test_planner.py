"""The parts of `goto`: poses between frames, echoes, the memory of the floor, the plan, the brakes, the patience."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.missions.goto import Footprint, ProgressChecker, ProgressCheckerConfig, braking_mps, clear_of
from sightline.vision_side.missions.planner import CELL_M, HORIZON_M, Costmap, Planner, cells_of
from sightline.vision_side.missions.port import RangeScan, View
from sightline.vision_side.missions.ranges import PoseMemory, about_robot, echoes, in_odometry
from tests.fixtures.vision.vision import camera

LENGTH = st.floats(-5, 5)
ANGLE = st.floats(-9, 9)


def header(t_us: int, pose=(0.0, 0.0, 0.0), moving=(0.0, 0.0), applied=(0.0, 0.0)) -> FrameHeader:
    return FrameHeader(session="0000abcd", seq=1, t_us=t_us, pose=pose, moving=moving, applied=applied)


# --- poses and echoes --------------------------------------------------------------------------------------------


def test_a_pose_between_two_frames_is_between_theirs_also_across_half_a_turn() -> None:
    poses = PoseMemory()
    poses.add(header(1_000_000, (0.0, 0.0, 3.1)))
    poses.add(header(1_100_000, (0.2, 0.4, -3.1)))
    x, y, yaw = poses.at(1_050_000)
    assert (x, y) == pytest.approx((0.1, 0.2))
    assert math.remainder(yaw - math.pi, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_a_pose_after_the_newest_continues_as_the_robot_moves_but_not_for_long() -> None:
    poses = PoseMemory()
    poses.add(header(0, (1.0, 0.0, math.pi / 2), moving=(0.5, 0.0)))
    assert poses.at(100_000) == pytest.approx((1.0, 0.05, math.pi / 2))
    assert poses.at(9_000_000) == pytest.approx((1.0, 0.1, math.pi / 2))


def test_a_pose_before_the_oldest_is_the_oldest() -> None:
    poses = PoseMemory()
    poses.add(header(500, (1.0, 2.0, 0.0)))
    assert poses.at(0) == (1.0, 2.0, 0.0)


@given(x=LENGTH, y=LENGTH, yaw=ANGLE, px=LENGTH, py=LENGTH)
def test_points_go_to_the_odometry_frame_and_back(x: float, y: float, yaw: float, px: float, py: float) -> None:
    points = np.array([[px, py]])
    assert about_robot(in_odometry(points, (x, y, yaw)), (x, y, yaw)) == pytest.approx(points, abs=1e-9)


def test_echoes_exclude_rays_without_an_obstacle_or_out_of_range() -> None:
    ranges = np.array([1.0, np.inf, 0.0, 2.0, 9.0], np.float32)
    found = echoes(RangeScan(0, -math.pi / 2, math.pi / 4, 0.05, 8.0, ranges), 0.1)
    assert found == pytest.approx(np.array([[0.1, -1.0], [0.1 + math.sqrt(2), math.sqrt(2)]]), abs=1e-6)


def test_obstacle_too_close_to_measure_is_an_echo_at_the_smallest_range() -> None:
    ranges = np.array([0.01, 0.0, 0.05], np.float32)
    found = echoes(RangeScan(0, -math.pi / 2, math.pi / 2, 0.05, 8.0, ranges), 0.1)
    assert found == pytest.approx(np.array([[0.1, -0.05], [0.1, 0.05]]), abs=1e-6)


# --- the floor ---------------------------------------------------------------------------------------------------


def test_one_echo_counts_immediately_and_rays_through_it_remove_it() -> None:
    ground = Costmap()
    ground.see((0.0, 0.0), np.array([[0.31, 0.0]]))
    assert len(ground.cells()) == 1 and ground.version == 1
    for _ in range(2):
        ground.see((0.0, 0.0), np.array([[0.9, 0.0]]))
    assert len(ground.cells()) == 2
    ground.see((0.0, 0.0), np.array([[0.9, 0.0]]))
    assert cells_of(ground.points()).tolist() == [[30, 0]]


def test_long_ray_clears_the_floor_within_the_horizon_only() -> None:
    """Whatever its length: steps of 3 cm along all of this one would not fit into any memory."""
    ground, near, far = Costmap(), (HORIZON_M - 0.3, 0.0), (HORIZON_M + 0.3, 0.0)
    ground.see((0.0, 0.0), np.array([near, far]))
    for _ in range(3):
        ground.see((0.0, 0.0), np.array([(1e12, 0.0), (-1.0, 0.0)]))
    left = {tuple(cell) for cell in ground.cells().tolist()}
    assert tuple(cells_of(np.array(near)).tolist()) not in left and tuple(cells_of(np.array(far)).tolist()) in left


def test_wall_at_a_grazing_angle_stays() -> None:
    ground = Costmap()
    wall = np.column_stack([np.linspace(0.05, 0.6, 40), np.full(40, 0.10)])
    for _ in range(30):
        ground.see((0.0, 0.0), wall)
    assert len(ground.cells()) >= 18


def test_the_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sightline.vision_side.missions.planner.MAX_CELLS", 100)
    ground = Costmap()
    for step in range(300):
        ground.see((step * CELL_M, 0.5), np.array([[step * CELL_M, 0.6]]))
    assert len(ground.cells()) == 100
    assert ground.cells()[:, 0].min() >= 199


# --- the plan ----------------------------------------------------------------------------------------------------


def wall(x: float, y1: float, y2: float) -> np.ndarray:
    return cells_of(np.column_stack([np.full(200, x), np.linspace(y1, y2, 200)]))


def test_a_free_way_is_straight() -> None:
    route = Planner(np.empty((0, 2), np.int64), (0.0, 0.0), (3.0, 1.0), 0.2, 0.2)
    entry = route.entry((0.0, 0.0), 0.1)
    assert entry is not None and route.sees((0.0, 0.0), (3.0, 1.0))
    assert route.left_m(entry) == pytest.approx(math.hypot(3, 1), rel=0.08)


@settings(max_examples=30)
@given(keep=st.floats(0.1, 0.4), half=st.floats(0.2, 1.2), shift=st.floats(-0.15, 0.15))
@example(keep=0.10546875, half=0.90625, shift=-0.03125)  # 1.7 cells less than it should keep
def test_the_way_round_a_wall_keeps_its_distance(keep: float, half: float, shift: float) -> None:
    """But for what cells leave open: 0.7 of one from its middle to a corner, 0.25 between the points of a straight line
    that are looked at, and 1.5 at its begin, which are not."""
    filled = wall(1.0, shift - half, shift + half)
    robot = (0.0, 0.0)
    route = Planner(filled, robot, (2.0, 0.0), keep, keep)
    assert not route.sees(robot, (2.0, 0.0))
    points = (filled + 0.5) * CELL_M
    for _ in range(200):
        entry = route.entry(robot, 0.1)
        assert entry is not None
        carrot = route.carrot(robot, entry)
        if carrot == (2.0, 0.0):
            break
        away = math.dist(robot, carrot)
        share = min(1.0, 0.1 / max(away, 1e-9))
        robot = (robot[0] + share * (carrot[0] - robot[0]), robot[1] + share * (carrot[1] - robot[1]))
        assert np.hypot(*(points - robot).T).min() > keep - 2.5 * CELL_M
    assert carrot == (2.0, 0.0)


def test_narrow_gap_is_closed_and_wide_gap_is_open() -> None:
    room = np.vstack([wall(1.0, -3.0, -0.2), wall(1.0, 0.2, 3.0), wall(-1.0, -3.0, 3.0),
                      wall(1.0, -3.0, -3.0)])
    ends = [cells_of(np.column_stack([np.linspace(-1, 1, 200), np.full(200, y)])) for y in (-3.0, 3.0)]
    closed = np.vstack([room, *ends])
    assert Planner(closed, (0.0, 0.0), (2.0, 0.0), 0.15, 0.15).entry((0.0, 0.0), 0.1) is not None
    assert Planner(closed, (0.0, 0.0), (2.0, 0.0), 0.25, 0.25).entry((0.0, 0.0), 0.1) is None


def test_a_robot_too_near_to_a_wall_is_led_out_to_the_nearest_free_place() -> None:
    route = Planner(wall(0.15, -1.0, 1.0), (0.0, 0.0), (-1.0, 0.0), 0.25, 0.25)
    entry = route.entry((0.0, 0.0), 0.2)
    assert entry is not None
    x, y = route.carrot((0.0, 0.0), entry)
    assert x < -0.05 and abs(y) < 0.2


@pytest.mark.parametrize("goal", [(50.0, 3.0), (-100.0, 100.0), (0.0, -80.0)])
def test_a_goal_beyond_the_horizon_is_aimed_at(goal: tuple[float, float]) -> None:
    route = Planner(wall(0.8, -0.5, 0.5), (0.0, 0.0), goal, 0.2, 0.2)
    entry = route.entry((0.0, 0.0), 0.1)
    assert entry is not None
    carrot = route.carrot((0.0, 0.0), entry)
    aside = math.remainder(math.atan2(carrot[1], carrot[0]) - math.atan2(goal[1], goal[0]), math.tau)
    assert abs(aside) < (1.2 if goal[0] > 0 else 0.15)
    assert route.left_m(entry) == pytest.approx(math.hypot(*goal), rel=0.02)


@pytest.mark.parametrize("goal", [(70.0, 0.0), (50.0, 50.0), (-40.0, 15.0)])
def test_way_left_to_a_goal_beyond_the_horizon_falls_from_plan_to_plan(goal: tuple[float, float]) -> None:
    filled, left_m = np.empty((0, 2), np.int64), []
    share = HORIZON_M / math.hypot(*goal)
    for step in (0.0, 0.5, 0.99, 1.5):
        robot = (step * share * goal[0], step * share * goal[1])
        route = Planner(filled, robot, goal, 0.2, 0.2)
        entry = route.entry(robot, 0.1)
        assert entry is not None
        left_m.append(route.left_m(entry))
        assert left_m[-1] == pytest.approx(math.dist(robot, goal), rel=0.02)
        assert route.left_from(robot) == left_m[-1]
    assert left_m == sorted(left_m, reverse=True)


# --- brakes ------------------------------------------------------------------------------------------------------


@given(room=st.floats(0.001, 3), delay=st.floats(0, 0.5), brake=st.floats(0.2, 5))
def test_braking_ends_where_it_should(room: float, delay: float, brake: float) -> None:
    speed = braking_mps(room, delay, brake)
    assert speed * delay + speed**2 / (2 * brake) == pytest.approx(room, rel=1e-6)


def test_no_room_no_speed() -> None:
    assert braking_mps(0.0, 0.1, 1.0) == braking_mps(-1.0, 0.1, 1.0) == 0.0


def test_only_motion_toward_a_point_is_cut() -> None:
    body, ahead = Footprint(), np.array([[0.25, 0.0]])
    assert clear_of(ahead, body, (0.5, 0.0), 0.1, 1.0) == pytest.approx(math.sqrt(2 * 0.07) / 0.5)
    assert clear_of(ahead, body, (-0.5, 0.0), 0.1, 1.0) == 1.0
    assert clear_of(np.array([[0.02, 0.1]]), body, (0.5, 0.0), 0.1, 1.0) == 1.0
    assert clear_of(np.array([[0.1, 0.0]]), body, (0.5, 0.0), 0.1, 1.0) == 0.0
    assert clear_of(np.empty((0, 2)), body, (0.5, 0.0), 0.1, 1.0) == 1.0


# --- patience ----------------------------------------------------------------------------------------------------


def view(dt_s: float, applied=(0.2, 0.0), pose=(0.0, 0.0, 0.0)) -> View:
    return View(header(0, applied=applied, pose=pose), dt_s, 0.05, camera(), ())


def test_closed_for_long_enough_is_closed_and_a_way_found_meanwhile_is_not() -> None:
    patience = ProgressChecker(ProgressCheckerConfig(closed_s=1.0))
    assert patience.step(view(0.6), None, 0) == ""
    assert patience.step(view(0.3), 2.0, 0) == ""
    assert patience.step(view(0.6), None, 0) == ""
    assert patience.step(view(0.5), None, 0) == "every way that was seen is closed"


@pytest.mark.parametrize(("pose", "stands"), [
    ((0.01, -0.01, 0.09), True), ((0.03, 0.0, 0.0), False), ((0.0, 0.0, -0.11), False),
])
def test_robot_that_never_moved_is_distinguished_from_one_without_a_way(pose, stands) -> None:
    patience = ProgressChecker(ProgressCheckerConfig(stuck_s=2.0))
    told = [patience.step(view(0.5, pose=(0.0, 0.0, 0.0) if at != 2 else pose), 3.0, 0) for at in range(5)]
    assert told[:4] == [""] * 4 and ("does not move" in told[4]) is stands


def test_no_progress_is_driving_without_coming_nearer_or_seeing_anything_new() -> None:
    patience = ProgressChecker(ProgressCheckerConfig(stuck_s=2.0))
    assert [patience.step(view(0.5, pose=(at / 9, 0.0, 0.0)), 3.0, 0) for at in range(4)] == [""] * 4
    assert patience.step(view(0.5), 3.0, 0) == "no progress in 2 s"
    patience.start_again()
    for left_m in (3.0, 2.8, 2.6, 2.4, 2.2, 2.0):
        assert patience.step(view(0.9), left_m, 0) == ""
    for discoveries in range(1, 8):
        assert patience.step(view(0.9), 2.0, discoveries) == ""
    for _ in range(20):
        assert patience.step(view(0.9, applied=(0.0, 0.0)), 2.0, 7) == ""
