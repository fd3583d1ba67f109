"""What is demanded of a learned detector, and whether a report keeps it. Pure.

Demanded on `FRAMES` scenes a column that nothing was trained or tuned on. Who did not ask for this is not judged by it:
a colour detector, for one, finds no traffic lights.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from sightline.evaluation.checks import Check
from sightline.evaluation.score.detectors import Figures
from sightline.evaluation.score.detector_report import LABELLED, Report

FRAMES: Final = 500
LEAST_HITS: Final = {
    "nominal": 0.85, "same-colour boxes": 0.78, "changed light": 0.80, "blur": 0.75, "quality 30": 0.78,
    "all at once": 0.68,
}
MOST_WRONG: Final = 0.05
"""Wrong objects, and false alarms, in every column: going for either is what must not happen."""
CLEAN: Final = "nominal"
"""The column of clean pictures, where the centre is judged."""
CENTRE_PX: Final = 1.0
"""The median."""
LEAST_AP50: Final = 0.80
LEAST_OBJECTS: Final = 300
"""Of each label; a figure of fewer says too little."""


def all_detector_checks(report: Report) -> list[Check]:
    """The checks of every detector, by name."""
    names = dict.fromkeys(name for own in report.columns.values() for name in own)
    return [replace(check, name=f"{name}: {check.name}") for name in names for check in detector_checks(report, name)]


def detector_checks(report: Report, name: str) -> list[Check]:
    """Hold one detector's figures against all that is demanded, in the columns that were shown."""
    checks = [check for column, own in report.columns.items() for check in _of_column(column, own[name])]
    return checks + [check for label in LABELLED for check in _of_label(label, report.precision[name].get(label))]


def _of_column(column: str, one: Figures) -> Iterator[Check]:
    yield _least(f"hits, {column}", one.hits, LEAST_HITS[column])
    for what, share in (("wrong object", one.wrong_object), ("false alarms", one.false_alarms)):
        yield Check(f"{what}, {column}", _percent(share), "%", _percent(MOST_WRONG), share <= MOST_WRONG)
    if column == CLEAN:
        centre_px = one.centre_p50_px
        is_near = centre_px is not None and centre_px <= CENTRE_PX
        yield Check(f"centre p50, {column}", centre_px, "px", CENTRE_PX, is_near)


def _of_label(label: str, found: tuple[int, float | None] | None) -> Iterator[Check]:
    """None: the detector found neither lights nor legs anywhere."""
    yield _least(f"AP50, {label}", found[1] if found else None, LEAST_AP50)
    if found:
        yield Check(f"least objects, {label}", found[0], "", LEAST_OBJECTS, found[0] >= LEAST_OBJECTS)


def _least(what: str, share: float | None, bound: float) -> Check:
    return Check(f"least {what}", None if share is None else _percent(share), "%", _percent(bound),
                 share is not None and share >= bound)


def _percent(share: float) -> float:
    return round(100 * share, 3)
