"""Compute the figures of a network case and of its wheel commands, with their bounds. Pure."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

from sightline.benchmarks.loop.figures import WheelCommand, percentile, wheel_ages
from sightline.benchmarks.network.cases import NetworkCase
from sightline.benchmarks.network.watch import NOTED
from sightline.evaluation.checks import Check, at_least, at_most, worst_checks
from sightline.evaluation.faults.evidence import OLD_US, RAMPED_US, held_us
from sightline.robot_side.safety.limits import TICK_US

_LATE_US: Final = 2 * TICK_US
"""A decision holds for one tick. The recorder of a twist may receive it slightly after the robot."""
_OLD_US: Final = OLD_US + _LATE_US
_RAMPED_OUT_US: Final = (RAMPED_US + 2 * _LATE_US) // TICK_US * TICK_US
"""Age of a frame, in whole ticks, at which even its ramp has ended; both its answer and the zero may
be late.
"""
_TENTH_US: Final = 100_000
_LEAST_MOVING_PERCENT: Final = 90.0
"""Against a robot that never leaves HOLD, which would satisfy the bounds of ages and holds."""
_FASTER_RAD_S: Final = 0.15
"""Smallest gain of speed. The conversion of a twist to wheel speeds rounds."""


def on_old_sight(rows: Sequence[WheelCommand], answers: Sequence[Sequence[int]], until_us: int = 0) -> int:
    """Count lines that no young frame allows. `answers`: (received_us, t_us of the answered frame) of every command.

    Once the youngest frame answered so far is too old to drive on, no wheel may accelerate. When also the ramp has
    ended, none may turn. Wheels keep their speed between lines, and the last one up to `until_us`.
    """
    times_us = held_us([row.t_us for row in rows], 0, until_us)
    rows = [row._replace(t_us=t_us) for row, each_us in zip(rows, times_us, strict=True) for t_us in each_us]
    ordered, known, youngest_us, lines = sorted(answers, key=lambda one: one[0]), 0, 0, 0
    for before, row in pairwise(rows):
        while known < len(ordered) and ordered[known][0] <= row.t_us + _LATE_US:
            youngest_us = max(youngest_us, ordered[known][1])
            known += 1
        age_us = row.t_us - youngest_us
        lines += (age_us > _OLD_US and _is_faster(before, row)) or (age_us > _RAMPED_OUT_US and row.moves)
    return lines


def _is_faster(before: WheelCommand, row: WheelCommand) -> bool:
    return max(abs(row[1]) - abs(before[1]), abs(row[2]) - abs(before[2])) > _FASTER_RAD_S


def moves_again_s(rows: Sequence[WheelCommand], since_us: int, until_us: int) -> float | None:
    """Return the time from `since_us` to the end of the longest standstill that ends after it, up to `until_us`, s.

    0 if the wheels never stood; None if they did not turn again or the log is empty.
    """
    inside = [row for row in rows if row.t_us < until_us]
    if not inside or not inside[-1].moves:
        return None
    stood_us = [(end_us - begin_us, end_us) for begin_us, end_us in _stands(inside) if end_us > since_us]
    return (max(stood_us)[1] - since_us) / 1e6 if stood_us else 0.0


def _stands(rows: Sequence[WheelCommand]) -> Iterator[tuple[int, int]]:
    """Yield the begin and the end of each standstill."""
    begin_us: int | None = None
    for row in rows:
        if not row.moves:
            begin_us = row.t_us if begin_us is None else begin_us
        elif begin_us is not None:
            yield begin_us, row.t_us
            begin_us = None


# The figures of a row of `bench network` from the robot's records, and their checks. Pure.


DRIVING: Final = ("ACTIVE", "DEGRADED")


@dataclass(frozen=True, slots=True)
class Stretch:
    """One phase as it ran: `[begin_us, end_us)`, bounds in force from `bounded_us`."""

    begin_us: int
    bounded_us: int
    end_us: int


@dataclass(frozen=True, slots=True)
class NetworkFigures:
    """Figures of one period. Ages are from capture to `drive.set` with moving wheels, `validated_ms` (median) to the
    validation. A late command counts as infinitely old."""

    p50_ms: float | None
    p95_ms: float | None
    validated_ms: float | None
    fps: float
    """Frames with an accepted command per second. A twist that is sent twice counts twice."""
    moving_percent: float
    """Share of the tenths of a second in which the wheels move."""
    executed_ms: float | None
    """Age of the oldest frame that was driven on, by ten statuses a second. None without a status."""
    holds_s: tuple[float, ...]
    flows_after_s: float | None
    """Time from the start of the stretch to the first accepted command for one of its frames."""
    window: int
    bytes_per_frame: float
    quality_percent: float
    scale_percent: float
    timeouts: int


def figures_of(
    notes: Mapping[str, Sequence[Sequence[Any]]], rows: Sequence[WheelCommand], stretch: Stretch
) -> NetworkFigures:
    """Compute the figures of `stretch`. `rows` are the wheel commands of the whole run."""
    frames = [row for row in notes["frames"] if stretch.bounded_us <= row[1] < stretch.end_us]
    statuses = [dict(zip(NOTED, row, strict=True)) for row in notes["statuses"]]
    inside = [one for one in statuses if stretch.bounded_us <= one["t_us"] < stretch.end_us]
    seconds = (stretch.end_us - stretch.bounded_us) / 1e6
    never_ms = [float("inf")] * (inside[-1]["stale"] - inside[0]["stale"] if inside else 0)
    headers = [(row[0], row[1], row[2]) for row in notes["frames"]]
    moving_us = [row.t_us for row in rows if row.moves]
    ages = [age for age in wheel_ages(headers, moving_us) if stretch.bounded_us <= age.set_us < stretch.end_us]
    moving = {t_us // _TENTH_US for t_us in moving_us if stretch.bounded_us <= t_us < stretch.end_us}
    ages_ms = [*(age.age_us / 1000 for age in ages), *never_ms]
    return NetworkFigures(
        p50_ms=percentile(ages_ms, 50),
        p95_ms=percentile(ages_ms, 95),
        validated_ms=percentile([*(age.validated_us / 1000 for age in ages), *never_ms], 50),
        fps=len({age.set_us - age.age_us for age in ages}) / seconds,
        moving_percent=min(100.0, len(moving) * 100 * _TENTH_US / 1e6 / seconds),
        executed_ms=_executed_ms(inside),
        holds_s=tuple(_holds_s(inside)),
        flows_after_s=_flows_after_s(notes["frames"], stretch),
        window=max((one["window"] for one in inside), default=0),
        bytes_per_frame=sum(row[3] for row in frames) / max(1, len(frames)),
        quality_percent=_mean([one["quality"] for one in inside]),
        scale_percent=_mean([one["scale"] for one in inside]),
        timeouts=inside[-1]["timeouts"] - inside[0]["timeouts"] if inside else 0,
    )


def _executed_ms(statuses: Sequence[Mapping[str, Any]]) -> float | None:
    ages_us = [one["frame_age_us"] or 0 if one["state"] in DRIVING else 0 for one in statuses]
    return max(ages_us) / 1000 if ages_us else None


def sent_between(statuses: Sequence[Sequence[Any]], begin_us: int, end_us: int) -> float:
    """Return the number of frames that the robot sent in that time, from its counts at 10 Hz."""
    counts = [(row[NOTED.index("t_us")], row[NOTED.index("sent")]) for row in statuses]
    return _count_at(counts, end_us) - _count_at(counts, begin_us)


def _count_at(counts: Sequence[tuple[int, int]], at_us: int) -> float:
    """Return the count at a time, by linear interpolation."""
    for (before_us, before), (after_us, after) in pairwise(counts):
        if before_us <= at_us < after_us:
            return before + (after - before) * (at_us - before_us) / (after_us - before_us)
    return float(counts[-1][1] if counts and at_us >= counts[-1][0] else counts[0][1] if counts else 0)


def _holds_s(statuses: Sequence[Mapping[str, Any]]) -> Iterator[float]:
    """Yield the length of each HOLD after driving, in s."""
    since_us: int | None = None
    driven = False
    for one in statuses:
        driving = one["state"] in DRIVING
        if driven and not driving and since_us is None:
            since_us = one["t_us"]
        if since_us is not None and (driving or one is statuses[-1]):
            yield (one["t_us"] - since_us) / 1e6
            since_us = None
        driven = driven or driving


def _flows_after_s(frames: Sequence[Sequence[Any]], stretch: Stretch) -> float | None:
    """Return the time until the first accepted command: until a frame has another latency than the one before."""
    for before, frame in pairwise(frames):
        accepted_us = before[1] if frame[2] != before[2] else None
        if accepted_us is not None and before[1] >= stretch.begin_us:
            return float(frame[1] - stretch.begin_us) / 1e6
    return None


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0


_CAUSES: Final[tuple[tuple[str, tuple[str, ...], Callable[[list[float]], float]], ...]] = (
    ("delayed", ("delay_ms", "jitter_ms", "rate_bit_s"), min),
    ("lost", ("loss",), min), ("lost", ("burst_start",), sum), ("cut", ("cut",), sum),
    ("duplicated", ("duplicate",), min), ("reordered", ("reorder",), min), ("corrupted", ("corrupt",), min),
)
"""A counter of the wire, the fields of a `LinkShape` that increase it, and how the counts of both directions combine.
Bursts are rare, and a cut ends the answers: few packets go toward the robot, so these may harm none of them."""


def injected_checks(row: NetworkCase, counts: Mapping[str, Mapping[str, int]]) -> Iterator[Check]:
    """Check that each effect that the shapes of a row request harmed packets; `counts` has those of each direction."""
    for kind, causes, together in _CAUSES:
        harmed = [float(count.get(kind, 0)) for leg, count in counts.items()
                  if any(getattr(getattr(phase.shapes, leg), cause) for phase in row.phases for cause in causes)]
        if harmed:
            yield at_least(f"packets {kind}", together(harmed), "", 1.0)


def network_checks(row: NetworkCase, figures: Sequence[NetworkFigures]) -> Iterator[Check]:
    """Check the last phase of a row against its bounds; `figures` are those of all its phases."""
    last, first = figures[-1], figures[0]
    if row.p50_ms is not None:
        yield at_most("age p50", last.p50_ms, "ms", row.p50_ms)
    if row.over_first_ms is not None:
        over = None if last.p50_ms is None or first.p50_ms is None else last.p50_ms - first.p50_ms
        yield at_most("p50 over loopback", over, "ms", row.over_first_ms)
    if row.p95_ms is not None:
        yield at_most("age p95", last.p95_ms, "ms", row.p95_ms)
    if row.least_fps is not None:
        yield at_least("answered", last.fps, "fps", row.least_fps)
    if row.most_holds is not None:
        yield at_most("holds", float(len(last.holds_s)), "", float(row.most_holds))
    if row.longest_hold_s is not None:
        yield at_most("longest hold", max(last.holds_s, default=0.0), "s", row.longest_hold_s)
    if row.flows_again_s is not None:
        yield at_most("flows again", last.flows_after_s, "s", row.flows_again_s)
    yield at_least("wheels move", last.moving_percent, "% of the time", _LEAST_MOVING_PERCENT)
    ages_ms = [one.executed_ms for one in figures if one.executed_ms is not None]
    yield at_most("oldest executed", max(ages_ms) if len(ages_ms) == len(figures) else None, "ms", OLD_US / 1000)


def worst_of_seeds(name: str, runs: Sequence[Sequence[Check]]) -> list[Check]:
    """Return the demands on the row `name`, each with its worst seed."""
    label = f"{name}, worst of {len(runs)} seeds" if len(runs) > 1 else name
    return [replace(check, name=f"{label}: {check.name}") for check in worst_checks(runs)]
