"""Compute the figures of a run from world truth, and check them against the scenario's bounds. Pure."""

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from sightline.evaluation.checks import Check
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.sim.scenario import AT_LEAST, FIGURES, OnPath, Scenario
from sightline.sim.truth import Truth

if TYPE_CHECKING:
    from sightline.vision_side.pipeline import Observation

ACQUIRED_WITHIN_M = 0.05
ACQUIRED_FOR_S = 1.0
"""Time for which the target must be within both limits. A target that only passes through is not acquired."""
FOUND_WITHIN_DEG = 10.0

WRONG_BY_M = 0.3
"""A reported target further than this from the true one is another object."""


class AnsweredFrame(NamedTuple):
    """Report of the mission on one frame: capture time, phase, note, and the place of its target from the lens."""

    t_us: int
    phase: str
    note: str
    bearing_rad: float | None = None
    distance_m: float | None = None

    @classmethod
    def of(cls, t_us: int, seen: "Observation") -> "AnsweredFrame":
        """Create it from the answer to the frame of `t_us`."""
        return cls(t_us, seen.phase, seen.note, seen.bearing_rad, seen.distance_m)


class RimSpeeds(NamedTuple):
    """Rim speeds of the wheels that the robot commanded from `t_us` until the next command."""

    t_us: int
    left_mps: float
    right_mps: float


@dataclass(slots=True)
class RunRecord:
    """The record of a run for its score, whether in lockstep or in real time."""

    samples: list[Truth] = field(default_factory=list)
    answers: list[AnsweredFrame] = field(default_factory=list)
    accepted_us: int | None = None
    """When the robot accepted its first twist; None if it never did."""
    wheels: list[RimSpeeds] = field(default_factory=list)
    """Each change of the wheel commands, in order."""


@dataclass(frozen=True, slots=True)
class Score:
    """The score of one run, from acquisition to the end, coasting included; None if never acquired."""

    acquired_s: float | None
    """Start of the first second, after the first accepted twist, in which the target stayed in view within
    `acquired_within_deg` and 0.05 m. It counts from the first sample."""
    found_s: float | None
    """When the target was first in view within 10 degrees."""
    bearing_rms_deg: float | None
    distance_rms_m: float | None
    lost_percent: float | None
    """Share of the time since acquisition in which the target was out of view."""
    wall_contacts: int
    """Physics steps in contact with a wall or another thing in the way, over the whole run."""
    travelled_m: float
    """Distance that the axle's midpoint moved over the whole run."""
    seconds: float
    unseen_percent: float = 0.0
    """Share of the whole run in which the target was out of view."""
    target_contacts: int = 0
    """Physics steps in which the robot drove into the target, over the whole run."""
    figures: Mapping[str, float | None] = field(default_factory=dict)
    """The other figures of this scenario; see `figures_of`."""

    def figure(self, name: str) -> float | None:
        """Return one figure by its name, of either kind."""
        own = name.removeprefix(AT_LEAST)
        value: float | None = self.figures[name] if name in self.figures else getattr(self, own, None)
        return value


def score(scenario: Scenario, run: RunRecord) -> Score:
    """Score a run of `scenario` by its evenly spaced samples. Raises ValueError without samples."""
    samples = run.samples
    if not samples:
        raise ValueError("a run without samples has no score")
    start_us, stand_off_m = samples[0].t_us, scenario.stand_off_m
    acquired = acquired_at(scenario, run)
    found = next((truth for truth in samples if _is_found(truth)), None)
    followed = samples[acquired:] if acquired is not None else []
    return Score(
        acquired_s=None if acquired is None else (samples[acquired].t_us - start_us) / 1e6,
        found_s=None if found is None else (found.t_us - start_us) / 1e6,
        bearing_rms_deg=_rms([math.degrees(truth.bearing_rad) for truth in followed]),
        distance_rms_m=_rms([truth.distance_m - stand_off_m for truth in followed]),
        lost_percent=100 * sum(not truth.visible for truth in followed) / len(followed) if followed else None,
        wall_contacts=samples[-1].wall_contacts - samples[0].wall_contacts,
        travelled_m=sum(math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) for a, b in pairwise(samples)),
        seconds=(samples[-1].t_us - start_us) / 1e6,
        unseen_percent=100 * sum(not truth.visible for truth in samples) / len(samples),
        target_contacts=samples[-1].target_contacts_by_robot - samples[0].target_contacts_by_robot,
        figures=figures_of(scenario, run, followed),
    )


