"""Missions `legs` and `legs-baseline`: the center between two legs, in closed loop; and the legacy numbers."""

import math
import random
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sightline.evaluation.baselines.legs import LegsBaseline
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.goto import Footprint
from sightline.vision_side.missions.legs import Legs, nearest_legs
from sightline.vision_side.missions.port import RangeScan, View
from sightline.vision_side.tracking.track import from_odometry
from tests.fixtures.vision.course import Course, Drive, Lidar, Row
from tests.fixtures.vision.vision import camera

LENS = camera()
LEG_M = 0.055
RASPBERRY = Footprint(front_m=0.07, rear_m=0.10, half_width_m=0.09)
Walk = Callable[[float], tuple[float, float, float]]
"""The place and the direction of the walker at a time."""


def legs_of(place: tuple[float, float, float], way_m: float) -> tuple[tuple[float, float, float], ...]:
    """Two posts, a fifth of a metre apart, that swing by a quarter of a step of half a metre."""
    x, y, heading = place
    cos, sin = math.cos(heading), math.sin(heading)
    swing = [0.5 * (abs(2 * ((way_m / 0.5 + start) % 1) - 1) - 0.5) / 2 for start in (0.0, 0.5)]
    return tuple((x + ahead * cos - left * sin, y + ahead * sin + left * cos, LEG_M)
                 for ahead, left in zip(swing, (0.1, -0.1), strict=True))


def box_of(posts: tuple[tuple[float, float, float], ...], pose: tuple[float, float, float]) -> tuple[Detection, ...]:
    """The box around both legs, as far as it is in view."""
    edges: list[float] = []
    for x, y, radius in posts:
        ahead, left = from_odometry(pose, x, y)
        ahead -= LENS.x_m
        if ahead < 0.1:
            return ()
        middle, half = math.atan2(left, ahead), math.asin(radius / math.hypot(ahead, left))
        edges += [LENS.cx_px - LENS.fx_px * math.tan(middle + side * half) for side in (-1, 1)]
    first, last = max(0.0, min(edges)), min(float(LENS.width_px), max(edges))
    return (Detection(first, 40.0, last, 160.0, 0.9, "legs"),) if last - first > 2 else ()


def follow(walk: Walk, speed_mps: float, seconds: float, seed: int = 1, others: Course | None = None,
           start=(0.0, 0.0, 0.0)) -> list[Row]:
    others = others or Course()

    def posts(t_s: float) -> tuple[tuple[float, float, float], ...]:
        return legs_of(walk(t_s), speed_mps * t_s)

    drive = Drive(Legs(Legs.Config(), LENS), lambda t_s: Course(others.walls, others.posts + posts(t_s)), start=start,
                  sensor=Lidar(noise_m=0.005), body=RASPBERRY, seed=seed, acceleration=(2.0, 10.0),
                  eye=lambda pose, t_s: (box_of(posts(t_s), pose), None))
    return drive.run(seconds)


def circle(speed_mps: float, radius_m: float = 2.5) -> Walk:
    def at(t_s: float) -> tuple[float, float, float]:
        turn = speed_mps * t_s / radius_m
        return 0.95 + radius_m * math.sin(turn), radius_m * (1 - math.cos(turn)), turn
    return at


def errors(run: list[Row], walk: Walk, from_s: float) -> tuple[float, float, float]:
    """RMS of the bearing in degrees, smallest and largest distance, from the lens to the center of the legs."""
    bearings, distances = [], []
    for row in run:
        if row.t_s >= from_s:
            x, y = from_odometry(row.pose, *walk(row.t_s)[:2])
            bearings.append(math.atan2(y, x - LENS.x_m))
            distances.append(math.hypot(x - LENS.x_m, y))
    return math.degrees(float(np.sqrt(np.mean(np.square(bearings))))), min(distances), max(distances)


@pytest.mark.parametrize("speed_mps", [0.2, 0.35, 0.45])
@pytest.mark.parametrize("seed", [1, 2])
def test_walking_legs_are_followed_at_eight_tenths_of_a_meter(speed_mps: float, seed: int) -> None:
    run = follow(circle(speed_mps), speed_mps, 20, seed)
    bearing_deg, least_m, most_m = errors(run, circle(speed_mps), 4.0)
    assert bearing_deg < 1  # the middle of the box alone sways by 1.2 to 1.6
    assert least_m > 0.7 and most_m < 1.0
    assert all(row.plan is None or row.plan.phase != "lost" for row in run)


def test_robot_backs_away_from_legs_that_approach() -> None:
    def walk(t_s: float) -> tuple[float, float, float]:
        return max(0.9, 1.6 - 0.2 * t_s), 0.0, math.pi
    run = follow(walk, 0.2, 10)
    assert errors(run, walk, 6.0)[1] > 0.7


