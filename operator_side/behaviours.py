"""docs/behaviours.md: every behaviour and its baseline in lockstep, with figures and a picture each. Shell (files).

A picture is of the first seed. The page says which command wrote it; no figure in it is typed by hand.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, as_completed
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from sightline.operator_side.behaviours_page import SPEEDS, kept, page_lines, picture_name
from sightline.evaluation.score.behaviours import ROWS, Row
from sightline.operator_side.preflight import needs
from sightline.evaluation.score.figures import Score, score
from sightline.operator_side.score_course import figures_of
from sightline.evaluation.score.runs import Case, run_of
from sightline.operator_side.speed_runs import SpeedRun, speed_cases, speed_run
from sightline.operator_side.worker_pool import worker_pool

Progress = Callable[[int], AbstractContextManager[Callable[[], None]]]


def write_page(page: Path, seeds: Sequence[int], jobs: int, progress: Progress, rows: Sequence[Row] = ROWS) -> bool:
    """Run all rows and write `page`, and its pictures into a folder beside it. True if every bound was kept."""
    wanted = list(dict.fromkeys(case for row in rows for case in row.all_cases(seeds)))
    wishes = speed_cases(seeds[0]) if any(row.scenario == "thymio" for row in rows) else []
    pictures = page.parent / page.stem
    pictures.mkdir(parents=True, exist_ok=True)
    with progress(len(wanted) + len(wishes)) as advance, worker_pool(jobs) as pool:
        runs = {pool.submit(_run, case, _picture(pictures, case, seeds)): case for case in wanted}
        drives = [pool.submit(speed_run, wish) for wish in wishes]
        everything: list[Future[Any]] = [*runs, *drives]
        for future in as_completed(everything):
            future.result()  # a run that failed ends the others here
            advance()
    results = {case: run.result() for run, case in runs.items()}
    speeds = [drive.result() for drive in drives]
    _draw_speeds(pictures / SPEEDS, speeds)
    page.write_text("\n".join(page_lines(rows, results, seeds, pictures.name, speeds)) + "\n", "utf-8")
    return all(kept(row, results, seeds) for row in rows)


def _picture(folder: Path, case: Case, seeds: Sequence[int]) -> Path | None:
    """Where the picture of this run goes; only the first seed's run in the scenario's own light has one."""
    return folder / picture_name(case) if case.seed == seeds[0] and case.look is None else None


def _run(case: Case, picture: Path | None) -> Score:
    with needs("report"):
        from sightline.evaluation.plots import plot_run
    scenario, run = run_of(case)
    if picture is not None:
        whose = f" on {case.robot}" if case.robot else ""
        law = case.mission or scenario.mission
        plot_run(picture, run.samples, scenario, f"{scenario.name}{whose}, {law}, seed {case.seed}")
    return score(run.samples, scenario.stand_off_m, figures_of(scenario, run.samples, run.said))


def _draw_speeds(path: Path, speeds: Sequence[SpeedRun]) -> None:
    with needs("report"):
        from sightline.operator_side.plot_speeds import plot_speeds
    if speeds:
        plot_speeds(path, speeds)
