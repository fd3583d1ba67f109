"""`sightline score`: every combination runs, the worst is checked, and the result is the exit code."""

import json
from dataclasses import replace

import pytest

from sightline.evaluation.score.figures import Score
from sightline.evaluation.score.runs import (
    ScoreCase,
    ScoreReport,
    cases,
    run_case,
    run_cases,
    score_text,
    scored_figures,
)
from sightline.operator_side.cli import app as cli
from sightline.protocol.errors import ConfigError
from sightline.sim.scenario import load_scenario

pytestmark = pytest.mark.computes

GOOD = Score(
    acquired_s=1.0, found_s=0.0, bearing_rms_deg=0.2, distance_rms_m=0.01, lost_percent=0.0, wall_contacts=0,
    travelled_m=1.0, seconds=5.0,
)


def test_every_combination_is_a_case_and_groups_lie_together():
    wanted = cases(["static", "eight"], [1, 2], [0, 50], [0.0, 0.1], None)
    assert len(set(wanted)) == 16
    groups = [case.group for case in wanted]
    assert all(groups.index(name) + groups.count(name) - 1 == len(groups) - 1 - groups[::-1].index(name)
               for name in groups)


def test_what_is_named_twice_runs_once():
    once = cases(["static", "eight"], [1, 2], [0, 50], [0.0, 0.1], None)
    assert cases(["static", "eight", "static"], [1, 2, 1], [0, 50, 0], [0.0, 0.1, 0.0], None) == once


def test_different_losses_are_scored_separately():
    assert len({case.group for case in cases(["static"], [1], [0], [0.001, 0.004, 0.101, 0.104, 0.1], None)}) == 5
    assert cases(["static"], [1], [50], [0.1], None)[0].group == "static +50 ms 10% loss"


@pytest.mark.parametrize(
    "arguments",
    [(["cirle"], [1], [0], [0]), (["circle"], [], [0], [0]), (["circle"], [-1], [0], [0]),
     (["circle"], [1], [-1], [0]), (["circle"], [1], [0], [1.0]), (["circle"], [1], [0], [float("nan")])],
)
def test_impossible_setting_is_rejected_before_any_run(arguments):
    with pytest.raises(ConfigError):
        cases(*arguments, None)


