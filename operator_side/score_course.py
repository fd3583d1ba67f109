"""The figures of scenarios that are more than following one ball: legs, waypoints, traffic lights. Pure.

From world truth alone, but for what a mission says aloud: that it cannot reach a waypoint, and which colour it sees.
"""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import pairwise

from sightline.evaluation.score.figures import score
from sightline.sim.scenario import Scenario
from sightline.sim.truth import Truth

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
    """Whatever `scenario` is judged by besides what every following is."""
    figures: Figures = {"wall_contact_s": (samples[-1].wall_contacts - samples[0].wall_contacts) * STEP_S}
    if scenario.target.shape == "legs":
        figures |= legs_figures(samples, scenario.stand_off_m)
    if scenario.goals_m:
        figures |= goal_figures(scenario, samples, said)
    if scenario.light is not None:
        figures |= light_figures(samples, said)
    return figures


def legs_figures(samples: Sequence[Truth], stand_off_m: float) -> Figures:
    """How near and how far, from the first acquisition on; and the nearest ever."""
    acquired_s = score(samples, stand_off_m).acquired_s
    begin_us = samples[0].t_us + acquired_s * 1e6 if acquired_s is not None else math.inf
    distances = [truth.distance_m for truth in samples if truth.t_us >= begin_us]
    return {
        "least_distance_m": min(distances, default=None), "most_distance_m": max(distances, default=None),
        "least_ever_m": min(truth.distance_m for truth in samples),
    }


def goal_figures(scenario: Scenario, samples: Sequence[Truth], said: MissionPhases) -> Figures:
    """When the last waypoint was reached, each after the one before; how near to anything; when it said it cannot."""
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
    """What the light showed at each crossing, and whether the robot could have stopped when it left green."""
    could_stop = False
    for before, now in pairwise(samples):
        if before.light == "green" != now.light:
            left_m = -(now.past_line_m or 0.0)
            could_stop = left_m > now.linear_mps * ANSWER_S + now.linear_mps**2 / (2 * HARDEST_MPS2)
        if (before.past_line_m or 0.0) < 0 <= (now.past_line_m or 0.0):
            yield now.light, could_stop


def _starts(samples: Sequence[Truth]) -> Iterator[float]:
    """How long after each green a robot that waited began to move."""
    green_us: int | None = None
    for before, now in pairwise(samples):
        waits = abs(now.linear_mps) < STANDING_MPS and -WAITS_WITHIN_M < (now.past_line_m or 0.0) < 0
        if before.light != "green" == now.light and waits:
            green_us = now.t_us
        if green_us is not None and (now.linear_mps >= STANDING_MPS or now.light != "green"):
            yield (now.t_us - green_us) / 1e6
            green_us = None


def _wrong_percent(samples: Sequence[Truth], said: MissionPhases) -> float | None:
    """Of the frames on the way to the line, those in which the mission names another colour than is lit, or none."""
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
    """Whether the light changed just before."""
    return any(0 <= t_us - change < SETTLED_S * 1e6 for change in changes)
