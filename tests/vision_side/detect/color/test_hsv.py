"""The colour detector and the cone fit: where the ball is, in any light, at any angle, partly hidden."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.protocol.messages import CameraModel
from sightline.vision_side.config import HsvConfig, HsvRange
from sightline.vision_side.decode import DecodedImage, Decoder
from sightline.vision_side.detect.color.hsv import HsvDetector, color_table, fit_round_part
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.locate import locate_sphere
from tests.fixtures.vision.vision import ball_about_lens, camera, draw_ball, jpeg_of, scene

SIZES = [(320, 240), (640, 480)]


def detect(model: CameraModel, picture: np.ndarray) -> tuple[Detection, ...]:
    decoder = Decoder(model.width_px, model.height_px, 10**7)
    return HsvDetector(HsvConfig()).detect(decoder.decode(jpeg_of(picture)))


def errors(model: CameraModel, x_m: float, y_m: float, picture: np.ndarray) -> tuple[float, float]:
    """Bearing error in degrees and distance error as a fraction, about the lens."""
    seen = locate_sphere(detect(model, picture)[0], model, 0.1)
    assert seen is not None
    true = math.hypot(x_m - model.x_m, y_m)
    bearing = math.atan2(seen.y_m, seen.x_m - model.x_m) - math.atan2(y_m, x_m - model.x_m)
    return math.degrees(bearing), math.hypot(seen.x_m - model.x_m, seen.y_m) / true - 1


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("pitch_rad", [0.0, 0.15, -0.1])
@pytest.mark.parametrize(("x_m", "y_m"), [(0.6, 0), (0.855, 0.1), (0.7, -0.3), (1.2, 0.2), (0.9, 0.6), (0.4, 0.1)])
def test_a_whole_ball_is_measured_to_a_tenth_of_a_degree_and_a_hundredth_and_a_half(
    size: tuple[int, int], pitch_rad: float, x_m: float, y_m: float
) -> None:
    model = camera(*size, pitch_rad=pitch_rad)
    bearing, distance = errors(model, x_m, y_m, scene(model, x_m, y_m))
    assert abs(bearing) < 0.1
    assert abs(distance) < 0.015


@pytest.mark.parametrize(("x_m", "y_m"), [(0.5, 0.36), (0.5, -0.36), (0.5, 0.40)])
def test_a_ball_half_out_of_view_is_not_drawn_inwards(x_m: float, y_m: float) -> None:
    model = camera()
    bearing, distance = errors(model, x_m, y_m, scene(model, x_m, y_m))
    assert abs(bearing) < 0.6
    assert abs(distance) < 0.04


def test_partly_hidden_ball_is_measured_by_its_visible_part() -> None:
    model = camera()
    picture = scene(model, 0.855, 0.0)
    picture[:, :150] = (90, 90, 90)  # covers the left third
    bearing, distance = errors(model, 0.855, 0.0, picture)
    assert abs(bearing) < 0.5
    assert abs(distance) < 0.05


@pytest.mark.parametrize(
    ("gain", "add"),
    [
        ((1, 1, 1), 0),
        ((0.4, 0.4, 0.4), 0),
        ((0.75, 1, 1.15), 0),
        ((1.2, 1, 0.85), 0),
        ((1, 1, 1), 20),
    ],
    ids=["plain", "dim", "warm", "cold", "washed"],
)
def test_distance_hardly_depends_on_light(gain: tuple[float, float, float], add: int) -> None:
    model = camera()
    picture = np.clip(scene(model, 0.855, 0.1) * np.array(gain) + add, 0, 255).astype(np.uint8)
    bearing, distance = errors(model, 0.855, 0.1, picture)
    assert abs(bearing) < 0.1
    assert abs(distance) < 0.015


@pytest.mark.parametrize(
    "colour",
    [(20, 200, 30), (190, 210, 225), (30, 30, 200), (200, 60, 30), (255, 255, 255)],
    ids=["green", "beige", "red", "blue", "white"],
)
def test_balls_of_other_colors_are_not_the_target(colour: tuple[int, int, int]) -> None:
    model = camera()
    assert detect(model, scene(model, 0.855, 0.0, colour=colour)) == ()


@pytest.mark.parametrize(
    "corners",
    [
        [(100, 80), (160, 80), (160, 140), (100, 140)],
        [(100, 80), (220, 80), (220, 110), (100, 110)],
        [(100, 140), (160, 140), (130, 80)],
    ],
    ids=["square", "bar", "triangle"],
)
def test_things_of_the_color_that_are_not_round_are_rejected(corners: list[tuple[int, int]]) -> None:
    picture = np.full((240, 320, 3), 140, np.uint8)
    cv2.fillPoly(picture, [np.array(corners)], (13, 199, 242))
    assert detect(camera(), picture) == ()


def test_largest_comes_first_and_boxes_are_exclusive() -> None:
    model = camera()
    picture = scene(model, 1.3, 0.4)
    draw_ball(model, ball_about_lens(model, 0.8, -0.2), picture)
    near, far = detect(model, picture)
    assert near.circle is not None and far.circle is not None
    assert near.circle.radius_px > far.circle.radius_px
    assert near.x2_px - near.x1_px == pytest.approx(2 * near.circle.radius_px, abs=2)
    assert near.x1_px + near.x2_px == pytest.approx(2 * near.circle.cx_px, abs=2.5)


def test_speckle_neither_costs_nor_detects() -> None:
    rng = np.random.default_rng(3)
    picture = np.full((480, 640, 3), 140, np.uint8)
    picture[rng.random((480, 640)) < 0.2] = (13, 199, 242)
    config = HsvConfig(max_contours=4)
    assert len(HsvDetector(config).detect(DecodedImage(picture, 1))) <= 4


@settings(max_examples=40)
@given(seed=st.integers(0, 2**31), rows=st.integers(16, 60), columns=st.integers(16, 60))
def test_no_image_makes_the_detector_raise(seed: int, rows: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    colours = np.array([(13, 199, 242), (140, 140, 140), (0, 0, 0)], np.uint8)
    blocks = colours[rng.integers(0, 3, (rows // 4 + 1, columns // 4 + 1))].repeat(4, 0).repeat(4, 1)
    for one in HsvDetector(HsvConfig()).detect(DecodedImage(np.ascontiguousarray(blocks[:rows, :columns]), 1)):
        assert 0 <= one.x1_px < one.x2_px <= columns
        assert 0 <= one.y1_px < one.y2_px <= rows
        locate_sphere(one, camera(), 0.1)


@given(hue=st.integers(0, 359), low=st.integers(0, 360), high=st.integers(0, 360))
def test_hue_ranges_wrap(hue: int, low: int, high: int) -> None:
    table = color_table((HsvRange(hue_low_deg=low, hue_high_deg=high),))
    bgr = (cv2.cvtColor(np.array([[[hue, 0.9, 0.9]]], np.float32), cv2.COLOR_HSV2BGR)[0, 0] * 255).astype(int)
    code = (bgr[0] >> 3) | (bgr[1] >> 2 << 5) | (bgr[2] >> 3 << 11)
    margin = 3  # a BGR565 code stands for colours up to this far apart
    inside = low <= hue <= high if low <= high else hue >= low or hue <= high
    edges = [abs((hue - edge + 180) % 360 - 180) for edge in (low, high)]
    if min(edges) > margin and not (low > high and hue < margin):
        assert bool(table[code]) == inside


@given(cx=st.floats(-50, 50), cy=st.floats(-50, 50), radius=st.floats(3, 80), start=st.floats(0, 6.28))
def test_circle_fit_is_exact_on_arcs(cx: float, cy: float, radius: float, start: float) -> None:
    turn = np.linspace(start, start + 2.0, 40)
    part = fit_round_part(np.column_stack([cx + radius * np.cos(turn), cy + radius * np.sin(turn)]), 2.9, 0.07)
    assert part is not None and part[0] == pytest.approx((cx, cy, radius), abs=1e-6)


@given(cx=st.floats(0, 640), cy=st.floats(0, 480), radius=st.floats(12, 80), start=st.floats(0, 6.28))
def test_occluding_edge_is_excluded_from_the_circle(cx: float, cy: float, radius: float, start: float) -> None:
    turn = np.linspace(start, start + 2 * math.pi, 120, endpoint=False)
    across = np.minimum(np.cos(turn - start), 0.7)  # a straight cut, at 0.7 radii from the centre
    along = np.sin(turn - start)
    x, y = across * math.cos(start) - along * math.sin(start), across * math.sin(start) + along * math.cos(start)
    part = fit_round_part(np.column_stack([cx + radius * x, cy + radius * y]), 3.0, 0.07)
    assert part is not None
    assert part[0] == pytest.approx((cx, cy, radius), abs=0.035 * radius)
    assert 60 <= len(part[1]) <= 120


@pytest.mark.parametrize("size", [(320, 240), (640, 480)])
@pytest.mark.parametrize("at", range(8))
def test_the_smallest_disc_is_found_wherever_it_lies(size: tuple[int, int], at: int) -> None:
    """A coarse grid of pixels selects the region, and no ball may fall between them."""
    scale, config = size[0] // 320, HsvConfig()
    for row in range(4):
        picture = np.full((size[1], size[0], 3), 140, np.uint8)
        middle = ((100 + at) * scale, (60 + row) * scale)
        cv2.circle(picture, middle, round(4 * scale), (13, 199, 242), -1)
        found = HsvDetector(config).detect(DecodedImage(np.ascontiguousarray(picture[::scale, ::scale]), scale))
        assert len(found) == 1
        assert (found[0].x1_px + found[0].x2_px) / 2 == pytest.approx(middle[0], abs=1.5 * scale)
        assert (found[0].y1_px + found[0].y2_px) / 2 == pytest.approx(middle[1], abs=1.5 * scale)


def test_line_is_not_round() -> None:
    assert fit_round_part(np.column_stack([np.arange(20.0), 2 * np.arange(20.0)]), 3.0, 0.07) is None


@given(x_m=st.floats(0.3, 5), share=st.floats(-0.6, 0.6))
def test_a_box_alone_still_locates(x_m: float, share: float) -> None:
    """A detector that knows no outline: the box of the true ellipse."""
    model = camera()
    centre = ball_about_lens(model, x_m, x_m * share)
    right, down, ahead = centre.tolist()
    half = 0.1 / math.sqrt(ahead**2 - 0.01)
    cx, cy = model.cx_px + model.fx_px * right / ahead, model.cy_px + model.fy_px * down / ahead
    half_px = model.fx_px * half
    box = Detection(cx - half_px, cy - half_px, cx + half_px, cy + half_px, 0.9, "ball")
    seen = locate_sphere(box, model, 0.1)
    if seen is not None:
        assert math.hypot(seen.x_m, seen.y_m) == pytest.approx(math.hypot(x_m, x_m * share), rel=0.25, abs=0.1)


def test_distortion_is_undone() -> None:
    straight = camera()
    bent = straight.model_copy(update={"distortion": (-0.2, 0.05, 0.001, 0.001, 0.0)})
    found = detect(straight, scene(straight, 0.7, 0.3))[0]
    matrix = np.array([[bent.fx_px, 0, bent.cx_px], [0, bent.fy_px, bent.cy_px], [0, 0, 1]])
    assert found.outline_px is not None
    flat = (found.outline_px - (bent.cx_px, bent.cy_px)) / (bent.fx_px, bent.fy_px)
    points = np.column_stack([flat, np.ones(len(flat))])
    outline = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(bent.distortion))[0][:, 0]
    moved = Detection(found.x1_px, found.y1_px, found.x2_px, found.y2_px, 1.0, "ball", found.circle, outline)
    first, second = locate_sphere(found, straight, 0.1), locate_sphere(moved, bent, 0.1)
    assert first is not None and second is not None
    assert (second.x_m, second.y_m) == pytest.approx((first.x_m, first.y_m), abs=0.002)


def test_detections_reach_a_distorted_camera_as_they_are() -> None:
    bent = camera().model_copy(update={"distortion": (1e-9,)})
    found = detect(bent, scene(bent, 0.7, 0.3))[0]
    first, second = locate_sphere(found, camera(), 0.1), locate_sphere(found, bent, 0.1)
    assert first is not None and second is not None
    assert (second.x_m, second.y_m) == pytest.approx((first.x_m, first.y_m), abs=1e-6)
