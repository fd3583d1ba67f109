"""The score is world truth: its counts, and its strict cases."""

import math
from dataclasses import replace

import pytest

from sightline.evaluation.score.figures import (
    ACQUIRED_FOR_S,
    AnsweredFrame,
    RimSpeeds,
    RunRecord,
    broken,
    checks_of,
    commanded_m,
    median_and_worst,
    score,
)
from sightline.sim.scenario import FIGURES, load_scenario, scenario_names
from sightline.sim.truth import Truth

STATIC = load_scenario("static")


def truth(t_s, *, bearing_deg=0.0, distance_m=0.8, visible=True, walls=0, x_m=0.0):
    return Truth(
        t_us=round(t_s * 1e6), x_m=x_m, y_m=0.0, yaw_rad=0.0, linear_mps=0.0, angular_rad_s=0.0,
        target_x_m=0.0, target_y_m=0.0, target_z_m=0.1, bearing_rad=math.radians(bearing_deg), distance_m=distance_m,
        visible=visible, wall_contacts=walls, target_contacts=0, target_contacts_by_robot=0,
    )


def samples(count=100, **changes):
    return [truth(index / 50, **{name: value(index) for name, value in changes.items()}) for index in range(count)]


def record(run, accepted_us=0, said=(), wheels=()):
    """Return the record of a run with these samples."""
    return RunRecord(list(run), [AnsweredFrame(*one) for one in said], accepted_us, list(wheels))


def scored(run, name="static", **rest):
    return score(load_scenario(name), record(run, **rest))


def failed(name, result, *conditions):
    return {check.name for check in checks_of(load_scenario(name), result, *conditions) if not check.ok}


def test_figures_are_taken_from_acquisition_to_the_end():
    run = samples(110, bearing_deg=lambda i: 30.0 if i < 50 else 1.0, distance_m=lambda i: 1.5 if i < 50 else 0.82)
    result = scored(run)
    assert result.acquired_s == pytest.approx(1.0)
    assert result.bearing_rms_deg == pytest.approx(1.0) and result.distance_rms_m == pytest.approx(0.02)


@pytest.mark.parametrize(("bearing_deg", "distance_m", "visible", "acquired"), [
    (1.99, 0.8, True, True), (2.01, 0.8, True, False), (0, 0.849, True, True), (0, 0.851, True, False),
    (0, 0.8, False, False),
])
def test_acquired_means_on_it_in_both_and_in_view(bearing_deg, distance_m, visible, acquired):
    run = samples(bearing_deg=lambda _: bearing_deg, distance_m=lambda _: distance_m, visible=lambda _: visible)
    assert (scored(run).acquired_s is not None) == acquired


@pytest.mark.parametrize(("on_it", "acquired_s"), [
    (lambda i: i >= 20, 0.4), (lambda i: 20 <= i <= 70, 0.4), (lambda i: 20 <= i < 70, None),
    (lambda i: i != 45, 0.92), (lambda i: i < 40 or 45 <= i < 80, None),
])
def test_acquired_means_a_second_without_a_break(on_it, acquired_s):
    assert ACQUIRED_FOR_S == 1.0
    result = scored(samples(bearing_deg=lambda i: 0.0 if on_it(i) else 2.5))
    assert result.acquired_s == (acquired_s if acquired_s is None else pytest.approx(acquired_s))


@pytest.mark.parametrize(("accepted_us", "acquired_s"), [(0, 0.0), (600_000, 0.6), (1_200_000, None), (None, None)])
def test_nothing_is_acquired_before_the_first_accepted_twist(accepted_us, acquired_s):
    result = scored(samples(), accepted_us=accepted_us)
    assert result.acquired_s == (acquired_s if acquired_s is None else pytest.approx(acquired_s))


@pytest.mark.parametrize("name", [
    name for name in scenario_names() if not load_scenario(name).goals_m and load_scenario(name).light is None
])
def test_target_that_is_never_acquired_fails_every_scenario_of_following(name):
    assert failed(name, scored(samples(bearing_deg=lambda _: 90.0, visible=lambda _: False), name))


