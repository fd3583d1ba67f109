"""Checks and figures as text. Pure."""

from operator_side.score import Check


def number(value: float | None) -> str:
    """Three digits; `never` for what did not happen."""
    return "never" if value is None else f"{value:.3g}"


def check_line(check: Check) -> str:
    """One check: name, value, unit, bound, verdict."""
    verdict = "ok" if check.ok else "FAIL"
    return f"{check.name:<22} {number(check.value):>8} {check.unit:<6} bound {number(check.bound):>6}  {verdict}"
