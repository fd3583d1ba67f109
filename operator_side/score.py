"""The score of a run, from world truth alone: never from what the software says of itself. Pure."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from sim.truth import Truth

ACQUIRED_WITHIN_DEG = 2.0
ACQUIRED_WITHIN_M = 0.05
FOUND_WITHIN_DEG = 10.0


@dataclass(frozen=True, slots=True)
class Score:
    """One run. From the first acquisition to the end, coasting included; None where it was never acquired."""

    acquired_s: float | None
    """When bearing and distance were first within 2 degrees and 0.05 m, since the first sample."""
    found_s: float | None
    """When the target was first in view within 10 degrees."""
    bearing_rms_deg: float | None
    distance_rms_m: float | None
    lost_percent: float | None
    """Share of the time since acquisition in which the target was out of view."""
    wall_contacts: int
    """Physics steps in contact with a wall, over the whole run."""
    travelled_m: float
    """Way of the axle's midpoint, over the whole run."""
    seconds: float


@dataclass(frozen=True, slots=True)
class Check:
    """One demanded figure."""

    name: str
    value: float | None
    unit: str
    bound: float
    ok: bool


def score(samples: Sequence[Truth], stand_off_m: float) -> Score:
    """Score evenly spaced samples. Raises ValueError for none at all."""
    if not samples:
        raise ValueError("a run without samples has no score")
    start_us = samples[0].t_us
    acquired = next((at for at, truth in enumerate(samples) if _is_on(truth, stand_off_m)), None)
    found = next((truth for truth in samples if _is_found(truth)), None)
    followed = samples[acquired:] if acquired is not None else ()
    return Score(
        acquired_s=None if acquired is None else (samples[acquired].t_us - start_us) / 1e6,
        found_s=None if found is None else (found.t_us - start_us) / 1e6,
        bearing_rms_deg=_rms([math.degrees(truth.bearing_rad) for truth in followed]),
        distance_rms_m=_rms([truth.distance_m - stand_off_m for truth in followed]),
        lost_percent=100 * sum(not truth.visible for truth in followed) / len(followed) if followed else None,
        wall_contacts=samples[-1].wall_contacts - samples[0].wall_contacts,
        travelled_m=sum(math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) for a, b in itertools.pairwise(samples)),
        seconds=(samples[-1].t_us - start_us) / 1e6,
    )


def _is_on(truth: Truth, stand_off_m: float) -> bool:
    near = abs(truth.distance_m - stand_off_m) < ACQUIRED_WITHIN_M
    return near and abs(math.degrees(truth.bearing_rad)) < ACQUIRED_WITHIN_DEG and truth.visible


def _is_found(truth: Truth) -> bool:
    return truth.visible and abs(math.degrees(truth.bearing_rad)) < FOUND_WITHIN_DEG


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(sum(value * value for value in values) / len(values)) if values else None


# --- what is demanded --------------------------------------------------------------------------------------------

UNITS = {
    "acquired_s": "s", "found_s": "s", "bearing_rms_deg": "deg", "distance_rms_m": "m", "lost_percent": "%",
    "wall_contacts": "steps", "travelled_m": "m",
}
STANDS_STILL_FROM_MS = 350
"""With so much added latency no frame is young enough any more: the robot is to stand still, and that is judged."""
BOUNDS: dict[str, dict[str, float]] = {
    "static": {"acquired_s": 1.5, "bearing_rms_deg": 0.5, "distance_rms_m": 0.03},
    "circle": {"bearing_rms_deg": 1.0, "distance_rms_m": 0.05},
    "eight": {"bearing_rms_deg": 3.0, "lost_percent": 0.0},
    "pushed": {"lost_percent": 0.0},
    "behind": {"found_s": 5.0},
    "walls": {},
}
"""For 0 to 200 ms added latency and 10 % loss on each leg. No contact with walls is demanded everywhere."""
_EXACT = ("lost_percent", "wall_contacts")


def judge(scenario: str, result: Score, latency_ms: float = 0.0, factor: float = 1.0) -> list[Check]:
    """Hold `result` against the bounds of `scenario`, each times `factor` but for counts that must be zero."""
    if latency_ms >= STANDS_STILL_FROM_MS:
        return [_check("travelled_m", result, 0.05), _check("wall_contacts", result, 0.0)]
    bounds = {**BOUNDS.get(scenario, {}), "wall_contacts": 0.0}
    checks = [_check(name, result, bound if name in _EXACT else bound * factor) for name, bound in bounds.items()]
    if not any(name.startswith(("found", "acquired")) for name in bounds):
        checks.insert(0, Check("acquired_s", result.acquired_s, "s", result.seconds, result.acquired_s is not None))
    return checks


def _check(name: str, result: Score, bound: float) -> Check:
    value: float | None = getattr(result, name)
    return Check(name, value, UNITS[name], bound, value is not None and value <= bound)


def median_and_worst(results: Sequence[Score], name: str) -> tuple[float | None, float | None]:
    """Median and worst of one figure over runs; None where a run has none, for then it is worst of all."""
    values: list[float | None] = [getattr(result, name) for result in results]
    numbers = [value for value in values if value is not None]
    worst = max(numbers) if numbers and len(numbers) == len(values) else None
    return (median(numbers) if numbers else None), worst
