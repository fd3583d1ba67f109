"""The score is world truth: its counts, and its strict cases."""

import math

import pytest

from sightline.evaluation.score.figures import checks_of, median_and_worst, score
from sightline.sim.truth import Truth


def truth(t_s, *, bearing_deg=0.0, distance_m=0.8, visible=True, walls=0, x_m=0.0):
    return Truth(
        t_us=round(t_s * 1e6), x_m=x_m, y_m=0.0, yaw_rad=0.0, linear_mps=0.0, angular_rad_s=0.0,
        target_x_m=0.0, target_y_m=0.0, target_z_m=0.1, bearing_rad=math.radians(bearing_deg), distance_m=distance_m,
        visible=visible, wall_contacts=walls, target_contacts=0, target_contacts_by_robot=0,
    )


def samples(count=100, **changes):
    return [truth(index / 50, **{name: value(index) for name, value in changes.items()}) for index in range(count)]


def test_figures_are_taken_from_acquisition_to_the_end():
    run = samples(bearing_deg=lambda i: 30.0 if i < 50 else 1.0, distance_m=lambda i: 1.5 if i < 50 else 0.82)
    result = score(run, 0.8)
    assert result.acquired_s == pytest.approx(1.0)
    assert result.bearing_rms_deg == pytest.approx(1.0) and result.distance_rms_m == pytest.approx(0.02)


@pytest.mark.parametrize(("bearing_deg", "distance_m", "visible", "acquired"), [
    (1.99, 0.8, True, True), (2.01, 0.8, True, False), (0, 0.849, True, True), (0, 0.851, True, False),
    (0, 0.8, False, False),
])
def test_acquired_means_on_it_in_both_and_in_view(bearing_deg, distance_m, visible, acquired):
    run = samples(bearing_deg=lambda _: bearing_deg, distance_m=lambda _: distance_m, visible=lambda _: visible)
    assert (score(run, 0.8).acquired_s is not None) == acquired


def test_never_acquired_fails_every_figure_that_is_demanded():
    result = score(samples(bearing_deg=lambda _: 90.0, visible=lambda _: False), 0.8)
    for scenario in ("static", "circle", "eight", "pushed", "walls"):
        assert not all(check.ok for check in checks_of(scenario, result))
    assert not all(check.ok for check in checks_of("behind", result))


def test_time_out_of_view_is_lost_and_contacts_are_never_excused():
    result = score(samples(visible=lambda i: i % 4 != 3, walls=lambda i: i // 50), 0.8)
    assert result.lost_percent == pytest.approx(25.0) and result.wall_contacts == 1
    names = {check.name for check in checks_of("pushed", result, factor=100.0) if not check.ok}
    assert names == {"lost_percent", "wall_contacts"}


def test_with_400_ms_the_demand_is_to_stand_still():
    still, moved = score(samples(), 0.8), score(samples(x_m=lambda i: i / 100), 0.8)
    assert all(check.ok for check in checks_of("eight", still, latency_ms=400))
    assert not all(check.ok for check in checks_of("eight", moved, latency_ms=400))


def test_one_run_without_a_figure_makes_the_worst_none():
    good, bad = score(samples(), 0.8), score(samples(visible=lambda _: False), 0.8)
    assert median_and_worst([good, good, bad], "bearing_rms_deg") == (0.0, None)
    assert median_and_worst([good, good], "bearing_rms_deg") == (0.0, 0.0)


def test_a_run_without_samples_has_no_score():
    with pytest.raises(ValueError, match="no score"):
        score([], 0.8)
