"""Each sabotage breaks what it names, and the score of each scenario notices it."""

import array
import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

from docs.make.sabotage import write_page
from sightline.evaluation.score import runs, sabotage
from sightline.evaluation.score.runs import (
    SabotagedPair,
    SabotagedRun,
    SabotageReport,
    ScoreCase,
    cases,
    run_of,
    run_sabotaged,
    sabotaged,
)
from sightline.evaluation.score.sabotage import HEALTHY, SABOTAGES, UNAFFECTED, SeamDetector, sabotages_named
from sightline.operator_side.cli import app as cli
from sightline.protocol.errors import ConfigError
from sightline.robot_side.ports import Ranges, WheelAngles
from sightline.sim.scenario import load_scenario, scenario_names
from sightline.vision_side.detect.port import Circle, Detection, DetectionResult

pytestmark = pytest.mark.computes

BALL = Detection(100.0, 50.0, 140.0, 90.0, 0.9, "target", Circle(120.0, 70.0, 20.0), np.array([[100.0, 70.0]]))
NEVER_USED_SEEDS = range(7901, 7907)


def case(scenario, name, seed=7006, seconds=None, latency_ms=50.0):
    return ScoreCase(scenario, latency_ms, 0.1, seed, seconds, sabotage=name)


# --- each seam ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "wheels"), [
    ("steering-flipped", (3.0, 1.0)), ("wheels-dead", (0.0, 0.0)), ("one-wheel-dead", (1.0, 0.0)),
    ("robot-only-rotates", (-1.0, 1.0)), ("detector-blind", (1.0, 3.0)),
])
def test_wheels_turn_as_the_name_of_the_sabotage_states(name, wheels):
    assert SABOTAGES[name](1).wheels(1.0, 3.0) == wheels


def test_wrong_object_stands_a_quarter_of_the_image_aside():
    (one,) = SABOTAGES["detector-wrong-object"](1).detections((BALL,), (320, 240))
    assert (one.x1_px, one.x2_px, one.y1_px, one.circle.cx_px, one.outline_px.tolist()) == (
        180.0, 220.0, 50.0, 200.0, [[180.0, 70.0]])
    at_the_edge = replace(BALL, x1_px=250.0, x2_px=290.0)
    assert SABOTAGES["detector-wrong-object"](1).detections((at_the_edge,), (320, 240)) == ()
    assert SABOTAGES["detector-blind"](1).detections((BALL,), (320, 240)) == ()


def test_frozen_camera_repeats_its_first_image():
    camera = SABOTAGES["frames-frozen"](1).camera
    assert [camera(image) for image in (b"1", b"2", b"3")] == [b"1"] * 3
    assert SABOTAGES["frames-frozen"](1).camera(b"4") == b"4", "each run has its own first image"


def test_random_odometry_follows_its_seed_and_not_the_wheels():
    real = WheelAngles(1.0, 1.0, 5)
    first, again, other = (SABOTAGES["odometry-random"](seed).angles(real) for seed in (1, 1, 2))
    assert first == again != other and first.t_us == 5


def test_blind_range_sensor_reports_no_obstacle():
    scan = Ranges(1, 0.0, 0.1, 0.05, 8.0, array.array("f", [0.3, 1.0]))
    blind = SABOTAGES["range-blind"](1).scan(scan)
    assert list(blind.ranges_m) == [math.inf] * 2 and blind.t_us == 1
    assert SABOTAGES["answers-late"](1).late_us == 1_000_000


def test_detector_of_a_seam_replaces_found_objects_and_keeps_a_missing_answer_missing():
    class Finds:
        def detect(self, _frames, _deadline_us):
            return [DetectionResult("r1", "00000001", 1, 1, 320, 240, (BALL,), "x"), None]

    found, missing = SeamDetector(Finds(), SABOTAGES["detector-blind"](1)).detect([], 0)
    assert found.detections == () and missing is None
    assert SeamDetector(Finds(), HEALTHY).detect([], 0)[0].detections == (BALL,)


# --- names -------------------------------------------------------------------------------------------------------


def test_names_come_as_a_list_with_commas_or_all():
    assert sabotages_named(["wheels-dead,range-blind", "wheels-dead"]) == ["wheels-dead", "range-blind"]
    assert sabotages_named(["wheels-dead", "all"]) == list(SABOTAGES) and len(SABOTAGES) == 10


