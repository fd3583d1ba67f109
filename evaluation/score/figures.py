"""The figures of a run from world truth, and the bounds of each scenario. Pure."""

import itertools
import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

from sightline.evaluation.checks import Check
from sightline.sim.scenario import Scenario
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
    """The other figures of this scenario; see `figures_of`."""

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


# The figures of scenarios that are more than following one ball: legs, waypoints, traffic lights. Pure.
#
# From world truth alone, except for the reports of a mission: an unreachable waypoint, and the color of the light.


Figures = dict[str, float | None]
MissionPhases = Sequence[tuple[int, str, str]]
"""Capture time of each frame answered, and the mission's phase and note."""

STEP_S = 0.004
"""A physics step: contacts are counted in these."""
REACHED_WITHIN_M = 0.06
"""The mission's 0.05 and what odometry may be off by then."""
STANDING_MPS = 0.02
WAITS_WITHIN_M = 0.5
"""A robot that stands no further than this before the line waits for the light."""
HARDEST_MPS2, ANSWER_S = 1.2, 0.25
"""What counts as being able to stop when the light turns yellow: this braking, after this time to see it and answer."""
READ_WITHIN_M = 2.0
"""So near before the line every picture must be read."""
SETTLED_S = 0.35
"""After a change of colour: a frame's way there and back, and a second look."""


def figures_of(scenario: Scenario, samples: Sequence[Truth], said: MissionPhases = ()) -> Figures:
    """Return the figures of `scenario` in addition to those of following."""
    figures: Figures = {"wall_contact_s": (samples[-1].wall_contacts - samples[0].wall_contacts) * STEP_S}
    if scenario.target.shape == "legs":
        figures |= legs_figures(samples, scenario.stand_off_m)
    if scenario.goals_m:
        figures |= goal_figures(scenario, samples, said)
    if scenario.light is not None:
        figures |= light_figures(samples, said)
    return figures


def legs_figures(samples: Sequence[Truth], stand_off_m: float) -> Figures:
    """Return the distances from the first acquisition on, and the smallest of the whole run."""
    acquired_s = score(samples, stand_off_m).acquired_s
    begin_us = samples[0].t_us + acquired_s * 1e6 if acquired_s is not None else math.inf
    distances = [truth.distance_m for truth in samples if truth.t_us >= begin_us]
    return {
        "least_distance_m": min(distances, default=None), "most_distance_m": max(distances, default=None),
        "least_ever_m": min(truth.distance_m for truth in samples),
    }


def goal_figures(scenario: Scenario, samples: Sequence[Truth], said: MissionPhases) -> Figures:
    """Return the time of the last waypoint, the smallest clearance, and the time of "cannot reach"."""
    goals, reached_s = list(scenario.goals_m), None
    for truth in samples:
        if goals and math.dist((truth.x_m, truth.y_m), goals[0]) <= REACHED_WITHIN_M:
            goals.pop(0)
            reached_s = (truth.t_us - samples[0].t_us) / 1e6
    given_up = next((t_us for t_us, phase, _ in said if phase == "cannot reach"), None)
    clearances = [truth.clearance_m for truth in samples if truth.clearance_m is not None]
    return {
        "reached_s": None if goals else reached_s, "least_clearance_m": min(clearances, default=None),
        "given_up_s": None if given_up is None else (given_up - samples[0].t_us) / 1e6,
    }


def light_figures(samples: Sequence[Truth], said: MissionPhases) -> Figures:
    """Crossings of the stop line and what the light showed, how soon it starts, and how often it misread the light."""
    crossings = list(_crossings(samples))
    starts = list(_starts(samples))
    return {
        "least_crossings": len(crossings), "crossed_on_red": sum(light == "red" for light, _ in crossings),
        "crossed_late": sum(light == "yellow" and could_stop for light, could_stop in crossings),
        "start_s": max(starts, default=0.0), "wrong_states_percent": _wrong_percent(samples, said),
    }


def _crossings(samples: Sequence[Truth]) -> Iterator[tuple[str, bool]]:
    """Yield the light at each crossing, and True if the robot could have stopped at the end of green."""
    could_stop = False
    for before, now in pairwise(samples):
        if before.light == "green" != now.light:
            left_m = -(now.past_line_m or 0.0)
            could_stop = left_m > now.linear_mps * ANSWER_S + now.linear_mps**2 / (2 * HARDEST_MPS2)
        if (before.past_line_m or 0.0) < 0 <= (now.past_line_m or 0.0):
            yield now.light, could_stop


def _starts(samples: Sequence[Truth]) -> Iterator[float]:
    """Yield the delay between each green and the start of a waiting robot, in s."""
    green_us: int | None = None
    for before, now in pairwise(samples):
        waits = abs(now.linear_mps) < STANDING_MPS and -WAITS_WITHIN_M < (now.past_line_m or 0.0) < 0
        if before.light != "green" == now.light and waits:
            green_us = now.t_us
        if green_us is not None and (now.linear_mps >= STANDING_MPS or now.light != "green"):
            yield (now.t_us - green_us) / 1e6
            green_us = None


def _wrong_percent(samples: Sequence[Truth], said: MissionPhases) -> float | None:
    """Return the share of frames before the line with a wrong or missing color of the mission, in percent."""
    times_us = [truth.t_us for truth in samples]
    changes = [now.t_us for before, now in pairwise(samples) if before.light != now.light]
    looked = right = 0
    for t_us, _, note in said:
        after = bisect_right(times_us, t_us)
        if not 0 < after < len(samples):
            continue
        truth = samples[after - 1]
        if truth.light != samples[after].light:  # it changed between two samples: before the frame or after it
            continue
        if not -READ_WITHIN_M < (truth.past_line_m or 0.0) < 0 or _is_new(t_us, changes):
            continue
        looked += 1
        right += note.startswith(f"light {truth.light}")
    return 100 * (1 - right / looked) if looked else None


