"""The report of the fault bench: a line per run for the terminal, and JSON for scripts. Pure."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any, Final

from sightline.evaluation.checks import Check, number, worst_checks
from sightline.evaluation.faults.runner import FaultOutcome

Results = Sequence[Sequence[FaultOutcome]]
_COUNTED_FROM: Final = 1000


def passed(results: Results) -> bool:
    """Return True if at least one row ran and all of them are within bounds. Skipped rows do not count."""
    ran = [outcome for outcomes in results for outcome in outcomes if not outcome.skipped]
    return bool(ran) and all(outcome.ok for outcome in ran)


def run_line(outcome: FaultOutcome) -> str:
    """Format the line of one run for the operator."""
    if outcome.skipped:
        return f"{outcome.row.id:<22} skip  {outcome.skipped}"
    wrong = [_figure(check) + f" (bound {number(check.bound)})" for check in outcome.checks if not check.ok]
    text = ", ".join([outcome.trouble] * bool(outcome.trouble) + (wrong or _figures(outcome.checks)))
    return f"{outcome.row.id:<22} {'ok  ' if outcome.ok else 'FAIL'}  {text}"


def progress_line(outcome: FaultOutcome, done: int, total: int, left_s: float) -> str:
    """Format `run_line` with the progress of all rows."""
    left = f"{left_s / 60:.0f} min" if left_s >= 90 else f"{left_s:.0f} s"
    return f"{done:>{len(str(total))}}/{total} ({left} left)  {run_line(outcome)}"


def _figures(checks: Iterable[Check]) -> list[str]:
    return [_figure(check) for check in checks]


def _figure(check: Check) -> str:
    return figure_text(check.name, check.value, check.unit)


def figure_text(name: str, value: float | None, unit: str) -> str:
    """Format a figure with its name."""
    return f"{name} {value_text(value)} {unit}".rstrip()


def value_text(value: float | None) -> str:
    """Format three digits, or all of a large count."""
    return f"{value:.0f}" if value is not None and value >= _COUNTED_FROM else number(value)


def to_dict(results: Results) -> dict[str, Any]:
    """Return the `--json` object of a command with checks."""
    checks = [
        asdict(check) | {"name": f"{outcomes[0].row.id}: {check.name}"}
        for outcomes in results
        for check in worst_checks(one.checks for one in outcomes)
    ]
    rows = [
        {
            "id": outcomes[0].row.id, "what": outcomes[0].row.what, "demanded": outcomes[0].row.demanded,
            "runs": len(outcomes), "ok": all(one.ok for one in outcomes), "skipped": outcomes[0].skipped,
            "trouble": next((one.trouble for one in outcomes if one.trouble), ""),
        }
        for outcomes in results
    ]
    return {"ok": passed(results), "checks": checks, "rows": rows}
