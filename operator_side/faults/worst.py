"""The worst figures of a fault report, by what broke: the block that `docs/safety.md` shows. Pure (text in, text out).

It is made of the report's own table, so that the two pages cannot disagree.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

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
