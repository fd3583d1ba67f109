"""The overlay of an image: its places, its text, and its robustness against any text of a detector."""

import math

import cv2
import numpy as np
import pytest

from sightline.protocol.messages import STILL, FrameHeader, Twist
from sightline.vision_side.detect.port import Circle, Detection
from sightline.vision_side.overlay import (
    AXES,
    FILTERED,
    OTHER,
    OUTLINE,
    RAW,
    TARGET,
    OverlayData,
    draw_overlay,
    draw_preview,
    filtered_px,
    radius_px,
    raw_px,
)
from sightline.vision_side.pipeline import Observation
from tests.fixtures.vision.vision import ball_about_lens, camera, scene

MODEL = camera()
HEADER = FrameHeader(session="0000abcd", seq=7, t_us=1_000, applied=(0.1, -0.2), latency_us=34_000)
GREY = np.full((240, 320, 3), 90, np.uint8)


def ball(x_px=200.0, y_px=90.0, radius=20.0, **more):
    turn = np.linspace(0, 2 * math.pi, 60)
    outline = np.column_stack([x_px + radius * np.cos(turn), y_px + radius * np.sin(turn)])
    return Detection(x_px - radius, y_px - radius, x_px + radius, y_px + radius, 0.9, "ball",
                     Circle(x_px, y_px, radius), outline, **more)


def shown(target=None, others=(), model=MODEL, **seen):
    found = (*((target,) if target else ()), *others)
    about = Observation(seen.pop("phase", "tracking"), found, target, **seen)
    return OverlayData(HEADER, about, Twist(linear_mps=0.2, angular_rad_s=-0.35), "follow", model, 0.1)


def near(canvas, colour, x_px, y_px, reach_px=4):
    """Return True if a pixel of about that color is within `reach_px` of the place."""
    part = canvas[max(0, y_px - reach_px) : y_px + reach_px + 1, max(0, x_px - reach_px) : x_px + reach_px + 1]
    return bool((np.abs(part.astype(int) - colour).max(axis=2) < 40).any())


def test_axes_go_through_the_middle_and_the_image_stays_below():
    canvas = draw_overlay(GREY, shown(phase="searching"), 640)
    assert canvas.shape == (480, 640, 3) and canvas.dtype == np.uint8
    assert tuple(canvas[200, 320]) == AXES and tuple(canvas[240, 100]) == AXES
    assert tuple(canvas[150, 100]) == (90, 90, 90)
    assert GREY[120, 160].tolist() == [90, 90, 90]  # what was given is not drawn into


def test_the_target_has_outline_circle_raw_and_filtered_centroid():
    target = ball()
    bearing = math.atan2(MODEL.cx_px - 190.0, MODEL.fx_px)
    canvas = draw_overlay(GREY, shown(target, bearing_rad=bearing, distance_m=1.0), 640)
    assert near(canvas, RAW, 400, 180) and near(canvas, OUTLINE, 440, 180) and near(canvas, TARGET, 440, 180)
    assert near(canvas, FILTERED, 380, 180 - 15)  # the tip of its diamond
    assert not near(draw_overlay(GREY, shown(target), 640), FILTERED, 380, 180 - 15)


def test_objects_that_are_not_targets_are_distinguished():
    box = Detection(40, 50, 80, 110, 0.5, "box")
    canvas = draw_overlay(GREY, shown(ball(), [box]), 640)
    assert near(canvas, OTHER, 80, 150, 1) and not near(canvas, TARGET, 80, 150, 3)


def test_words_are_in_strips_above_and_below():
    canvas = draw_overlay(GREY, shown(ball(), distance_m=1.0, bearing_rad=0.1), 640)
    for strip in (canvas[:20], canvas[-40:]):
        assert strip.max() > 200 and np.median(strip) < 50
    silent = draw_overlay(GREY, shown(ball(), distance_m=1.0, bearing_rad=0.1, note="something else"), 640)
    assert not np.array_equal(canvas[:20], silent[:20]) and np.array_equal(canvas[30:], silent[30:])


