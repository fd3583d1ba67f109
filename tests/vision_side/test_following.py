"""Closed loop in the small rig: the figures of issue 2 with room to spare, and what must hold when things go wrong."""

import math
import random
from itertools import pairwise

import numpy as np
import pytest

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import SearchConfig, VisionConfig
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Circle, Detection
from sightline.vision_side.missions.follow import Follow
from sightline.vision_side.missions.port import View
from tests.fixtures.vision.vision import (
    FLOOR_BGR,
    YELLOW_BGR,
    Path,
    Rig,
    acquired_at,
    ball_about_lens,
    camera,
    circle,
    draw_ball,
    eight,
    errors_after,
    still,
)

pytestmark = pytest.mark.computes

SEEDS = (1, 2, 3, 4, 5, 6)


def ahead(seed: int) -> Path:
    """A still ball 0.65 to 1 m from the lens, within 15 degrees."""
    rng = random.Random(seed)
    distance, bearing = rng.uniform(0.65, 1.0), math.radians(rng.uniform(-15, 15))
    return still(0.055 + distance * math.cos(bearing), distance * math.sin(bearing))


@pytest.mark.parametrize("seed", SEEDS)
def test_static(seed: int) -> None:
    run = Rig(ahead(seed), seed=seed).run(10)
    acquired = acquired_at(run)
    assert acquired is not None and acquired < 1.5
    bearing, distance = errors_after(run, acquired)
    assert bearing < 0.5
    assert distance < 0.03


def test_static_from_drawn_images() -> None:
    bearing, distance = errors_after(Rig(ahead(5), seed=5, drawn=True).run(4), 1.5)
    assert bearing < 0.3
    assert distance < 0.02


@pytest.mark.parametrize("seed", SEEDS)
def test_circle(seed: int) -> None:
    bearing, distance = errors_after(Rig(circle(), seed=seed).run(12), 1.5)
    assert bearing < 0.5
    assert distance < 0.03


