"""Figures of the fault bench besides the stop: ticks distinguished from gaps."""

import pytest

from sightline.evaluation.faults.cases import _tick_checks, permille_us, undisturbed_gaps_us
from sightline.evaluation.faults.evidence import MotorRow
from sightline.evaluation.faults.sampler import Hole


def motors(times_us):
    return [MotorRow(t_us, 0.0, 0.0, 0.0, 0.0) for t_us in times_us]


# --- ticks -------------------------------------------------------------------------------------------------------


def test_gaps_are_those_between_motor_commands():
    assert undisturbed_gaps_us(motors([0, 20_000, 41_000]), []) == [20_000, 21_000]


@pytest.mark.parametrize(
    ("hole", "left"),
    [
        (Hole(19_000, 20_000), [20_000, 20_000]),
        (Hole(20_001, 20_002), [20_000, 20_000]),
        (Hole(39_999, 40_001), [20_000]),
        (Hole(0, 100_000), []),
    ],
)
def test_gap_during_a_machine_stall_is_ignored(hole, left):
    assert undisturbed_gaps_us(motors([0, 20_000, 40_000, 60_000]), [hole])[: len(left)] == left
    assert len(undisturbed_gaps_us(motors([0, 20_000, 40_000, 60_000]), [hole])) == {0: 0, 1: 1, 2: 2}[len(left)]


@pytest.mark.parametrize(("late", "worst_us"), [(0, 20_000), (1, 20_000), (2, 50_000)])
def test_one_tick_in_a_thousand_may_be_later(late, worst_us):
    gaps_us = [50_000] * late + [20_000] * 1000
    assert permille_us(gaps_us, 1000) == worst_us


def test_commands_that_arrive_do_not_dilute_the_ticks():
    gaps_us = [50_000] * 2 + [20_000] * 1000 + [10_000] * 100_000
    assert permille_us(gaps_us, 1000) == 50_000


def checks(rows, holes=(), published_us=0):
    return {check.name: check for check in _tick_checks(rows, holes, published_us)}


def test_a_lateness_that_the_robot_does_not_publish_fails():
    rows = motors([*range(0, 21_000_000, 20_000), 21_060_000])
    assert not checks(rows)["unpublished lateness"].ok
    honest = checks(rows, published_us=60_000)
    assert honest["unpublished lateness"].ok and honest["tick p99.9"].ok and honest["ticks"].ok


def test_too_few_ticks_give_no_measurement():
    assert not checks(motors(range(0, 10_000_000, 20_000)))["ticks"].ok
    assert not checks([])["ticks"].ok
