"""Every scenario by name in real time: real processes over Zenoh, scored from world truth. `test-long` runs all."""

import csv
import math
from collections.abc import Iterable
from itertools import pairwise

import pytest

from sightline.evaluation.demo.run import MOTOR_LOG, RECORDING, DemoOptions, DemoRun, run_demo
from sightline.operator_side.recording.replay import replay
from sightline.sim.scenario import Scenario, load_scenario, scenario_names
from sightline.sim.truth import Truth

IN_EVERY_TEST_RUN = "legs"
"""Scenario with everything that `circle` of test_demo.py lacks: range scans, boxes from a remote detector."""


def chosen(names: Iterable[str]) -> list[object]:
    long = [pytest.mark.long, pytest.mark.alone]
    return [pytest.param(name, marks=pytest.mark.slow if name == IN_EVERY_TEST_RUN else long) for name in names]


def seconds_of(scenario: Scenario) -> float:
    """A light is red for five seconds, and the way to its line takes a few."""
    return 12.0 if scenario.light else 8.0 if scenario.goals_m else 6.0


def went_where_it_should(scenario: Scenario, samples: list[Truth]) -> bool:
    """Towards its waypoint, or up to the line and not across on red, or to its place behind the target."""
    first, last = samples[0], samples[-1]
    if scenario.goals_m:
        begun, left = (math.dist((one.x_m, one.y_m), scenario.goals_m[0]) for one in (first, last))
        return left < begun - 0.2 and min(one.clearance_m or 0.0 for one in samples) > 0.05
    if scenario.light:
        crossed = [now.light for was, now in pairwise(samples) if was.past_line_m < 0 <= now.past_line_m]
        return last.past_line_m > first.past_line_m + 0.3 and "red" not in crossed
    if scenario.walls:  # what it follows may be behind one by now: it drives, or looks around
        return any(abs(one.linear_mps) > 0.1 or abs(one.angular_rad_s) > 0.3 for one in samples)
    return follows(samples, scenario.stand_off_m)


def follows(samples: list[Truth], stand_off_m: float) -> bool:
    """In view, ahead, and at its distance or on the way there: while processes start, a target walks on."""
    late = [truth for truth in samples if truth.t_us > samples[-1].t_us - 2e6]
    before_m, off_m = (abs(truth.distance_m - stand_off_m) for truth in (late[0], late[-1]))
    ahead = all(truth.visible and abs(math.degrees(truth.bearing_rad)) < 8 for truth in late[len(late) // 2 :])
    return ahead and (off_m < 0.15 or off_m < before_m - 0.03)


def motors_end(run: DemoRun) -> dict[str, str]:
    with (run.folder / MOTOR_LOG).open() as file:
        return list(csv.DictReader(file))[-1]


@pytest.mark.parametrize("name", chosen(scenario_names()))
def test_every_scenario_runs_by_name_in_real_time(tmp_path, name):
    scenario, told = load_scenario(name), []
    run = run_demo(DemoOptions(name, seconds_of(scenario), seed=17, out=tmp_path / "run"), told.append)
    assert went_where_it_should(scenario, run.samples), run.samples[-1]
    assert run.samples[-1].contacts == 0 and run.killed == []
    end = motors_end(run)
    assert float(end["left_rad_s"]) == float(end["right_rad_s"]) == 0.0
    again = replay(run.folder / RECORDING)
    assert again.total > 30 and (again.equal == again.total or again.gaps), again  # a busy machine may lose an answer
