"""How `sightline conform` shows itself: a bar on stderr while it runs, then a table by group. Shell (a terminal)."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from typing import Final

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from sightline.conformance.case import Case, Level
from sightline.conformance.report import summary
from sightline.conformance.runner import Outcome, Result

_FEW: Final = 3
"""So many that lack the same and more are one line."""
_COLOURS: Final = {Outcome.PASSED: "green", Outcome.FAILED: "red", Outcome.SKIPPED: "dim"}


@contextmanager
def progress(total: int) -> Iterator[Callable[[Result], None]]:
    """A bar over `total` cases with what has failed above it; a line per failure where stderr is no terminal."""
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), console=console, transient=True,
        disable=not console.is_terminal,
    ) as bar:  # fmt: skip
        task = bar.add_task("cases", total=total)

        def show(result: Result) -> None:
            bar.update(task, advance=1, description=result.case.id)
            if result.outcome is Outcome.FAILED:
                console.print(f"{result.case.id}: {result.reason}", markup=False, highlight=False)

        yield show


def print_results(results: Sequence[Result]) -> None:
    """The table on stdout, group by group, with the reason of whatever did not pass; then the summary."""
    console = Console()
    table = Table(box=None, pad_edge=False, show_header=False)
    for _ in range(4):
        table.add_column()
    for group, members in groupby(results, lambda one: one.case.group):
        listed = list(members)
        good = sum(one.outcome is Outcome.PASSED for one in listed)
        table.add_row(f"[bold]{group}[/bold]", "", "", f"[bold]{good} of {len(listed)} passed[/bold]")
        for alike in _alike(listed):
            table.add_row(*_row(alike[0]) if len(alike) < _FEW else _row_of_many(alike))
            for one in alike[1:] if len(alike) < _FEW else ():
                table.add_row(*_row(one))
    console.print(table)
    console.print(summary(results), markup=False, highlight=False)


def _alike(results: Sequence[Result]) -> Iterator[list[Result]]:
    """Neighbours that are not applicable for the same reason together, every other case alone."""

    def sort(numbered: tuple[int, Result]) -> tuple[int, str]:
        number, one = numbered
        return (-1, one.reason) if one.outcome is Outcome.SKIPPED else (number, "")

    for _sort, members in groupby(enumerate(results), sort):
        yield [one for _, one in members]


def _row_of_many(alike: Sequence[Result]) -> tuple[str, str, str, str]:
    said = f"{len(alike)} cases, to {alike[-1].case.id}\n[dim]{escape(alike[0].reason)}[/dim]"
    return f"  {alike[0].case.id}", "", f"[dim]{Outcome.SKIPPED.value}[/dim]", said


def _row(one: Result) -> tuple[str, str, str, str]:
    weak = one.outcome is Outcome.FAILED and one.case.level is Level.SHOULD
    colour = "yellow" if weak else _COLOURS[one.outcome]
    said = f"\n[dim]{escape(one.reason)}[/dim]" if one.reason else ""
    outcome = f"[{colour}]{one.outcome.value}[/{colour}]"
    return f"  {one.case.id}", one.case.level.value, outcome, f"{escape(one.case.title)}{said}"


def listing(cases: Sequence[Case]) -> str:
    """Every case in a line, for `--list`."""
    return "\n".join(
        f"{case.id:<12} {case.level.value:<6} {case.group:<14} {case.title} [{case.clause}]" for case in cases
    )
