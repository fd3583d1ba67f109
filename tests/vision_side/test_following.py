"""Closed loop in the small rig: the figures of issue 2 with room to spare, and what must hold when things go wrong."""

import math
import random
from itertools import pairwise

import pytest

from sightline.vision_side.config import SearchConfig, VisionConfig
from tests.fixtures.vision.vision import Path, Rig, acquired_at, circle, eight, errors_after, still

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
