"""The age of a robot's stamp, measured against its quickest message: never too old, and separate for each start."""

from random import Random

import pytest

from sightline.protocol.clock import RobotClock


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


def test_another_session_is_another_clock():
    clock = RobotClock()
    assert clock.age_us("", 0, 5) is None and clock.age_us("0a0b0c0d", 0, 5) is None
    clock.update("0a0b0c0d", 9_000_000, 10_000_000)
    clock.update("11111111", 500, 10_100_000)
    assert clock.age_us("0a0b0c0d", 9_000_000, 10_200_000) is None
    assert clock.age_us("11111111", 500, 10_200_000) == 100_000
