"""The simulated camera against the pinhole model, and what looks do to a picture."""

import math

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

import simplejpeg

from sightline.protocol.jpeg import read_jpeg_size
from sightline.sim.scenario import Wall, load_scenario, look_named
from sightline.sim.world.world import World
from tests.fixtures.sim import robot_with, seen_at, use_pybullet_without_numpy

BALL_RADIUS_M = 0.10


def picture(world: World) -> np.ndarray:
    """One frame, RGB."""
    return simplejpeg.decode_jpeg(world.render(), "RGB").astype(int)


def ball_mask(rgb: np.ndarray) -> np.ndarray:
    """Pixels in the ball's colour: red far above blue."""
    return rgb[..., 0] - rgb[..., 2] > 60


def outline(world: World) -> tuple[float, float, float]:
    """(u, v, area) of the ellipse that a ball's outline is in the pinhole model: its own, not TinyRenderer's maths."""
    model, truth = world.camera_model, world.truth()
    centre = np.array([
        -truth.distance_m * math.sin(truth.bearing_rad), model.z_m - truth.target_z_m,
        truth.distance_m * math.cos(truth.bearing_rad),
    ])
    cone = np.outer(centre, centre) - (centre @ centre - BALL_RADIUS_M**2) * np.eye(3)
    middle = -np.linalg.solve(cone[:2, :2], cone[:2, 2])
    scale = cone[2, 2] + cone[:2, 2] @ middle
    area = math.pi * abs(scale) / math.sqrt(np.linalg.det(cone[:2, :2])) * model.fx_px * model.fy_px
    return model.cx_px + model.fx_px * middle[0], model.cy_px + model.fy_px * middle[1], area


@pytest.mark.parametrize("distance_m", [0.5, 0.8, 1.5, 3.0])
@pytest.mark.parametrize("bearing_deg", [-28.0, -10.0, 0.0, 10.0, 28.0])
def test_the_ball_is_where_the_pinhole_model_has_it(distance_m, bearing_deg):
    with World(seen_at(distance_m, bearing_deg), robot_with(), 1) as world:
        for _ in range(50):
            world.step()
        rows, columns = np.nonzero(ball_mask(picture(world)))
        u, v, area = outline(world)
        assert columns.mean() + 0.5 == pytest.approx(u, abs=0.5)
        assert rows.mean() + 0.5 == pytest.approx(v, abs=0.5)
        assert math.sqrt(len(rows) / math.pi) == pytest.approx(math.sqrt(area / math.pi), abs=0.5)


def test_a_wall_hides_the_part_of_the_ball_behind_it():
    scenario = seen_at(1.0, 0.0)
    with World(scenario, robot_with(), 1) as world:
        whole, truth = ball_mask(picture(world)), world.truth()
    along, across = truth.yaw_rad, truth.yaw_rad + math.pi / 2
    foot = (truth.x_m + 0.5 * math.cos(along), truth.y_m + 0.5 * math.sin(along))
    left = (foot[0] + 3 * math.cos(across), foot[1] + 3 * math.sin(across))
    for far_m, hidden in ((0.0, True), (1.0, False)):
        ends = [(x + far_m * math.cos(along), y + far_m * math.sin(along)) for x, y in (foot, left)]
        wall = Wall(start_m=ends[0], end_m=ends[1], thickness_m=0.02)
        with World(scenario.model_copy(update={"walls": (wall,)}), robot_with(), 1) as world:
            seen = ball_mask(picture(world))
        assert seen[:, 160:].sum() == pytest.approx(whole[:, 160:].sum(), rel=0.1)
        assert seen[:, :158].any() != hidden


def test_a_wall_meets_the_floor_where_the_pinhole_model_has_it():
    scenario = seen_at(20.0, 180.0)
    with World(scenario, robot_with(), 1) as world:
        model, truth = world.camera_model, world.truth()
    lens = (truth.x_m + model.x_m * math.cos(truth.yaw_rad), truth.y_m + model.x_m * math.sin(truth.yaw_rad))
    ahead, across = truth.yaw_rad, truth.yaw_rad + math.pi / 2
    middle = (lens[0] + 1.05 * math.cos(ahead), lens[1] + 1.05 * math.sin(ahead))
    ends = [(middle[0] + s * math.cos(across), middle[1] + s * math.sin(across)) for s in (-3, 3)]
    wall = Wall(start_m=ends[0], end_m=ends[1], thickness_m=0.1, height_m=0.2, color=(0.0, 0.0, 0.2))
    with World(scenario.model_copy(update={"walls": (wall,)}), robot_with(), 1) as world:
        rows = np.nonzero(picture(world)[:, 160, 0] < 60)[0]
    assert rows.min() == pytest.approx(model.cy_px - model.fy_px * (0.2 - model.z_m), abs=1.5)
    assert rows.max() + 1 == pytest.approx(model.cy_px + model.fy_px * model.z_m, abs=1.5)


