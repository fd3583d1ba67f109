"""How `sightline score` shows itself: a progress bar on stderr, a table of median and worst. Shell (a terminal)."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sightline.evaluation.checks import number
from sightline.evaluation.score.runs import ScoredFigure, ScoreReport


@contextmanager
def progress(total: int) -> Iterator[Callable[[], None]]:
    """A bar over `total` runs, gone when it is full; silent where stderr is no terminal."""
    console = Console(stderr=True)
    columns = (TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("runs", total=total)
        yield lambda: bar.advance(task)


def score_text(report: ScoreReport) -> str:
    """One line per figure, under the name of its group and what its detector had to say."""
    lines: list[str] = []
    group = ""
    for one in report.judged:
        if one.group != group:
            group = one.group
            lines += [group, *(f"  {line}" for line in report.news.get(group, ()))]
        lines.append(_line(one))
    return "\n".join([*lines, f"{len(report.runs)} runs, {'all within bounds' if report.ok else 'NOT within bounds'}"])


def _line(one: ScoredFigure) -> str:
    figures = f"median {number(one.median):>7}  worst {number(one.worst):>7} {one.unit:<5}"
    return f"  {one.name:<16} {figures}  bound {number(one.bound):>6}  {'ok' if one.ok else 'FAIL'}"