@pytest.mark.parametrize(("given", "near"), [("wrng", "detector-wrong-object"), ("wheel-dead", "wheels-dead")])
def test_unknown_sabotage_is_one_line_with_the_nearest_name(given, near, capsys):
    with pytest.raises(ConfigError, match=f"unknown sabotage '{given}'; did you mean '{near}'"):
        sabotages_named([given])
    assert cli.run(["score", "--scenario", "static", "--sabotage", given]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_listed_pairs_exist():
    assert set(UNAFFECTED) <= set(SABOTAGES)
    for reason, names in UNAFFECTED.values():
        assert reason and names <= set(scenario_names())


# --- the result --------------------------------------------------------------------------------------------------


def pair(*results, scenario="static", name="range-blind", **changes):
    made = tuple(SabotagedRun(case(scenario, name, seed, **changes), broken, 1.0, unchanged)
                 for seed, (broken, unchanged) in enumerate(results))
    return SabotagedPair(f"{scenario} {name}", scenario, name, made)


FAILS, SAME, PASSES = (("acquired_s",), False), ((), True), ((), False)


@pytest.mark.parametrize(("results", "is_listed", "ok"), [
    ([FAILS, FAILS], False, True), ([FAILS, PASSES], False, False), ([FAILS, SAME], True, False),
    ([SAME, SAME], True, True), ([SAME, SAME], False, False), ([PASSES, PASSES], True, False),
])
def test_pair_is_good_if_each_run_fails_or_nothing_changed_where_nothing_can(results, is_listed, ok, monkeypatch):
    monkeypatch.setattr(sabotage, "UNAFFECTED", {"range-blind": ("no use", frozenset({"static"} if is_listed else ()))})
    one = pair(*results)
    assert one.ok is ok and SabotageReport([one]).ok is ok
    assert SabotageReport([one]).to_dict()["checks"][0]["ok"] is ok
    assert SabotageReport([one, pair(PASSES)]).ok is False


def test_scenario_without_bounds_cannot_notice_a_sabotage(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text('extends = "static"\nbounds = {}\n')
    report = SabotageReport([pair(PASSES, scenario=str(mine))])
    assert report.ok is None and report.to_dict()["checks"] == [] and "not evaluated" in report.lines()[0]


def test_latency_without_bounds_cannot_notice_a_sabotage():
    report = SabotageReport([pair(PASSES, latency_ms=300)])
    assert report.ok is None and report.to_dict()["checks"] == [] and "not evaluated" in report.lines()[0]


def test_each_case_comes_with_each_sabotage_and_groups_lie_together_but_once_where_nothing_can_change():
    wanted = sabotaged(cases(["static", "eight"], [1, 2], [50], [0.1], None), ["wheels-dead", "range-blind"])
    assert [(one.scenario, one.sabotage, one.seed) for one in wanted] == [
        (scenario, name, seed) for scenario in ("static", "eight")
        for name, seed in (("wheels-dead", 1), ("wheels-dead", 2), ("range-blind", 1))]


# --- runs --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scenario", "name"), [
    ("static", "wheels-dead"), ("static", "robot-only-rotates"), ("static", "one-wheel-dead"),
    *(pytest.param(scenario, name, marks=pytest.mark.slow) for scenario, name in (
        ("walls", "steering-flipped"), ("walls", "detector-blind"), ("walls", "wheels-dead"),
        ("behind", "detector-blind"), ("behind", "robot-only-rotates"))),
])
def test_breakage_that_passed_before_fails(scenario, name):
    result = run_sabotaged(case(scenario, name))
    assert result.broken
    assert result.seconds <= load_scenario(scenario).seconds / 2, "a bound that is broken for good ends the run"


def test_run_that_broke_no_bound_is_compared_with_the_healthy_one(monkeypatch):
    monkeypatch.setitem(SABOTAGES, "nothing", lambda _seed: HEALTHY)
    monkeypatch.setattr(runs, "checks_of", lambda *_given: [])
    monkeypatch.setattr(runs, "broken", lambda *_given: [])
    assert run_sabotaged(case("static", "nothing", seconds=0.6)).unchanged
    assert not run_sabotaged(case("static", "wheels-dead", seconds=0.6)).unchanged


def test_bound_that_the_healthy_run_breaks_too_shows_no_sabotage():
    result = run_sabotaged(case("static", "wheels-dead", seconds=0.5))
    assert result.broken == () and not result.unchanged and not pair((result.broken, result.unchanged)).ok


@pytest.mark.parametrize(("changes", "names", "is_compared"), [
    ({}, ["static"], False), ({}, [], True), ({"loss": 0.11}, ["static"], True), ({"loss": 0.0}, ["static"], False),
    ({"seconds": 9.0}, ["static"], True), ({"detector": "onnx"}, ["static"], True),
])  # fmt: skip
def test_healthy_run_is_compared_where_no_test_shows_that_it_passes(monkeypatch, changes, names, is_compared):
    short = run_of(case("static", "wheels-dead", seconds=0.1))
    monkeypatch.setattr(runs, "run_of", lambda *_: short)
    monkeypatch.setattr(runs, "scenario_names", lambda: names)
    result = run_sabotaged(replace(case("static", "wheels-dead"), **changes))
    assert (result.broken == ()) is is_compared


@pytest.mark.parametrize(("latency_ms", "ends_early"), [(50, True), (400, False)])
def test_run_ends_early_only_by_the_bounds_of_its_scenario(monkeypatch, latency_ms, ends_early):
    monkeypatch.setattr(runs, "broken", lambda *_given: ["acquired_s"])
    result = run_sabotaged(case("static", "wheels-dead", seconds=1.2, latency_ms=latency_ms))
    assert (result.seconds < 1.1) is ends_early


def test_sabotage_shows_in_the_exit_code_and_the_json(capsys):
    options = ["--scenario", "static", "--seeds", "7006", "--jobs", "1", "--sabotage", "wheels-dead"]
    assert cli.run(["score", *options, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] and result["checks"][0]["value"] == 1 and result["runs"][0]["broken"][0] == "acquired_s"


@pytest.mark.long
@pytest.mark.parametrize("scenario", scenario_names())
def test_score_notices_every_sabotage_and_no_healthy_run_fails(tmp_path, scenario):
    page = tmp_path / "sabotage.md"
    assert write_page(page, NEVER_USED_SEEDS, os.cpu_count() or 1, [scenario]), page.read_text()
