"""Mission `goto`: it arrives, keeps its clearance, and reports failure; in many layouts and from many starts.

Bounds are those of the simulated Thymio: (1.5, 1.5) with a cylinder in the way in 15 s, 0.10 m clear.
"""

import math
import random

import numpy as np
import pytest
from pydantic import ValidationError

from sightline.vision_side.missions.goto import Footprint, Goto
from sightline.vision_side.missions.port import Plan
from tests.fixtures.vision.course import Course, Drive, Eyes, Lidar, Row, Segment
from tests.fixtures.vision.vision import camera

pytestmark = pytest.mark.computes

THYMIO = Footprint(front_m=0.08, rear_m=0.03, half_width_m=0.0635)
CLEAR_M = 0.10


def mission(*waypoints: tuple[float, float], **options) -> Goto:
    return Goto(Goto.Config.model_validate({"waypoints": waypoints, "body": THYMIO, **options}), camera())


def drive(course: Course, *waypoints: tuple[float, float], seconds: float = 60.0, **how) -> list[Row]:
    options = how.pop("options", {})
    return Drive(mission(*waypoints, **options), course, body=THYMIO, **how).run(seconds)


def end_of(run: list[Row]) -> Plan:
    plan = run[-1].plan
    assert plan is not None
    return plan


def nearest(run: list[Row]) -> float:
    return min(row.clearance_m for row in run)


def box(x1: float, y1: float, x2: float, y2: float) -> tuple[tuple[float, float, float, float], ...]:
    return (x1, y1, x2, y1), (x2, y1, x2, y2), (x2, y2, x1, y2), (x1, y2, x1, y1)


def thick(x1: float, y1: float, x2: float, y2: float, thick_m: float = 0.06) -> tuple[Segment, ...]:
    """A wall with two faces and two ends. Ends narrower than the gap between two rays, 5 cm, are seen late."""
    length = math.hypot(x2 - x1, y2 - y1)
    ax, ay = (x2 - x1) / length * thick_m / 2, (y2 - y1) / length * thick_m / 2
    a, b = (x1 - ax - ay, y1 - ay + ax), (x2 + ax - ay, y2 + ay + ax)
    c, d = (x2 + ax + ay, y2 + ay - ax), (x1 - ax + ay, y1 - ay - ax)
    return (*a, *b), (*b, *c), (*c, *d), (*d, *a)


CYLINDER = Course(posts=((0.75, 0.75, 0.2),))
WIDE_WALL = Course(walls=thick(0.25, 1.0, 1.05, 0.4, 0.1))
TRAP = Course(walls=(*thick(0.75, 1.35, 1.35, 0.75), *thick(0.75, 1.35, 0.35, 0.95), *thick(1.35, 0.75, 0.95, 0.35)))
SLALOM = Course(posts=((0.45, 0.38, 0.14), (0.80, 0.98, 0.14), (1.22, 0.90, 0.14)))
CORNER = Course(walls=(*thick(-0.6, 0.9, 1.0, 0.9), *thick(1.0, 0.9, 1.0, -0.6)))
DEEP_TRAP = Course(walls=(*thick(1.2, -0.5, 1.2, 0.5), *thick(1.2, 0.5, -0.3, 0.5), *thick(1.2, -0.5, -0.3, -0.5)))
CLOSED = Course(walls=box(1.0, 1.0, 2.0, 2.0))
SHUT_IN = Course(walls=box(-0.6, -0.5, 0.7, 0.6))


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 6])
def test_the_cylinder_in_the_way_costs_less_than_fifteen_seconds(seed: int) -> None:
    draw = random.Random(seed)
    post = (0.75 + draw.uniform(-0.06, 0.06), 0.75 + draw.uniform(-0.06, 0.06), 0.2)
    run = drive(Course(posts=(post,)), (1.5, 1.5), start=(0, 0, draw.uniform(-1.05, 1.05)), seed=seed)
    assert end_of(run).note == "reached 1 of 1"
    assert math.dist(run[-1].pose[:2], (1.5, 1.5)) < 0.07
    assert run[-1].t_s < 15.0
    assert nearest(run) > CLEAR_M


