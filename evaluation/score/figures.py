"""The score of a run, from world truth alone: never from what the software says of itself. Pure."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

from sightline.sim.truth import Truth

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
    """Physics steps in contact with a wall or another thing in the way, over the whole run."""
    travelled_m: float
    """Way of the axle's midpoint, over the whole run."""
    seconds: float
    unseen_percent: float = 0.0
    """Share of the whole run in which the target was out of view."""
    target_contacts: int = 0
    """Physics steps in which the robot drove into the target, over the whole run."""
    figures: Mapping[str, float | None] = field(default_factory=dict)
    """What else this scenario is judged by; see `score_course.py`."""

    def figure(self, name: str) -> float | None:
        """One figure by its name, whichever kind it is."""
        value: float | None = self.figures[name] if name in self.figures else getattr(self, name, None)
        return value


def score(
    samples: Sequence[Truth], stand_off_m: float, figures: Mapping[str, float | None] | None = None
) -> Score:
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
        unseen_percent=100 * sum(not truth.visible for truth in samples) / len(samples),
        target_contacts=samples[-1].target_contacts_by_robot - samples[0].target_contacts_by_robot,
        figures=figures or {},
    )


def _is_on(truth: Truth, stand_off_m: float) -> bool:
    near = abs(truth.distance_m - stand_off_m) < ACQUIRED_WITHIN_M
    return near and abs(math.degrees(truth.bearing_rad)) < ACQUIRED_WITHIN_DEG and truth.visible


def _is_found(truth: Truth) -> bool:
    return truth.visible and abs(math.degrees(truth.bearing_rad)) < FOUND_WITHIN_DEG


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(sum(value * value for value in values) / len(values)) if values else None


def median_and_worst(results: Sequence[Score], name: str) -> tuple[float | None, float | None]:
    """Median and worst of one figure over runs; None where a run has none, for then it is worst of all."""
    values = [result.figure(name) for result in results]
    numbers = [value for value in values if value is not None]
    worst = min if name.startswith(AT_LEAST) else max
    whole = worst(numbers) if numbers and len(numbers) == len(values) else None
    return (median(numbers) if numbers else None), whole


AT_LEAST = "least_"
"""A figure whose name begins so must not fall below its bound."""