def acquired_at(scenario: Scenario, run: RunRecord) -> int | None:
    """Return the index of the acquisition: the begin of a second on the target, after the first accepted twist."""
    if run.accepted_us is None:
        return None
    begin: int | None = None
    for at, truth in enumerate(run.samples):
        if truth.t_us < run.accepted_us or not _is_on(truth, scenario):
            begin = None
            continue
        begin = at if begin is None else begin
        if truth.t_us - run.samples[begin].t_us >= ACQUIRED_FOR_S * 1e6:
            return begin
    return None


def _is_on(truth: Truth, scenario: Scenario) -> bool:
    near = abs(truth.distance_m - scenario.stand_off_m) < ACQUIRED_WITHIN_M
    return near and abs(math.degrees(truth.bearing_rad)) < scenario.acquired_within_deg and truth.visible


def _is_found(truth: Truth) -> bool:
    return truth.visible and abs(math.degrees(truth.bearing_rad)) < FOUND_WITHIN_DEG


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(sum(value * value for value in values) / len(values)) if values else None


def median_and_worst(results: Sequence[Score], name: str) -> tuple[float | None, float | None]:
    """Return median and worst of a figure over runs. None if a run has none, which is worst of all."""
    values = [result.figure(name) for result in results]
    numbers = [value for value in values if value is not None]
    worst = min if name.startswith(AT_LEAST) else max
    whole = worst(numbers) if numbers and len(numbers) == len(values) else None
    return (median(numbers) if numbers else None), whole


# Figures of scenarios with more than one ball to follow: legs, waypoints, traffic lights. Pure.
#
# From world truth alone, except for the wheel commands and two reports of a mission: an unreachable waypoint, and the
# color of the light.


Figures = dict[str, float | None]
STEP_S = 0.004
"""A physics step: contacts are counted in these."""
REACHED_WITHIN_M = 0.06
"""The mission's 0.05 and the possible error of odometry."""
STANDING_MPS = 0.02
WAITS_WITHIN_M = 0.5
"""A robot that stands within this distance before the line waits for the light."""
HARDEST_MPS2, ANSWER_S = 1.2, 0.25
"""The robot can stop at yellow with this braking, after this time to detect and answer."""
READ_WITHIN_M = 2.0
"""Distance before the line within which every image must be read."""
SETTLED_S = 0.35
"""After a change of color: round trip of a frame, and a second look."""


def figures_of(scenario: Scenario, run: RunRecord, followed: Sequence[Truth]) -> Figures:
    """Return the figures of `scenario` in addition to those of following. `followed` begins at the acquisition."""
    samples = run.samples
    figures: Figures = {
        "wall_contact_s": (samples[-1].wall_contacts - samples[0].wall_contacts) * STEP_S,
        "commanded_m": commanded_m(run.wheels, samples[0].t_us, samples[-1].t_us),
        **identity_figures(followed, run.answers),
    }
    if any(isinstance(thing, OnPath) for thing in scenario.things):
        figures["least_passes"] = samples[-1].passes - samples[0].passes
    if scenario.target.shape == "legs":
        figures |= legs_figures(samples, followed)
    if scenario.goals_m:
        figures |= goal_figures(scenario, samples, run.answers)
    if scenario.light is not None:
        figures |= light_figures(samples, run.answers) | {"most_aside_m": _most_aside_m(scenario, samples)}
    return figures


def commanded_m(wheels: Sequence[RimSpeeds], begin_us: int, end_us: int) -> float:
    """Return the distance that the commands alone would roll the faster wheel, regardless of pushes."""
    ends_us = [*(command.t_us for command in wheels[1:]), end_us]
    return sum(
        max(abs(command.left_mps), abs(command.right_mps)) * max(0, until_us - max(command.t_us, begin_us)) / 1e6
        for command, until_us in zip(wheels, ends_us, strict=True)
    ) if wheels else 0.0


def identity_figures(followed: Sequence[Truth], answers: Sequence[AnsweredFrame]) -> Figures:
    """Return how the mission followed another object, and the target again, in the frames since the acquisition."""
    times_us = [truth.t_us for truth in followed]
    wrong, missed = list[tuple[int, bool]](), list[tuple[int, bool]]()
    for one in answers:
        if times_us and one.t_us >= times_us[0]:
            truth = followed[bisect_right(times_us, one.t_us) - 1]
            is_wrong = _is_wrong(truth, one)
            wrong.append((one.t_us, is_wrong))
            missed.append((one.t_us, truth.visible and (is_wrong or one.phase != "tracking")))
    return {
        "wrong_percent": 100 * sum(is_wrong for _, is_wrong in wrong) / len(wrong) if wrong else None,
        "lost_after_s": _longest_s(wrong), "found_again_s": _longest_s(missed),
    }


