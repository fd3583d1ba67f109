"""The score of detectors: results, figures, average precision, and the command on real scenes."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")


from sightline.evaluation.score.detector_report import DetectorReport, markdown, score_scenes, subjects, text
from sightline.evaluation.score.detectors import FrameResult, LabelMatches, figures, frame_result, precisions
from sightline.operator_side.cli import app as cli
from sightline.operator_side.cli import evaluate as cli_score_detectors
from sightline.sim.scenes.model import COLUMNS, SCORED_FROM, LabelledBox, Scene
from sightline.sim.scenes.plan import plan_scene
from sightline.training.shipping import ball_threshold, label_threshold
from sightline.vision_side.detect.port import Circle, Detection, overlap

pytestmark = pytest.mark.computes

BALL = LabelledBox("ball", (100.0, 100.0, 140.0, 140.0), 1.0, (100.0, 100.0, 140.0, 140.0))
OTHER = (200.0, 100.0, 240.0, 160.0)


def scene(truths=(BALL,), others=(OTHER,), unclear=()):
    plan = plan_scene(SCORED_FROM + 1, COLUMNS["nominal"])
    return Scene(plan, np.zeros((240, 320, 3), np.uint8), tuple(truths), tuple(others), tuple(unclear))


def found(x1, y1, x2, y2, score=0.9, label="ball", circle=None):
    return Detection(x1, y1, x2, y2, score, label, circle)


def test_overlap_is_intersection_by_union():
    assert overlap((0, 0, 2, 2), (1, 0, 3, 2)) == pytest.approx(1 / 3)
    assert overlap((0, 0, 2, 2), (2, 0, 3, 2)) == 0 and overlap((0, 0, 2, 2), (0, 0, 2, 2)) == 1


@pytest.mark.parametrize(("detections", "outcome"), [
    ([found(100, 100, 140, 140)], "hit"),
    ([found(100, 100, 140, 121)], "hit"),  # just more than half of it
    ([found(100, 100, 140, 119)], "nowhere"),
    ([found(*OTHER)], "wrong object"),
    ([found(10, 10, 30, 30)], "nowhere"),
    ([], "none"),
    (None, "none"),
    ([found(*OTHER, label="legs")], "none"),  # another label is not followed
    ([found(*OTHER), found(100, 100, 140, 140)], "wrong object"),  # the first is the answer
    ([found(100, 100, 140, 140, label="target")], "hit"),  # what the colour detectors call it
    ([found(100, 100, 140, 140, label="sports ball")], "hit"),  # what models of COCO call it
])
def test_first_answer_decides(detections, outcome):
    assert frame_result(detections, scene()).outcome == outcome


def test_a_half_hidden_ball_is_hit_by_its_visible_part_or_by_its_circle():
    half = replace(BALL, box=(120.0, 100.0, 140.0, 140.0), seen=0.5)
    assert frame_result([found(120, 100, 140, 140)], scene([half])).outcome == "hit"
    assert frame_result([found(130, 100, 140, 140, circle=Circle(120, 120, 20))], scene([half])).outcome == "hit"


def test_the_centre_counts_only_where_all_of_the_ball_is_in_view():
    assert frame_result([found(103, 104, 143, 144)], scene()).off_px == pytest.approx(5.0)
    assert frame_result([found(103, 104, 143, 144, circle=Circle(121, 120, 20))], scene()).off_px == pytest.approx(1.0)
    assert frame_result([found(100, 100, 140, 140)], scene([replace(BALL, seen=0.9)])).off_px is None


def test_legs_and_lights_are_wrong_objects_too():
    legs = LabelledBox("legs", (10.0, 100.0, 60.0, 200.0), 1.0)
    assert frame_result([found(20, 110, 40, 150)], scene([BALL, legs])).outcome == "wrong object"


def test_figures_count_each_frame_where_it_belongs():
    frames = [
        FrameResult(True, "hit", 0.9, 1.0, 900),
        FrameResult(True, "hit", 0.9, 3.0, 1100),
        FrameResult(True, "wrong object", 0.6),
        FrameResult(True, "none"),
        FrameResult(False, "none"),
        FrameResult(False, "nowhere", 0.5),
        FrameResult(False, "wrong object", 0.5),
        FrameResult(False, "none"),
    ]
    one = figures(frames)
    assert (one.frames, one.balls, one.hits, one.missed) == (8, 4, 0.5, 0.25)
    assert (one.wrong_object, one.false_alarms) == (0.25, 0.5)
    assert (one.centre_p50_px, one.centre_p95_px, one.compute_p50_us) == (3.0, 3.0, 1100.0)
    assert figures([]).hits == 0.0


def test_answer_on_nothing_while_a_ball_is_in_view_is_shown():
    hits = [FrameResult(True, "hit", 0.9)] * 3
    one = figures([FrameResult(True, "nowhere", 0.5), *hits, FrameResult(False, "nowhere")])
    assert one.nowhere == 0.25
    shown = DetectorReport(0, 5, {"nominal": {"hsv": one}}, {"hsv": {}}, {}, {}, {})
    head, cells = (line.split("|")[1:-1] for line in markdown(shown).splitlines()[::2][:2])
    assert cells[[cell.strip() for cell in head].index("nowhere")].strip() == "25.0 %"


def test_average_precision_knows_the_simple_cases():
    def of(objects, marks):
        return LabelMatches(objects, list(marks)).average_precision()

    assert of(2, [(0.9, True), (0.8, True)]) == 1.0
    assert of(2, [(0.9, True)]) == 0.5
    assert of(1, [(0.9, False), (0.8, True)]) == 0.5
    assert of(2, [(0.9, True), (0.8, False), (0.7, True)]) == pytest.approx(0.5 + 0.5 * 2 / 3)
    assert of(3, []) == 0.0 and of(0, [(0.5, False)]) is None


def test_each_object_is_found_once_and_what_is_unclear_counts_for_nothing():
    legs = LabelledBox("legs", (10.0, 100.0, 60.0, 200.0), 1.0)
    one = LabelMatches()
    detections = [found(10, 100, 60, 200, 0.9, "legs"), found(12, 100, 60, 200, 0.8, "legs"),
                  found(200, 50, 230, 150, 0.7, "legs"), found(*OTHER, label="ball")]
    one.add("legs", detections, scene([legs], unclear=[(195.0, 50.0, 225.0, 120.0)]))
    assert one.objects == 1 and one.marks == [(0.9, True), (0.8, False)]


def test_label_that_is_never_found_is_reported():
    legs = LabelledBox("legs", (10.0, 100.0, 60.0, 200.0), 1.0)
    seen = [found(10, 100, 60, 200, 0.9, "light-red")]
    marks = {label: LabelMatches() for label in ("legs", "light-red")}
    for label, one in marks.items():
        one.add(label, seen, scene([legs]))
    assert precisions(marks) == {"legs": (1, 0.0), "light-red": (0, None)}
    assert precisions({"legs": LabelMatches(3)}) == {}, "a detector of balls alone has no figure for legs"


def test_thresholds_hold_false_alarms_and_wrong_objects_down():
    alarms = [FrameResult(False, "nowhere", 0.30)] * 2 + [FrameResult(False, "none")] * 8
    wrong = [FrameResult(True, "wrong object", 0.50)] + [FrameResult(True, "hit", 0.9)] * 9
    assert ball_threshold({"one": alarms}) == pytest.approx(0.31)
    assert ball_threshold({"one": alarms, "two": wrong}) == pytest.approx(0.51)
    assert ball_threshold({"one": [FrameResult(True, "hit", 0.9)]}) == pytest.approx(0.06)


def test_a_labels_threshold_balances_what_is_found_and_what_is_right():
    assert label_threshold(LabelMatches(2, [(0.9, True), (0.4, True), (0.3, False)])) == pytest.approx(0.4)
    assert label_threshold(LabelMatches(2, [(0.9, True), (0.2, False), (0.19, False), (0.1, False)])) == pytest.approx(
        0.9
    )
    overlooked_is_worse = LabelMatches(2, [(0.9, True), (0.5, False), (0.4, False), (0.35, False), (0.3, True)])
    assert label_threshold(overlooked_is_worse) == pytest.approx(0.3)
    assert label_threshold(LabelMatches()) == pytest.approx(0.3)


def test_command_line_starts_at_the_first_scored_seed():
    assert cli_score_detectors.FROM == SCORED_FROM


def test_detectors_are_scored_on_the_same_pictures():
    asked = subjects(["hsv", "adaptive"])
    report = score_scenes(asked, 10, looks=4, columns=["nominal", "same-color boxes"])
    assert set(report.columns) == {"nominal", "same-color boxes"}
    hsv = report.columns["nominal"]["hsv"]
    assert (hsv.frames, hsv.balls) == (10, 8) and hsv.hits >= 0.25 and hsv.compute_p50_us
    assert report.columns["nominal"]["adaptive"].hits > 0  # four looks are enough to be sure
    assert report.made_by["hsv"]["device"] == "cpu"
    assert "same-color boxes" in text(report) and markdown(report).count("| nominal |") == 2


def test_the_command_gives_json(capsys):
    code = cli.run(["score", "detectors", "hsv", "--frames", "2", "--column", "blur", "--json"])
    told = json.loads(capsys.readouterr().out)
    assert code == 0 and told["frames"] == 2 and set(told["columns"]) == {"blur"}


@pytest.mark.parametrize(("arguments", "says"), [
    (["hvs"], "did you mean"),
    (["hsv", "--column", "blurr"], "did you mean 'blur'"),
    (["hsv", "--frames", "0"], "--frames"),
    (["onnx:nowhere.onnx"], "nowhere.onnx"),
])
def test_a_bad_argument_is_one_line(arguments, says, capsys):
    assert cli.run(["score", "detectors", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert says in error and "\n" not in error
