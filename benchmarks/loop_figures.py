"""The figures of `bench loop` and the bounds they are held against. Pure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Final

from sightline.benchmarks.loop_course import Sample
from sightline.benchmarks.loop.figures import FLOOR, OURS, PEERS, TAKEN_BOUND_PERCENT, TCP, LoopSetting

P50_OVER_FLOOR_MS: Final = 1.5
P95_OVER_FLOOR_MS: Final = 5.0
CPU_OVER_FLOOR_MS: Final = 0.6
ANSWERED_PERCENT: Final = 99.0
OVERLOADED_LIKE_MS: Final = 80.0
"""A detector overloaded by the rate is allowed the same ages as one with this delay."""
LOADED_P50_OVER_DELAY_MS: Final = 10.0
LOADED_P99_OVER_DELAY_MS: Final = 40.0
DRIFT_PERCENT: Final = 10.0
_PART_US: Final = 10_000_000
_PARTS: Final = 5
"""Drift is from the first ten seconds to the last, of a shorter time from its first fifth to its last."""


@dataclass(frozen=True, slots=True)
class Figures:
    """One contestant. Times are from capture to the verdict; None where nothing was answered.

    `first_ms` and `last_ms` are medians of the first and the last ten seconds, or fifths of a shorter time; `cpu_ms` is
    per answered picture and process, `memory_mb` the high-water mark, `bytes_per_picture` what went over the sockets,
    both ways.
    """

    name: str
    captured: int
    fps: float
    answered_percent: float
    p50_ms: float | None
    p95_ms: float | None
    p99_ms: float | None
    first_ms: float | None
    last_ms: float | None
    cpu_ms: Mapping[str, float]
    memory_mb: Mapping[str, float]
    bytes_per_picture: float | None
    taken_percent: float
    tries: int
    hot_ms: float | None


@dataclass(frozen=True, slots=True)
class LoopCheck:
    """One demanded figure."""

    name: str
    value: float | None
    unit: str
    bound: float
    ok: bool


def percentile(values: Sequence[float], percent: float) -> float | None:
    """The smallest of `values` that at least `percent` (0..100) of them do not exceed; None of none."""
    if not values:
        return None
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)  # rounded up
    return ordered[max(0, int(rank) - 1)]


def figures_of(sample: Sample) -> Figures:
    """The figures of a sample."""
    course = sample.course
    ages_ms = [age_us / 1000 for _, age_us in course.ages_us]
    parts = _parts(course.ages_us)
    judged = max(1, len(ages_ms))
    return Figures(
        name=sample.name,
        captured=course.captured,
        fps=course.captured * course.answered_percent / 100 / sample.seconds,
        answered_percent=course.answered_percent,
        p50_ms=percentile(ages_ms, 50),
        p95_ms=percentile(ages_ms, 95),
        p99_ms=percentile(ages_ms, 99),
        first_ms=parts[0],
        last_ms=parts[1],
        cpu_ms={name: 1000 * cpu_s / judged for name, cpu_s in sample.cpu_s.items()},
        memory_mb=dict(sample.memory_mb),
        bytes_per_picture=None if sample.carried_bytes is None else sample.carried_bytes / max(1, course.captured),
        taken_percent=sample.taken_percent,
        tries=sample.tries,
        hot_ms=None if sample.hot_us is None else sample.hot_us / 1000,
    )


def _parts(ages_us: Sequence[tuple[int, int]]) -> tuple[float | None, float | None]:
    """Medians, in milliseconds, of the first and the last part of the time."""
    if not ages_us:
        return None, None
    begin_us, end_us = ages_us[0][0], ages_us[-1][0]
    part_us = min(_PART_US, (end_us - begin_us) / _PARTS)
    first = [age_us for at_us, age_us in ages_us if at_us <= begin_us + part_us]
    last = [age_us for at_us, age_us in ages_us if at_us >= end_us - part_us]
    return median(first) / 1000, median(last) / 1000


def loop_checks(figures: Mapping[str, Figures], setting: LoopSetting) -> list[LoopCheck]:
    """Hold Sightline against the floor of the same run, or, with a detector slower than the camera, against its delay.

    And against every rival there is; transports with our eyes are shown and not judged. `figures` has at least the
    floor and Sightline.
    """
    ours, floor = figures[OURS], figures[FLOOR]
    like_ms = setting.detector_delay_ms or OVERLOADED_LIKE_MS
    checks = _loaded(ours, like_ms) if setting.is_loaded else _unloaded(ours, floor)
    rivals = [figures[name] for name in (*PEERS, *((TCP,) if setting.is_loaded else ())) if name in figures]
    for rival in rivals:
        checks.append(at_most(f"p95 behind {rival.name}", _over(ours.p95_ms, rival.p95_ms), "ms", 0.0))
        if setting.is_loaded:
            checks.append(at_most(f"p50 behind {rival.name}", _over(ours.p50_ms, rival.p50_ms), "ms", 0.0))
    disturbed = [one for one in figures.values() if one.taken_percent > TAKEN_BOUND_PERCENT]
    return [*checks, at_most("samples disturbed by others", len(disturbed), "", 0.0)]


def _unloaded(ours: Figures, floor: Figures) -> list[LoopCheck]:
    cpu_ms = ours.cpu_ms["vision"] - floor.cpu_ms["vision"]
    return [
        at_most("p50 over floor", _over(ours.p50_ms, floor.p50_ms), "ms", P50_OVER_FLOOR_MS),
        at_most("p95 over floor", _over(ours.p95_ms, floor.p95_ms), "ms", P95_OVER_FLOOR_MS),
        at_most("not accepted", 100 - ours.answered_percent, "%", 100 - ANSWERED_PERCENT),
        at_most("vision CPU over floor", cpu_ms, "ms", CPU_OVER_FLOOR_MS),
    ]


def _loaded(ours: Figures, delay_ms: float) -> list[LoopCheck]:
    drift = _over(ours.last_ms, ours.first_ms)
    drift_percent = None if drift is None or not ours.first_ms else 100 * abs(drift) / ours.first_ms
    return [
        at_most("age p50", ours.p50_ms, "ms", delay_ms + LOADED_P50_OVER_DELAY_MS),
        at_most("age p99", ours.p99_ms, "ms", delay_ms + LOADED_P99_OVER_DELAY_MS),
        at_most("drift of age", drift_percent, "%", DRIFT_PERCENT),
        at_most("not accepted", 100 - ours.answered_percent, "%", 100 - ANSWERED_PERCENT),
    ]


def _over(value: float | None, other: float | None) -> float | None:
    return None if value is None or other is None else value - other


def at_most(name: str, value: float | None, unit: str, bound: float) -> LoopCheck:
    """Hold `value` against `bound`; a value that there is not does not hold."""
    return LoopCheck(name, value, unit, bound, value is not None and value <= bound)
