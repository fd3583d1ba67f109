"""Figures of legs, waypoints and traffic lights, from truth made up for the purpose."""

import math
from dataclasses import replace

import pytest

from sightline.evaluation.score.figures import goal_figures, legs_figures, light_figures, median_and_worst, red_stops
from sightline.sim.scenario import load_scenario
from tests.evaluation.score import test_figures
from tests.evaluation.score.test_figures import samples, scored, truth


def drive(light_of, way_of, speed_of=lambda _s: 0.3, count=600):
    """Truth at 50 Hz of a robot near a light: functions of the time in seconds."""
    return [
        replace(truth(index / 50), light=light_of(index / 50), past_line_m=way_of(index / 50),
                linear_mps=speed_of(index / 50))
        for index in range(count)
    ]


def failed(name, run, said=()):
    return test_figures.failed(name, scored(run, name, said=said))


# --- the light ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("light", "figures"), [
    (lambda _s: "green", (1, 0, 0)), (lambda _s: "red", (1, 1, 0)),
    (lambda s: "green" if s < 4.9 else "yellow", (1, 0, 0)),  # 3 cm left at 0.3 m/s: too late to stop
    (lambda s: "green" if s < 3.0 else "yellow", (1, 0, 1)),  # 0.6 m left: it could have stopped
])
def test_crossings_count_by_what_the_light_showed_and_whether_it_could_stop(light, figures):
    found = light_figures(drive(light, lambda s: -1.5 + 0.3 * s), ())
    assert (found["least_crossings"], found["crossed_on_red"], found["crossed_late"]) == figures


def test_run_without_a_crossing_fails():
    run = drive(lambda _s: "green", lambda _s: -0.1, lambda _s: 0.0)
    assert "least_crossings" in failed("traffic-light", run)


@pytest.mark.parametrize(("y_m", "is_off"), [(0.2, False), (-0.3, True)])
def test_robot_beside_the_lane_fails(y_m, is_off):
    run = [replace(one, target_x_m=4.6, x_m=0.3 * at / 50, y_m=y_m if at == 90 else 0.0)
           for at, one in enumerate(drive(lambda _s: "green", lambda s: -1.5 + 0.3 * s))]
    assert ("most_aside_m" in failed("traffic-light", run)) == is_off
    assert scored(run, "traffic-light").figure("most_aside_m") == pytest.approx(abs(y_m))


@pytest.mark.parametrize(("goes_s", "start_s"), [(5.4, 0.4), (6.5, 1.5)])
def test_a_robot_that_waited_is_timed_from_green(goes_s, start_s):
    run = drive(lambda s: "red" if s < 5 else "green", lambda s: -0.1 + max(0.0, s - goes_s) * 0.3,
                lambda s: 0.0 if s < goes_s else 0.3)
    assert light_figures(run, ())["start_s"] == pytest.approx(start_s, abs=0.021)
    assert ("start_s" in failed("traffic-light", run)) == (start_s > 0.7)


@pytest.mark.parametrize(("way_of", "speed_of", "light_of", "stops"), [
    (lambda s: min(-0.1, -1.0 + 0.3 * s), lambda s: 0.3 if s < 3 else 0.0, lambda s: "red" if s < 6 else "green", 1),
    (lambda s: min(-0.1, -1.0 + 0.3 * s), lambda s: 0.3 if s < 3 else 0.0, lambda s: "green", 0),
    (lambda s: min(-0.6, -1.0 + 0.3 * s), lambda s: 0.3 if s < 1.4 else 0.0, lambda s: "red", 0),  # too far away
    (lambda s: -1.0 + 0.3 * s, lambda s: 0.3, lambda s: "red", 0),
    (lambda _s: 0.1, lambda _s: 0.0, lambda _s: "red", 0),
    (lambda s: -0.1, lambda s: 0.3 if s < 3 else 0.0, lambda s: "green" if 4 < s < 8 else "red", 2),
])
def test_red_stop_is_a_rest_shortly_before_the_line_at_red(way_of, speed_of, light_of, stops):
    assert red_stops(drive(light_of, way_of, speed_of)) == stops


def test_one_that_never_starts_is_timed_to_the_end_of_green():
    run = drive(lambda s: "green" if 5 <= s < 10 else "red", lambda _s: -0.1, lambda _s: 0.0)
    assert light_figures(run, ())["start_s"] == pytest.approx(5.0, abs=0.021)


@pytest.mark.parametrize(("shift_s", "wrong"), [(0.0, 0.0), (0.3, 0.0), (1.0, None)])
def test_a_color_that_is_reported_late_is_wrong(shift_s, wrong):
    def light(at_s):
        return "red" if at_s < 5 else "green"

    run = drive(light, lambda _s: -1.0)
    said = [(round(at * 2e4), "waiting", f"light {light(at / 50 - shift_s)}, line in 1 m") for at in range(600)]
    percent = light_figures(run, said)["wrong_states_percent"]
    assert percent == pytest.approx(wrong, abs=0.01) if wrong is not None else percent > 4