def test_others_and_a_wall_behind_do_not_change_the_range() -> None:
    walk = circle(0.3)
    room = Course(walls=((-4.0, 3.9, 6.0, 3.9),), posts=((2.0, -0.9, LEG_M), (2.0, -1.1, LEG_M)))
    _, least_m, most_m = errors(follow(walk, 0.3, 15, others=room), walk, 4.0)
    assert least_m > 0.7 and most_m < 1.0


# --- one step ----------------------------------------------------------------------------------------------------


def scan_of(course: Course, sensor_x_m: float = 0.055) -> RangeScan:
    return Lidar(at_x_m=sensor_x_m).scan(course, (0.0, 0.0, 0.0), 0)


def view(boxes: tuple[Detection, ...], scan: RangeScan | None, t_us: int = 0) -> View:
    header = FrameHeader(session="0000abcd", seq=1, t_us=t_us)
    return View(header, 0.03, 0.05, LENS, boxes, None, scan)


@pytest.mark.parametrize("bearing_deg", [-24, -12, 0, 7, 24])
@pytest.mark.parametrize("away_m", [0.6, 1.2, 3.0])
@pytest.mark.parametrize("way_m", [0.0, 0.125, 0.25])
def test_the_field_is_symmetric_and_metric_at_each_step(bearing_deg: float, away_m: float, way_m: float) -> None:
    x = LENS.x_m + away_m * math.cos(math.radians(bearing_deg))
    y = away_m * math.sin(math.radians(bearing_deg))
    posts = legs_of((x, y, math.radians(bearing_deg)), way_m)
    plan = Legs(Legs.Config(), LENS).step(view(box_of(posts, (0, 0, 0)), scan_of(Course(posts=posts))))
    assert plan.bearing_rad is not None and plan.distance_m is not None
    assert math.degrees(plan.bearing_rad) == pytest.approx(bearing_deg, abs=0.3)
    assert plan.distance_m == pytest.approx(away_m, abs=0.04)


@pytest.mark.parametrize("way_m", [0.0, 0.125, 0.25])
def test_a_box_around_the_whole_human_gives_the_middle_of_the_legs(way_m: float) -> None:
    posts = legs_of((LENS.x_m + 1.2, 0.0, 0.0), way_m)
    (legs,) = box_of(posts, (0, 0, 0))
    human = replace(legs, x1_px=legs.x1_px - 15, x2_px=legs.x2_px + 15)
    bearing_rad = Legs(Legs.Config(), LENS).step(view((human,), scan_of(Course(posts=posts)))).bearing_rad
    assert bearing_rad is not None and math.degrees(bearing_rad) == pytest.approx(0.0, abs=0.3)


def test_legs_are_distinguished_by_the_gap_between_them() -> None:
    points = np.array([[1.0, 0.2], [0.99, 0.18], [1.1, 0.0], [1.09, 0.02], [3.0, -0.1]])
    assert nearest_legs(points, np.hypot(*points.T), 0.6) == [1, 3]


@pytest.mark.parametrize("first_deg", [-180, 0, 3, 8])
def test_scan_may_begin_in_the_middle_of_a_leg(first_deg: int) -> None:
    angles_deg = np.remainder(first_deg + np.arange(360) + 180, 360) - 180
    legs_m = np.where(abs(angles_deg) < 3, 1.0, np.where(abs(angles_deg - 8) < 3, 1.3, np.inf)).astype(np.float32)
    scan = RangeScan(0, math.radians(first_deg), math.radians(1), 0.05, 8.0, legs_m)
    box = box_of(((1.0, 0.0, 0.06), (1.29, 0.18, 0.06)), (0.0, 0.0, 0.0))
    mission = Legs(Legs.Config(sensor_x_m=0.0), LENS)
    assert mission.step(view(box, scan)).distance_m == pytest.approx(1.15 - LENS.x_m + LEG_M, abs=0.01)


def test_single_echo_is_one_leg() -> None:
    assert nearest_legs(np.array([[1.0, 0.0]]), np.array([1.0]), 0.6) == [0]


@pytest.mark.parametrize(("expected_m", "found"), [
    (None, [0, 1, 2]), (1.95, [2, 3, 4]), (1.3, [0, 1]), (3.0, [0, 1, 2]),
])
def test_legs_at_the_expected_distance_come_before_nearer_ones(expected_m, found) -> None:
    points = np.array([[1.2, 0.0], [1.35, 0.3], [1.7, 0.0], [2.0, 0.3], [2.1, 0.0]])
    assert nearest_legs(points, points[:, 0], 0.6, expected_m) == found


