"""Combinators: labels, colours, ids from frame to frame; and the shapes that other tools take."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.filters import KEPT_US, MAX_TRACKS, ColorFilter, LabelFilter, TrackIds
from sightline.vision_side.detect.port import (
    NO_DEADLINE,
    DetectFrame,
    Detection,
    clipped,
    corners,
    overlap,
)
from tests.fixtures.vision.detector import Told, box
from tests.fixtures.vision.vision import YELLOW_BGR, jpeg_of

GREY = np.full((240, 320, 3), 140, np.uint8)


def frame(seq: int = 1, bgr: np.ndarray = GREY, robot: str = "r1", t_us: int | None = None,
          session: str = "0000abcd") -> DetectFrame:
    header = FrameHeader(session=session, seq=seq, t_us=seq * 33_333 if t_us is None else t_us)
    return DetectFrame(robot, header, jpeg_of(bgr), Decoder(bgr.shape[1], bgr.shape[0], 10**7))


def look(detector, one: DetectFrame) -> tuple[Detection, ...] | None:
    (result,) = detector.detect([one], NO_DEADLINE)
    return result and result.detections


def test_only_configured_labels_count() -> None:
    fallback = box(99, label="target")
    detector = LabelFilter(Told([box(10), box(60, label="legs"), fallback], [box(60, label="legs")], None), ("ball",))
    assert look(detector, frame()) == (box(10), fallback)
    assert look(detector, frame()) == ()
    assert detector.detect([frame()], NO_DEADLINE) == [None], "no answer stays no answer"


@pytest.mark.parametrize("scale", [1, 2])
def test_model_finds_balls_and_color_selects_one(scale: int) -> None:
    picture = np.full((240 * scale, 320 * scale, 3), 140, np.uint8)
    for x, colour in ((60, YELLOW_BGR), (160, (200, 60, 30)), (260, (140, 140, 140))):
        cv2.circle(picture, (x * scale, 120 * scale), 20 * scale, colour, -1)
    balls = [box((x - 20) * scale, 100 * scale, 40 * scale) for x in (160, 60, 260)]
    detector = ColorFilter(Told(balls), HsvConfig().ranges)
    assert look(detector, frame(bgr=picture)) == (balls[1],)


@given(x=st.floats(-50, 400), y=st.floats(-50, 300), size=st.floats(0.01, 500))
def test_any_box_in_the_image_has_a_color(x: float, y: float, size: float) -> None:
    inside = clipped(box(x, y, size), 320, 240)
    if inside is not None:
        assert look(ColorFilter(Told([inside]), HsvConfig().ranges), frame()) == ()


def test_without_an_image_the_color_filter_has_no_answer() -> None:
    bad = DetectFrame("r1", frame().header, b"no picture", Decoder(320, 240, 10**7))
    assert ColorFilter(Told([box(1)]), HsvConfig().ranges).detect([bad], NO_DEADLINE) == [None]


def ids(detector, *frames: DetectFrame) -> list[list[int | None]]:
    return [[one.track_id for one in look(detector, each) or ()] for each in frames]


def test_slow_object_keeps_its_id_in_any_order() -> None:
    detector = TrackIds(Told([box(10), box(200)], [box(205), box(16)], [box(22), box(120), box(210)]))
    assert ids(detector, frame(1), frame(2), frame(3)) == [[1, 2], [2, 1], [1, 3, 2]]


def test_two_that_meet_do_not_share_an_id() -> None:
    detector = TrackIds(Told([box(10), box(40)], [box(24), box(27)]))
    first, second = ids(detector, frame(1), frame(2))
    assert sorted(second) == sorted(first) == [1, 2]


def test_another_label_or_a_second_away_is_another_thing() -> None:
    detector = TrackIds(Told([box(10)], [box(10, label="legs")], [box(10)], [box(10)]))
    late = frame(9, t_us=10 * 33_333 + KEPT_US + 1)
    assert ids(detector, frame(1), frame(2), frame(3), late) == [[1], [2], [1], [3]]


def test_robots_and_sessions_have_separate_ids() -> None:
    detector = TrackIds(Told([box(10)], [box(10)], [box(10)], [box(200)]))
    frames = frame(1), frame(1, robot="r2"), frame(2), frame(1, session="0000beef")
    assert ids(detector, *frames) == [[1], [1], [1], [1]]


def test_many_objects_need_bounded_memory() -> None:
    many = [box(4.0 * index, size=3.0) for index in range(MAX_TRACKS + 20)]
    detector = TrackIds(Told(*[many] * 4))
    for seq in range(1, 5):
        given_ids = ids(detector, frame(seq))[0]
        assert given_ids[:MAX_TRACKS] == list(range(1, MAX_TRACKS + 1)) and set(given_ids[MAX_TRACKS:]) == {None}


@given(x=st.floats(-100, 100), y=st.floats(-100, 100), size=st.floats(1, 100))
def test_overlap_is_a_share_and_the_same_both_ways(x: float, y: float, size: float) -> None:
    one, other = corners(box(0, 0)), corners(box(x, y, size))
    assert overlap(one, one) == pytest.approx(1)
    assert overlap(one, other) == pytest.approx(overlap(other, one))
    assert 0 <= overlap(one, other) <= 1 + 1e-9


@pytest.mark.parametrize(
    ("corners", "expected"),
    [((-5, -5, 10, 10), (0, 0, 10, 10)), ((300, 200, 400, 300), (300, 200, 320, 240)), ((320, 0, 330, 9), None),
     ((5, 5, 5, 9), None), ((float("nan"), 5, 6, 9), None), ((9, 9, 5, 12), None)],
)
def test_boxes_are_clipped_to_the_image(corners: tuple, expected: tuple | None) -> None:
    part = clipped(Detection(*corners, 0.5, "ball"), 320, 240)
    assert (None if part is None else (part.x1_px, part.y1_px, part.x2_px, part.y2_px)) == expected
