"""Mission `goto-baseline`: the numbers of the legacy article, its three states, and its limits."""

import math
from itertools import pairwise

import numpy as np
import pytest

from sightline.evaluation.baselines.goto import GotoBaseline
from sightline.protocol.messages import FrameHeader, Pose
from sightline.vision_side.missions.goto import Footprint
from sightline.vision_side.missions.port import Plan, RangeScan, View
from tests.fixtures.vision.course import Course, Drive, Row
from tests.fixtures.vision.vision import camera

THYMIO = Footprint(front_m=0.08, rear_m=0.03, half_width_m=0.0635)
RAY_RAD = math.radians(3)
FRONT_M = 0.077
"""Where its front sensor stands, ahead of the axle."""


def mission(*waypoints: tuple[float, float]) -> GotoBaseline:
    return GotoBaseline(GotoBaseline.Config.model_validate({"waypoints": waypoints}), camera())


def view(pose: Pose, t_us: int, seen: dict[float, float] | None = None) -> View:
    """`seen`: what the front sensor sees, ranges by angle in radians; all else is free. The scan is about the axle."""
    ranges = np.full(120, np.inf, np.float32)
    for angle, range_m in (seen or {}).items():
        x_m, y_m = FRONT_M + range_m * math.cos(angle), range_m * math.sin(angle)
        ranges[round((math.atan2(y_m, x_m) + math.pi) / RAY_RAD)] = math.hypot(x_m, y_m)
    scan = RangeScan(t_us, -math.pi, RAY_RAD, 0.01, 0.3, ranges)
    return View(FrameHeader(session="0000abcd", seq=1, t_us=t_us, pose=pose), 0.03, 0.05, camera(), (), None, scan)


def steps(one: GotoBaseline, *views: View) -> Plan:
    return [one.step(each) for each in views][-1]


def drive(course: Course, goal: tuple[float, float], seconds: float, **how) -> list[Row]:
    return Drive(mission(goal), course, body=THYMIO, latency_s=0.0, loss=0.0, **how).run(seconds)


def test_baseline_has_the_numbers_of_the_legacy_controllers() -> None:
    turning = steps(mission((1.0, 1.0)), view((0, 0, 0), 0), view((0, 0, 0), 100_000))
    assert turning.twist.angular_rad_s == pytest.approx(1.2 * math.pi / 4)
    assert turning.twist.linear_mps == 0.0
    straight = steps(mission((1.0, 0.0)), view((0, 0, 0), 0), view((0.1, 0, 0), 100_000))
    assert straight.twist.linear_mps == pytest.approx(0.3 * 0.9 + 0.08 * 0.1)
    fast = steps(mission((10.0, 0.0)), view((0, 0, 0), 0), view((0.1, 0, 0), 100_000))
    assert fast.twist.linear_mps == 0.5


def test_baseline_decides_ten_times_a_second() -> None:
    one = mission((1.0, 1.0))
    first = steps(one, view((0, 0, 0), 0), view((0, 0, 0), 100_000))
    assert one.step(view((0, 0, 0.5), 133_000)) == first
    assert one.step(view((0, 0, 0.5), 200_000)) != first


def test_baseline_drives_a_free_way() -> None:
    run = drive(Course(), (1.0, 0.5), 30)
    assert run[-1].plan is not None and run[-1].plan.note == "reached 1 of 1"
    assert math.dist(run[-1].pose[:2], (1.0, 0.5)) < 0.12


@pytest.mark.parametrize(("left_m", "right_m", "phase"), [(0.15, 0.19, "right contour"), (0.19, 0.15, "left contour")])
def test_the_contour_is_chosen_by_the_two_middle_rays(left_m: float, right_m: float, phase: str) -> None:
    seen = {0.25: left_m, 0.0: right_m}
    plan = steps(mission((1.0, 0.0)), view((0, 0, 0), 0, seen), view((0, 0, 0), 100_000, seen))
    assert plan.phase == phase


def test_baseline_turns_away_from_a_wall_by_time() -> None:
    near = {RAY_RAD * k: 0.12 for k in range(-9, 10)}
    one = mission((1.0, 0.0))
    plan = steps(one, view((0, 0, 0), 0, near), view((0, 0, 0), 100_000, near))
    side = 1.0 if plan.phase == "left contour" else -1.0
    assert plan.twist.angular_rad_s == side and plan.twist.linear_mps == 0.0
    assert one.step(view((0, 0, 1.0), 1_500_000)).twist.angular_rad_s == side  # whatever it sees meanwhile


@pytest.mark.parametrize(("front_m", "approaches"), [(0.16, True), (0.14, True), (0.12, False)])
def test_baseline_uses_the_readings_of_each_sensor(front_m: float, approaches: bool) -> None:
    """It turns 0.13 m before a wall, seen from the sensor at its front; from the axle that is 0.21 m."""
    wall = {angle: front_m / math.cos(angle) for angle in np.arange(-0.7, 0.7, 0.04)}
    plan = steps(mission((1.0, 0.0)), *(view((0, 0, 0), at * 100_000, wall) for at in range(3)))
    assert (plan.twist.linear_mps, abs(plan.twist.angular_rad_s)) == ((0.1, 0.0) if approaches else (0.0, 1.0))


def test_baseline_passes_a_cylinder_without_delay() -> None:
    run = drive(Course(posts=((0.75, 0.75, 0.2),)), (1.5, 1.5), 60)
    assert run[-1].plan is not None and run[-1].plan.phase == "arrived"
    assert math.dist(run[-1].pose[:2], (1.5, 1.5)) < 0.12
    assert {row.plan.phase for row in run if row.plan} >= {"to goal", "left contour"}


def test_closed_room_without_a_report_fails() -> None:
    corners = ((-0.6, -0.5), (0.7, -0.5), (0.7, 0.6), (-0.6, 0.6), (-0.6, -0.5))
    run = drive(Course(walls=tuple((*one, *other) for one, other in pairwise(corners))), (3.0, 0.4), 60)
    assert run[-1].t_s > 59 and not any(row.plan and row.plan.done for row in run)


def test_without_ranges_nothing_moves() -> None:
    header = FrameHeader(session="0000abcd", seq=1, t_us=0)
    plan = mission((1.0, 0.0)).step(View(header, 0.0, 0.05, camera(), ()))
    assert plan.phase == "no ranges" and plan.twist.linear_mps == plan.twist.angular_rad_s == 0.0
