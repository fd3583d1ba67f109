"""A camera with latency shows the past: the same image, and the same labels, as at that time."""

import math

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

import simplejpeg

from sightline.sim.robot import load_robot
from sightline.sim.scenario import Look, load_scenario, look_named
from sightline.sim.world.world import STEP_US, World
from tests.fixtures.sim import robot_with, seen_at


def started(name: str, look: Look, seed: int = 2) -> World:
    scenario = load_scenario(name).model_copy(update={"look": look})
    return World(scenario, load_robot(scenario.robot), seed)


@pytest.mark.parametrize("name", ["circle", "pushed", "legs-crowd", "traffic-light", "occluder"])
def test_image_and_labels_with_latency_are_those_of_that_time(name):
    look = Look(noise=0.0, shadows=0.3, clutter=3, room_m=1.0)
    late_steps = 25
    delayed = look.model_copy(update={"latency_ms": late_steps * STEP_US // 1000})
    with started(name, look) as now, started(name, delayed) as late:
        for world in (now, late):
            world.set_wheels(4.0, 6.0)
        for _ in range(late_steps):
            late.step()
        for _ in range(6):
            for _ in range(200):
                now.step()
                late.step()
            expected, got = (simplejpeg.decode_jpeg(world.render(), "RGB").astype(int) for world in (now, late))
            assert np.abs(got - expected).mean() < 0.02  # a position set and read again may differ in its last bit
            assert np.quantile(np.abs(got - expected), 0.999) <= 8
            for one, other in zip(now.labels(), late.labels(), strict=True):
                assert one[1:] == pytest.approx(other[1:], abs=1e-3)


def test_traffic_light_with_latency_changes_later_in_the_image():
    scenario = load_scenario("traffic-light")
    near = scenario.start.model_copy(update={"at_m": (2.0, -0.4), "heading_deg": (0.0, 0.0), "jitter_m": 0.0})
    look = Look(noise=0.0, latency_ms=400)
    with World(scenario.model_copy(update={"start": near, "look": look}), robot_with(), 5) as world:
        state = world.truth().light
        while world.truth().light == state:
            before = simplejpeg.decode_jpeg(world.render(), "RGB").astype(int)
            for _ in range(25):
                world.step()
        for _ in range(50):
            world.step()
        soon = simplejpeg.decode_jpeg(world.render(), "RGB").astype(int)
        for _ in range(60):
            world.step()
        later = simplejpeg.decode_jpeg(world.render(), "RGB").astype(int)
    assert (np.abs(soon - before) > 60).sum() == 0
    assert (np.abs(later - before) > 60).sum() > 50


def test_labels_follow_the_rolling_shutter_of_a_turning_robot():
    def left_px(wheel_rad_s: float, readout_ms: float) -> float:
        with started("legs", Look(noise=0.0, rolling_shutter_ms=readout_ms)) as world:
            world.set_wheels(-wheel_rad_s, wheel_rad_s)
            for _ in range(50):
                world.step()
            return world.labels()[0].x1_px

    assert left_px(0.0, 80) == pytest.approx(left_px(0.0, 0), abs=1e-2)
    assert abs(left_px(4.0, 80) - left_px(4.0, 0)) > 1.0


def test_before_there_is_a_past_the_image_is_the_first():
    with started("circle", Look(noise=0.0, latency_ms=500)) as world:
        first = world.render()
        world.set_wheels(-6.0, 6.0)
        for _ in range(100):
            world.step()
        assert world.render() == first
        for _ in range(60):
            world.step()
        assert world.render() != first


def test_images_of_the_look_real_are_of_the_seed_byte_for_byte():
    def images(seed: int) -> list[bytes]:
        with started("circle", look_named("real"), seed) as world:
            world.set_wheels(4.0, 7.0)
            found = []
            for _ in range(2):
                for _ in range(10):
                    world.step()
                found.append(world.render())
            return found

    assert images(5) == images(5)
    assert images(5) != images(6)


def test_truth_and_capture_time_have_no_latency():
    with started("circle", Look()) as now, started("circle", Look(latency_ms=200)) as late:
        for world in (now, late):
            world.set_wheels(5.0, 4.0)
            for _ in range(300):
                world.step()
            world.render()
        assert now.truth() == late.truth()


@pytest.mark.parametrize("direction", [-1, 1])
def test_rows_of_a_rolling_shutter_show_the_time_of_their_exposure(direction):
    """The turning robot's image, row by row, against images that are exposed at once at the time of that row."""
    readout_ms = 40
    global_shutter = seen_at(1.0, 0.0).model_copy(update={"look": Look(noise=0.0, jpeg_quality=100)})
    with World(global_shutter, robot_with(), 1) as world:
        world.set_wheels(-3.0 * direction, 3.0 * direction)
        for _ in range(60):
            world.step()
        at_once = []
        for _ in range(readout_ms * 1000 // STEP_US + 1):
            at_once.append(simplejpeg.decode_jpeg(world.render(), "RGB").astype(float))
            world.step()
    look = Look(noise=0.0, jpeg_quality=100, rolling_shutter_ms=readout_ms)
    with World(seen_at(1.0, 0.0).model_copy(update={"look": look}), robot_with(), 1) as world:
        world.set_wheels(-3.0 * direction, 3.0 * direction)
        for _ in range(60 + len(at_once) // 2):
            world.step()
        rolling = simplejpeg.decode_jpeg(world.render(), "RGB").astype(float)

    def middle_px(rgb: np.ndarray, row: int) -> float:
        return float(np.nonzero(rgb[row, :, 0] - rgb[row, :, 2] > 60)[0].mean())

    rows = np.nonzero((rolling[..., 0] - rolling[..., 2] > 60).sum(axis=1) > 8)[0]
    moved = abs(middle_px(at_once[0], 125) - middle_px(at_once[-1], 125))
    assert moved > 5
    for row in (int(rows[2]), int(rows[-3])):
        exposed = at_once[round(row / 240 * (len(at_once) - 1))]
        assert middle_px(rolling, row) == pytest.approx(middle_px(exposed, row), abs=0.8)


def test_turning_robot_blurs_its_image_and_a_standing_one_does_not():
    look = Look(noise=0.0, jpeg_quality=100, motion_blur_ms=30)

    def steepest(wheel_rad_s: float) -> float:
        with World(seen_at(1.0, 0.0).model_copy(update={"look": look}), robot_with(), 1) as world:
            world.set_wheels(-wheel_rad_s, wheel_rad_s)
            for _ in range(60):
                world.step()
            rgb = simplejpeg.decode_jpeg(world.render(), "RGB").astype(float)
        return float(np.abs(np.diff(rgb[..., 0] - rgb[..., 2], axis=1)).max())

    assert steepest(3.0) < 0.6 * steepest(0.0)


def test_known_lens_gives_the_pipeline_the_true_bearing_and_an_unknown_one_does_not():
    from sightline.vision_side.tracking.locate import points_ahead

    errors_deg = {}
    for is_known in (True, False):
        look = Look(noise=0.0, distortion=(-0.12, 0.012), lens_known=is_known)
        with World(seen_at(1.5, 33.0).model_copy(update={"look": look}), robot_with(), 1) as world:
            rgb = simplejpeg.decode_jpeg(world.render(), "RGB").astype(int)
            rows, columns = np.nonzero(rgb[..., 0] - rgb[..., 2] > 60)
            middle = np.array([[columns.mean() + 0.5, rows.mean() + 0.5]])
            right = points_ahead(middle, world.camera_model)[0, 0]
            errors_deg[is_known] = abs(math.degrees(-math.atan(right) - world.truth().bearing_rad))
    assert errors_deg[True] < 0.3
    assert errors_deg[False] > 1.0
