"""The places of detections: spheres from exact outlines and against another solver, boxes by size and bearing."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sightline.protocol.codec import encode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import (
    CameraModel,
    DetectedBox,
    DetectedCircle,
    Detections,
    DetectionsHeader,
    Echo,
    FrameHeader,
)
from sightline.vision_side.config import BoxesConfig
from sightline.vision_side.detect.port import Circle, Detection, clipped
from sightline.vision_side.tracking import locate as module
from sightline.vision_side.tracking.locate import (
    REMEMBERED,
    BoxReader,
    Sighting,
    locate_box,
    locate_sphere,
    place_px,
    points_ahead,
)

CAMERA = CameraModel(
    width_px=640, height_px=480, fx_px=400.0, fy_px=410.0, cx_px=330.0, cy_px=235.0, x_m=0.1, y_m=-0.05, pitch_rad=0.2
)
LEVEL = CAMERA.model_copy(update={"pitch_rad": 0.0})
RADIUS_M = 0.1
DISTORTIONS = [(0.1,), (0.1, -0.02, 0.001, 0.002), (0.1, -0.02, 0.001, 0.002, 0.003), (0.1, -0.02, 0, 0, 0, 0.01),
               (0.1, -0.02, 0, 0, 0, 0.01, 0.02, 0.003)]


def rays(center, count=24, share=(0.0, 1.0), radius_m=RADIUS_M):
    """Return rays (right, down, ahead) along the edge of a sphere, over a share of the edge."""
    center = np.array(center, float)
    distance = np.linalg.norm(center)
    axis = center / distance
    across = np.cross(axis, [0.3, 1.0, 0.2])
    across /= np.linalg.norm(across)
    down = np.cross(axis, across)
    sin = radius_m / distance
    turn = 2 * math.pi * np.linspace(*share, count, endpoint=False)
    return math.sqrt(1 - sin**2) * axis + sin * (np.outer(np.cos(turn), across) + np.outer(np.sin(turn), down))


def pixels(directions, camera=CAMERA):
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])
    distortion = np.array((*camera.distortion, *(0.0,) * (8 - len(camera.distortion))))
    return cv2.projectPoints(directions, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]


def outlined(outline_px):
    return Detection(0.0, 0.0, 1.0, 1.0, 1.0, "ball", outline_px=outline_px)


def place(center, camera=CAMERA):
    """Return where this center is about the robot: the lens points up by the pitch."""
    right, down, ahead = center
    return (
        camera.x_m + ahead * math.cos(camera.pitch_rad) + down * math.sin(camera.pitch_rad), camera.y_m - right
    )  # fmt: skip


def at(sighting):
    return sighting.x_m, sighting.y_m


# --- spheres -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("center", [
    (0.0, 0.0, 1.0), (0.5, 0.2, 1.2), (-0.8, 0.3, 1.0), (0.2, -0.1, 3.0), (0.05, 0.02, 0.15), (-0.3, -0.3, 0.4),
])  # fmt: skip
@pytest.mark.parametrize("share", [(0.0, 1.0), (0.1, 0.5), (0.6, 0.9)])
def test_sphere_is_located_exactly_by_any_part_of_its_outline(center, share):
    detection = outlined(pixels(rays(center, share=share)))
    sighting = locate_sphere(detection, CAMERA, RADIUS_M)
    assert sighting is not None and sighting.exactness == 1
    assert sighting.detection is detection
    assert at(sighting) == pytest.approx(place(center), abs=1e-5)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_distortion_of_the_lens_is_removed(distortion):
    camera = CAMERA.model_copy(update={"distortion": distortion})
    center = (0.3, -0.2, 1.0)
    sighting = locate_sphere(outlined(pixels(rays(center), camera)), camera, RADIUS_M)
    assert at(sighting) == pytest.approx(place(center), abs=1e-3)
    plain = locate_sphere(outlined(pixels(rays(center), camera)), CAMERA, RADIUS_M)
    assert at(plain) != pytest.approx(place(center), abs=1e-3)


@pytest.mark.parametrize("radius_m", [0.05, 0.3])
def test_distance_follows_from_the_radius(radius_m):
    sighting = locate_sphere(outlined(pixels(rays((0.2, 0.1, 1.5), radius_m=radius_m))), CAMERA, radius_m)
    assert at(sighting) == pytest.approx(place((0.2, 0.1, 1.5)), abs=1e-6)


@pytest.mark.parametrize(("count", "located"), [(5, False), (6, True)])
def test_outline_of_fewer_than_six_points_is_not_located(count, located):
    detection = outlined(pixels(rays((0.0, 0.0, 1.0), count)))
    assert (locate_sphere(detection, CAMERA, RADIUS_M) is not None) == located


@pytest.mark.parametrize("points", [
    np.full((8, 2), 100.0), np.column_stack([np.arange(8) * 10.0, np.arange(8) * 10.0]),
    np.column_stack([np.arange(8) * 10.0, np.full(8, 40.0)]),
])  # fmt: skip
def test_points_on_a_line_are_not_a_sphere(points):
    assert locate_sphere(outlined(points), CAMERA, RADIUS_M) is None


def test_sphere_beside_the_lens_is_not_located():
    """Its center is behind the plane of the lens, though a part of it is in view."""
    edge = rays((1.0, 0.0, -0.05), 400, radius_m=0.6)
    assert locate_sphere(outlined(pixels(edge[edge[:, 2] > 0.05])), CAMERA, 0.6) is None
    edge = rays((1.0, 0.0, 0.05), 400, radius_m=0.6)
    sighting = locate_sphere(outlined(pixels(edge[edge[:, 2] > 0.05])), LEVEL, 0.6)
    assert at(sighting) == pytest.approx(place((1.0, 0.0, 0.05), LEVEL), abs=1e-4)


def solved(outline_px, camera, radius_m):
    """Fit by another solver: least squares of LAPACK; at most three times drop what is off by four median errors."""
    directions = np.column_stack([
        (outline_px[:, 0] - camera.cx_px) / camera.fx_px, (outline_px[:, 1] - camera.cy_px) / camera.fy_px,
        np.ones(len(outline_px)),
    ])  # fmt: skip
    lengths = np.linalg.norm(directions, axis=1)
    for trimmed in range(4):
        w = np.linalg.lstsq(directions, lengths, rcond=None)[0]
        off = np.abs(directions @ w - lengths)
        fits = off <= 4.0 * np.sort(off)[len(off) // 2]
        if trimmed == 3 or fits.all():
            break
        directions, lengths = directions[fits], lengths[fits]
    return radius_m * w / math.sqrt(w @ w - 1)


@pytest.mark.parametrize("distance_m", [30.0, 2_000.0])
def test_sphere_far_away_is_located(distance_m):
    """Its edge is 1.3 or 0.02 pixels from its center."""
    sighting = locate_sphere(outlined(pixels(rays((0.0, 0.0, distance_m)))), LEVEL, RADIUS_M)
    assert at(sighting) == pytest.approx(place((0.0, 0.0, distance_m), LEVEL), rel=1e-3)


@pytest.mark.parametrize("seed", range(32))
def test_points_far_off_the_outline_are_dropped_as_another_solver_drops_them(seed):
    """The edge of another object in front of the sphere, and the stair-steps of pixels."""
    random = np.random.default_rng(seed)
    outline = pixels(rays((0.2, 0.1, 1.0), 40)) + random.laplace(0, 0.2, (40, 2))
    if seed % 4 == 3:
        outline += random.choice([-1, 1], (40, 2)) * random.lognormal(-4, 2.5, (40, 2))  # beyond three times
    else:
        outline[:6] += random.normal(0, (0.5, 3.0, 9.0)[seed % 4], (6, 2))
    expected = place(solved(outline, CAMERA, RADIUS_M))
    assert at(locate_sphere(outlined(outline), CAMERA, RADIUS_M)) == pytest.approx(expected, abs=1e-7)


def test_outline_that_the_last_fit_cannot_use_is_not_located(monkeypatch):
    """Each fit leaves out the points furthest off, and after the third time too few directions are left."""
    fits = iter([(0.0, 0.0, 1.0)] * 3 + [None])
    monkeypatch.setattr(module, "_solved", lambda _points: next(fits))
    off = np.sqrt(2.0 ** np.arange(0, -24, -1))  # each half as far off as the one before it
    outline = np.column_stack([330.0 + 400.0 * off, np.full(24, 235.0)])
    assert locate_sphere(outlined(outline), CAMERA, RADIUS_M) is None
    assert next(fits, "all used") == "all used"


# --- a sphere from its box ---------------------------------------------------------------------------------------


def boxed(x1, y1, x2, y2):
    return Detection(x1, y1, x2, y2, 0.9, "ball")


def ellipse(x1, y1, x2, y2):
    """Return 24 points of the ellipse in a box."""
    turn = np.arange(24) * 2 * math.pi / 24
    return np.column_stack([
        (x1 + x2) / 2 + (x2 - x1) / 2 * np.cos(turn), (y1 + y2) / 2 + (y2 - y1) / 2 * np.sin(turn)
    ])  # fmt: skip


@pytest.mark.parametrize("box", [(300.0, 200.0, 380.0, 290.0), (10.0, 20.0, 60.0, 66.0), (1.5, 1.5, 99.0, 90.0),
                                 (558.6, 200.0, 638.6, 290.0), (300.0, 398.6, 380.0, 478.6)])
def test_sphere_without_an_outline_is_the_ellipse_in_its_box(box):
    expected = locate_sphere(outlined(ellipse(*box)), CAMERA, RADIUS_M)
    assert at(locate_sphere(boxed(*box), CAMERA, RADIUS_M)) == pytest.approx(at(expected))


@pytest.mark.parametrize(("box", "border"), [
    ((1.0, 1.0, 81.0, 91.0), lambda x, y: (x > 1) & (y > 1)),
    ((559.0, 389.0, 639.0, 479.0), lambda x, y: (x < 639) & (y < 479)),
    ((0.0, 0.0, 60.0, 70.0), lambda x, y: (x > 1) & (y > 1)),
    ((590.0, 400.0, 640.0, 480.0), lambda x, y: (x < 639) & (y < 479)),
])  # fmt: skip
def test_points_in_a_corner_of_the_image_are_left_out(box, border):
    points = ellipse(*box)
    shown = points[border(*points.T)]
    assert len(shown) < 24
    expected = locate_sphere(outlined(shown), CAMERA, RADIUS_M)
    assert at(locate_sphere(boxed(*box), CAMERA, RADIUS_M)) == pytest.approx(at(expected))


def ball_box(center, camera=CAMERA):
    """Return the box of a ball as a detector delivers it, and whether the border of the image cuts it."""
    edge = pixels(rays(center, 1440), camera)
    box = boxed(*edge.min(axis=0), *edge.max(axis=0))
    shown = clipped(box, camera.width_px, camera.height_px)
    return shown, shown is not box


@pytest.mark.parametrize("center", [
    (0.75, 0.0, 1.0), (-0.8, 0.1, 1.0), (0.0, -0.55, 1.0), (0.1, 0.57, 1.0), (0.3, 0.33, 0.6), (-0.37, 0.0, 0.5),
])  # fmt: skip
def test_ball_at_the_border_is_located_by_the_three_sides_in_view(center):
    """At most half of it is hidden."""
    box, is_cut = ball_box(center)
    found = locate_sphere(box, CAMERA, RADIUS_M)
    assert is_cut and at(found) == pytest.approx(place(center), abs=1e-4) and found.exactness == 1.0


@pytest.mark.parametrize("center", [(-0.4, 0.28, 0.5), (0.36, 0.27, 0.5), (0.4, -0.33, 0.5), (-0.8, -0.6, 1.0)])
def test_ball_in_a_corner_of_the_image_has_a_bearing_and_an_inexact_range(center):
    box, is_cut = ball_box(center, LEVEL)
    found, (x_m, y_m) = locate_sphere(box, LEVEL, RADIUS_M), place(center, LEVEL)
    assert is_cut and found is not None and found.exactness == 0.3
    assert math.atan2(found.y_m, found.x_m) == pytest.approx(math.atan2(y_m, x_m), abs=0.15)
    outlined_box = replace(box, outline_px=pixels(rays(center), LEVEL))
    assert locate_sphere(outlined_box, LEVEL, RADIUS_M).exactness == 1.0


def test_outline_of_a_ball_at_the_border_counts_more_than_its_box():
    box, _ = ball_box((0.75, 0.0, 1.0))
    other = replace(box, outline_px=pixels(rays((0.3, 0.1, 0.8))))
    assert at(locate_sphere(other, CAMERA, RADIUS_M)) == pytest.approx(place((0.3, 0.1, 0.8)), abs=1e-5)


@pytest.mark.parametrize("box", [
    (639.5, 200.0, 600.0, 290.0), (300.0, 479.5, 380.0, 400.0), (300.0, 0.0, 300.0, 90.0), (0.0, 200.0, 50.0, 200.0),
    (0.0, 100.0, 1.00001, 100.00001),
])  # fmt: skip
def test_empty_box_of_a_ball_is_not_located(box):
    assert locate_sphere(boxed(*box), CAMERA, RADIUS_M) is None


def test_box_outside_the_image_is_not_located():
    assert locate_sphere(boxed(-90.0, 200.0, 0.5, 290.0), CAMERA, RADIUS_M) is None


def test_rays_are_right_down_ahead_and_their_length():
    found = points_ahead(np.array([[330.0, 235.0], [730.0, 645.0]]), CAMERA)
    assert found.T.tolist() == [pytest.approx([0.0, 0.0, 1.0, 1.0]), pytest.approx([1.0, 1.0, 1.0, math.sqrt(3.0)])]


# --- boxes by their size -----------------------------------------------------------------------------------------


def box_at(right_m, down_m, ahead_m, width_m=0.2, height_m=0.4, camera=LEVEL):
    """Return the box of a flat thing that faces the lens."""
    x, y = camera.cx_px + camera.fx_px * right_m / ahead_m, camera.cy_px + camera.fy_px * down_m / ahead_m
    half_x, half_y = camera.fx_px * width_m / ahead_m / 2, camera.fy_px * height_m / ahead_m / 2
    return boxed(x - half_x, y - half_y, x + half_x, y + half_y)


@pytest.mark.parametrize("sizes", [
    {"height_m": 0.4}, {"width_m": 0.2}, {"height_m": 0.4, "width_m": 0.2}, {"height_m": 0.4, "width_m": 9.0},
])  # fmt: skip
@pytest.mark.parametrize("pitch_rad", [0.0, 0.3])
def test_box_is_located_by_its_height_else_its_width(sizes, pitch_rad):
    camera = CAMERA.model_copy(update={"pitch_rad": pitch_rad})
    box = box_at(0.3, -0.1, 1.5)
    found = locate_box(box, camera, BoxesConfig(**sizes), 9.0)
    assert found == Sighting(*map(pytest.approx, place((0.3, -0.1, 1.5), camera)), box, exactness=1.0)


def test_sightings_at_one_place_are_equal_whatever_their_looks():
    """An array has no truth of its own: a comparison that took it in would raise."""
    one, other = (Sighting(1.0, 0.0, boxed(0, 0, 1, 1), look=np.full(2, value)) for value in (0.2, 0.8))
    assert one == other


def test_box_of_unknown_size_is_on_its_bearing_at_the_assumed_distance():
    """3 to 4 over the floor: 1.5 m are 0.9 and 1.2."""
    found = locate_box(box_at(0.9, 0.0, 1.2), LEVEL, BoxesConfig(), 1.5)
    assert at(found) == pytest.approx((0.1 + 1.2, -0.05 - 0.9))
    found = locate_box(box_at(0.9, 0.5, 1.2), CAMERA, BoxesConfig(), 1.5)
    forward, across = math.cos(0.2) + 0.5 / 1.2 * math.sin(0.2), 0.75
    scale = 1.5 / math.hypot(forward, across)
    assert at(found) == pytest.approx((0.1 + scale * forward, -0.05 - scale * across))


@pytest.mark.parametrize(("moved", "by"), [
    ({}, "height"), ({"y1_px": 1.0}, "height"), ({"y1_px": 0.99}, "width"), ({"y2_px": 479.0}, "height"),
    ({"y2_px": 479.01}, "width"), ({"y1_px": 0.5, "x1_px": 1.0}, "width"), ({"y1_px": 0.5, "x1_px": 0.99}, "none"),
    ({"y1_px": 0.5, "x2_px": 639.0}, "width"), ({"y1_px": 0.5, "x2_px": 639.01}, "none"),
])  # fmt: skip
def test_size_counts_only_if_both_ends_are_in_view(moved, by):
    """A pixel at the border may hide the rest of the thing."""
    edges = {"x1_px": 100.0, "y1_px": 100.0, "x2_px": 200.0, "y2_px": 300.0, **moved}
    box = boxed(*edges.values())
    height, width = (box.y2_px - box.y1_px) / 410.0, (box.x2_px - box.x1_px) / 400.0
    across = ((box.x1_px + box.x2_px) / 2 - 330.0) / 400.0
    ahead = {"height": 0.4 / height, "width": 0.2 / width, "none": 1.5 / math.hypot(1.0, across)}[by]
    found = locate_box(box, LEVEL, BoxesConfig(height_m=0.4, width_m=0.2), 1.5)
    assert at(found) == pytest.approx((0.1 + ahead, -0.05 - ahead * across))


@pytest.mark.parametrize("box", [
    (100.0, 100.0, 100.0, 200.0), (100.0, 100.0, 200.0, 100.0), (100.0, 100.0, 100.0, 100.0),
])  # fmt: skip
def test_empty_box_is_not_located(box):
    for sizes in ({}, {"height_m": 0.4}, {"width_m": 0.2}):
        assert locate_box(boxed(*box), LEVEL, BoxesConfig(**sizes), 1.5) is None


@pytest.mark.parametrize(("pitch_rad", "located"), [(-1.0, True), (-1.2, False), (-1.5, False)])
def test_box_behind_the_robot_is_not_located(pitch_rad, located):
    """A lens that points at the floor has what is at its lower border behind itself."""
    camera = CAMERA.model_copy(update={"pitch_rad": pitch_rad})
    box = boxed(300.0, 430.0, 360.0, 470.0)  # 0.524 down for each meter ahead
    assert (locate_box(box, camera, BoxesConfig(), 1.0) is not None) == located


@pytest.mark.parametrize("distortion", [(), *DISTORTIONS])
@pytest.mark.parametrize("pitch_rad", [0.0, 0.2, -0.3])
def test_place_in_the_image_is_that_of_the_object_over_the_floor(pitch_rad, distortion):
    """Before, it was elsewhere on a ray of the same slope."""
    camera = CAMERA.model_copy(update={"pitch_rad": pitch_rad, "distortion": distortion})
    was, now = pixels(np.array([[-0.4, 0.3, 1.0], [0.25, 0.3, 1.0]]), camera)
    found = place_px(*place((0.1, 0.12, 0.4), camera), tuple(was), camera)
    assert found == pytest.approx(tuple(now), abs=0.05)


@pytest.mark.parametrize(("x_m", "y_m", "pitch_rad"), [
    (0.1, 0.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 0.0, -1.2), (math.nan, 0.0, 0.0), (1.0, math.nan, 0.0),
    (1.0, math.inf, 0.0),
])  # fmt: skip
def test_object_that_is_not_in_front_of_the_camera_has_no_place_in_the_image(x_m, y_m, pitch_rad):
    camera = CAMERA.model_copy(update={"pitch_rad": pitch_rad})
    assert place_px(x_m, y_m, (330.0, 450.0), camera) is None


# --- boxes of another service ------------------------------------------------------------------------------------

ROBOT = "0000000a"


def frame(seq=3, t_us=30, session=ROBOT):
    return FrameHeader(session=session, seq=seq, t_us=t_us)


def boxes(*found, size=(640, 480), echo="same", channel="frame", sender="0000000b", **changes):
    named = {"session": ROBOT, "seq": 3, "t_us": 30, **changes}
    echo = Echo(channel=channel, **named) if echo == "same" else echo
    header = DetectionsHeader(source="guest", session=sender, seq=1, echo=echo)
    return encode(header), encode(Detections(width_px=size[0], height_px=size[1], boxes=found))


def box(score=0.5, label="ball", x1_px=10.0, circle=None):
    return DetectedBox(label=label, score=score, x1_px=x1_px, y1_px=20.0, x2_px=60.0, y2_px=70.0, circle=circle)


def reader(**config):
    made = BoxReader(BoxesConfig(**config))
    made.remember(frame())
    return made


def test_boxes_name_their_frame_and_become_detections_best_first():
    circle = DetectedCircle(cx_px=35.0, cy_px=45.0, radius_px=25.0)
    found, detections = reader().read(*boxes(box(0.3), box(0.9, "cup", circle=circle), box(0.5)), CAMERA)
    assert found == frame()
    assert detections == (
        Detection(10.0, 20.0, 60.0, 70.0, 0.9, "cup", Circle(35.0, 45.0, 25.0)),
        Detection(10.0, 20.0, 60.0, 70.0, 0.5, "ball"), Detection(10.0, 20.0, 60.0, 70.0, 0.3, "ball"),
    )  # fmt: skip
    assert reader().read(*boxes(), CAMERA) == (frame(), ())


@pytest.mark.parametrize(("config", "kept"), [
    ({}, ["ball", "cup"]), ({"label": "cup"}, ["cup"]), ({"label": "hat"}, []), ({"min_score": 0.5}, ["ball", "cup"]),
    ({"min_score": 0.51}, ["ball"]),
])  # fmt: skip
def test_only_boxes_of_the_label_and_score_are_meant(config, kept):
    _, detections = reader(**config).read(*boxes(box(0.6), box(0.5, "cup")), CAMERA)
    assert [one.label for one in detections] == kept


@pytest.mark.parametrize(("changes", "reason", "detail"), [
    ({"size": (320, 240)}, "MALFORMED", "boxes of a 320x240 image, the camera delivers 640x480"),
    ({"size": (640, 240)}, "MALFORMED", "boxes of a 640x240 image"),
    ({"echo": None}, "UNKNOWN_FRAME", "boxes answer no frame"),
    ({"seq": 4}, "UNKNOWN_FRAME", "boxes answer frame 4 of session 0000000a, not received here"),
    ({"session": "0000000f"}, "UNKNOWN_FRAME", "boxes answer frame 3 of session 0000000f"),
    ({"t_us": 31}, "UNKNOWN_FRAME", "boxes answer frame 3"), ({"channel": "status"}, "UNKNOWN_FRAME", "boxes answer"),
])  # fmt: skip
def test_boxes_of_another_size_or_frame_are_rejected(changes, reason, detail):
    with pytest.raises(WireError) as error:
        reader().read(*boxes(box(), **changes), CAMERA)
    assert error.value.reason == reason and error.value.detail.startswith(detail)


@pytest.mark.parametrize(("ends_px", "is_rejected"), [((1.0,), True), ((1.99, 0.5), True), ((2.0, 1.0), False)])
def test_boxes_in_the_corner_are_rejected_as_boxes_from_0_to_1(ends_px, is_rejected):
    found = [box().model_copy(update={"x1_px": 0.0, "y1_px": 0.0, "x2_px": end, "y2_px": end}) for end in ends_px]
    if not is_rejected:
        assert len(reader().read(*boxes(*found), CAMERA)[1]) == len(found)
        return
    with pytest.raises(WireError) as error:
        reader().read(*boxes(*found), CAMERA)
    assert (error.value.reason, error.value.detail) == (
        "MALFORMED", "all boxes lie within two pixels of the corner, as if from 0 to 1")


@pytest.mark.parametrize(("senders", "returns"), [
    ("a", 0), ("aaa", 0), ("ab", 0), ("aabbcc", 0), ("aba", 1), ("aabba", 1), ("abab", 2), ("abbaacca", 2), ("abca", 0),
])
def test_changes_back_to_the_service_before_the_last_one_are_counted(senders, returns):
    made = reader()
    for sender in senders:
        made.read(*boxes(sender=f"0000000{sender}"), CAMERA)
    assert made.returns == returns


def test_the_last_128_frames_are_remembered():
    made = reader()
    assert REMEMBERED == 128
    for seq in range(4, 131):
        made.remember(frame(seq, seq * 10))
    assert made.read(*boxes(), CAMERA)[0] == frame()
    made.remember(frame(131, 1310))
    with pytest.raises(WireError):
        made.read(*boxes(), CAMERA)
    assert made.read(*boxes(seq=4, t_us=40), CAMERA)[0] == frame(4, 40)
