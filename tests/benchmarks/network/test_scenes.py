"""The rows of `bench network` with more than one robot and one vision service: their checks, and one real run."""

import json
import subprocess

import pytest

from sightline.benchmarks.loop.figures import read_wheel_commands
from sightline.benchmarks.network.figures import moves_again_s, on_old_sight
from sightline.benchmarks.network.run import wheel_checks
from sightline.benchmarks.network.scenes import (
    ROBOTS,
    again_checks,
    fleet_checks,
    reached_ms,
    reported_check,
    stop_checks_of,
)
from sightline.evaluation.faults.evidence import MotorRow
from sightline.evaluation.processes import SIGHTLINE
from sightline.sim.tun_emulator import why_impossible

TICK_US = 20_000
SECOND_US = 1_000_000


def told(*spans):
    """Lines of the log drive: (speed, seconds) after one another."""
    speeds = [speed for speed, seconds in spans for _ in range(round(seconds * 50))]
    return read_wheel_commands("".join(f"{number * TICK_US},{speed},{speed}\n" for number, speed in enumerate(speeds)))


# --- wheels ------------------------------------------------------------------------------------------------------


def test_a_line_being_written_is_left_out():
    assert read_wheel_commands("1,0.5,0.5\n2,0.0,0.0\n3,0.") == [(1, 0.5, 0.5), (2, 0.0, 0.0)]


def test_moving_again_is_the_end_of_the_longest_standstill_after_it():
    rows = told((0, 1), (3, 2), (0, 0.02), (3, 0.5), (0, 0.7), (3, 2))
    assert moves_again_s(rows, 3 * SECOND_US, 60 * SECOND_US) == pytest.approx(1.22, abs=0.03)
    assert moves_again_s(rows, 5 * SECOND_US, 60 * SECOND_US) == 0, "it never stood again"


def test_wheels_that_stay_still_do_not_move_again():
    rows = told((3, 2), (0, 3))
    assert moves_again_s(rows, 2 * SECOND_US, 60 * SECOND_US) is None
    assert moves_again_s(told((3, 2), (0, 1), (3, 1)), 1_900_000, 2_500_000) is None, "not by then"
    assert moves_again_s([], 0, 1) is None


@pytest.mark.parametrize(("stands", "ok"), [(True, False), (False, True)])
def test_harm_that_must_stop_the_wheels_did_not_happen_without_a_standstill(stands, ok):
    never_stood_s = moves_again_s(told((3, 5)), 3 * SECOND_US, 60 * SECOND_US)
    injected, again = again_checks([1.2, never_stood_s], 3.0, stands=stands)
    assert injected.ok is ok and again.ok


ANSWERS = [(at_us, at_us - 50_000) for at_us in range(0, SECOND_US, 50_000)]
"""Frames 50 ms old when answered, for one second; then none."""


def test_wheels_that_ramp_down_after_the_last_young_frame_moved_on_no_old_one():
    assert on_old_sight(told((3, 1.3), (2, 0.1), (1, 0.1), (0, 2)), ANSWERS) == 0
    assert on_old_sight(told((0, 0.1), (3, 0.5), (-5, 0.5), (0, 2)), ANSWERS) == 0, "young frames allow all"


@pytest.mark.parametrize("speeds", [((3, 1.3), (2, 0.2), (5, 0.02), (0, 2)), ((3, 1.3), (2, 1.7), (0, 0.02)),
                                    ((3, 1.3), (2, 0.2), (-5, 0.02), (0, 2))])  # fmt: skip
def test_wheels_that_gain_speed_or_go_on_without_a_young_frame_are_counted(speeds):
    assert on_old_sight(told(*speeds), ANSWERS) >= 1
    late = [(at_us, at_us - 900_000) for at_us in range(SECOND_US, 3 * SECOND_US, 50_000)]
    assert on_old_sight(told(*speeds), ANSWERS + late) >= 1, "answers to old frames allow nothing"


def test_speed_that_wheels_keep_without_a_line_is_counted():
    driving = told((3, 1))
    resumed = [*ANSWERS, *((at_us, at_us) for at_us in range(4 * SECOND_US, 5 * SECOND_US, 50_000))]
    for later in (told((3, 4.02))[-1:], told((0, 4.02))[-1:]):
        assert on_old_sight([*driving, *later], resumed) > 100
    assert on_old_sight(driving, ANSWERS, 3 * SECOND_US) > 50
    assert on_old_sight(driving, ANSWERS, SECOND_US) == 0
    assert on_old_sight(told((3, 1), (0, 0.02)), ANSWERS, 3 * SECOND_US) == 0


