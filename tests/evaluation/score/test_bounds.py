"""The figures of a run and their bounds, with numbers from short runs."""

import math

import pytest

from sightline.evaluation.score.figures import RunRecord, checks_of, score
from sightline.sim.scenario import load_scenario
from sightline.sim.truth import Truth

STAND_OFF_M = 0.8


def sample(t_s, *, bearing_deg=0.0, distance_m=STAND_OFF_M, visible=True):
    return Truth(
        t_us=round(t_s * 1e6), x_m=0.0, y_m=0.0, yaw_rad=0.0, linear_mps=0.0, angular_rad_s=0.0,
        target_x_m=0.0, target_y_m=0.0, target_z_m=0.1, bearing_rad=math.radians(bearing_deg), distance_m=distance_m,
        visible=visible, wall_contacts=0, target_contacts=0, target_contacts_by_robot=0,
    )


def test_lost_share_is_of_the_time_since_the_acquisition():
    """Acquired after 2 of 10 s, out of view for the last 2 s: a quarter of the 8 s since then."""
    run = [sample(at / 50, bearing_deg=30.0 if at < 100 else 0.0, visible=at < 400) for at in range(500)]
    result = score(load_scenario("static"), RunRecord(run, accepted_us=0))
    assert result.acquired_s == pytest.approx(2.0)
    assert result.lost_percent == pytest.approx(25.0)
    assert result.unseen_percent == pytest.approx(20.0)


@pytest.mark.parametrize(("factor", "bound_m"), [(1.0, 0.7), (1.5, 0.7 / 1.5), (2.0, 0.35)])
def test_factor_lowers_the_bound_of_a_figure_that_must_not_fall_below_it(factor, bound_m):
    """`least_distance_m` of `legs` is at least 0.7 m; a factor makes every bound easier."""
    legs = load_scenario("legs")
    run = [sample(at / 50, distance_m=0.5 if at == 99 else STAND_OFF_M) for at in range(100)]
    result = score(legs, RunRecord(run, accepted_us=0))
    (check,) = [one for one in checks_of(legs, result, factor=factor) if one.name == "least_distance_m"]
    assert check.bound == pytest.approx(bound_m)
    assert check.ok == (bound_m <= 0.5)