@pytest.mark.parametrize("latency_s", [0.0, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("odometry_scale", [0.98, 1.0, 1.02])
def test_eight_at_every_latency_and_with_odometry_off_by_two_percent(latency_s: float, odometry_scale: float) -> None:
    run = Rig(eight(), latency_s=latency_s, odometry_scale=odometry_scale).run(15)
    bearing, distance = errors_after(run, 1.5)
    assert bearing < 1.0
    assert distance < 0.05
    assert max(abs(row.bearing_rad) for row in run) < math.radians(40)


@pytest.mark.parametrize("degrees", [100, 140, 180, 220, 260])
def test_behind_is_found_within_five_seconds(degrees: float) -> None:
    angle = math.radians(degrees)
    found = acquired_at(Rig(still(math.cos(angle), math.sin(angle))).run(7))
    assert found is not None and found < 6
    run = Rig(still(math.cos(angle), math.sin(angle))).run(5)
    assert any(row.seen and row.seen.phase == "tracking" for row in run)


def test_a_ball_that_vanishes_for_a_moment_is_followed_again() -> None:
    run = Rig(circle(), blind=lambda t_s: 3.0 < t_s < 3.4).run(8)
    bearing, distance = errors_after(run, 5.0)
    assert "coasting" in {row.seen.phase for row in run if row.seen}
    assert "searching" not in {row.seen.phase for row in run if row.seen}
    assert bearing < 0.5
    assert distance < 0.03


def test_a_ball_gone_for_good_stops_the_robot_within_the_coasting_time_and_the_search_ends() -> None:
    config = VisionConfig(search=SearchConfig(max_turn_rad=4.0))
    run = Rig(circle(), blind=lambda t_s: t_s > 3.0, config=config).run(12)
    stopped = [row for row in run if row.t_s > 3.0 + config.track.coast_s + 0.6]
    assert max(abs(row.moving[0]) for row in stopped) < 0.02
    assert all(row.moving == pytest.approx((0.0, 0.0), abs=0.01) for row in run if row.t_s > 11)
    assert run[-1].seen is not None and run[-1].seen.phase == "lost"


def test_a_robot_held_for_long_starts_without_a_jump() -> None:
    """Integrals must not wind up while the wheels are off."""
    run = Rig(still(1.0, 0.15), held_until_s=5.0).run(10)
    moved = [row for row in run if row.t_s > 5.0]
    bearing, distance = errors_after(run, 7.0)
    assert max(abs(later.moving[0] - row.moving[0]) for row, later in pairwise(moved)) <= 2.0 * 0.004 * 1.01
    assert min(row.distance_m for row in moved) > 0.74
    assert bearing < 0.4
    assert distance < 0.03


def test_a_pushed_ball_is_never_lost() -> None:
    def path(t_s: float) -> tuple[float, float]:
        """Pushed sideways, back and away, each within one frame."""
        pushes = ((2.0, 0.0, 0.5), (4.0, 0.3, -0.8), (6.0, -0.3, 0.3))
        return (0.9 + sum(vx * max(0.0, min(t_s - at, 2.0)) for at, vx, _ in pushes),
                sum(vy * max(0.0, min(t_s - at, 2.0)) for at, _, vy in pushes))

    run = Rig(path, seed=2).run(9)
    assert {row.seen.phase for row in run if row.seen and row.t_s > 0.5} <= {"tracking", "coasting"}
    assert max(abs(row.bearing_rad) for row in run) < math.radians(40)


def test_robot_on_a_late_link_does_not_move() -> None:
    run = Rig(circle(), latency_s=0.45).run(4)
    assert max(abs(row.moving[0]) + abs(row.moving[1]) for row in run) == 0.0


# --- a ball in front of the target -------------------------------------------------------------------------------

RED_BGR, BLUE_BGR = (25, 25, 217), (204, 77, 26)
MODEL, TARGET_M = camera(), 2.0
Bgr = tuple[int, int, int]


def seen_ball(picture: np.ndarray, x_m: float, y_m: float, color: Bgr) -> Detection:
    """Draw a ball and return the detection of it."""
    right, down, ahead = center = ball_about_lens(MODEL, x_m, y_m)
    draw_ball(MODEL, center, picture, color)
    x_px, y_px, r_px = (MODEL.cx_px + MODEL.fx_px * right / ahead, MODEL.cy_px + MODEL.fx_px * down / ahead,
                        MODEL.fx_px * 0.1 / ahead)
    return Detection(x_px - r_px, y_px - r_px, x_px + r_px, y_px + r_px, 0.9, "ball", Circle(x_px, y_px, r_px))


def followed(fps: int, nearer_m: float, places: list[float | None], color: Bgr, own: Bgr = YELLOW_BGR) -> list[str]:
    """Return what is followed in each frame: the ball, another one that is nearer, or the phase.

    `places` are those of the other one to the left, from 1 s on. It hides the ball while it is in front of it. `own` is
    the color of the ball from then on.
    """
    follow, names = Follow(Follow.Config(), MODEL), []
    for number, y_m in enumerate([None] * fps + places):
        picture = np.full((240, 320, 3), FLOOR_BGR, np.uint8)
        is_hidden, is_later = y_m is not None and abs(y_m) < 0.13, number >= fps
        target = seen_ball(picture, TARGET_M, 0.0, own if is_later else YELLOW_BGR)
        other = None if y_m is None else seen_ball(picture, TARGET_M - nearer_m, y_m, color)
        shown = tuple(one for one in (other, None if is_hidden else target) if one is not None)
        header = FrameHeader(session="0000abcd", seq=number + 1, t_us=round((number + 1) * 1e6 / fps))
        plan = follow.step(View(header, 1 / fps if number else 0.0, 0.05, MODEL, shown, DecodedImage(picture, 1)))
        names.append({target: "ball", other: "other", None: plan.phase}[plan.target])
    return names[fps:]


def rolls(fps: int, from_m: float, speed_mps: float, hold_s: float) -> list[float | None]:
    """Return the places of a ball that rolls to the front of the target, stays there, and rolls on to 1.1 m."""
    step_m = speed_mps / fps
    coming = [from_m + step_m * number for number in range(math.ceil(-from_m / step_m))]
    leaving = [step_m * number for number in range(round(1.1 / step_m))]
    return [*coming, *[0.0] * round(hold_s * fps), *leaving, *[1.1] * fps]


@pytest.mark.parametrize(("fps", "from_m", "speed_mps", "hold_s", "color"), [
    (30, 0.0, 0.4, 1.0, RED_BGR), (15, 0.0, 0.4, 1.0, BLUE_BGR), (10, -0.6, 1.2, 3.0, RED_BGR),
    (5, -0.6, 0.6, 3.0, BLUE_BGR), (5, -1.3, 1.5, 3.0, RED_BGR), (4, -1.3, 1.2, 3.0, RED_BGR),
    (2, -1.3, 0.6, 3.0, RED_BGR),
])  # fmt: skip
def test_ball_of_another_color_in_front_of_the_target_is_never_followed(
    fps: int, from_m: float, speed_mps: float, hold_s: float, color: Bgr
) -> None:
    """It is 0.3 m nearer. It comes at once, or after fewer than five frames beside the target."""
    names = followed(fps, 0.3, rolls(fps, from_m, speed_mps, hold_s), color)
    assert "other" not in names and {"lost", "searching"} & {*names}
    assert names[-fps:] == ["ball"] * fps


@pytest.mark.parametrize(("fps", "hold_s"), [(30, 0.5), (15, 1.5), (10, 0.3), (5, 2.0)])
def test_ball_of_another_color_at_the_place_of_the_target_is_followed_no_longer_than_it_hides_the_target(
    fps: int, hold_s: float
) -> None:
    """10 cm nearer, it could be the target in another light."""
    names = followed(fps, 0.1, rolls(fps, 0.0, 0.4, hold_s), RED_BGR)
    assert names[-2 * fps:] == ["ball"] * 2 * fps


@pytest.mark.parametrize("fps", [5, 15])
def test_target_in_another_light_is_followed_without_a_break(fps: int) -> None:
    names = followed(fps, 0.3, [None] * fps * 6, RED_BGR, own=BLUE_BGR)
    assert names == ["ball"] * fps * 6
