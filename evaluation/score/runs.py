"""`sightline score`: many lockstep runs, scored and compared with their bounds. Shell (processes, a terminal).

Each run is a process's own, so that they share the machine's cores; a run itself repeats bit for bit.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, field
from itertools import groupby, product
from typing import Any, Final

from sightline.evaluation.checks import Check, number
from sightline.evaluation.lockstep import Conditions, Run, run_lockstep
from sightline.evaluation.processes import worker_pool
from sightline.evaluation.scenario_config import robot_of, vision_config
from sightline.evaluation.score.figures import NOT_EVALUATED, Score, checks_of, median_and_worst, score
from sightline.protocol.errors import ConfigError
from sightline.sim.scenario import FIGURES, Scenario, load_scenario, look_named
from sightline.vision_side.detect.registry import check_choice
from sightline.vision_side.missions.registry import REGISTRY, configured_mission

_MOST_NOTICES: Final = 3
"""Of each group: later ones repeat the first with higher counts."""


@dataclass(frozen=True, slots=True)
class ScoreCase:
    """One run to make. `seconds` None is the scenario's own length."""

    scenario: str
    latency_ms: float
    loss: float
    seed: int
    seconds: float | None
    mission: str | None = None
    """In place of the scenario's own, as the robot, the look and the detector are."""
    robot: str | None = None
    look: str | None = None
    detector: str | None = None

    @property
    def group(self) -> str:
        """Return the name that it shares with the runs of other seeds."""
        others = "".join(f" {one}" for one in (self.mission, self.robot, self.look, self.detector) if one)
        return f"{self.scenario}{others} +{self.latency_ms:g} ms {100 * self.loss:g}% loss"


@dataclass(frozen=True, slots=True)
class ScoredFigure:
    """One figure of one group: its median and its worst over the seeds. The worst is checked."""

    group: str
    name: str
    median: float | None
    worst: float | None
    unit: str
    bound: float
    ok: bool


@dataclass(frozen=True, slots=True)
class ScoreReport:
    """All runs, and what was demanded of them."""

    runs: list[tuple[ScoreCase, Score]]
    judged: list[ScoredFigure]
    unevaluated: list[str] = field(default_factory=list)
    """Groups whose scenario has no bounds."""
    news: dict[str, list[str]] = field(default_factory=dict)
    """Lines of the detector for the operator by group, e.g. the cause of a missing answer."""

    @property
    def ok(self) -> bool | None:
        """Return True if every run is within every bound, None if a scenario without bounds cannot show that."""
        if not all(one.ok for one in self.judged):
            return False
        return None if self.unevaluated else True

    def to_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {
            "ok": self.ok,
            "checks": [
                {"name": f"{one.group}: {one.name}", "value": one.worst, "median": one.median, "unit": one.unit,
                 "bound": one.bound, "ok": one.ok}
                for one in self.judged
            ],
            "not_evaluated": self.unevaluated,
            "news": self.news,
            "runs": [{**asdict(case), "score": asdict(result)} for case, result in self.runs],
        }


def cases(
    scenarios: Sequence[str], seeds: Sequence[int], latencies_ms: Sequence[float], losses: Sequence[float],
    seconds: float | None, *, mission: str | None = None, robot: str | None = None, look: str | None = None,
    detector: str | None = None,
) -> list[ScoreCase]:
    """Every combination, those of one group together. Raises ConfigError for an invalid name or number."""
    if mission is not None:
        REGISTRY.load(mission)
    for name in scenarios:
        scenario = load_scenario(name)
        config = vision_config(scenario, robot_of(scenario, robot), 0, mission)
        try:
            configured_mission(config)
        except ConfigError as error:
            if mission is None:
                raise
            raise ConfigError(f"scenario {name}: {error}; choose with --scenario what {mission} can drive") from None
        if detector is not None:
            check_choice(detector, {}, config)
    if look is not None:
        look_named(look)
    if not seeds or any(not 0 <= seed < 2**32 for seed in seeds):
        raise ConfigError("--seeds needs whole numbers from 0, e.g. --seeds 101,102,103")
    if any(not 0 <= one <= 10_000 for one in latencies_ms) or any(not 0 <= one < 1 for one in losses):
        raise ConfigError("--latency-ms is 0 to 10000 and --loss 0 to below 1, e.g. --latency-ms 0,50 --loss 0.1")
    return [
        ScoreCase(name, latency_ms, loss, seed, seconds, mission, robot, look, detector)
        for name, latency_ms, loss, seed in product(scenarios, latencies_ms, losses, seeds)
    ]