def _longest_s(flags: Sequence[tuple[int, bool]]) -> float | None:
    """Return the longest time from a frame with a true flag to the next one with a false flag, or to the last frame."""
    longest_us, begin_us = 0, None
    for t_us, flag in flags:
        begin_us = t_us if begin_us is None else begin_us
        longest_us = max(longest_us, t_us - begin_us)
        begin_us = begin_us if flag else None
    return longest_us / 1e6 if flags else None


def _is_wrong(truth: Truth, one: AnsweredFrame) -> bool:
    """Return True if the target that is tracked in a frame is not where the true one is."""
    if one.phase != "tracking" or one.bearing_rad is None or one.distance_m is None:
        return False
    off_rad = one.bearing_rad - truth.bearing_rad  # by the law of cosines
    square = one.distance_m**2 + truth.distance_m**2 - 2 * one.distance_m * truth.distance_m * math.cos(off_rad)
    return square > WRONG_BY_M**2


def legs_figures(samples: Sequence[Truth], followed: Sequence[Truth]) -> Figures:
    """Return the distances from the acquisition on, and the smallest of the whole run."""
    distances = [truth.distance_m for truth in followed]
    return {
        "least_distance_m": min(distances, default=None), "most_distance_m": max(distances, default=None),
        "least_ever_m": min(truth.distance_m for truth in samples),
    }


def goal_figures(scenario: Scenario, samples: Sequence[Truth], answers: Sequence[AnsweredFrame]) -> Figures:
    """Return the time of the last waypoint, the smallest clearance, and the time of "cannot reach"."""
    goals, reached_s = list(scenario.goals_m), None
    for truth in samples:
        if goals and math.dist((truth.x_m, truth.y_m), goals[0]) <= REACHED_WITHIN_M:
            goals.pop(0)
            reached_s = (truth.t_us - samples[0].t_us) / 1e6
    given_up = next((one.t_us for one in answers if one.phase == "cannot reach"), None)
    clearances = [truth.clearance_m for truth in samples if truth.clearance_m is not None]
    return {
        "reached_s": None if goals else reached_s, "least_clearance_m": min(clearances, default=None),
        "least_around_deg": _around_deg(samples, scenario.goals_m[-1]),
        "given_up_s": None if given_up is None else (given_up - samples[0].t_us) / 1e6,
    }


def _around_deg(samples: Sequence[Truth], goal_m: tuple[float, float]) -> float:
    """Return the angle around the last waypoint that the robot covered: a robot that stands covers none."""
    angles_rad = [math.atan2(truth.y_m - goal_m[1], truth.x_m - goal_m[0]) for truth in samples]
    turns_rad = [math.remainder(now - before, math.tau) for before, now in pairwise(angles_rad)]
    covered_rad = list(accumulate(turns_rad, initial=0.0))
    return math.degrees(max(covered_rad) - min(covered_rad))


def _most_aside_m(scenario: Scenario, samples: Sequence[Truth]) -> float:
    """Return the largest distance from the center of the lane, which runs from the start to the target."""
    (x_m, y_m), first = scenario.start.at_m or (0.0, 0.0), samples[0]
    along_rad = math.atan2(first.target_y_m - y_m, first.target_x_m - x_m)
    cos, sin = math.cos(along_rad), math.sin(along_rad)
    return max(abs((truth.y_m - y_m) * cos - (truth.x_m - x_m) * sin) for truth in samples)


