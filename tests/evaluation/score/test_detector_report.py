"""`score detectors --demand`: bounds of a learned detector; options; plug-ins with errors or invalid results."""

import json
import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

from sightline.evaluation.checks import check_lines
from sightline.evaluation.score import detector_report as score_scenes_file
from sightline.evaluation.score.detector_report import (
    LABELLED,
    LEAST_HITS,
    DetectorReport,
    all_detector_checks,
    close_subjects,
    detector_checks,
    score_scenes,
    subjects,
)
from sightline.evaluation.score.detectors import DetectorFigures
from sightline.operator_side.cli import app as cli
from sightline.operator_side.cli import evaluate as cli_score_detectors
from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import ConfigError
from sightline.sim.scenes.model import COLUMNS
from sightline.vision_side.detect.port import Detection, Maker, result_of
from tests.fixtures.vision.remote import frame

GOOD = DetectorFigures(500, 400, 0.85, 0.1, 0.05, 0.05, 1.0, 3.0, 900.0, 0.0)
EVERY = dict.fromkeys(LABELLED, (300, 0.8))


def report(precision=None, **columns):
    of = {name: {"onnx": GOOD} for name in COLUMNS}
    of |= {name.replace("_", " "): {"onnx": one} for name, one in columns.items()}
    return DetectorReport(900_000, 500, of, {"onnx": EVERY if precision is None else precision}, {}, {}, {})


def failed(one):
    return [check.name for check in detector_checks(one, "onnx") if not check.ok]


def test_every_column_and_label_is_demanded_and_the_bounds_themselves_are_enough():
    assert set(LEAST_HITS) == set(COLUMNS) and failed(report()) == []
    exact = {name.replace(" ", "_"): replace(GOOD, hits=least) for name, least in LEAST_HITS.items()}
    assert failed(report(**exact)) == []
    assert len(detector_checks(report(), "onnx")) == 3 * len(COLUMNS) + 1 + 2 * len(LABELLED)


@pytest.mark.parametrize("column", COLUMNS)
@pytest.mark.parametrize(("worse", "name"), [
    ({"hits": None}, "least hits"), ({"wrong_object": 0.052}, "wrong object"), ({"false_alarms": 0.06}, "false alarms"),
])
def test_a_figure_beyond_its_bound_fails_alone(column, worse, name):
    if "hits" in worse:
        worse = {"hits": LEAST_HITS[column] - 1 / 400}
    of = report()
    of.columns[column]["onnx"] = replace(GOOD, **worse)
    assert failed(of) == [f"{name}, {column}"]


def test_the_centre_is_scored_on_clean_pictures_and_has_to_be_there():
    assert failed(report(blur=replace(GOOD, centre_p50_px=4.0))) == []
    assert failed(report(nominal=replace(GOOD, centre_p50_px=1.01))) == ["center p50, nominal"]
    assert failed(report(nominal=replace(GOOD, centre_p50_px=None))) == ["center p50, nominal"]


def test_each_label_needs_enough_objects_also_without_detections():
    assert failed(report({**EVERY, "legs": (300, 0.79)})) == ["least AP50, legs"]
    assert failed(report({**EVERY, "light-red": (299, 0.9)})) == ["least objects, light-red"]
    assert failed(report({})) == [f"least AP50, {label}" for label in LABELLED]


@pytest.mark.parametrize(("balls", "shares"), [
    (5, ["85.0 %", "10.0 %", "5.0 %", "-", "0.0 %"]), (0, ["-", "-", "5.0 %", "5.0 %", "-"]),
    (4, ["85.0 %", "10.0 %", "5.0 %", "5.0 %", "0.0 %"]),
])  # fmt: skip
def test_share_of_no_scene_is_not_shown(balls, shares):
    row = score_scenes_file.rows(report(nominal=replace(GOOD, frames=5, balls=balls)))[list(COLUMNS).index("nominal")]
    assert list(row[2:7]) == shares


def test_a_line_for_each_check_names_whose_it_is():
    lines = check_lines(all_detector_checks(report(nominal=replace(GOOD, centre_p50_px=None, hits=0.84))))
    assert " ".join(lines[0].split()) == "onnx: least hits, nominal 84 % bound 85 FAIL"
    assert " ".join(lines[3].split()) == "onnx: center p50, nominal never px bound 1 FAIL"
    assert sum(line.endswith("  ok") for line in lines) == len(lines) - 2


# --- the command -----------------------------------------------------------------------------------------------------


