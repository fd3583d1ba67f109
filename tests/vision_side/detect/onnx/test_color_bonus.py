"""The color bonus: a target of the configured color may have a lower score, and comes first."""

import numpy as np
import pytest

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame, is_followable
from sightline.vision_side.detect.registry import build_detector
from tests.fixtures.vision.vision import camera, jpeg_of, scene

pytestmark = pytest.mark.usefixtures("no_gpu")

YELLOW = {"hue_low_deg": 36, "hue_high_deg": 68}
BALL, LEGS = 0, 4
AT_YELLOW, AT_RED, AT_GRAY = (40.0, 60.0, 100.0, 120.0), (200.0, 60.0, 260.0, 120.0), (120.0, 140.0, 180.0, 200.0)


def detector(color=True, **options):
    section = {"hsv": {"ranges": [YELLOW]}} if color else {}
    return build_detector("onnx", {"second_look": False, **options}, VisionConfig.model_validate(section))


def squares():
    """A gray image with a yellow and a red square, of which there is a model's answer at each."""
    image = np.full((240, 320, 3), 110, np.uint8)
    image[60:120, 40:100] = (30, 210, 230)
    image[60:120, 200:260] = (30, 40, 210)
    return jpeg_of(image)


def found(one, jpeg, answers=None, wanted="", expected_px=None):
    """Return (label, left edge, score) of all that `one` finds; `answers` replace its model's: (box, score, label)."""
    frame = DetectFrame("r1", FrameHeader(session="0000abcd", seq=1, t_us=1), jpeg, Decoder(320, 240, 320 * 240))
    frame.goes_by, frame.expected_px = lambda label: is_followable(label, wanted), expected_px
    if answers is not None:
        boxes, scores, labels = (np.array(part, np.float32) for part in zip(*answers, strict=True))
        one._engine.run = lambda _pixels: {"boxes": boxes * one._form.size[1] / 320, "scores": scores, "labels": labels}
    (result,) = one.detect([frame], NO_DEADLINE)
    return [(each.label, round(each.x1_px), round(each.score, 2)) for each in result.detections]


@pytest.mark.parametrize("score", [0.21, 0.35, 0.49])
def test_a_lower_score_is_enough_for_a_target_of_the_color_alone(score):
    answers = [(box, score, BALL) for box in (AT_RED, AT_YELLOW, AT_GRAY)]
    assert found(detector(refine=[]), squares(), answers) == [("ball", 40, round(score + 0.3, 2))]
    assert found(detector(color=False, refine=[]), squares(), answers) == []
    assert found(detector(refine=[], color_bonus=0.0), squares(), answers) == []


def test_the_target_of_the_color_comes_first_and_no_score_exceeds_1():
    answers = [(AT_RED, 0.9, BALL), (AT_YELLOW, 0.8, BALL), (AT_GRAY, 0.19, BALL)]
    assert found(detector(refine=[]), squares(), answers) == [("ball", 40, 1.0), ("ball", 200, 0.9)]


def test_a_box_that_the_model_has_ruled_out_does_not_count_whatever_its_color():
    answers = [(AT_YELLOW, 0.0, BALL), (AT_RED, 0.25, BALL)]
    assert found(detector(refine=[], min_score=0.2), squares(), answers) == [("ball", 200, 0.25)]
    assert len(found(detector(refine=[], min_score=0.0), squares(), answers)) == 2


def test_what_the_mission_does_not_follow_gets_no_bonus():
    answers = [(AT_YELLOW, 0.4, LEGS), (AT_RED, 0.6, LEGS)]
    assert found(detector(), squares(), answers) == [("legs", 200, 0.6)]
    assert found(detector(), squares(), answers, wanted="legs") == [("legs", 40, 0.7), ("legs", 200, 0.6)]


def test_the_second_look_has_the_bonus_too():
    colored = detector(refine=[], second_look=True)
    looks = iter([0.1, 0.4])
    colored._engine.run = lambda _pixels: {
        "boxes": np.float32([[120, 96, 192, 168]]), "scores": np.float32([next(looks)]), "labels": np.float32([BALL])}
    image = np.full((240, 320, 3), 110, np.uint8)
    image[80:160, 110:190] = (30, 210, 230)
    assert found(colored, jpeg_of(image), expected_px=(160.0, 120.0)) == [("ball", 124, 0.7)]


@pytest.mark.parametrize(("second_look", "nearest_m", "farthest_m"), [(False, 3.6, 8.0), (True, 5.0, 8.5)])
def test_more_far_balls_of_the_color_are_found(second_look, nearest_m, farthest_m):
    model, counts = camera(320, 240), []
    for one in (detector(color=False, second_look=second_look), detector(second_look=second_look)):
        counts.append(0)
        for far_m in np.linspace(nearest_m, farthest_m, 9):
            middle_px = 160 - model.fx_px * 0.1 / far_m
            seen = found(one, jpeg_of(scene(model, far_m, 0.1, shaded=True)))
            counts[-1] += any(abs(left_px - middle_px) < 14 for _, left_px, _ in seen)
    assert counts[0] + 2 <= counts[1]
