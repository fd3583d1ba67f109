"""`sightline score`: many lockstep runs, scored and compared with their bounds. Shell (processes, a terminal).

Each run is in a separate process, so that they use all cores. A run repeats bit for bit.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby, product
from typing import Any, Final, TypeVar

from sightline.evaluation.checks import Check, number
from sightline.evaluation.lockstep import Conditions, Run, run_lockstep
from sightline.evaluation.processes import worker_pool
from sightline.evaluation.scenario_config import robot_of, vision_config
from sightline.evaluation.score.figures import (
    NOT_EVALUATED,
    Score,
    bounds_of,
    broken,
    checks_of,
    median_and_worst,
    score,
)
from sightline.evaluation.score.sabotage import HEALTHY, SABOTAGES, reason_of
from sightline.protocol.errors import ConfigError
from sightline.sim.scenario import FIGURES, Scenario, load_scenario, look_named, scenario_names
from sightline.vision_side.detect.registry import check_choice, check_takes_pictures
from sightline.vision_side.missions.registry import REGISTRY, configured_mission

Result = TypeVar("Result")
BOUNDS_UP_TO_LOSS: Final = 0.1
"""Loss on each leg up to which the bounds of the scenarios apply."""
MOST_NOTICES: Final = 3
"""Of each group; later ones repeat the first with higher counts."""


@dataclass(frozen=True, slots=True)
class ScoreCase:
    """One run to score. `seconds` None: the length of the scenario."""

    scenario: str
    latency_ms: float
    loss: float
    seed: int
    seconds: float | None
    mission: str | None = None
    """Mission in place of the scenario's, as are the robot, the look and the detector."""
    robot: str | None = None
    look: str | None = None
    detector: str | None = None
    sabotage: str | None = None

    @property
    def group(self) -> str:
        """Return the name that it shares with the runs of other seeds."""
        given = (self.mission, self.robot, self.look, self.detector, self.sabotage)
        others = "".join(f" {one}" for one in given if one)
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
    """All runs and their checks."""

    runs: list[tuple[ScoreCase, Score]]
    scored: list[ScoredFigure]
    unevaluated: list[str] = field(default_factory=list)
    """Groups whose scenario has no bounds."""
    news: dict[str, list[str]] = field(default_factory=dict)
    """Lines of the detector for the operator by group, e.g. the cause of a missing answer."""

    @property
    def ok(self) -> bool | None:
        """Return True if every run is within every bound, None if a scenario without bounds cannot show that."""
        if not all(one.ok for one in self.scored):
            return False
        return None if self.unevaluated else True

    def to_dict(self) -> dict[str, Any]:
        """Return the object for `--json`."""
        return {
            "ok": self.ok,
            "checks": [
                {"name": f"{one.group}: {one.name}", "value": one.worst, "median": one.median, "unit": one.unit,
                 "bound": one.bound, "ok": one.ok}
                for one in self.scored
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
    """Return every combination once, grouped. Raises ConfigError for an invalid name or number."""
    if mission is not None:
        REGISTRY.load(mission)
    for name in scenarios:
        scenario = load_scenario(name)
        config = vision_config(scenario, robot_of(scenario, robot), 0, mission)
        try:
            configured_mission(config)
        except ConfigError as error:
            given = "; its goals_m are the waypoints" if scenario.goals_m else ""
            fix = f"choose with --scenario what {mission} can drive" if mission else "correct its mission or options"
            raise ConfigError(f"scenario {name}: {error}{given}; {fix}") from None
        if detector is not None:
            check_takes_pictures(detector)
            check_choice(detector, {}, config)
    if look is not None:
        look_named(look)
    if not seeds or any(not 0 <= seed < 2**32 for seed in seeds):
        raise ConfigError("--seeds needs whole numbers from 0, e.g. --seeds 101,102,103")
    if any(not 0 <= one <= 10_000 for one in latencies_ms) or any(not 0 <= one < 1 for one in losses):
        raise ConfigError("--latency-ms is 0 to 10000 and --loss 0 to below 1, e.g. --latency-ms 0,50 --loss 0.1")
    return list(dict.fromkeys(
        ScoreCase(name, latency_ms, loss, seed, seconds, mission, robot, look, detector)
        for name, latency_ms, loss, seed in product(dict.fromkeys(scenarios), latencies_ms, losses, seeds)
    ))


def run_case(case: ScoreCase) -> tuple[Score, list[str]]:
    """Run one case in lockstep. Returns its score and the notices of the detector."""
    scenario, run = run_of(case)
    return score(scenario, run), run.news


def run_of(case: ScoreCase, is_over: Callable[[Run], bool] = lambda _run: False) -> tuple[Scenario, Run]:
    """Return the scenario as it was run, and the run."""
    scenario = load_scenario(case.scenario)
    if case.look is not None:
        scenario = scenario.model_copy(update={"look": look_named(case.look)})
    model, conditions = robot_of(scenario, case.robot), Conditions(case.latency_ms, case.loss)
    vision = vision_config(scenario, model, case.seed, case.mission)
    if case.detector is not None:
        vision = vision.model_copy(update={"detector": vision.detector.model_copy(update={"kind": case.detector})})
    seams = SABOTAGES[case.sabotage](case.seed) if case.sabotage else HEALTHY
    return scenario, run_lockstep(
        scenario, model, case.seed, conditions, case.seconds, vision=vision, seams=seams, is_over=is_over
    )


def run_cases(wanted: Sequence[ScoreCase], jobs: int, on_done: Callable[[ScoreCase], None]) -> ScoreReport:
    """Run `wanted` on `jobs` processes, in any order, and score them. Calls `on_done` after each."""
    results = _run_each(run_case, wanted, jobs, on_done)
    runs = [(case, results[case][0]) for case in wanted]
    news: dict[str, list[str]] = {}
    for case in wanted:
        for line in results[case][1]:
            news.setdefault(case.group, []).append(line)
    notices = {group: list(dict.fromkeys(lines))[:MOST_NOTICES] for group, lines in news.items()}
    groups = {case.group: case for case in wanted}
    unevaluated = [
        name for name, case in groups.items() if not bounds_of(load_scenario(case.scenario), case.latency_ms)
    ]
    return ScoreReport(runs, scored_figures(runs), unevaluated, notices)


def _run_each(
    run: Callable[[ScoreCase], Result], wanted: Sequence[ScoreCase], jobs: int, on_done: Callable[[ScoreCase], None]
) -> dict[ScoreCase, Result]:
    results: dict[ScoreCase, Result] = {}
    with worker_pool(min(jobs, len(wanted))) as pool:
        futures = {pool.submit(run, case): case for case in wanted}
        for future in as_completed(futures):
            results[futures[future]] = future.result()
            on_done(futures[future])
    return results


def scored_figures(runs: Sequence[tuple[ScoreCase, Score]]) -> list[ScoredFigure]:
    """Return the figures of each group: median, worst, and whether every run is within the bound."""
    scored = []
    for name, members in groupby(runs, key=lambda run: run[0].group):
        group = list(members)
        scenario = load_scenario(group[0][0].scenario)
        checks = [checks_of(scenario, result, case.latency_ms) for case, result in group]
        results = [result for _, result in group]
        scored += [_scored_figure(name, list(same), results) for same in zip(*checks, strict=True)]
    return scored


def _scored_figure(group: str, checks: list[Check], results: list[Score]) -> ScoredFigure:
    first = checks[0]
    median, worst = median_and_worst(results, first.name)
    return ScoredFigure(group, first.name, median, worst, first.unit, first.bound, all(check.ok for check in checks))


# Sabotaged runs: each must break a bound of its scenario. Shell (processes).


@dataclass(frozen=True, slots=True)
class SabotagedRun:
    """The result of one sabotaged run. `unchanged` if it equals the healthy run byte for byte."""

    case: ScoreCase
    broken: tuple[str, ...]
    """Bounds that it broke and the healthy run does not."""
    seconds: float
    """Time of its end. A bound that is broken for good ends it early."""
    unchanged: bool = False


@dataclass(frozen=True, slots=True)
class SabotagedPair:
    """The runs of one scenario with one sabotage."""

    group: str
    scenario: str
    sabotage: str
    runs: tuple[SabotagedRun, ...]

    @property
    def failed(self) -> int:
        """Return the number of runs that broke a bound."""
        return sum(bool(run.broken) for run in self.runs)

    @property
    def is_unchanged(self) -> bool:
        """Return True if the sabotage changed nothing in any run, and need not."""
        is_expected = self.scenario not in scenario_names() or reason_of(self.sabotage, self.scenario) is not None
        return is_expected and all(run.unchanged for run in self.runs)

    @property
    def ok(self) -> bool | None:
        """Return True if the score noticed the sabotage in each run, or nothing changed; None without bounds."""
        if not bounds_of(load_scenario(self.scenario), self.runs[0].case.latency_ms):
            return None
        return self.failed == len(self.runs) or self.is_unchanged

    def line(self) -> str:
        """Return the result as one line."""
        first = ", ".join(dict.fromkeys(run.broken[0] for run in self.runs if run.broken))
        if self.is_unchanged:
            reason = reason_of(self.sabotage, self.scenario) or "the run equals the healthy one"
            return f"{self.group}: changes nothing: {reason}"
        if self.ok is None:
            return f"{self.group}: {NOT_EVALUATED}"
        text = f"{self.group}: {self.failed} of {len(self.runs)} runs fail" + (f" ({first})" if first else "")
        equal = sum(run.unchanged for run in self.runs)
        text += f", {equal} equal the healthy run" if equal else ""
        return f"{text}  {'ok' if self.ok else 'FAIL'}"


@dataclass(frozen=True, slots=True)
class SabotageReport:
    """All sabotaged runs."""

    pairs: list[SabotagedPair]

    @property
    def ok(self) -> bool | None:
        """Return True if the score noticed every sabotage, None if a scenario without bounds cannot."""
        results = [pair.ok for pair in self.pairs]
        return False if False in results else None if None in results else True

    def to_dict(self) -> dict[str, Any]:
        """Return the object for `--json`."""
        checks = [
            {"name": f"{pair.group}: runs that fail", "value": pair.failed, "unit": "runs",
             "bound": 0 if pair.is_unchanged else len(pair.runs), "ok": pair.ok}
            for pair in self.pairs if pair.ok is not None
        ]
        return {"ok": self.ok, "checks": checks, "runs": [asdict(run) for pair in self.pairs for run in pair.runs]}

    def lines(self) -> list[str]:
        """Return one line for each pair, and the result of all."""
        result = {True: "the score noticed every sabotage", False: "the score did NOT notice every sabotage",
                  None: NOT_EVALUATED}
        return [*(pair.line() for pair in self.pairs), result[self.ok]]


def sabotaged(wanted: Sequence[ScoreCase], names: Sequence[str]) -> list[ScoreCase]:
    """Return each case with each sabotage, grouped; one case if the sabotage changes nothing."""
    groups = [list(group) for _, group in groupby(wanted, key=lambda case: case.group)]
    return [
        replace(case, sabotage=name) for members in groups for name in names
        for case in (members[:1] if reason_of(name, members[0].scenario) else members)
    ]


def run_sabotaged(case: ScoreCase) -> SabotagedRun:
    """Run until a bound is broken for good, or to the end. Compare with the healthy run if that may fail too."""
    scenario = load_scenario(case.scenario)
    seconds = case.seconds or scenario.seconds
    is_own = bounds_of(scenario, case.latency_ms) == scenario.bounds  # other bounds apply only at the end of the run

    def is_over(run: Run) -> bool:
        return is_own and bool(broken(scenario, score(scenario, run), seconds))

    _, run = run_of(case, is_over)
    names, healthy, ended_s = _broken_by(case, run), replace(case, sabotage=None), run.samples[-1].t_us / 1e6
    as_it_is = ScoreCase(case.scenario, case.latency_ms, min(case.loss, BOUNDS_UP_TO_LOSS), case.seed, None)
    if names and healthy == as_it_is and case.scenario in scenario_names():  # tests show that it breaks none
        return SabotagedRun(case, names, ended_s)
    _, compared = run_of(healthy)
    anyway = _broken_by(healthy, compared)
    names = tuple(name for name in names if name not in anyway)
    return SabotagedRun(case, names, ended_s, not names and run == compared)


def _broken_by(case: ScoreCase, run: Run) -> tuple[str, ...]:
    scenario = load_scenario(case.scenario)
    checks = checks_of(scenario, score(scenario, run), case.latency_ms)
    return tuple(check.name for check in checks if not check.ok)


def run_all_sabotaged(
    wanted: Sequence[ScoreCase], jobs: int, on_done: Callable[[ScoreCase], None]
) -> SabotageReport:
    """Run `wanted` on `jobs` processes, in any order. `on_done` is called after each."""
    results = _run_each(run_sabotaged, wanted, jobs, on_done)
    groups = groupby(wanted, key=lambda case: case.group)
    pairs = [(group, [results[case] for case in cases]) for group, cases in groups]
    return SabotageReport([
        SabotagedPair(group, runs[0].case.scenario, runs[0].case.sabotage or "", tuple(runs)) for group, runs in pairs
    ])


# The output of `sightline score`: a table of median and worst. Pure.


def score_text(report: ScoreReport) -> str:
    """Return one line per figure, below the name of its group and the notices of its detector."""
    lines: list[str] = []
    group = ""
    for one in report.scored:
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
    """Yield the figures of runs without bounds."""
    for name, figure in FIGURES.items():
        median, worst = median_and_worst(results, name)
        if median is not None:
            yield f"  {name:<16} median {number(median):>7}  worst {number(worst):>7} {figure.unit:<5}"
    yield f"  {NOT_EVALUATED}"


def _line(one: ScoredFigure) -> str:
    figures = f"median {number(one.median):>7}  worst {number(one.worst):>7} {one.unit:<5}"
    return f"  {one.name:<16} {figures}  bound {number(one.bound):>6}  {'ok' if one.ok else 'FAIL'}"
