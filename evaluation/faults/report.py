"""The fault report: a line per run, JSON, the table of docs/faults.md and the worst values of docs/safety.md. Pure."""

import os
import platform
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from sightline.evaluation.checks import Check, number
from sightline.evaluation.faults.runner import Outcome

PACKAGES: Final = ("eclipse-zenoh", "pybullet", "opencv-python-headless", "pydantic")


def describe_machine() -> list[str]:
    """CPU, cores, load, kernel, Python and the packages that matter, one line each."""
    return [
        f"CPU: {_cpu_model()}, {os.cpu_count()} cores; load average at the start {os.getloadavg()[0]:.1f}",
        f"system: {platform.system()} {platform.release()}, {platform.machine()}",
        f"Python {platform.python_version()}; " + ", ".join(f"{name} {version(name)}" for name in PACKAGES),
    ]


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


# The fault bench's report: a line per run, JSON for scripts, and the table that `docs/faults.md` holds. Pure.


Results = Sequence[Sequence[Outcome]]
_LOWEST_IS_WORST: Final = ("injected", "drives again", "sent", "speed kept", "commands after it", "reset refused",
                           "next driver after", "came", "admitted", "pictures seen", "ticks")
_SHOWN_IF_WRONG: Final = ("on old sight", "drives again", "reset refused", "exit code", "last speed told")
"""Yes or no: in the table they are in what was demanded."""
_COUNTED_FROM: Final = 1000


def passed(results: Results) -> bool:
    """Whether something ran, and all that ran is within bounds; rows that could not run here do not count."""
    ran = [outcome for outcomes in results for outcome in outcomes if not outcome.skipped]
    return bool(ran) and all(outcome.ok for outcome in ran)


def worst_checks(outcomes: Iterable[Outcome]) -> list[Check]:
    """Of each figure the worst run; one that never happened is worst of all."""
    by_name: dict[str, list[Check]] = {}
    for outcome in outcomes:
        for check in outcome.checks:
            by_name.setdefault(check.name, []).append(check)
    return [max(checks, key=_badness) for checks in by_name.values()]


def _badness(check: Check) -> tuple[bool, float]:
    if check.value is None:
        return True, float("inf")
    return not check.ok, -check.value if check.name in _LOWEST_IS_WORST else check.value


def run_line(outcome: Outcome) -> str:
    """One run, for a person who waits."""
    if outcome.skipped:
        return f"{outcome.row.id:<22} skip  {outcome.skipped}"
    wrong = [_figure(check) + f" (bound {number(check.bound)})" for check in outcome.checks if not check.ok]
    text = ", ".join([outcome.trouble] * bool(outcome.trouble) + (wrong or _figures(outcome.checks)))
    return f"{outcome.row.id:<22} {'ok  ' if outcome.ok else 'FAIL'}  {text}"


def progress_line(outcome: Outcome, done: int, total: int, left_s: float) -> str:
    """`run_line` with how far the whole is."""
    left = f"{left_s / 60:.0f} min" if left_s >= 90 else f"{left_s:.0f} s"
    return f"{done:>{len(str(total))}}/{total} ({left} left)  {run_line(outcome)}"


def _figures(checks: Iterable[Check]) -> list[str]:
    return [_figure(check) for check in checks]


def _figure(check: Check) -> str:
    counted = check.value is not None and check.value >= _COUNTED_FROM
    return f"{check.name} {f'{check.value:.0f}' if counted else number(check.value)} {check.unit}".rstrip()


