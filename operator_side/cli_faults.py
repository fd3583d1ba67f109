"""The command `faults`: break things on purpose and judge what the wheels did. Shell. Exit code 5 when a row fails."""

import json
import os
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.operator_side.cli.options import CHECK_FAILED
from sightline.operator_side.preflight import needs
from sightline.operator_side.out_file import check_out_file

if TYPE_CHECKING:
    from sightline.operator_side.faults.report import Results

JOBS = min(4, (os.cpu_count() or 1) + 1)
"""A row waits more than it computes; a row that was disturbed too much says so and runs again."""
SAFETY_PAGE = "safety.md"


def register_faults(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline faults --only vision.kill --only wire")(faults)


def faults(
    *,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="ID", help="A row, or a group such as `wire`; repeatable.")
    ] = None,
    short: Annotated[bool, typer.Option("--short", help="The short set, as in CI.")] = False,
    repeat: Annotated[int, typer.Option(min=1, max=100, help="Run each row so often.")] = 1,
    jobs: Annotated[
        int, typer.Option(min=1, max=16, help="Rows at once; those that take the whole machine run alone.")
    ] = JOBS,
    listing: Annotated[bool, typer.Option("--list", help="Name the rows and what each demands; run nothing.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the report (with --only, its rows into it); worst values go to safety.md."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> int:
    """Start real processes, break one thing at a time, and judge from the simulated motors' own log."""
    with needs("all"):
        from sightline.evaluation.faults.report import describe_machine
        from sightline.operator_side.faults.parallel import run_cases
        from sightline.operator_side.faults.report import markdown, passed, progress_line, to_dict, with_rows_of
        from sightline.operator_side.faults.rows import chosen
    rows = chosen(only or (), short=short)
    if listing:
        typer.echo("\n".join(f"{row.id:<22} {row.what}: {row.demanded}" for row in rows))
        return 0
    if out is not None:
        check_out_file(out)
    machine, folder = describe_machine(), Path(tempfile.mkdtemp(prefix="sightline-faults-"))
    results = run_cases(
        rows, repeat, folder, jobs, lambda one, progress: typer.echo(progress_line(one, *progress), err=as_json)
    )
    _remove_if_empty(folder)
    if out is not None:
        report = markdown(results, machine, _command(only, short, repeat, jobs), repeat)
        _write_report(out, with_rows_of(out.read_text("utf-8"), report) if only and out.exists() else report)
    typer.echo(json.dumps(to_dict(results)) if as_json else _summary(results, folder))
    return 0 if passed(results) else CHECK_FAILED


def _write_report(out: Path, report: str) -> None:
    """The report, and its worst values into the page of promises beside it."""
    from sightline.operator_side.faults.worst import page_with_summary

    out.write_text(report, "utf-8")
    page = out.with_name(SAFETY_PAGE)
    if page.exists():
        page.write_text(page_with_summary(page.read_text("utf-8"), report), "utf-8")


def _command(only: list[str] | None, short: bool, repeat: int, jobs: int) -> str:
    options = [*(f" --only {name}" for name in only or ()), " --short" * short, f" --repeat {repeat} --jobs {jobs}"]
    return "sightline faults" + "".join(options)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):  # a row that failed left its logs
        folder.rmdir()


def _summary(results: "Results", folder: Path) -> str:
    ran = [outcomes for outcomes in results if not outcomes[0].skipped]
    good = sum(all(one.ok for one in outcomes) for outcomes in ran)
    left = f"; logs of what failed are in {folder}" if folder.exists() else ""
    return f"{good} of {len(ran)} rows passed, {len(results) - len(ran)} could not run here{left}"