@pytest.mark.parametrize("seed", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("course", [WIDE_WALL, TRAP, SLALOM, CORNER], ids=["wall", "trap", "slalom", "corner"])
def test_layouts_are_passed_without_a_touch(course: Course, seed: int) -> None:
    run = drive(course, (1.5, 1.5), start=(0, 0, seed - 2.0), seed=seed)
    assert end_of(run).note == "reached 1 of 1"
    assert nearest(run) > CLEAR_M


def test_a_trap_deeper_than_the_robot_sees_is_left_again() -> None:
    run = drive(DEEP_TRAP, (2.2, 0.0), seed=4, seconds=120)
    assert end_of(run).note == "reached 1 of 1"
    assert nearest(run) > CLEAR_M


@pytest.mark.parametrize("seed", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("course", "goal"), [(CLOSED, (1.5, 1.5)), (SHUT_IN, (3.0, 0.4)), (SHUT_IN, (40.0, -30.0))],
                         ids=["goal shut in", "robot shut in", "robot shut in, goal far"])
def test_a_closed_room_is_reported_as_closed(course: Course, goal: tuple[float, float], seed: int) -> None:
    run = drive(course, goal, seconds=90, start=(0, 0, seed * 2.0), seed=seed)
    assert end_of(run).done and end_of(run).phase == "cannot reach"
    assert end_of(run).note == "reached 0 of 1: cannot reach waypoint 1: every way that was seen is closed"
    assert run[-1].moving == (0.0, 0.0)
    assert nearest(run) > CLEAR_M


def random_course(draw: random.Random) -> Course:
    """Posts and walls that leave room for the robot between any two of them, at its start and at its goal."""
    parts: list[Course] = []
    points = np.array([(0.0, 0.0), (2.0, 1.0)])
    for _ in range(draw.randint(3, 9)):
        x, y = draw.uniform(-0.5, 2.5), draw.uniform(-1.0, 2.0)
        turn, length = draw.uniform(0, math.pi), draw.uniform(0.2, 1.2)
        wall = thick(x, y, x + length * math.cos(turn), y + length * math.sin(turn))
        one = Course(walls=wall) if draw.random() < 0.5 else Course(posts=((x, y, draw.uniform(0.05, 0.3)),))
        outline = one.outline(0.02)
        if np.hypot(*(outline[:, None] - points[None]).reshape(-1, 2).T).min() > 0.52:
            parts.append(one)
            points = np.vstack([points, outline])
    return Course(sum((one.walls for one in parts), ()), sum((one.posts for one in parts), ()))


@pytest.mark.parametrize("seed", range(8))
def test_random_layouts(seed: int) -> None:
    draw = random.Random(seed)
    run = drive(random_course(draw), (2.0, 1.0), start=(0, 0, draw.uniform(-3, 3)), seed=seed, seconds=90)
    assert end_of(run).note == "reached 1 of 1"
    assert nearest(run) > CLEAR_M


@pytest.mark.parametrize("distance_m", [0.2, 2.0, 10.0])
def test_a_free_way_is_driven_straight_and_ends_on_the_spot(distance_m: float) -> None:
    run = drive(Course(), (distance_m, 0.0))
    assert end_of(run).note == "reached 1 of 1"
    assert abs(run[-1].pose[0] - distance_m) < 0.06
    assert max(abs(row.pose[1]) for row in run) < 0.02
    assert max(row.moving[0] for row in run) <= 0.5


def test_far_ray_sensor_permits_full_speed() -> None:
    run = drive(Course(), (4.0, 0.0), sensor=Lidar(), options={"sight_m": 3.0, "sensor_x_m": 0.055})
    assert max(row.moving[0] for row in run) > 0.45
    assert run[-1].t_s < 12.0


def test_a_goal_behind_the_robot_is_turned_to_the_short_way() -> None:
    run = drive(Course(), (-1.0, 0.05), start=(0, 0, 0.1))
    assert end_of(run).note == "reached 1 of 1"
    turned = [row.pose[2] for row in run]
    assert 2.8 < max(turned) < 3.5 and min(turned) > 0.0


def test_a_heading_far_beyond_a_turn_is_a_heading() -> None:
    run = drive(Course(), (1.0, 0.0), start=(0, 0, 6 * math.pi + 0.2))
    assert end_of(run).note == "reached 1 of 1"
    assert abs(run[-1].pose[2] - 6 * math.pi) < 0.5


def test_waypoints_are_reached_in_order() -> None:
    run = drive(CYLINDER, (0.8, 0.0), (1.4, 1.4), (0.0, 1.2))
    assert end_of(run).note == "reached 3 of 3"
    firsts = [next(row.t_s for row in run if math.dist(row.pose[:2], spot) < 0.06)
              for spot in ((0.8, 0.0), (1.4, 1.4), (0.0, 1.2))]
    assert firsts == sorted(firsts)


def test_the_second_waypoint_that_cannot_be_reached_is_named() -> None:
    run = drive(CLOSED, (0.5, 0.3), (1.5, 1.5), seconds=90)
    assert end_of(run).note == "reached 1 of 2: cannot reach waypoint 2: every way that was seen is closed"


def test_without_ranges_nothing_moves() -> None:
    class Silent(Eyes):
        def scan(self, course, pose, t_us):  # type: ignore[no-untyped-def]
            return None

    run = drive(Course(), (1.0, 0.0), sensor=Silent(), seconds=3)
    assert all(row.moving == (0.0, 0.0) for row in run)
    assert end_of(run).phase == "no ranges"


@pytest.mark.parametrize("latency_s", [0.05, 0.2])
def test_without_a_new_scan_the_robot_goes_no_farther_than_the_last_one_saw_free(latency_s: float) -> None:
    seen_from_m = [0.0]

    class Late(Eyes):
        def scan(self, course, pose, t_us):  # type: ignore[no-untyped-def]
            if t_us > 2_000_000:
                return None
            seen_from_m[0] = pose[0]
            return super().scan(course, pose, t_us)

    options = {"sight_m": 0.2, "clearance_m": 0.112, "max_scan_age_s": 2.0}
    run = drive(Course(), (3.0, 0.0), sensor=Late(), seconds=5, loss=0.0, latency_s=latency_s, options=options)
    assert 0.2 < run[-1].pose[0] <= seen_from_m[0] + 0.2 - 0.112


def test_ranges_that_end_stop_the_robot() -> None:
    class Dying(Eyes):
        def scan(self, course, pose, t_us):  # type: ignore[no-untyped-def]
            return super().scan(course, pose, min(t_us, 2_000_000))

    run = drive(Course(), (3.0, 0.0), sensor=Dying(), seconds=5)
    assert any(row.moving[0] > 0.15 for row in run)
    assert all(row.moving[0] == 0.0 for row in run if row.t_s > 3.5)


def test_time_in_hold_does_not_count_as_missing_progress() -> None:
    run = drive(Course(), (0.5, 0.0), held_until_s=40.0, seconds=60)
    assert end_of(run).note == "reached 1 of 1"


def test_removed_obstacle_frees_the_path() -> None:
    shut = Course(walls=(*box(-0.5, -0.5, 0.6, 0.5), (2.5, -2.0, 2.5, 2.0)))
    open_ = Course(walls=shut.walls[:1] + shut.walls[2:])
    shut_until_s = 6.0
    run = Drive(mission((1.6, 0.2), patience={"closed_s": 30.0}), lambda t_s: shut if t_s < shut_until_s else open_,
                body=THYMIO, sensor=Lidar(rays=180)).run(90)
    assert end_of(run).note == "reached 1 of 1"


def test_odometry_that_is_two_percent_off_touches_nothing() -> None:
    run = drive(TRAP, (1.5, 1.5), odometry_scale=0.98, seed=3)
    assert end_of(run).done
    assert nearest(run) > 0.08


def test_the_same_frames_give_the_same_plans() -> None:
    one, other = drive(TRAP, (1.5, 1.5), seed=5, seconds=8), drive(TRAP, (1.5, 1.5), seed=5, seconds=8)
    assert [(row.pose, row.plan) for row in one] == [(row.pose, row.plan) for row in other]


@pytest.mark.parametrize("waypoints", [[], [[1.0, math.nan]], [[1.0, math.inf]], [[101.0, 0.0]], [["a", 0.0]], [[1.0]],
                                       [[0.0, 0.0]] * 65])
def test_waypoints_out_of_the_world_are_rejected(waypoints: list) -> None:
    with pytest.raises(ValidationError):
        Goto.Config.model_validate({"waypoints": waypoints})


def test_sensors_that_see_no_farther_than_the_clearance_are_rejected() -> None:
    with pytest.raises(ValidationError, match=r"sight_m of 0\.1 m must be more than 0\.129 m"):
        mission((1.0, 0.0), sight_m=0.1)