@pytest.mark.parametrize("told", ["red", "green"])
def test_a_frame_between_two_samples_of_different_light_is_of_neither(told):
    run = drive(lambda at_s: "red" if at_s < 5 else "green", lambda _s: -1.0)
    said = [(2_000_000, "", "light red"), (4_990_000, "", f"light {told}"), (7_000_000, "", "light green")]
    assert light_figures(run, said)["wrong_states_percent"] == 0
    wrong = [(2_000_000, "", "light red"), (4_970_000, "", "light green"), (7_000_000, "", "light green")]
    assert light_figures(run, wrong)["wrong_states_percent"] > 0


def test_unknown_color_is_wrong_and_a_far_light_is_not_scored():
    near, far = drive(lambda _s: "red", lambda _s: -1.0), drive(lambda _s: "red", lambda _s: -3.0)
    said = [(round(at * 2e4), "driving", "light unknown") for at in range(600)]
    assert light_figures(near, said)["wrong_states_percent"] == 100
    assert light_figures(far, said)["wrong_states_percent"] is None


# --- waypoints ---------------------------------------------------------------------------------------------------


def on_the_way(places, clearance_m=0.2):
    return [replace(truth(at / 50), x_m=x, y_m=y, clearance_m=clearance_m) for at, (x, y) in enumerate(places)]


def test_waypoints_count_in_their_order():
    scenario = load_scenario("thymio").model_copy(update={"goals_m": ((1.0, 0.0), (0.0, 0.0))})
    there = [(at / 100, 0.0) for at in range(101)]
    assert goal_figures(scenario, on_the_way(there), ())["reached_s"] is None
    back = goal_figures(scenario, on_the_way(there + there[::-1]), ())
    assert back["reached_s"] == pytest.approx((202 - 7) / 50, abs=0.03)


def test_smallest_distance_is_checked_as_a_minimum():
    there = [(1.5 * at / 100, 1.5 * at / 100) for at in range(101)]
    assert failed("thymio", on_the_way(there, clearance_m=0.11)) == set()
    assert failed("thymio", on_the_way(there, clearance_m=0.09)) == {"least_clearance_m"}
    assert failed("thymio", on_the_way(there[:50])) == {"reached_s"}


def test_closed_room_requires_the_report_that_no_way_exists():
    around = [math.radians(-135 + 2 * at) for at in range(100)]
    run = on_the_way([(1.5 + 2 * math.cos(angle), 1.5 + 2 * math.sin(angle)) for angle in around])
    assert failed("thymio-closed", run) == {"given_up_s"}
    assert failed("thymio-closed", run, [(1_000_000, "cannot reach", "waypoint 1")]) == set()


@pytest.mark.parametrize(("degrees", "covered"), [
    ([-135] * 100, 0.0), (range(-135, 47), 181.0), ([*range(100, 260), *range(260, 100, -1)], 160.0),
])
def test_closed_room_requires_a_way_around_it(degrees, covered):
    run = on_the_way([(1.5 + math.cos(math.radians(one)), 1.5 + math.sin(math.radians(one))) for one in degrees])
    found = goal_figures(load_scenario("thymio-closed"), run, ())["least_around_deg"]
    assert found == pytest.approx(covered, abs=1e-6)
    report = [(1_000_000, "cannot reach", "waypoint 1")]
    assert ("least_around_deg" in failed("thymio-closed", run, report)) == (covered < 180)


# --- legs and walls ----------------------------------------------------------------------------------------------


def test_legs_are_kept_at_a_distance_from_acquisition_on():
    run = samples(distance_m=lambda at: 1.4 - 0.012 * min(at, 50) + (0.25 if at == 80 else 0.0))
    found = legs_figures(run, run[46:])
    assert (found["least_distance_m"], found["most_distance_m"]) == pytest.approx((0.8, 1.05))
    assert found["least_ever_m"] == pytest.approx(0.8)


def test_an_occluder_may_be_touched_for_less_than_a_tenth_of_a_second():
    for steps, bad in ((25, set()), (26, {"wall_contact_s"})):
        run = samples(200, x_m=lambda at: at / 100, walls=lambda at, steps=steps: steps if at > 50 else 0)
        assert failed("occluder", run) == bad


def test_a_robot_that_stays_where_it_is_does_not_follow_behind_an_occluder():
    for way_m, bad in ((0.51, set()), (0.49, {"least_travelled_m"}), (0.0, {"least_travelled_m"})):
        run = samples(201, x_m=lambda at, way_m=way_m: way_m * at / 200)
        assert failed("occluder", run) == bad and scored(run).figure("least_travelled_m") == pytest.approx(way_m)


def test_driving_into_the_target_is_a_failure():
    run = [replace(one, target_contacts_by_robot=1 if at > 50 else 0) for at, one in enumerate(samples())]
    assert failed("ball", run) == {"target_contacts"}


def test_the_worst_of_a_least_is_the_smallest():
    results = [replace(scored(samples()), figures={"least_clearance_m": value}) for value in (0.2, 0.1, 0.3)]
    assert median_and_worst(results, "least_clearance_m") == (0.2, 0.1)
