"""The table of `sightline score detectors`, as text and as Markdown. Pure."""

from collections.abc import Sequence

from sightline.evaluation.checks import Check
from sightline.evaluation.score.detectors import BALL_LABELS, Figures
from sightline.evaluation.score.detector_report import Report

_HEAD = ("column", "detector", "hits", "missed", "wrong object", "false alarms", "centre p50 / p95 px", "ms p50")
_MOST_LABELS = 3


def rows(report: Report) -> list[tuple[str, ...]]:
    """One for each column and detector."""
    return [(column, name, *_cells(one)) for column, own in report.columns.items() for name, one in own.items()]


def _cells(one: Figures) -> tuple[str, ...]:
    shares = [f"{100 * share:.1f} %" for share in (one.hits, one.missed, one.wrong_object, one.false_alarms)]
    centre = "-" if one.centre_p50_px is None else f"{one.centre_p50_px:.2f} / {one.centre_p95_px:.2f}"
    time = "-" if one.compute_p50_us is None else f"{one.compute_p50_us / 1000:.2f}"
    return (*shares, centre, time)


def precision_lines(report: Report) -> list[str]:
    """One for each detector that finds more than balls."""
    lines = []
    for name, labels in report.precision.items():
        if labels:
            parts = [f"{label} {100 * (share or 0):.1f} % of {objects}" for label, (objects, share) in labels.items()]
            lines.append(f"{name}: AP50 {', '.join(parts)}")
    return lines


def text(report: Report) -> str:
    """For a terminal."""
    table = [_HEAD, *rows(report)]
    widths = [max(len(row[place]) for row in table) for place in range(len(_HEAD))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table]
    return "\n".join([*lines, *precision_lines(report), _made(report)])


def markdown(report: Report) -> str:
    """For a page."""
    lines = [_line(_HEAD), _line(["---"] * len(_HEAD)), *(_line(row) for row in rows(report))]
    return "\n".join([*lines, "", *(f"- {line}" for line in precision_lines(report))])


def check_lines(checks: Sequence[Check]) -> list[str]:
    """One a line: what, its value, the bound, the verdict."""
    width = max((len(check.name) for check in checks), default=0)
    return [f"{check.name.ljust(width)}  {_value(check):>9}  bound {check.bound:g} {check.unit}".rstrip()
            + ("  ok" if check.ok else "  FAIL") for check in checks]


def _value(check: Check) -> str:
    return "never" if check.value is None else f"{round(check.value, 2):g} {check.unit}".rstrip()


def silence_lines(report: Report) -> list[str]:
    """One for each detector that did not always answer, and for each that calls things what nobody asks for."""
    silent = [f"{name}: no answer to {one.scenes} of {one.of} scenes, which count as missed: {one.why}"
              for name, one in report.silent.items()]
    calls = [f"{name}: not counted is what it calls {_some(labels)}; a ball is {' or '.join(BALL_LABELS)}, and target.label"
             for name, labels in report.uncounted.items()]
    return [" ".join(line.split()) for line in (*silent, *calls)]


def _some(labels: Sequence[str]) -> str:
    more = f" and {len(labels) - _MOST_LABELS} more" if len(labels) > _MOST_LABELS else ""
    return ", ".join(map(repr, labels[:_MOST_LABELS])) + more


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _made(report: Report) -> str:
    ran = ", ".join(f"{name} on {by['device'] or 'its own'}" for name, by in report.made_by.items())
    last = report.first_seed + report.frames - 1
    return f"{report.frames} scenes a column, seeds {report.first_seed} to {last}; {ran or 'nobody answered'}"