def _is_new(t_us: int, changes: Sequence[int]) -> bool:
    """Return True if the light has just changed."""
    return any(0 <= t_us - change < SETTLED_S * 1e6 for change in changes)


# The bounds of each scenario, and their check. Pure.
#
# They apply to 0 to 200 ms added latency and 10 % loss on each leg. Contact is permitted only where a bound names it.


UNITS = {
    "acquired_s": "s", "found_s": "s", "bearing_rms_deg": "deg", "distance_rms_m": "m", "lost_percent": "%",
    "wall_contacts": "steps", "target_contacts": "steps", "travelled_m": "m", "wall_contact_s": "s",
    "least_distance_m": "m", "most_distance_m": "m", "least_ever_m": "m", "reached_s": "s", "least_clearance_m": "m",
    "given_up_s": "s", "crossed_on_red": "times", "crossed_late": "times", "least_crossings": "times",
    "start_s": "s", "wrong_states_percent": "%",
}
STANDS_STILL_FROM_MS = 350
"""Added latency from which every frame is too old. The robot must stand still, and the score checks it."""

_CIRCLE = {"bearing_rms_deg": 1.0, "lost_percent": 0.0, "target_contacts": 0.0}
_EIGHT = {"bearing_rms_deg": 3.0, "lost_percent": 0.0, "target_contacts": 0.0}
_LEGS = {
    "bearing_rms_deg": 3.0, "lost_percent": 0.0, "least_distance_m": 0.7, "most_distance_m": 1.0, "least_ever_m": 0.3,
    "target_contacts": 0.0,
}
_LIGHT = {
    "crossed_on_red": 0.0, "crossed_late": 0.0, "least_crossings": 1.0, "start_s": 0.7, "wrong_states_percent": 0.0,
}
_COURSE = {"reached_s": 40.0, "least_clearance_m": 0.10}

BOUNDS: dict[str, dict[str, float]] = {
    "static": {"acquired_s": 1.5, "bearing_rms_deg": 0.5, "distance_rms_m": 0.03},
    "circle": {"bearing_rms_deg": 1.0, "distance_rms_m": 0.05},
    "eight": {"bearing_rms_deg": 3.0, "lost_percent": 0.0},
    "pushed": {"lost_percent": 0.0},
    "behind": {"found_s": 5.0},
    "walls": {},
    "occluder": {"wall_contact_s": 0.1},
    "blue-sphere": _CIRCLE, "ball": _CIRCLE, "blocks": _CIRCLE, "blocks-red": _CIRCLE, "blocks-yellow": _CIRCLE,
    "chaser": _CIRCLE, "chaser-circle": _CIRCLE,
    "blue-sphere-eight": _EIGHT, "ball-eight": _EIGHT, "blocks-eight": _EIGHT, "chaser-eight": _EIGHT,
    "legs": _LEGS, "legs-slow": _LEGS, "legs-fast": _LEGS, "legs-crowd": _LEGS,
    "traffic-light": _LIGHT, "traffic-light-boxes": _LIGHT,
    "thymio": {**_COURSE, "reached_s": 15.0}, "thymio-box": _COURSE, "thymio-slalom": _COURSE,
    "thymio-trap": {**_COURSE, "reached_s": 60.0}, "thymio-closed": {"given_up_s": 60.0, "least_clearance_m": 0.10},
}
EXACT = (
    "lost_percent", "wall_contacts", "target_contacts", "crossed_on_red", "crossed_late", "least_crossings",
    "wrong_states_percent", "wall_contact_s",
)
"""Figures that leave no room."""
_ACQUIRES = ("bearing_rms_deg", "distance_rms_m", "lost_percent")
"""Figures that are taken from the first acquisition on."""


def checks_of(scenario: str, result: Score, latency_ms: float = 0.0, factor: float = 1.0) -> list[Check]:
    """Hold `result` against the bounds of `scenario`, each times `factor` but for those that leave no room."""
    if latency_ms >= STANDS_STILL_FROM_MS:
        return [_check("travelled_m", result, 0.05), _check("wall_contacts", result, 0.0)]
    bounds = dict(BOUNDS[scenario] if scenario in BOUNDS else _usual(result))
    if "wall_contact_s" not in bounds:
        bounds["wall_contacts"] = 0.0
    checks = [_check(name, result, _granted(name, bound, factor)) for name, bound in bounds.items()]
    if "acquired_s" not in bounds and _must_acquire(bounds):
        checks.insert(0, Check("acquired_s", result.acquired_s, "s", result.seconds, result.acquired_s is not None))
    return checks


def _usual(result: Score) -> dict[str, float]:
    """Return the bounds of a user's scenario by its kind."""
    if "least_crossings" in result.figures:
        return _LIGHT
    return {**_COURSE, "reached_s": result.seconds} if "reached_s" in result.figures else {}


def _must_acquire(bounds: dict[str, float]) -> bool:
    """Return True if the run must acquire the target, because no other bound of following applies."""
    return any(name in _ACQUIRES for name in bounds) or set(bounds) <= {"wall_contacts", "wall_contact_s"}


def _granted(name: str, bound: float, factor: float) -> float:
    if name in EXACT:
        return bound
    return bound / factor if name.startswith(AT_LEAST) else bound * factor


def _check(name: str, result: Score, bound: float) -> Check:
    value = result.figure(name)
    ok = value is not None and (value >= bound if name.startswith(AT_LEAST) else value <= bound)
    return Check(name, value, UNITS[name], bound, ok)