def told(capsys, *arguments):
    """The report of one scene with a ball, and two with lights and legs."""
    code = cli.run(["score", "detectors", "--frames", "1", "--seeds", "900001", "--column", "nominal", *arguments])
    return code, *capsys.readouterr()


def test_only_detectors_with_the_bound_are_checked(capsys):
    code, out, err = told(capsys, "hsv", "--json")
    assert (code, err) == (0, "") and not {"ok", "checks"} & set(json.loads(out))
    code, out, _ = told(capsys, "hsv", "--demand", "--json")
    judged = json.loads(out)
    assert code == 5 and judged["ok"] is False and judged["columns"]["nominal"]["hsv"]["frames"] == 1
    first = judged["checks"][0]
    assert (first["name"], first["unit"], first["bound"]) == ("hsv: least hits, nominal", "%", 85.0)


def test_each_check_is_a_line_under_the_table(capsys):
    code, out, _ = told(capsys, "hsv", "--demand")
    lines = out.splitlines()
    assert code == 5 and lines[0].startswith("column") and lines[-1].startswith("hsv: least AP50, legs")
    assert lines[-1].endswith("FAIL")


class Eyes:
    """A plug-in; what it answers is set by the test."""

    answer = staticmethod(lambda frame: result_of(frame, (), Maker("eyes", device="cpu")))
    closed = 0

    class Config(Settings):
        pass

    def __init__(self, config):
        pass

    def detect(self, frames, deadline_us):
        return [type(self).answer(frame) for frame in frames]

    def close(self):
        type(self).closed += 1


def _boom(frame):
    raise RuntimeError("boom\nand more")


def _nan(frame):
    return result_of(frame, [Detection(1, 1, math.nan, 9, 0.9, "ball")], Maker("eyes"))


FAULTS = {
    "Raises": (_boom, "RuntimeError: boom and more"), "Silent": (lambda frame: None, "no answer in time"),
    "Nonsense": (lambda frame: "nonsense", "invalid answer"), "Nan": (_nan, "nan or infinite"),
}


@pytest.fixture
def eyes(monkeypatch):
    answers = {"Eyes": Eyes.answer, **{name: answer for name, (answer, _) in FAULTS.items()}}
    kinds = {name: type(name, (Eyes,), {"answer": staticmethod(answer)}) for name, answer in answers.items()}
    monkeypatch.setitem(sys.modules, "eyes_of_a_test", SimpleNamespace(**kinds))
    return SimpleNamespace(**kinds)


NAME = "eyes_of_a_test:Eyes"


def test_a_plug_in_that_gives_no_answer_is_scored_and_reported_in_one_line(capsys, eyes):
    code, out, err = told(capsys, NAME, *(f"eyes_of_a_test:{name}" for name in FAULTS), "--json")
    judged, lines = json.loads(out), err.splitlines()
    assert code == 0 and len(lines) == len(FAULTS) == len(judged["silent"])
    for line, (name, (_, why)) in zip(lines, FAULTS.items(), strict=True):
        assert line.startswith(f"eyes_of_a_test:{name}: no answer to 3 of 3 scenes, which count as missed: ")
        assert why in line
        assert judged["columns"]["nominal"][f"eyes_of_a_test:{name}"]["missed"] == 1
        assert getattr(eyes, name).closed == 1


def test_detector_with_another_label_for_balls_is_reported(capsys, eyes, monkeypatch):
    def named(frame):
        return result_of(frame, [Detection(1, 1, 9, 9, 0.9, f"cup {n}") for n in range(5)], Maker("eyes"))

    monkeypatch.setattr(eyes.Eyes, "answer", staticmethod(named))
    _, out, err = told(capsys, NAME, "--json")
    assert json.loads(out)["uncounted"] == {NAME: [f"cup {n}" for n in range(5)]}
    assert err.startswith(f"{NAME}: not counted is what it calls 'cup 0', 'cup 1', 'cup 2' and 2 more; a ball is ball")
    assert err.count("\n") == 1
    assert told(capsys, "hsv", "--json")[2] == ""
    _, out, err = told(capsys, NAME, "--json", "--set", "target.label=cup 3")
    assert "cup 3" not in err and json.loads(out)["columns"]["nominal"][NAME]["missed"] == 0


def test_unavailable_detector_reports_its_reason(capsys):
    assert "127.0.0.1:1: Connection refused" in told(capsys, "http+jpeg://127.0.0.1:1/eyes")[2]


