"""docs/behaviours.md: every behaviour and its baseline in lockstep, with figures and a picture each. Shell (files).

A picture is of the first seed. The page says which command wrote it; nothing in it is typed by hand.
"""

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from operator_side.check_text import number
from operator_side.extras import needs
from operator_side.score import Score, median_and_worst, score
from operator_side.score_bounds import UNITS, judge
from operator_side.score_course import figures_of
from operator_side.score_runs import Case, run_of
from sim.scenario import load_scenario

LATENCY_MS, LOSS = 50.0, 0.1


@dataclass(frozen=True, slots=True)
class Row:
    """One behaviour: a scenario, and a law in place of its own if it is a baseline's."""

    scenario: str
    baseline: str = ""
    robot: str | None = None

    @property
    def law(self) -> str:
        """The mission that drives."""
        return self.baseline or load_scenario(self.scenario).mission

    def cases(self, seeds: Sequence[int]) -> list[Case]:
        """Its runs."""
        mission = self.baseline or None
        return [Case(self.scenario, LATENCY_MS, LOSS, seed, None, mission, self.robot) for seed in seeds]


ROWS = (
    Row("blue-sphere"), Row("blue-sphere", "band"), Row("blue-sphere-eight"),
    Row("ball"), Row("ball", "pixel-pi"), Row("ball-eight"),
    Row("blocks"), Row("blocks-red"), Row("blocks-yellow"), Row("blocks", "pixel-pi"), Row("blocks-eight"),
    Row("chaser"), Row("chaser", "pixel-p"), Row("chaser-circle"), Row("chaser-eight"),
    Row("legs-slow"), Row("legs"), Row("legs-fast"), Row("legs-crowd"), Row("legs", "legs-baseline"),
    Row("traffic-light"), Row("traffic-light-boxes"),
    Row("thymio"), Row("thymio-box"), Row("thymio-slalom"), Row("thymio-trap"), Row("thymio-closed"),
    Row("thymio", "goto-baseline"), Row("thymio-trap", "goto-baseline"),
    Row("occluder"),
)
_BASELINE_FIGURES = ("bearing_rms_deg", "unseen_percent", "wall_contacts", "target_contacts")
"""What is told of a law from which nothing is demanded."""
_UNITS = {**UNITS, "unseen_percent": "%"}

Progress = Callable[[int], AbstractContextManager[Callable[[], None]]]


def write_page(page: Path, seeds: Sequence[int], jobs: int, progress: Progress) -> bool:
    """Run all rows and write `page`, and its pictures into a folder beside it. True if every bound was kept."""
    wanted = [case for row in ROWS for case in row.cases(seeds)]
    pictures = page.parent / page.stem
    pictures.mkdir(parents=True, exist_ok=True)
    results: dict[Case, Score] = {}
    with progress(len(wanted)) as advance, ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(_run, case, _picture(pictures, case, seeds)): case for case in wanted}
        for future in as_completed(futures):
            results[futures[future]] = future.result()
            advance()
    page.write_text("\n".join(_page(results, seeds, pictures.name)) + "\n", "utf-8")
    return all(ok for row in ROWS if not row.baseline for ok in _kept(row, results, seeds))


def _picture(folder: Path, case: Case, seeds: Sequence[int]) -> Path | None:
    """Where the picture of this run goes; only the first seed's run has one."""
    if case.seed != seeds[0]:
        return None
    return folder / f"{case.scenario}{f'-{case.mission}' if case.mission else ''}.png"


def _run(case: Case, picture: Path | None) -> Score:
    with needs("report"):
        from operator_side.plot import plot_run
    scenario, run = run_of(case)
    if picture is not None:
        law = case.mission or scenario.mission
        plot_run(picture, run.samples, scenario, f"{scenario.name}, {law}, seed {case.seed}")
    return score(run.samples, scenario.stand_off_m, figures_of(scenario, run.samples, run.said))


def _kept(row: Row, results: dict[Case, Score], seeds: Sequence[int]) -> list[bool]:
    checks = [judge(row.scenario, results[case], LATENCY_MS) for case in row.cases(seeds)]
    return [check.ok for one in checks for check in one]


def _page(results: dict[Case, Score], seeds: Sequence[int], folder: str) -> Iterator[str]:
    names = ",".join(map(str, seeds))
    yield "# Behaviours\n"
    yield (f"Every behaviour by name, in lockstep on {len(seeds)} starts (seeds {names}), +{LATENCY_MS:g} ms latency, "
           f"{LOSS:.0%} loss on each leg, judged from\nworld truth: the median over the starts, then the worst. A "
           "baseline is an older write-up's law with its own numbers; nothing is demanded of it.\n"
           "[robots.md](robots.md) says what each robot and scenario is, and whose it was.\n")
    yield f"Written by `sightline score --page docs/behaviours.md --seeds {names}`. See one with `sightline demo "
    yield "--scenario NAME`, judge one with `sightline score --scenario NAME`.\n"
    for row in ROWS:
        yield from _section(row, results, seeds, folder)


def _section(row: Row, results: dict[Case, Score], seeds: Sequence[int], folder: str) -> Iterator[str]:
    scenario = load_scenario(row.scenario)
    title = f"{row.scenario}, baseline `{row.baseline}`" if row.baseline else row.scenario
    yield f"## {title}\n"
    robot, summary = row.robot or scenario.robot, scenario.summary
    yield f"{summary[0].upper()}{summary[1:]}. Robot `{robot}`, law `{row.law}`.\n"
    yield "| figure | median | worst | bound | |\n|---|---:|---:|---:|---|"
    runs = [results[case] for case in row.cases(seeds)]
    if row.baseline:
        for name in _BASELINE_FIGURES:
            yield _line(name, runs, "", "")
    else:
        for same in zip(*(judge(row.scenario, one, LATENCY_MS) for one in runs), strict=True):
            kept = "ok" if all(check.ok for check in same) else "**not kept**"
            yield _line(same[0].name, runs, f"{number(same[0].bound)} {same[0].unit}", kept)
    picture = f"{row.scenario}{f'-{row.baseline}' if row.baseline else ''}"
    yield f"\n![{title}: the ways and the figures over time]({folder}/{picture}.png)\n"


def _line(name: str, runs: Sequence[Score], bound: str, kept: str) -> str:
    median, worst = median_and_worst(runs, name)
    unit = _UNITS[name]
    return f"| {name} | {_figure(median, unit)} | {_figure(worst, unit)} | {bound} | {kept} |"


def _figure(value: float | None, unit: str) -> str:
    return "never" if value is None else f"{number(value)} {unit}"