def test_lens_against_a_wall_sees_only_the_wall():
    scenario = seen_at(20.0, 180.0)
    with World(scenario, robot_with(), 1) as world:
        model, truth = world.camera_model, world.truth()
    ahead, across = truth.yaw_rad, truth.yaw_rad + math.pi / 2
    middle_m = model.x_m + 0.005 + 0.05  # 5 mm in front of the lens, and half of the wall
    middle = (truth.x_m + middle_m * math.cos(ahead), truth.y_m + middle_m * math.sin(ahead))
    ends = [(middle[0] + s * math.cos(across), middle[1] + s * math.sin(across)) for s in (-3, 3)]
    wall = Wall(start_m=ends[0], end_m=ends[1], thickness_m=0.1, height_m=0.3, color=(0.0, 0.0, 0.2))
    with World(scenario.model_copy(update={"walls": (wall,)}), robot_with(), 1) as world:
        assert (picture(world)[..., 0] < 60).all()


def test_image_with_pybullet_without_numpy_is_the_same(monkeypatch):
    scenario = seen_at(1.0, 0.0)
    with World(scenario, robot_with(), 1) as world:
        truth = world.truth()
    ahead = (truth.x_m + 2 * math.cos(truth.yaw_rad), truth.y_m + 2 * math.sin(truth.yaw_rad))
    wall = Wall(start_m=ahead, end_m=(ahead[0] + 0.5, ahead[1] + 0.5))
    walled = scenario.model_copy(update={"walls": (wall,)})
    with World(walled, robot_with(), 1) as world:
        expected = picture(world)
    widths = use_pybullet_without_numpy(monkeypatch)
    with World(walled, robot_with(), 1) as world:
        rgb = picture(world)
    assert widths == [rgb.shape[1]]
    assert ball_mask(rgb).any() and np.array_equal(rgb, expected)


@pytest.mark.parametrize("look", ["plain", "clean", "dim", "bright", "warm", "cold", "soft"])
def test_nothing_but_the_ball_is_strongly_coloured(look):
    for bearing_deg in (90.0, 180.0):
        with World(seen_at(1.0, bearing_deg, look=look), robot_with(), 1) as world:
            rgb = simplejpeg.decode_jpeg(world.render(), "RGB").astype(float)
        spread = (rgb.max(axis=-1) - rgb.min(axis=-1)) / np.maximum(rgb.max(axis=-1), 40)
        assert np.quantile(spread, 0.999) < 0.55


def test_looks_have_their_effects():
    def seen(look: str) -> np.ndarray:
        with World(seen_at(0.8, 0.0, look=look), robot_with(), 1) as world:
            return simplejpeg.decode_jpeg(world.render(), "RGB").astype(float)

    plain, dim, warm = seen("clean"), seen("dim"), seen("warm")
    assert dim.mean() == pytest.approx(plain.mean() / 2, rel=0.05)
    assert warm[..., 2].mean() < 0.8 * plain[..., 2].mean()
    assert np.abs(np.diff(seen("soft"), axis=1)).mean() < np.abs(np.diff(seen("plain"), axis=1)).mean()


def test_noise_differs_from_frame_to_frame_and_a_clean_look_has_none():
    for look, same in (("plain", False), ("clean", True)):
        with World(seen_at(0.8, 0.0, look=look), robot_with(), 1) as world:
            assert (world.render() == world.render()) == same


def test_size_and_quality_are_data():
    robot = robot_with()
    big = robot.model_copy(update={"camera": robot.camera.model_copy(update={"width_px": 640, "height_px": 480})})
    with World(load_scenario("circle"), big, 1) as world:
        jpeg = world.render()
    assert (read_jpeg_size(jpeg).width_px, read_jpeg_size(jpeg).height_px) == (640, 480)
    coarse = load_scenario("circle").model_copy(update={"look": look_named("soft")})
    with World(coarse, big, 1) as world:
        assert len(world.render()) < len(jpeg)


@pytest.mark.parametrize(("look", "expected"), [
    ("plain", (195.44, 197.14, 197.54, 111.78, 109.06, 103.08, 8.79, 0.92)),
    ("clean", (195.68, 197.39, 197.14, 110.51, 108.95, 103.34, 8.39, 0.72)),
    ("dim", (98.36, 98.91, 98.41, 55.46, 54.54, 51.95, 4.98, 2.01)),
    ("bright", (253.81, 253.01, 245.47, 166.75, 162.70, 155.28, 12.51, 1.06)),
    ("warm", (225.09, 196.99, 148.06, 127.89, 108.97, 77.69, 20.70, 1.22)),
    ("cold", (166.81, 197.41, 236.84, 94.43, 109.01, 124.33, 14.69, 1.23)),
    ("soft", (195.35, 197.99, 198.96, 109.61, 110.06, 102.91, 8.46, 0.46)),
    ("desaturated", (196.20, 197.08, 197.27, 110.09, 109.01, 106.02, 8.32, 1.18)),
    ("quality30", (195.09, 198.14, 198.88, 109.57, 110.02, 102.87, 8.54, 0.70)),
])
def test_looks_without_new_options_draw_what_they_drew_before(look, expected):
    """Means of both halves, spread of the floor and mean step from pixel to pixel, measured before there was `real`."""
    with World(seen_at(0.8, 0.0, look=look), robot_with(), 1) as world:
        rgb = simplejpeg.decode_jpeg(world.render(), "RGB").astype(float)
    found = (*rgb[:120].mean(axis=(0, 1)), *rgb[120:].mean(axis=(0, 1)), rgb[200:].std(),
             np.abs(np.diff(rgb, axis=1)).mean())
    assert found == pytest.approx(expected, abs=0.15)