@pytest.mark.parametrize(("transport", "names"), [("zenoh", ["moved on frames over 400 ms"]), ("websocket", [])])
def test_wheels_are_checked_although_no_twist_was_seen(transport, names):
    checks = list(wheel_checks(told((3, 1)), [], transport, SECOND_US))
    assert [check.name for check in checks] == names and not any(check.ok for check in checks)


def test_without_any_answer_wheels_may_only_stand():
    assert on_old_sight(told((0, 3)), []) == 0
    assert on_old_sight(read_wheel_commands("1000000,0,0\n1020000,3.0,3.0\n"), []) == 1


# --- STOP --------------------------------------------------------------------------------------------------------


def motors(*rad_s):
    angle, rows = 0.0, []
    for number, speed in enumerate(rad_s):
        rows.append(MotorRow(number * TICK_US, speed, speed, angle, angle))
        angle += speed * 0.02
    return rows


FALL = (12.0, 9.0, 6.0, 3.0, 0.0, 0.0, 0.0)


def test_a_stop_reaches_the_wheels_with_the_first_line_of_the_fall_that_ends_at_zero():
    rows = motors(*[15.0] * 10, 13.0, 15.0, *FALL)
    assert reached_ms(rows[6:], 5 * TICK_US) == pytest.approx(20 * (12 - 5))
    assert reached_ms(motors(*[15.0] * 10), 0) is None, "a STOP that never reached the wheels"


def test_one_failed_stop_gives_no_p99():
    heard = motors(*[15.0] * 10, *FALL, *[0.0] * 20, *[15.0] * 20)
    reached, zero = stop_checks_of(heard, [5 * TICK_US], [35 * TICK_US])
    assert reached.ok and zero.ok and reached.value == pytest.approx(20 * (10 - 5))
    reached, zero = stop_checks_of(heard, [5 * TICK_US, 45 * TICK_US], [35 * TICK_US, 50 * TICK_US])
    assert not reached.ok and reached.value is None and not zero.ok


def test_wheels_at_rest_without_fresh_frames_do_not_count_as_stopped():
    heard = motors(*[15.0] * 4, *FALL, *[15.0] * 6, *FALL, *[0.0] * 10)
    reached, zero = stop_checks_of(heard, [2 * TICK_US], [30 * TICK_US])
    assert reached.value == pytest.approx(20 * (17 - 2)), "the second fall is the one that lasts"
    assert zero.value == pytest.approx(20 * (21 - 2), abs=20)


def test_robot_that_never_reports_stopped_fails():
    assert reported_check([1_000_000, 5_000_000], [1_200_000, 5_300_000]).value == pytest.approx(300)
    assert not reported_check([1_000_000], [1_500_000]).ok
    assert reported_check([1_000_000, 5_000_000], [1_200_000]).value is None


def test_a_late_stop_is_over_its_bound():
    late = motors(*[15.0] * 25, *FALL, *[0.0] * 20)
    reached, zero = stop_checks_of(late, [5 * TICK_US], [40 * TICK_US])
    assert not reached.ok and reached.value == pytest.approx(20 * (25 - 5)) and zero.ok


# --- the fleet ---------------------------------------------------------------------------------------------------


def answers(fps=15, age_ms=20, seconds=10):
    return [(round(number * SECOND_US / fps), age_ms * 1000) for number in range(fps * seconds)]


def test_a_fleet_is_scored_by_the_robot_that_fares_worst():
    seen = {f"r{number}": answers() for number in range(ROBOTS)}
    assert all(check.ok for check in fleet_checks(seen, 0, 10 * SECOND_US))
    for spoiled, wrong in ((answers(fps=13), "answered, least"), (answers(age_ms=90), "age p95, worst robot")):
        bad = fleet_checks({**seen, "r3": spoiled}, 0, 10 * SECOND_US)
        assert [check.name for check in bad if not check.ok] == [wrong]
    bad = fleet_checks({**seen, "r3": []}, 0, 10 * SECOND_US)
    assert {check.name: check.value for check in bad if not check.ok} == {
        "answered, least": 0.0, "age p95, worst robot": None,
    }


def test_a_robot_that_is_missing_is_noticed():
    few = {f"r{number}": answers() for number in range(ROBOTS - 1)}
    assert [check.name for check in fleet_checks(few, 0, 10 * SECOND_US) if not check.ok] == ["robots"]


# --- for real ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(bool(why_impossible()), reason=f"{why_impossible()}; run the tests as root with /dev/net/tun")
def test_standby_row_runs_with_real_processes():
    command = [*SIGHTLINE, "bench", "network", "--only", "standby", "--seconds", "4", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    said = json.loads(done.stdout)
    taken = next(check for check in said["checks"] if "drives again" in check["name"])
    assert taken["value"] is not None and 0.2 < taken["value"] < 5, "wheels stood and turned again"
    assert said["rows"][0]["injected"] >= 1
