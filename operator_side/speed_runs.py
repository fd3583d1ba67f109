"""How the Thymio speeds up and slows down on a free way, by the default law and by the older one. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sightline.evaluation.score.behaviours import LATENCY_MS, LOSS
from sightline.evaluation.lockstep import Conditions, run_lockstep
from sightline.evaluation.scenario_config import robot_of
from sightline.operator_side.score_course import REACHED_WITHIN_M
from sightline.sim.scenario import Scenario, Start, load_scenario
from sightline.sim.truth import Truth

LAWS: Final = ("goto", "goto-baseline")
GOALS_M: Final = (0.2, 2.0, 10.0)
"""Those of the older write-up's plots."""
_SLOWEST_MPS: Final = 0.2  # what either law keeps up on a free way, and then some time to settle
_SETTLES_S: Final = 8.0
_ACROSS: Final = 5  # samples to either side: an acceleration over 0.2 s, for the physics' own steps are noise


@dataclass(frozen=True, slots=True)
class SpeedCase:
    """One drive to make."""

    law: str
    goal_m: float
    seed: int


@dataclass(frozen=True, slots=True)
class SpeedRun:
    """What came of it, in world truth: one entry of each list per sample."""

    wish: SpeedCase
    times_s: list[float]
    speeds_mps: list[float]
    accelerations_mps2: list[float]
    arrived_s: float | None
    """When it first was at the waypoint."""
    off_m: float
    """From the waypoint, at the end."""

    @property
    def top_mps(self) -> float:
        """The highest speed."""
        return max(self.speeds_mps)


def speed_cases(seed: int) -> list[SpeedCase]:
    """Every law to every waypoint."""
    return [SpeedCase(law, goal_m, seed) for law in LAWS for goal_m in GOALS_M]


def free_way(goal_m: float) -> Scenario:
    """The Thymio's scenario with nothing in the way and the waypoint straight ahead."""
    thymio = load_scenario("thymio")
    return thymio.model_copy(update={
        "things": (), "goals_m": ((goal_m, 0.0),), "start": Start(at_m=(0.0, 0.0)),
        "target": thymio.target.model_copy(update={"at_m": (goal_m, 0.0)}),
        "seconds": goal_m / _SLOWEST_MPS + _SETTLES_S,
    })


def speed_run(wish: SpeedCase) -> SpeedRun:
    """Drive it, under the conditions of the page."""
    scenario = free_way(wish.goal_m)
    mission = None if wish.law == scenario.mission else wish.law
    run = run_lockstep(scenario, robot_of(scenario), wish.seed, Conditions(LATENCY_MS, LOSS), mission=mission)
    return speeds_of(wish, run.samples)


def speeds_of(wish: SpeedCase, samples: Sequence[Truth]) -> SpeedRun:
    """The figures of a drive along x."""
    times_s = [(truth.t_us - samples[0].t_us) / 1e6 for truth in samples]
    speeds_mps = [truth.linear_mps for truth in samples]
    off_m = [abs(complex(truth.x_m - wish.goal_m, truth.y_m)) for truth in samples]
    arrived_s = next((t_s for t_s, off in zip(times_s, off_m, strict=True) if off <= REACHED_WITHIN_M), None)
    return SpeedRun(wish, times_s, speeds_mps, _slopes(times_s, speeds_mps), arrived_s, off_m[-1])


def _slopes(times_s: Sequence[float], values: Sequence[float]) -> list[float]:
    last = len(values) - 1
    ends = [(max(0, at - _ACROSS), min(last, at + _ACROSS)) for at in range(len(values))]
    return [(values[end] - values[begin]) / (times_s[end] - times_s[begin]) for begin, end in ends]