def to_dict(results: Results) -> dict[str, Any]:
    """One object, as every judging command prints with `--json`."""
    checks = [
        asdict(check) | {"name": f"{outcomes[0].row.id}: {check.name}"}
        for outcomes in results
        for check in worst_checks(outcomes)
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


def markdown(results: Results, machine: Sequence[str], command: str, repeat: int) -> str:
    """The whole of `docs/faults.md`."""
    ran = [outcomes for outcomes in results if not outcomes[0].skipped]
    good = sum(all(one.ok for one in outcomes) for outcomes in ran)
    return "\n".join([
        "# What the robot did when things broke",
        "",
        f"Written by `{command}`; do not edit. {good} of {len(ran)} rows passed.",
        "",
        *_LEGEND,
        "",
        *(f"- {line}" for line in machine),
        "",
        f"| fault | demanded | worst of {repeat} | pass |",
        "|---|---|---|---|",
        *map(_table_row, results),
        "",
    ])


def with_rows_of(report: str, newer: str) -> str:
    """`report` with the rows that `newer` ran in place of its own, and said to be; what only `newer` has is added."""
    rows, again = _table_rows(report), _table_rows(newer)
    rows.update(again)
    head, _, _ = report.partition("|---|---|---|---|\n")
    passed_rows = sum(line.endswith("| yes |") for line in rows.values())
    ran = sum(not line.endswith("| not run |") for line in rows.values())
    head = re.sub(r"[0-9]+ of [0-9]+ rows passed", f"{passed_rows} of {ran} rows passed", head)
    note = f"- run again by `{_COMMAND.search(newer)[1]}`: {'; '.join(again)}"  # type: ignore[index]
    head = head.replace("\n\n| fault ", f"\n{note}\n\n| fault ")
    return head + "|---|---|---|---|\n" + "\n".join(rows.values()) + "\n"


_COMMAND: Final = re.compile(r"^Written by `([^`]+)`", re.MULTILINE)


def _table_rows(report: str) -> dict[str, str]:
    """Lines of the table by their fault."""
    lines = report.partition("|---|---|---|---|\n")[2].splitlines()
    return {line.split(" | ")[0].removeprefix("| "): line for line in lines if line.startswith("| ")}


_LEGEND: Final = (
    "Real processes, one fault each, injected at 0.3 m/s or more (vision follows a ball) or at 0.5 m/s (a scripted",
    "driver), and judged from the simulated motors' own log. Times count from the last valid command. *Falls*: the",
    "wheels leave their highest speed for good. *Zero*: they are told zero and really roll slower than 0.01 m/s.",
    "*Injected*: how often the fault was done; a row that injected nothing fails. In every row, besides that:",
    "no motion that no frame younger than 400 ms allows, and no process of Sightline grows by 5 MB. A row during which",
    "this machine stood still for over 20 ms is run again, three times at most.",
)


def _table_row(outcomes: Sequence[Outcome]) -> str:
    row, first = outcomes[0].row, outcomes[0]
    if first.skipped:
        return f"| {row.what} | {row.demanded} | {first.skipped} | not run |"
    trouble = [one.trouble for one in outcomes if one.trouble][:1]
    told = [check for check in worst_checks(outcomes) if not check.ok or check.name not in _SHOWN_IF_WRONG]
    good = all(one.ok for one in outcomes)
    return f"| {row.what} | {row.demanded} | {', '.join([*trouble, *_figures(told)])} | {'yes' if good else '**no**'} |"


# The worst figures of a fault report, by what broke: the block that `docs/safety.md` shows. Pure (text in, text out).
#
# It is made of the report's own table, so that the two pages cannot disagree.


_MARKS: Final = re.compile(r"(<!-- worst values[^\n]*-->\n).*?(<!-- /worst values -->)", re.DOTALL)
_WRITTEN_BY: Final = re.compile(r"^Written by (`[^`]+`)", re.MULTILINE)
_FIGURES: Final = {"falls": "ms", "zero": "ms", "distance": "m", "memory": "MB"}
_STOP_BOUND: Final = re.compile(r"falls <= [0-9.]+ ms, zero <= [0-9.]+ ms, <= [0-9.]+ m")
_NEVER: Final = float("inf")
_HEAD: Final = "| what broke | rows | a stop demanded within | " + " | ".join(
    f"{name}, {unit}" for name, unit in _FIGURES.items()
) + " | rows passed |"


@dataclass(frozen=True, slots=True)
class _Line:
    """One row of the report's table."""

    group: str
    bound: str
    figures: dict[str, float]
    """By name; infinite for what was to happen and never did."""
    passed: bool


def page_with_summary(page: str, report: str) -> str:
    """`page` with the block between its marks made of `report`; as it was if it has no marks."""
    return _MARKS.sub(lambda marks: marks[1] + _block(report) + marks[2], page)


def _block(report: str) -> str:
    lines = list(_lines(report))
    groups = dict.fromkeys((line.group, line.bound) for line in lines)
    rows = [_summary_row(group, bound, [one for one in lines if (one.group, one.bound) == (group, bound)])
            for group, bound in groups]
    written = _WRITTEN_BY.search(report)
    source = f"The worst of every run of {written[1] if written else 'the bench'}, of what broke in the same way."
    return "\n".join([source, "", _HEAD, "|---" * (_HEAD.count("|") - 1) + "|", *rows, ""])


def _summary_row(group: str, bound: str, lines: list[_Line]) -> str:
    worst = [max((line.figures[name] for line in lines if name in line.figures), default=None) for name in _FIGURES]
    cells = ["-" if one is None else "never" if one == _NEVER else f"{one:g}" for one in worst]
    passed = sum(line.passed for line in lines)
    return f"| {group} | {len(lines)} | {bound or '-'} | {' | '.join(cells)} | {passed} of {len(lines)} |"


def _lines(report: str) -> Iterator[_Line]:
    """Rows that ran."""
    for text in report.splitlines():
        cells = [cell.strip() for cell in text.strip("|").split("|")]
        if text.startswith("| ") and len(cells) == 4 and cells[3] in ("yes", "**no**"):
            bound = _STOP_BOUND.search(cells[1])
            yield _Line(cells[0].partition(":")[0], bound[0] if bound else "", _figures_in(cells[2]), cells[3] == "yes")


def _figures_in(cell: str) -> dict[str, float]:
    found = {}
    for name, unit in _FIGURES.items():
        match = re.search(rf"\b{name} (never|[0-9.]+) {unit}\b", cell)
        if match:
            found[name] = _NEVER if match[1] == "never" else float(match[1])
    return found