def test_goals_of_a_scenario_whose_mission_has_none_are_named(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('extends = "static"\ngoals_m = [[1, 1]]\n')
    with pytest.raises(ConfigError, match=r"scenario .*mine\.toml: mission 'follow': .*'waypoints'.*its goals_m are"):
        cases([str(file)], [1], [0], [0], None)


@pytest.mark.parametrize("at", range(3))
@pytest.mark.parametrize("bad", [{"bearing_rms_deg": 0.9}, {"acquired_s": None}, {"wall_contacts": 1}])
def test_one_bad_run_of_three_fails_its_figure_and_no_other(at, bad):
    runs = [(ScoreCase("static", 50, 0.1, seed, 5.0), GOOD) for seed in range(3)]
    assert all(one.ok for one in scored_figures(runs))
    runs[at] = (runs[at][0], replace(GOOD, **bad))
    judged = scored_figures(runs)
    assert [one.name for one in judged if not one.ok] == list(bad)
    failed = next(one for one in judged if not one.ok)
    assert failed.worst == next(iter(bad.values()))
    assert "FAIL" in score_text(ScoreReport(runs, judged))


@pytest.mark.parametrize("names", [["static"], pytest.param(["static", "behind"], marks=pytest.mark.slow)])
def test_runs_on_other_processes_are_those_of_this_one(names):
    wanted = cases(names, [301], [50], [0.1], 1.5)
    done = []
    report = run_cases(wanted, 2, done.append)
    assert sorted(done, key=str) == sorted(wanted, key=str)
    assert report.runs == [(case, run_case(case)[0]) for case in wanted] and report.news == {}


def test_another_detector_looks_in_place_of_the_scenarios_own():
    """A detector of yellow never finds a blue ball."""
    yellow = "examples.older_range:OlderRange"
    asked = [cases(["blue-sphere"], [303], [50], [0.1], 3.0, detector=kind)[0] for kind in (None, yellow)]
    own, other = (run_case(case)[0] for case in asked)
    assert own.acquired_s is not None and other.acquired_s is None
    assert yellow in cases(["static"], [1], [0], [0], None, detector=yellow)[0].group


def test_detector_without_an_answer_is_reported_with_its_reason(capsys):
    options = ["--scenario", "static", "--seeds", "1,2", "--jobs", "1", "--seconds", "1", "--detector", "oip+http://127.0.0.1:9/ball"]
    assert cli.run(["score", *options]) == 5
    told = capsys.readouterr().out
    said = [line for line in told.splitlines() if line.startswith("  detector")]
    assert 1 <= len(said) <= 3 and "no answer: UNREACHABLE: 127.0.0.1:9: " in said[0]


OPEN_VIEW = """extends = "static"
bounds = {}
[start]
bearing_deg = [150.0, 170.0]
"""
"""A scenario of a user, whose target the robot does not see at first."""


@pytest.fixture
def bare_options(tmp_path):
    """The options of one short run of a scenario without bounds."""
    mine = tmp_path / "mine.toml"
    mine.write_text(OPEN_VIEW)
    return ["--scenario", str(mine), "--seeds", "1", "--jobs", "1", "--seconds", "1"]


@pytest.mark.parametrize("latency_ms", ["50", pytest.param("400", marks=pytest.mark.slow)])
def test_scenario_without_bounds_is_not_evaluated_and_never_ok(latency_ms, bare_options, capsys):
    assert cli.run(["score", *bare_options, "--latency-ms", latency_ms]) == 0
    text = capsys.readouterr().out
    assert "not evaluated" in text and "ok" not in text.split() and "within bounds" not in text
    assert "commanded_m" in text


def test_scenario_without_bounds_has_a_null_in_its_json_and_exit_code_0(bare_options, capsys):
    assert cli.run(["score", *bare_options, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] is None and result["checks"] == [] and len(result["not_evaluated"]) == 1
    assert result["runs"][0]["score"]["unseen_percent"] > 60


def test_scenario_without_bounds_at_this_latency_is_not_evaluated(capsys):
    options = ["--scenario", "static", "--seeds", "1", "--jobs", "1", "--seconds", "1", "--latency-ms", "300"]
    assert cli.run(["score", *options, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] is None and result["checks"] == [] and len(result["not_evaluated"]) == 1


def test_blanks_beside_the_commas_of_a_list_change_nothing(capsys):
    assert cli.run(["score", "--scenario", " static , circle, nosuch", "--seeds", "1, 2"]) == 2
    assert capsys.readouterr().err.startswith("error: no scenario called 'nosuch'")


def test_scenario_that_extends_another_is_scored_by_its_bounds(tmp_path, capsys):
    mine = tmp_path / "mine.toml"
    mine.write_text(OPEN_VIEW.replace("bounds = {}", ""))
    options = ["--scenario", str(mine), "--seeds", "1", "--jobs", "1", "--seconds", "1"]
    assert cli.run(["score", *options, "--json"]) == 5
    checks = json.loads(capsys.readouterr().out)["checks"]
    assert [one["name"].split(": ")[1] for one in checks] == list(load_scenario("static").bounds)
    assert not checks[0]["ok"]


def test_failure_of_one_scenario_outweighs_another_without_bounds():
    good = scored_figures([(ScoreCase("static", 50, 0.1, 1, 5.0), GOOD)])
    bad = scored_figures([(ScoreCase("static", 50, 0.1, 1, 5.0), replace(GOOD, wall_contacts=1))])
    assert ScoreReport([], good).ok is True
    assert ScoreReport([], good, ["mine"]).ok is None
    assert ScoreReport([], bad, ["mine"]).ok is False


@pytest.mark.slow
def test_the_command_prints_one_object_and_exits_5_when_not_ok(capsys):
    options = ["--scenario", "static", "--seeds", "302", "--json", "--seconds"]
    assert cli.run(["score", *options, "4"]) == 0
    good = json.loads(capsys.readouterr().out)
    assert good["ok"] and good["checks"] and len(good["runs"]) == 1
    assert cli.run(["score", *options, "1", "--latency-ms", "200"]) == 5, "no run acquires a target in this time"
    bad = json.loads(capsys.readouterr().out)
    assert not bad["ok"]
    assert "acquired_s" in next(check["name"] for check in bad["checks"] if not check["ok"])