@pytest.mark.parametrize("aside_m", [-0.35, -0.2, 0.2, 0.35])
def test_a_box_around_the_target_and_who_walks_before_it_gives_the_place_of_the_target(aside_m: float) -> None:
    legs = Legs(Legs.Config(), LENS)
    target = (2.0, 0.1, LEG_M), (2.0, -0.1, LEG_M)
    other = (1.1, aside_m + 0.12, LEG_M), (1.1, aside_m - 0.12, LEG_M)
    for step in range(30):
        posts = target if step < 20 else (*target, *other)
        header = FrameHeader(session="0000abcd", seq=step + 1, t_us=step * 33_000)
        scan = Lidar(at_x_m=0.055).scan(Course(posts=posts), (0.0, 0.0, 0.0), step * 33_000)
        plan = legs.step(View(header, 0.033, 0.05, LENS, box_of(posts, (0.0, 0.0, 0.0)), None, scan))
    assert plan.bearing_rad is not None
    assert math.degrees(plan.bearing_rad) == pytest.approx(0.0, abs=2.0)


def test_one_leg_before_the_other_does_not_pull_the_target_nearer() -> None:
    legs = Legs(Legs.Config(), LENS)
    apart, behind = ((2.0, 0.1, LEG_M), (2.0, -0.1, LEG_M)), ((1.85, 0.0, LEG_M), (2.15, 0.0, LEG_M))
    plans = []
    for step, posts in enumerate([apart] * 20 + [behind] * 10):
        header = FrameHeader(session="0000abcd", seq=step + 1, t_us=step * 33_000)
        scan = Lidar(at_x_m=0.055).scan(Course(posts=posts), (0.0, 0.0, 0.0), step * 33_000)
        boxes = box_of(posts, (0.0, 0.0, 0.0))
        plans.append(legs.step(View(header, 0.033, 0.05, LENS, boxes, None, scan)))
    assert plans[19].distance_m == pytest.approx(2.0 - LENS.x_m, abs=0.03)
    assert plans[-1].distance_m == pytest.approx(2.0 - LENS.x_m, abs=0.1)


def test_a_box_of_something_else_is_left_alone() -> None:
    cat = Detection(100, 50, 140, 160, 0.9, "cat")
    assert Legs(Legs.Config(), LENS).step(view((cat,), None)).target is None


def test_without_a_scan_or_with_an_old_one_it_only_turns_to_the_box() -> None:
    posts = legs_of((2.0, 0.7, 0.0), 0.0)
    for scan, t_us in ((None, 0), (scan_of(Course(posts=posts)), 2_000_000)):
        mission = Legs(Legs.Config(), LENS)
        for _ in range(4):
            plan = mission.step(view(box_of(posts, (0, 0, 0)), scan, t_us))
        assert plan.twist.angular_rad_s > 0.3
        assert abs(plan.twist.linear_mps) < 0.05


def test_hostile_scans_break_nothing() -> None:
    draw = random.Random(7)
    mission = Legs(Legs.Config(), LENS)
    box = (Detection(-50, -10, 900, 400, 1.0, "legs"), Detection(10, 10, 10, 10, 0.5, "legs"))
    for count in (0, 1, 2, 5000):
        ranges = np.array([draw.choice([0.0, 0.3, 1e9, math.inf]) for _ in range(count)], np.float32)
        plan = mission.step(view(box, RangeScan(count, -math.pi, 0.01, 0.05, 8.0, ranges), count))
        assert math.isfinite(plan.twist.linear_mps) and math.isfinite(plan.twist.angular_rad_s)


# --- the baseline ------------------------------------------------------------------------------------------------


def baseline(post: tuple[float, float, float], steps: int = 1, box: tuple[float, float] = (0.0, 1.0)):
    mission = LegsBaseline(LegsBaseline.Config(), LENS)
    boxes = (Detection(box[0] * LENS.width_px, 50, box[1] * LENS.width_px, 150, 0.9, "legs"),)
    for _ in range(steps):
        plan = mission.step(view(boxes, scan_of(Course(posts=(post,)), 0.0)))
    return plan


def test_the_baseline_s_numbers_for_a_leg_straight_ahead() -> None:
    plan = baseline((1.05, 0.0, 0.05))
    assert plan.phase == "driving"
    assert plan.twist.linear_mps == pytest.approx(1.0 * 0.25 + 0.02 * 1.0, abs=0.01)
    assert plan.twist.angular_rad_s == pytest.approx(9 * -0.0145 * 0.4 - 0.0005 * 9, abs=1e-6)


@pytest.mark.parametrize(("away_m", "phase"), [(3.0, "out of range"), (2.4, "driving"), (0.5, "turning"),
                                               (0.3, "too near")])
def test_the_baseline_s_bands(away_m: float, phase: str) -> None:
    plan = baseline((away_m + 0.05, 0.0, 0.05))
    assert plan.phase == phase
    assert (plan.twist.linear_mps > 0) == (phase == "driving")


def test_the_baseline_s_field_is_lopsided_and_its_integral_grows_without_bound() -> None:
    assert baseline((1.0, 0.0, 0.05)).twist.angular_rad_s < 0  # straight ahead, and it turns right
    assert baseline((2.0, 0.0, 0.05), steps=400).twist.linear_mps > 5


def test_the_baseline_sees_nothing_outside_its_box() -> None:
    assert baseline((1.0, 0.0, 0.05), box=(0.0, 0.3)).phase == "out of range"
