"""`sightline bench streams`: its checks on invented runs."""

from collections import Counter

import pytest

from sightline.benchmarks.detector import OVERLOAD, Load, StreamPlan, stream_checks

ROBOTS = [f"s{index}" for index in range(40)]
SECONDS = 60
ANSWERED_HZ = 30 / OVERLOAD


def load(answered_s=SECONDS):
    """A run whose services answer each robot evenly, for so long; an answer takes 50 ms."""
    answers = round(answered_s * ANSWERED_HZ)
    one = Load(offered=30 * SECONDS * len(ROBOTS), answered=Counter(dict.fromkeys(ROBOTS, answers)), ages_ms=[50.0],
               memory_mb=[80.0] * SECONDS, seconds=SECONDS, answered_us=dict.fromkeys(ROBOTS, 0))
    for robot in ROBOTS:
        for number in range(answers):
            at_us = round(number * 1e6 / ANSWERED_HZ)
            one.close_gap(robot, at_us)
            one.answered_us[robot] = at_us
        one.close_gap(robot, SECONDS * 1_000_000)
    return one


def failed(one, **plan):
    return {check.name for check in stream_checks(one, StreamPlan(**plan)) if not check.ok}


def test_services_that_answer_to_the_end_pass():
    assert not failed(load())


@pytest.mark.parametrize("kill", [False, True])
def test_services_that_stop_to_answer_in_the_middle_fail(kill):
    assert failed(load(SECONDS / 2), kill=kill) == {"offered per answered frame", "longest time without an answer"}
