"""No more than so many a second, of frames that come at a rate of their own and with jitter."""

from itertools import pairwise
from random import Random

import pytest

from sightline.vision_side.viewing import RateLimiter


def passed(rate_hz: float, frames_hz: float, seconds: float, jitter: float = 0.0, seed: int = 0) -> list[int]:
    random, pace = Random(seed), RateLimiter(rate_hz)
    places = range(round(seconds * frames_hz))
    times_us = [round((at + random.uniform(-jitter, jitter)) * 1e6 / frames_hz) for at in places]
    return [at for at in times_us if pace.is_due(at)]


@pytest.mark.parametrize(("rate_hz", "frames_hz", "expected"), [
    (15, 30, 150), (10, 30, 100), (15, 10, 100), (30, 30, 300), (15, 60, 150), (7, 30, 70),
])
def test_the_mean_rate_is_kept(rate_hz, frames_hz, expected):
    assert abs(len(passed(rate_hz, frames_hz, 10.0)) - expected) <= expected * 0.02


@pytest.mark.parametrize("seed", [3, 17, 81])
def test_jitter_costs_no_third_frame(seed):
    kept = passed(15, 30, 20.0, jitter=0.2, seed=seed)
    assert 290 <= len(kept) <= 301
    assert max(late - early for early, late in pairwise(kept)) < 110_000


def test_pause_is_not_made_up_for():
    pace = RateLimiter(10)
    assert pace.is_due(0) and not pace.is_due(50_000)
    assert pace.is_due(5_000_000)
    assert [pace.is_due(5_000_000 + at * 10_000) for at in range(1, 8)] == [False] * 7