def light_figures(samples: Sequence[Truth], answers: Sequence[AnsweredFrame]) -> Figures:
    """Return the stop line crossings by light, the start delay, and how often the light was misread."""
    crossings = list(_crossings(samples))
    starts = list(_starts(samples))
    return {
        "least_crossings": len(crossings), "least_red_stops": red_stops(samples),
        "crossed_on_red": sum(light == "red" for light, _ in crossings),
        "crossed_late": sum(light == "yellow" and could_stop for light, could_stop in crossings),
        "start_s": max(starts, default=0.0), "wrong_states_percent": _wrong_percent(samples, answers),
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


def red_stops(samples: Sequence[Truth]) -> int:
    """Count how often the robot came to rest before the line at a red light."""
    waits = [truth.light == "red" and _waits(truth) for truth in samples]
    return sum(now and not before for before, now in pairwise(waits))


def _waits(truth: Truth) -> bool:
    return abs(truth.linear_mps) < STANDING_MPS and -WAITS_WITHIN_M < (truth.past_line_m or 0.0) < 0


def _starts(samples: Sequence[Truth]) -> Iterator[float]:
    """Yield the delay between each green and the start of a waiting robot, in s."""
    green_us: int | None = None
    for before, now in pairwise(samples):
        if before.light != "green" == now.light and _waits(now):
            green_us = now.t_us
        if green_us is not None and (now.linear_mps >= STANDING_MPS or now.light != "green"):
            yield (now.t_us - green_us) / 1e6
            green_us = None


def _wrong_percent(samples: Sequence[Truth], answers: Sequence[AnsweredFrame]) -> float | None:
    """Return the share of frames before the line with a wrong or missing color of the mission, in percent."""
    times_us = [truth.t_us for truth in samples]
    changes = [now.t_us for before, now in pairwise(samples) if before.light != now.light]
    looked = right = 0
    for t_us, _, note, *_ in answers:
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


# A score against the bounds of its scenario. Pure.


NOT_EVALUATED = "not evaluated: the scenario has no [bounds] for this latency"
BOUNDS_UP_TO_MS = 200
"""Added latency up to which the bounds of a scenario apply, with 10 % loss on each leg. Above it the robot is slow."""
STANDS_STILL_FROM_MS = SafetyConfig().zero_speed_age_ms
"""Added latency from which every frame is too old. The robot must stand still, and the score checks it."""
_STANDS_STILL = {"commanded_m": 0.05, "wall_contacts": 0.0}
"""Bounds of the wheel commands. A target may push a standing robot."""
EXACT = tuple(name for name, figure in FIGURES.items() if figure.is_exact)
"""Figures without a margin."""


def bounds_of(scenario: Scenario, latency_ms: float = 0.0) -> Mapping[str, float]:
    """Return the bounds of `scenario` with that latency; empty if it is not evaluated."""
    if latency_ms <= BOUNDS_UP_TO_MS:
        return scenario.bounds
    return _STANDS_STILL if scenario.bounds and latency_ms >= STANDS_STILL_FROM_MS else {}


def checks_of(scenario: Scenario, result: Score, latency_ms: float = 0.0, factor: float = 1.0) -> list[Check]:
    """Check `result` against the bounds of `scenario`, each times `factor` unless it is exact."""
    bounds = bounds_of(scenario, latency_ms)
    return [_check(name, result, granted(name, bound, factor)) for name, bound in bounds.items()]


def granted(name: str, bound: float, factor: float) -> float:
    """Return `bound` times `factor`; unchanged for an exact figure."""
    if FIGURES[name].is_exact:
        return bound
    return bound / factor if name.startswith(AT_LEAST) else bound * factor


def _check(name: str, result: Score, bound: float) -> Check:
    value = result.figure(name)
    return Check(name, value, FIGURES[name].unit, bound, is_within(name, value, bound))


def is_within(name: str, value: float | None, bound: float) -> bool:
    """Return True if a figure is within its bound. A missing value is not."""
    return value is not None and (value >= bound if name.startswith(AT_LEAST) else value <= bound)


def broken(scenario: Scenario, so_far: Score, seconds: float) -> list[str]:
    """Return the bounds that a run of `seconds` has already broken for good."""
    return [name for name, bound in scenario.bounds.items() if _is_beyond_repair(name, bound, so_far, seconds)]


def _is_beyond_repair(name: str, bound: float, so_far: Score, seconds: float) -> bool:
    value, course = so_far.figure(name), FIGURES[name].course
    if course == "moment" and value is None:
        return so_far.seconds > bound + (ACQUIRED_FOR_S if name == "acquired_s" else 0.0)
    if value is None or course == "other" or (course == "count" and name.startswith(AT_LEAST)):
        return False
    if course in ("rms", "share"):
        begin_s = so_far.acquired_s or 0.0
        share = min(1.0, (so_far.seconds - begin_s) / max(seconds - begin_s, 1e-9))
        # The best possible rest of the run has no error at all.
        value *= share if course == "share" else math.sqrt(share)
    return not is_within(name, value, bound)