def run_case(case: ScoreCase) -> tuple[Score, list[str]]:
    """One run in lockstep, scored, and the detector's news."""
    scenario, run = run_of(case)
    return score(scenario, run), run.news


def run_of(case: ScoreCase) -> tuple[Scenario, Run]:
    """The run itself, and the scenario as it was run."""
    scenario = load_scenario(case.scenario)
    if case.look is not None:
        scenario = scenario.model_copy(update={"look": look_named(case.look)})
    model, conditions = robot_of(scenario, case.robot), Conditions(case.latency_ms, case.loss)
    vision = vision_config(scenario, model, case.seed, case.mission)
    if case.detector is not None:
        vision = vision.model_copy(update={"detector": vision.detector.model_copy(update={"kind": case.detector})})
    return scenario, run_lockstep(scenario, model, case.seed, conditions, case.seconds, vision=vision)


def run_cases(wanted: Sequence[ScoreCase], jobs: int, on_done: Callable[[ScoreCase], None]) -> ScoreReport:
    """Run `wanted` on `jobs` processes, in any order, and score them. `on_done` is called after each."""
    results: dict[ScoreCase, tuple[Score, list[str]]] = {}
    with worker_pool(min(jobs, len(wanted))) as pool:
        futures = {pool.submit(run_case, case): case for case in wanted}
        for future in as_completed(futures):
            results[futures[future]] = future.result()
            on_done(futures[future])
    runs = [(case, results[case][0]) for case in wanted]
    news: dict[str, list[str]] = {}
    for case in wanted:
        for line in results[case][1]:
            news.setdefault(case.group, []).append(line)
    told = {group: list(dict.fromkeys(lines))[:_MOST_NOTICES] for group, lines in news.items()}
    unbounded = {name for name in {case.scenario for case in wanted} if not load_scenario(name).bounds}
    unevaluated = list(dict.fromkeys(case.group for case in wanted if case.scenario in unbounded))
    return ScoreReport(runs, scored_figures(runs), unevaluated, told)


def scored_figures(runs: Sequence[tuple[ScoreCase, Score]]) -> list[ScoredFigure]:
    """Each group's figures: median, worst, and whether every run of it is within the bound."""
    judged = []
    for name, members in groupby(runs, key=lambda run: run[0].group):
        group = list(members)
        scenario = load_scenario(group[0][0].scenario)
        checks = [checks_of(scenario, result, case.latency_ms) for case, result in group]
        results = [result for _, result in group]
        judged += [_scored_figure(name, list(same), results) for same in zip(*checks, strict=True)]
    return judged


def _scored_figure(group: str, checks: list[Check], results: list[Score]) -> ScoredFigure:
    first = checks[0]
    median, worst = median_and_worst(results, first.name)
    return ScoredFigure(group, first.name, median, worst, first.unit, first.bound, all(check.ok for check in checks))


# How `sightline score` shows its results: a table of median and worst. Pure.


def score_text(report: ScoreReport) -> str:
    """Return one line per figure, below the name of its group and the notices of its detector."""
    lines: list[str] = []
    group = ""
    for one in report.judged:
        if one.group != group:
            group = one.group
            lines += [group, *(f"  {line}" for line in report.news.get(group, ()))]
        lines.append(_line(one))
    for group in report.unevaluated:
        results = [result for case, result in report.runs if case.group == group]
        lines += [group, *(f"  {line}" for line in report.news.get(group, ())), *_unevaluated_lines(results)]
    return "\n".join([*lines, f"{len(report.runs)} runs, {_result(report)}"])


def _result(report: ScoreReport) -> str:
    if report.ok is False:
        return "NOT within bounds"
    return NOT_EVALUATED if report.unevaluated else "all within bounds"


def _unevaluated_lines(results: Sequence[Score]) -> Iterator[str]:
    """Yield the figures that happened, without bounds."""
    for name, figure in FIGURES.items():
        median, worst = median_and_worst(results, name)
        if median is not None:
            yield f"  {name:<16} median {number(median):>7}  worst {number(worst):>7} {figure.unit:<5}"
    yield f"  {NOT_EVALUATED}"


def _line(one: ScoredFigure) -> str:
    figures = f"median {number(one.median):>7}  worst {number(one.worst):>7} {one.unit:<5}"
    return f"  {one.name:<16} {figures}  bound {number(one.bound):>6}  {'ok' if one.ok else 'FAIL'}"
