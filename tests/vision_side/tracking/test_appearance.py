"""The look of drawn objects: the same in any brightness, another for another color, and bounded for any box."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.appearance import OTHER, difference, look_of, updated

COLORS = {"yellow": (13, 199, 242), "orange": (13, 110, 242), "red": (25, 25, 217), "blue": (204, 77, 26),
          "green": (64, 166, 38), "white": (235, 235, 235)}  # fmt: skip
"""Blue, green, red."""
BALL = Detection(130.0, 90.0, 190.0, 150.0, 1.0, "ball")


def picture_of(color, floor=(90, 90, 90), gain=1.0, noise=3.0, seed=1, scale=1):
    image = np.full((240 // scale, 320 // scale, 3), floor, np.float64)
    cv2.circle(image, (160 // scale, 120 // scale), 30 // scale, color, cv2.FILLED)
    image = image * gain + np.random.default_rng(seed).normal(0, noise, image.shape)
    return DecodedImage(np.clip(image, 0, 255).astype(np.uint8), scale)


def look(color, one=BALL, **changes):
    return look_of(picture_of(COLORS.get(color, color), **changes), one)


@pytest.mark.parametrize("color", COLORS)
def test_look_has_length_1_and_does_not_depend_on_brightness_floor_and_scale(color):
    first = look(color)
    assert first.shape == (64,) and float(first @ first) == pytest.approx(1.0, abs=1e-5)
    for changes in ({"gain": 0.3}, {"floor": (20, 60, 160)}, {"scale": 2}, {"seed": 2}):
        assert difference(first, look(color, **changes)) < 0.1, changes


@pytest.mark.parametrize(("one", "other"), [
    ("yellow", "red"), ("yellow", "blue"), ("orange", "blue"), ("red", "green"), ("white", "red"), ("blue", "red"),
])
def test_other_colors_are_other_looks(one, other):
    assert difference(look(one), look(other)) > OTHER == 0.4, "measured: docs/explanation/decisions/0013-identity.md"


def look_by_pixels(bgr, corners, scale):
    """The definition: colors by their shares of green and red in the middle 0.6 of a box, at most 20 pixels a side."""
    x1, y1, x2, y2 = (value / scale for value in corners)
    left, right = (max(0, round((x1 + x2) / 2 + sign * 0.3 * (x2 - x1))) for sign in (-1, 1))
    top, bottom = (max(0, round((y1 + y2) / 2 + sign * 0.3 * (y2 - y1))) for sign in (-1, 1))
    counts = np.zeros((10, 10))
    for y in range(top, min(bottom, len(bgr)), 1 + (bottom - top) // 20):
        for x in range(left, min(right, len(bgr[0])), 1 + (right - left) // 20):
            blue, green, red = map(int, bgr[y, x])
            light = max(1, blue + green + red)
            counts[1 + min(7, 8 * green // light), 1 + min(7, 8 * red // light)] += light
    counts[[0, 9]], counts[:, [0, 9]] = counts[[2, 7]], counts[:, [2, 7]]
    counts[[0, 9]] = counts[[2, 7]]
    blur = np.array([0.25, 0.5, 0.25])
    smooth = sum(blur[i] * blur[j] * counts[i : i + 8, j : j + 8] for i in range(3) for j in range(3))
    return np.sqrt(smooth / smooth.sum()).ravel()


@pytest.mark.parametrize("seed", range(12))
def test_look_is_the_share_of_each_color_in_the_middle_of_the_box(seed):
    random = np.random.default_rng(seed)
    bgr = np.where(random.random((240, 320, 1)) < 0.5, random.integers(0, 256, (240, 320, 3)), (0, 0, 250 * (seed % 2)))
    bgr = bgr.astype(np.uint8)
    x1, y1 = random.uniform(-60, 260), random.uniform(-60, 180)
    corners = (x1, y1, x1 + random.uniform(60, 180), y1 + random.uniform(60, 120))
    scale = 1 + seed % 2
    found = look_of(DecodedImage(bgr, scale), Detection(*(scale * value for value in corners), 1.0, "ball"))
    assert found == pytest.approx(look_by_pixels(bgr, [scale * value for value in corners], scale), abs=1e-5)


def test_color_of_the_middle_counts_and_not_that_of_the_corners():
    wide = replace(BALL, x1_px=125.0, x2_px=195.0, y1_px=85.0, y2_px=155.0)
    assert difference(look("yellow"), look("yellow", wide, floor=COLORS["blue"])) < 0.05


def test_dark_pixels_count_less_than_bright_ones():
    image = picture_of((0, 0, 200), noise=0.0)
    image.bgr[::3] = (4, 1, 1)
    assert difference(look_of(image, BALL), look((0, 0, 200), noise=0.0)) < 0.05


@pytest.mark.parametrize(("corners", "is_known"), [
    ((158, 118, 164, 124), True), ((158, 118, 163, 123), False), ((-50, -50, -1, -1), False),
    ((-40, -40, 60, 60), True), ((300, 220, 400, 300), False), ((0, 0, 320, 240), True), ((160, 120, 160, 120), False),
    ((-50, 20, -1, 150), False), ((20, -50, 150, -1), False),
    ((150, 110, 163.4, 113.4), True), ((150, 110, 161.7, 113.4), False), ((150, 110, 158.4, 115), False),
])
def test_look_is_known_from_16_pixels_on_for_any_box(corners, is_known):
    found = look("yellow", Detection(*map(float, corners), 1.0, "ball"))
    assert (found is not None) == is_known


def test_unknown_looks_do_not_differ():
    assert difference(None, None) == difference(look("red"), None) == difference(None, look("red")) == 0.0
    for one in map(look, COLORS):
        assert 0.0 <= difference(one, one) < 1e-6
    assert difference(*np.eye(64, dtype=np.float32)[:2]) == 1.0


def test_look_follows_the_newest_one():
    first, newest = np.eye(64, dtype=np.float32)[:2]
    now, differences = first, []
    for _ in range(8):
        now = updated(now, newest)
        differences.append(difference(now, newest))
        assert float(now @ now) == pytest.approx(1.0, abs=1e-5)
    assert differences == sorted(differences, reverse=True) and differences[-1] < 0.02
    assert differences[0] == pytest.approx(1 - 0.3 / math.hypot(0.7, 0.3), abs=1e-6)
    assert updated(None, newest) is newest and updated(first, None) is first and updated(None, None) is None
