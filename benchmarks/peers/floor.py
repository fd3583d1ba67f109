"""The floor, without a transport: sleep until the image's time, then decode and step, in one process. Shell."""

from __future__ import annotations

import statistics
import time
from typing import TYPE_CHECKING, Final

from sightline.protocol.text import parse_twist

if TYPE_CHECKING:
    from sightline.benchmarks.peers.contest import RecordedFrames, Tally, Vision

_HOT_STEPS: Final = 150


def alone(film: RecordedFrames, detector: Vision, tally: Tally, *, hot: bool) -> None:
    """Answer images at their pace forever. Before that, `hot` measures steps without pauses."""
    if hot:
        tally.hot_us = statistics.median(_step_us(film, detector) for _ in range(_HOT_STEPS))
    while True:
        time.sleep(film.next_in_s())
        t_us, jpeg = film.shoot()
        tally.capture(t_us)
        parse_twist(detector.answer(t_us, jpeg).encode())
        tally.validate(t_us)


def _step_us(film: RecordedFrames, detector: Vision) -> float:
    t_us, jpeg = film.shoot()
    began_ns = time.perf_counter_ns()
    detector.answer(t_us, jpeg)
    return (time.perf_counter_ns() - began_ns) / 1000
