"""`sightline bench streams`: its checks on invented runs."""

from sightline.benchmarks.detector import OVERLOAD, Load, StreamPlan, stream_checks

ROBOTS = [f"s{index}" for index in range(40)]
SECONDS = 60
BEGIN_US = 5_000_000
ANSWERED_HZ = 30 / OVERLOAD


def load(answered_s=SECONDS):
    """A run whose services answer each robot evenly, for so long; an answer takes 50 ms."""
    one = Load(offered=30 * SECONDS * len(ROBOTS), memory_mb=[0.0] * SECONDS, seconds=SECONDS)
    one.begin(ROBOTS, BEGIN_US)
    one.memory_mb += [80.0] * SECONDS
    for number in range(round(answered_s * ANSWERED_HZ)):
        at_us = BEGIN_US + round(number * 1e6 / ANSWERED_HZ)
        for robot in ROBOTS:
            one.answer(robot, at_us - 50_000, at_us)
    one.end(BEGIN_US + SECONDS * 1_000_000)
    return one


def failed(one):
    return {check.name for check in stream_checks(one, StreamPlan()) if not check.ok}


def test_services_that_answer_to_the_end_pass():
    assert not failed(load())


def test_services_that_stop_to_answer_in_the_middle_fail():
    assert failed(load(SECONDS / 2)) == {"offered per answered frame", "longest time without an answer"}
