"""One figure and its bound. Creates, prints and reduces checks to the worst of several runs. Pure."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

_WHOLE_FROM: Final = 999.5  # larger values have an exponent in three digits


def number(value: float | None) -> str:
    """Format with three digits, or all before the point; `never` for a missing value."""
    if value is None:
        return "never"
    return f"{value:.3g}" if abs(value) < _WHOLE_FROM else f"{value:.0f}"



@dataclass(frozen=True, slots=True)
class Check:
    """One demanded figure: at most `bound`, or at least, if its name begins with `least`."""

    name: str
    value: float | None
    unit: str
    bound: float
    ok: bool


def check_lines(checks: Sequence[Check]) -> list[str]:
    """Format a line for each check: name, value, unit, bound, result."""
    width = max((len(check.name) for check in checks), default=0)
    return [
        f"{check.name:<{width}} {_value(check):>8} {check.unit:<6} bound {number(check.bound):>6}  "
        f"{'ok' if check.ok else 'FAIL'}"
        for check in checks
    ]


def _value(check: Check) -> str:
    """Format a value, with more digits if three would hide the failure."""
    text = number(check.value)
    return text if check.value is None or check.ok or text != number(check.bound) else f"{check.value:g}"


def to_dict(checks: Iterable[Check]) -> dict[str, Any]:
    """Return the common part of `--json` of every command with checks."""
    listed = [asdict(check) for check in checks]
    return {"ok": all(check["ok"] for check in listed), "checks": listed}


def at_most(name: str, value: float | None, unit: str, bound: float) -> Check:
    """Check that a figure exists and is at most its bound."""
    return Check(name, value, unit, bound, value is not None and value <= bound)


def at_least(name: str, value: float, unit: str, bound: float) -> Check:
    """Check that a figure reaches its bound."""
    return Check(name, value, unit, bound, value >= bound)


def worst_checks(runs: Iterable[Sequence[Check]]) -> list[Check]:
    """Return the worst check of each name: the farthest outside its bound, or the nearest inside."""
    by_name: dict[str, list[Check]] = {}
    for checks in runs:
        for check in checks:
            by_name.setdefault(check.name, []).append(check)
    return [max(checks, key=_badness) for checks in by_name.values()]


def _badness(check: Check) -> tuple[bool, float]:
    away = float("inf") if check.value is None else abs(check.value - check.bound)
    return (True, away) if not check.ok else (False, -away)
