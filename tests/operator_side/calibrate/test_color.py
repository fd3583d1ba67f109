"""A place in a picture becomes a range: that of the thing, through red too, and not where there is no colour."""

import colorsys
from random import Random

import cv2
import numpy as np
import pytest

from sightline.operator_side.calibrate.color import (
    MOST_MARKED,
    Box,
    check_trial,
    mask_of,
    mask_picture,
    pick,
    ranges_text,
    trial_text,
    try_out,
)
from sightline.protocol.errors import ConfigError
from sightline.vision_side.config import HsvConfig, HsvRange
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.color.hsv import HsvDetector
from tests.fixtures.vision.vision import camera, scene

MODEL = camera()


def bgr_of(hue_deg, saturation=0.85, value=0.8):
    red, green, blue = colorsys.hsv_to_rgb(hue_deg / 360, saturation, value)
    return round(blue * 255), round(green * 255), round(red * 255)


def ball_picture(hue_deg, x_m=1.0, y_m=0.2, seed=1, **more):
    return scene(MODEL, x_m, y_m, seed=seed, colour=bgr_of(hue_deg, **more))


def shaded(picture):
    """Lit from above: half as bright below."""
    fall = np.linspace(1.0, 0.5, picture.shape[0])[:, None, None]
    return (picture * fall).astype(np.uint8)


BALL = Box(110, 112)
"""Inside the ball of `ball_picture`."""


@pytest.mark.parametrize("hue_deg", range(0, 360, 15))
@pytest.mark.parametrize("place", [BALL, Box(92, 92, 36, 42)], ids=["click", "box"])
def test_picked_color_finds_only_the_target(hue_deg, place):
    random = Random(hue_deg)
    picture = shaded(ball_picture(hue_deg, seed=hue_deg))
    ranges = pick(picture, place)
    others = [ball_picture(hue_deg, random.uniform(0.8, 1.5), random.uniform(-0.3, 0.3), seed=at) for at in range(4)]
    trial = try_out(ranges, [picture, *others])
    check_trial(trial)
    assert (trial.with_any, trial.least_blobs, trial.most_blobs) == (5, 1, 1)
    assert 0.003 < trial.mean_share < 0.05
    opposite = ball_picture((hue_deg + 60) % 360)
    assert cv2.countNonZero(mask_of(ranges, opposite)) == 0


@pytest.mark.parametrize(("hue_deg", "count"), [(0, 2), (3, 2), (357, 2), (354, 2), (30, 1), (330, 1), (120, 1)])
def test_a_color_on_both_sides_of_red_is_two_ranges(hue_deg, count):
    ranges = pick(ball_picture(hue_deg), BALL)
    assert len(ranges) == count
    if count == 2:
        assert (ranges[0].hue_high_deg, ranges[1].hue_low_deg) == (360, 0)
        assert ranges[0].hue_low_deg > 330 and ranges[1].hue_high_deg < 30
    assert all(one.hue_low_deg < one.hue_high_deg for one in ranges)


def test_vision_follows_the_picked_color():
    ranges = pick(ball_picture(210), BALL)
    detector = HsvDetector(HsvConfig(ranges=ranges))
    found = detector.detect(DecodedImage(ball_picture(210, 1.2, -0.1, seed=9), 1))
    assert len(found) == 1 and found[0].circle is not None
    assert detector.detect(DecodedImage(ball_picture(50), 1)) == ()


@pytest.mark.parametrize(("picture", "words"), [
    (np.full((240, 320, 3), 140, np.uint8), "no color at 110,112.*: it is gray"),
    (np.full((240, 320, 3), 255, np.uint8), "gray"),
    (np.full((240, 320, 3), 10, np.uint8), "too dark"),
    (np.zeros((240, 320, 3), np.uint8), "too dark"),
])
def test_place_without_color_is_rejected(picture, words):
    for place in (BALL, Box(110, 112, 20, 20)):
        with pytest.raises(ConfigError, match=words) as why:
            pick(picture, place)
        assert "\n" not in str(why.value)


@pytest.mark.parametrize("place", [Box(320, 0), Box(0, 240), Box(-1, 5), Box(310, 10, 11, 5), Box(0, 239, 1, 2)])
def test_place_outside_is_rejected(place):
    with pytest.raises(ConfigError, match="is outside the image of 320x240"):
        pick(ball_picture(60), place)


def test_several_colors_in_one_box_are_rejected():
    stripes = np.zeros((60, 60, 3), np.uint8)
    for number in range(6):
        stripes[:, number * 10 : number * 10 + 10] = bgr_of(number * 60)
    with pytest.raises(ConfigError, match="several colors at 0,0,60,60: the most common covers 1"):
        pick(stripes, Box(0, 0, 60, 60))


def test_range_that_marks_half_of_an_image_is_rejected():
    wall = np.full((240, 320, 3), bgr_of(120), np.uint8)
    ranges = pick(wall, BALL)
    assert try_out(ranges, [wall]).most_share == 1.0
    for part, refused in ((MOST_MARKED + 0.02, True), (MOST_MARKED - 0.02, False)):
        half = np.full((240, 320, 3), 120, np.uint8)
        half[: round(240 * part)] = bgr_of(120)
        trial = try_out(ranges, [ball_picture(120), half])
        if not refused:
            check_trial(trial)
            continue
        with pytest.raises(ConfigError, match=r"marks 5[0-9]% of an image: the background has the same color"):
            check_trial(trial)


def test_range_that_marks_only_speckle_is_rejected():
    speckled = np.full((240, 320, 3), 120, np.uint8)
    speckled[112, 110] = bgr_of(20)
    ranges = (HsvRange(hue_low_deg=10, hue_high_deg=30),)
    with pytest.raises(ConfigError, match="marks only speckle"):
        check_trial(try_out(ranges, [speckled]))


def test_mask_image_shows_the_marked_area_next_to_the_mask():
    picture = ball_picture(60)
    ranges = pick(picture, BALL)
    shown = mask_picture(ranges, picture)
    assert shown.shape == (240, 640, 3)
    assert np.array_equal(shown[112, 110], picture[112, 110]) and tuple(shown[112, 430]) == (255, 255, 255)
    assert shown[10, 10].max() < 70 and tuple(shown[10, 330]) == (0, 0, 0)


def test_ranges_and_trials_are_formatted_as_text():
    ranges = pick(ball_picture(0), BALL)
    assert " and hue 0 to " in ranges_text(ranges)
    two = ball_picture(0)
    two[:40, :40] = bgr_of(0)
    several = trial_text(try_out(ranges, [two, ball_picture(0), ball_picture(120)]))
    assert several.endswith("in 0 to 2 blobs; marks in 2 of 3 images")
    assert "in 1 blob; marks in 1 of 1" in trial_text(try_out(ranges, [ball_picture(0)]))