def test_boxes_are_cut_to_the_picture_as_vision_would_have_them(eyes):
    eyes.Eyes.answer = staticmethod(lambda frame: result_of(
        frame, [Detection(-50, 10, 20, 30, 0.9, "ball"), Detection(400, 0, 500, 9, 0.8, "ball")], Maker("eyes")))
    seen = []
    score_scenes(asked := subjects([NAME]), 1, columns=["nominal"], each=seen.append)
    close_subjects(asked)
    (only,) = seen[0].answers[0].detections
    assert (only.x1_px, only.x2_px) == (0, 20)


def test_who_was_opened_is_closed_when_the_next_cannot_be(eyes):
    with pytest.raises(ConfigError, match="did you mean 'hsv'"):
        subjects([NAME, "hvs"])
    assert eyes.Eyes.closed == 1
    assert [one.name for one in subjects([NAME, NAME])] == [NAME], "the same name twice is one detector"


BLUE = "[{hue_low_deg=200, hue_high_deg=260}]"


def built(*names, file=None, sets=()):
    return cli_score_detectors._subjects(names, file, sets, None)


def test_a_calibrated_range_is_checked(tmp_path, capsys):
    (tmp_path / "vision.toml").write_text(f"[hsv]\nranges = {BLUE}\n")
    hits = [json.loads(told(capsys, "hsv", "--json", *more)[1])["columns"]["nominal"]["hsv"]["hits"]
            for more in ((), ("--config", str(tmp_path / "vision.toml")))]
    assert hits == [1.0, 0.0]
    ways = ((), ("hsv.ranges=" + BLUE,), ("detector.options.hsv.ranges=" + BLUE,))
    found = [len(built("hsv", sets=sets)[0].detector.detect([frame()], 0)[0].detections) for sets in ways]
    assert found == [1, 0, 0]


def test_options_are_those_of_the_detector_that_is_named(monkeypatch):
    given = {}
    monkeypatch.setattr(score_scenes_file, "build_detector", lambda name, options, _: given.update({name: options}))
    own, named, other = "detector.options.confirm=1", "detector.kind=adaptive", "detector.kind=onnx"
    for names, sets, expected in (
        (("adaptive",), (own,), [{"confirm": 1}]), (("hsv", "adaptive"), (named, own), [{}, {"confirm": 1}]),
        (("hsv", "adaptive"), (other, own), [{}, {}]), (("adaptive",), (other, own), [{}]),
    ):
        built(*names, sets=sets)
        assert [given[name] for name in names] == expected


@pytest.mark.parametrize(("arguments", "says"), [
    (["hsv", "--set", "hsv.range=3"], "hsv.range"),
    (["hsv", "--config", "/nowhere/vision.toml"], "/nowhere/vision.toml"),
    (["hsv", "--set", "detector.options.hue=3"], "unknown option 'hue'"),
    (["onnx", "adaptive", "--set", "detector.options.confirm=1"], "--set detector.kind=NAME"),
    (["hsv", "adaptive", "--device", "cuda"], "no device to choose"),
    (["hsv", "--demand", "--seeds", "899999"], "--demand needs seeds from 900000 up"),
])
def test_a_bad_argument_is_one_line(arguments, says, capsys):
    code, out, err = told(capsys, *arguments)
    assert (code, out) == (2, "") and says in err and err.count("\n") == 1


def test_a_device_is_for_those_that_can_have_one(capsys):
    code, out, _ = told(capsys, "hsv", "onnx", "--device", "cpu", "--json")
    assert code == 0 and json.loads(out)["made_by"]["onnx"]["device"] == "cpu"


def test_bench_takes_an_option_of_a_section_too(capsys):
    assert cli.run(["bench", "detector", "hsv", "--frames", "30", "--set", "hsv.max_contours=0"]) == 2
    assert "option 'hsv.max_contours': Input" in capsys.readouterr().err


def test_a_mission_follows_the_ball_except_in_scenes_of_lights_and_legs(eyes, monkeypatch):
    seen = {}
    real = score_scenes_file.checked_answers

    def noted(detector, frames, deadline_us):
        seen.setdefault(frames[0].goes_by("legs"), []).append(frames[0].goes_by("ball"))
        return real(detector, frames, deadline_us)

    monkeypatch.setattr(score_scenes_file, "checked_answers", noted)
    score_scenes(subjects([NAME]), 2, columns=["nominal"])
    assert seen == {False: [True] * 2, True: [True] * 5}
