"""Every scenario by name, and every legacy law, over the real line in virtual time; bounds are in test_lockstep.py."""

import math
from statistics import fmean

import pytest

from sightline.evaluation.lockstep import Conditions, Run, run_lockstep
from sightline.evaluation.scenario_config import robot_of
from sightline.evaluation.score.figures import STEP_S
from sightline.protocol.messages import State
from sightline.sim.scenario import load_scenario, scenario_names
from sightline.sim.truth import Truth

pytestmark = pytest.mark.computes

BASICS = {"static", "circle", "eight", "pushed", "behind", "walls"}
"""Those that test_lockstep.py holds against all their bounds."""


def drive(name: str, seed: int, seconds: float, mission: str | None = None, **changes: float) -> Run:
    scenario = load_scenario(name).model_copy(update=changes)
    conditions = Conditions(latency_ms=50, loss=0.1)
    return run_lockstep(scenario, robot_of(scenario), seed, conditions, seconds, mission=mission)


def last(run: Run, seconds: float) -> list[Truth]:
    return [truth for truth in run.samples if truth.t_us > run.samples[-1].t_us - seconds * 1e6]


@pytest.mark.parametrize("name", sorted(set(scenario_names()) - BASICS))
def test_every_scenario_runs_and_its_robot_is_let_drive(name):
    run = drive(name, 801, 1.2)
    assert State.ACTIVE in run.states and len(run.twists) > 15
    assert run.samples[-1].contacts == 0
    assert all(phase not in ("failed", "cannot reach") for _, phase, *_ in run.answers)
    if load_scenario(name).target.shape != "place":
        assert run.samples[-1].visible and abs(math.degrees(run.samples[-1].bearing_rad)) < 5


@pytest.mark.slow
def test_a_target_behind_a_wall_is_not_driven_at_through_it():
    """Without the range guard this start touches the wall for more than 0.5 s."""
    run = drive("occluder", 804, 8.4)
    assert sum(not truth.visible for truth in run.samples) > 100
    assert run.samples[-1].wall_contacts * STEP_S < 0.1


@pytest.mark.slow
def test_ball_that_crosses_a_meter_ahead_is_not_followed():
    """It hides the target for a second, and for some frames both have one outline."""
    run = drive("three-balls", 7905, 12.0, stand_off_m=0.9)
    assert sum(not truth.visible for truth in run.samples) > 10
    assert all(abs(math.degrees(truth.bearing_rad)) < 2 for truth in last(run, 2.0))


# --- the legacy laws, which must fail as they did ----------------------------------------------------------------


def test_band_steering_soon_finds_the_ball_too_far():
    """It is too small for its band: the robot stands, though the ball is in view."""
    run = drive("blue-sphere", 811, 3.0, "band")
    assert run.answers[-1][1] == "too far"
    assert all(truth.visible and abs(truth.linear_mps) < 0.01 for truth in last(run, 0.5))


@pytest.mark.slow
def test_band_steering_hardly_turns_and_then_stands():
    """At the end the ball is out of view."""
    run = drive("blue-sphere", 811, 14.6, "band")
    assert all(abs(truth.linear_mps) < 0.01 and not truth.visible for truth in last(run, 0.5))
    phases = [phase for _, phase, *_ in run.answers]
    assert "too far" in phases and phases[-1] == "no target"


def test_integral_law_treats_pixels_and_meters_differently():
    """200 / area is a speed for one distance, whichever that is; and the target hangs at the edge of the dead band."""
    run = drive("ball", 811, 7.0, "pixel-pi")
    truths = last(run, 3.0)
    assert all(truth.visible for truth in truths)
    assert fmean(truth.distance_m for truth in truths) > 0.9
    assert fmean(abs(math.degrees(truth.bearing_rad)) for truth in truths) > 3


@pytest.mark.slow
def test_two_speeds_by_the_pixel_never_settle():
    run = drive("chaser", 811, 6.0, "pixel-p")
    distances = [truth.distance_m for truth in last(run, 3.0)]
    assert max(distances) < 1.1 and max(distances) - min(distances) > 0.05
    assert {phase for t_us, phase, *_ in run.answers if t_us > 3e6} == {"near", "straight"}


def test_the_older_legs_law_swings_from_edge_to_edge():
    run = drive("legs", 811, 5.0, "legs-baseline")
    assert max(abs(math.degrees(truth.bearing_rad)) for truth in last(run, 3.0)) > 30


def test_legacy_waypoint_law_stops_at_the_cylinder_without_a_report():
    """Its sensors reach 0.2 m and it comes at 0.5 m/s: once so near, the guard lets no corner turn nearer."""
    run = drive("thymio", 811, 6.0, "goto-baseline")
    assert len({(round(truth.x_m, 2), round(truth.y_m, 2)) for truth in last(run, 2.0)}) == 1
    assert run.samples[-1].contacts == 0 and run.answers[-1][1] in ("left contour", "right contour")
