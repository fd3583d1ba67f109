"""Checks and figures as text. Pure."""

from typing import Final

from operator_side.score import Check

_WHOLE_FROM: Final = 999.5  # three digits of what is more have an exponent


def number(value: float | None) -> str:
    """Three digits, or all before the point; `never` for what did not happen."""
    if value is None:
        return "never"
    return f"{value:.3g}" if abs(value) < _WHOLE_FROM else f"{value:.0f}"


def check_line(check: Check) -> str:
    """One check: name, value, unit, bound, verdict."""
    verdict = "ok" if check.ok else "FAIL"
    return f"{check.name:<22} {number(check.value):>8} {check.unit:<6} bound {number(check.bound):>6}  {verdict}"
