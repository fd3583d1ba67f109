"""A check: name, value, unit, bound, verdict; how checks are made, printed and returned as an exit code. Pure."""

from dataclasses import dataclass
from typing import Final

_WHOLE_FROM: Final = 999.5  # three digits of what is more have an exponent


def number(value: float | None) -> str:
    """Three digits, or all before the point; `never` for what did not happen."""
    if value is None:
        return "never"
    return f"{value:.3g}" if abs(value) < _WHOLE_FROM else f"{value:.0f}"




@dataclass(frozen=True, slots=True)
class Check:
    """One demanded figure: at most `bound`, or at least, where the name begins so."""

    name: str
    value: float | None
    unit: str
    bound: float
    ok: bool
def check_line(check: Check) -> str:
    """One check: name, value, unit, bound, verdict."""
    verdict = "ok" if check.ok else "FAIL"
    return f"{check.name:<22} {number(check.value):>8} {check.unit:<6} bound {number(check.bound):>6}  {verdict}"


def at_most(name: str, value: float | None, unit: str, bound: float) -> Check:
    """A figure that must have happened and be within its bound."""
    return Check(name, value, unit, bound, value is not None and value <= bound)


def at_least(name: str, value: float, unit: str, bound: float) -> Check:
    """A figure that must reach its bound."""
    return Check(name, value, unit, bound, value >= bound)