def test_time_out_of_view_is_lost_and_contacts_are_never_excused():
    result = scored(samples(200, visible=lambda i: i < 60 or i % 4 != 3, walls=lambda i: i // 150))
    assert result.lost_percent == pytest.approx(17.5) and result.wall_contacts == 1
    checks = checks_of(load_scenario("pushed"), result, factor=100.0)
    assert {check.name for check in checks if not check.ok} >= {"lost_percent", "wall_contacts"}


# --- where the robot must stand still ----------------------------------------------------------------------------


def test_with_400_ms_the_wheel_commands_are_checked_and_not_the_place():
    pushed = scored(samples(x_m=lambda i: i / 100))
    assert pushed.travelled_m > 0.9 and failed("eight", pushed, 400) == set()
    driven = scored(samples(), wheels=[RimSpeeds(100_000, 0.0, 0.2), RimSpeeds(400_000, 0.0, 0.0)])
    assert driven.travelled_m == 0 and failed("eight", driven, 400) == {"commanded_m"}
    assert driven.figure("commanded_m") == pytest.approx(0.06)


@pytest.mark.parametrize(("wheels", "way_m"), [
    ([], 0.0), ([(0, 0.5, 0.5)], 1.0), ([(0, -0.5, 0.1), (1_000_000, 0.0, 0.0)], 0.5),
    ([(-1_000_000, 0.2, 0.2), (500_000, 0.0, -0.4)], 0.1 + 0.6),
    ([(-2_000_000, 0.2, 0.2), (-1_000_000, 0.0, 0.0)], 0.0),
])
def test_commanded_way_is_that_of_the_faster_wheel_within_the_run(wheels, way_m):
    assert commanded_m([RimSpeeds(*one) for one in wheels], 0, 2_000_000) == pytest.approx(way_m)


# --- bounds ------------------------------------------------------------------------------------------------------


def test_every_shipped_scenario_has_bounds_and_one_without_has_no_checks():
    assert all(load_scenario(name).bounds for name in scenario_names())
    bare = STATIC.model_copy(update={"bounds": {}})
    assert checks_of(bare, scored(samples())) == checks_of(bare, scored(samples()), 400) == []


def test_factor_widens_bounds_to_their_side_and_leaves_exact_ones():
    scenario = load_scenario("legs")
    wide = {check.name: check.bound for check in checks_of(scenario, scored(samples(), "legs"), factor=2.0)}
    for name, bound in scenario.bounds.items():
        share = 1.0 if FIGURES[name].is_exact else 0.5 if name.startswith("least_") else 2.0
        assert wide[name] == pytest.approx(share * bound), name


# --- bounds that are broken for good -----------------------------------------------------------------------------


def bounded(**bounds):
    return STATIC.model_copy(update={"bounds": bounds})


@pytest.mark.parametrize(("bounds", "changes", "is_broken"), [
    ({"wall_contacts": 0}, {"walls": lambda i: i // 90}, True), ({"wall_contacts": 0}, {}, False),
    ({"acquired_s": 0.9}, {"bearing_deg": lambda _: 9.0}, True),
    ({"acquired_s": 0.9}, {"bearing_deg": lambda i: 9.0 if i < 60 else 0.0}, True),
    ({"acquired_s": 0.99}, {"bearing_deg": lambda i: 9.0 if i < 49 else 0.0}, False),  # the second is not over
    ({"found_s": 1.5}, {"bearing_deg": lambda _: 12.0}, True),
    ({"found_s": 2.5}, {"bearing_deg": lambda _: 12.0}, False),
    ({"bearing_rms_deg": 0.5}, {"bearing_deg": lambda _: 1.8}, True),  # 2 of 10 s: at least 0.8 over all
    ({"bearing_rms_deg": 0.9}, {"bearing_deg": lambda _: 1.8}, False),
    ({"lost_percent": 0.0}, {"visible": lambda i: i != 90}, True),
    ({"lost_percent": 0.2}, {"visible": lambda i: i != 90}, False),  # 1 of 100 samples, 1 of 500 at the end
])
def test_bound_is_broken_for_good_only_if_no_rest_of_the_run_can_keep_it(bounds, changes, is_broken):
    scenario = bounded(**bounds)
    run = samples(100, **changes)
    assert broken(scenario, score(scenario, record(run)), 10.0) == (list(bounds) if is_broken else [])


def test_least_figures_that_still_can_rise_are_not_broken_early():
    scenario = load_scenario("traffic-light")
    run = record([replace(truth(at / 50), light="red", past_line_m=-1.0) for at in range(100)])
    assert broken(scenario, score(scenario, run), 40.0) == []


def test_one_run_without_a_figure_makes_the_worst_none():
    good, bad = scored(samples()), scored(samples(visible=lambda _: False))
    assert median_and_worst([good, good, bad], "bearing_rms_deg") == (0.0, None)
    assert median_and_worst([good, good], "bearing_rms_deg") == (0.0, 0.0)
