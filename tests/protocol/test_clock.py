"""The age of a robot's stamp, measured against its quickest message: never too old, and separate for each start."""

import time
from random import Random

import pytest

from sightline.protocol.clock import RobotClock, heartbeat_us, monotonic_us


@pytest.mark.parametrize("seed", [1, 29, 400])
def test_an_age_is_short_by_no_more_than_the_quickest_delay(seed):
    random, clock = Random(seed), RobotClock()
    offset_us = random.randrange(10**12)
    for at_us in range(0, 2_000_000, 100_000):
        clock.update("0a0b0c0d", at_us, offset_us + at_us + 4_000 + random.randrange(30_000))
    clock.update("0a0b0c0d", 2_000_000, offset_us + 2_004_000)
    for true_us in (0, 5_000, 80_000, 3_000_000):
        age_us = clock.age_us("0a0b0c0d", 2_500_000, offset_us + 2_500_000 + true_us)
        assert age_us == max(0, true_us - 4_000)


@pytest.mark.parametrize("fps", [30, 240, 1_000])
def test_clock_of_a_slow_robot_is_followed_at_any_rate(fps):
    """50 us/s slower: without the drift its newest message would be 3 ms old after a minute."""
    clock = RobotClock()
    for now_us in range(0, 60_000_000, 1_000_000 // fps):
        t_us = now_us - now_us // 20_000
        assert clock.update("0a0b0c0d", t_us, now_us)
    assert clock.age_us("0a0b0c0d", t_us, now_us) <= 1


def test_another_session_is_another_clock():
    clock = RobotClock()
    assert clock.age_us("", 0, 5) is None and clock.age_us("0a0b0c0d", 0, 5) is None
    clock.update("0a0b0c0d", 9_000_000, 10_000_000)
    clock.update("11111111", 500, 10_100_000)
    assert clock.age_us("0a0b0c0d", 9_000_000, 10_200_000) is None
    assert clock.age_us("11111111", 500, 10_200_000) == 100_000


def test_time_in_suspend_counts_for_ages_and_not_for_heartbeats(monkeypatch):
    real, suspended_us = time.clock_gettime_ns, 60_000_000
    before_us, beat_us = monotonic_us(), heartbeat_us()
    added_ns = {time.CLOCK_BOOTTIME: suspended_us * 1000}
    monkeypatch.setattr(time, "clock_gettime_ns", lambda clock: real(clock) + added_ns.get(clock, 0))
    assert suspended_us <= monotonic_us() - before_us < suspended_us + 1_000_000
    assert 0 <= heartbeat_us() - beat_us < 1_000_000