@pytest.mark.parametrize("pitch_rad", [0.0, 0.15, -0.1])
@pytest.mark.parametrize(("x_m", "y_m"), [(1.2, 0.3), (0.6, -0.2), (3.0, 0.0)])
def test_the_filtered_centroid_is_where_a_ball_on_the_floor_would_be(pitch_rad, x_m, y_m):
    model = camera(pitch_rad=pitch_rad)
    right, down, ahead = ball_about_lens(model, x_m, y_m)
    ahead_m = x_m - model.x_m
    found = filtered_px(shown(model=model, bearing_rad=math.atan2(y_m, ahead_m), distance_m=math.hypot(ahead_m, y_m)))
    assert found == pytest.approx((model.cx_px + model.fx_px * right / ahead, model.cy_px + model.fy_px * down / ahead))


def test_behind_the_lens_or_unknown_there_is_no_filtered_centroid():
    assert filtered_px(shown()) is None
    assert filtered_px(shown(bearing_rad=3.0, distance_m=1.0)) is None
    assert filtered_px(shown(bearing_rad=math.nan, distance_m=1.0)) is None


def test_a_box_without_a_circle_has_its_middle_and_a_radius_of_like_area():
    box = Detection(10, 20, 30, 60, 1.0, "box")
    assert raw_px(box) == (20, 40) and radius_px(box) == pytest.approx(math.sqrt(800 / math.pi))


@pytest.mark.parametrize("odd", [
    Detection(math.nan, 0, math.inf, 5, 1.0, "x"),
    Detection(-1e9, -1e9, 1e9, 1e9, 1.0, "x", Circle(1e8, -1e8, 1e7)),
    Detection(1, 1, 2, 2, math.nan, "日本\x07" * 40, Circle(math.nan, math.nan, 3)),
    Detection(1, 1, 2, 2, 1.0, "x", None, np.empty((0, 2))),
])
def test_any_text_of_a_detector_is_drawn(odd):
    for one in (shown(odd, bearing_rad=1e9, distance_m=1e-9), shown(ball(), [odd], note="wörter\n" * 100)):
        assert draw_overlay(GREY, one, 640).shape == (480, 640, 3)


@pytest.mark.parametrize("width_px", [160, 320, 640, 1280])
def test_any_width_keeps_the_cameras_shape(width_px):
    wide = camera(320, 180)
    assert draw_overlay(np.zeros((180, 320, 3), np.uint8), shown(ball(), model=wide), width_px).shape == (
        round(width_px * 180 / 320), width_px, 3)


def test_missing_command_is_reported():
    told = shown(ball())
    none = OverlayData(told.header, told.seen, None, "follow", MODEL, 0.1)
    still = OverlayData(told.header, told.seen, STILL, "follow", MODEL, 0.1)
    assert not np.array_equal(draw_overlay(GREY, none, 640)[-25:], draw_overlay(GREY, still, 640)[-25:])


def test_the_age_is_the_robots_own_measure_or_else_the_least_it_can_be():
    unmeasured = HEADER.model_copy(update={"latency_us": None})
    strips = [
        draw_overlay(GREY, OverlayData(header, Observation("lost"), None, "follow", MODEL, 0.1, age_us), 640)[
            :20
        ].tobytes()
        for header in (HEADER, unmeasured)
        for age_us in (None, 12_000)
    ]
    assert strips[0] == strips[1] and len(set(strips)) == 3


def test_a_preview_is_the_image_made_small():
    picture = scene(MODEL, 1.0, 0.2)
    small = draw_preview(picture, 160)
    assert small.shape == (120, 160, 3)
    assert np.abs(cv2.resize(picture, (160, 120), interpolation=cv2.INTER_AREA).astype(int) - small).max() <= 1
    assert draw_preview(picture, 640) is picture
