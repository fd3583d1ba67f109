"""One result of the doctor, with the command that fixes it. Pure."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from sightline.protocol.errors import SightlineError


@dataclass(frozen=True)
class Finding:
    """`value` is the result, `ok` is None for plain information, `fix` is the exact command of the fix."""

    name: str
    ok: bool | None
    value: str
    fix: str = ""
    unit: str = ""
    bound: str = ""

    @property
    def line(self) -> str:
        """Format the finding as one line, with its fix on the next line."""
        sign = {True: "ok  ", False: "BAD ", None: "    "}[self.ok]
        fix = f"\n{'':25}fix: {self.fix}" if self.fix and self.ok is not True else ""
        unit = f" {self.unit}" if self.unit else ""
        return f"{sign} {self.name:<19} {self.value}{unit}{fix}"

    @property
    def check(self) -> dict[str, Any]:
        """Return the finding for scripts. A value with a unit is a number. A good finding has no fix."""
        numbers = {name: _number(getattr(self, name)) for name in ("value", "bound") if self.unit}
        return {**asdict(self), **numbers, "fix": "" if self.ok is True else self.fix}


def trouble(name: str, error: SightlineError) -> Finding:
    """Convert an error to a finding. The fix follows the last semicolon."""
    what, _, fix = str(error).rpartition("; ")
    return Finding(name, False, what or fix, fix if what else "")


def _number(text: str) -> float | str | None:
    try:
        return float(text) if text else None
    except ValueError:
        return text


def as_object(findings: list[Finding]) -> dict[str, Any]:
    """Return the --json object of a command with checks."""
    return {"ok": all(one.ok is not False for one in findings), "checks": [one.check for one in findings]}


def histogram(values_ms: list[float], bins: int = 8, width: int = 40) -> list[str]:
    """Draw `values_ms` as lines of text: lower end of the bin, bar, count. Empty without values."""
    if not values_ms:
        return []
    low, high = min(values_ms), max(values_ms)
    step = (high - low) / bins or 1.0
    counts = [0] * bins
    for value in values_ms:
        counts[min(bins - 1, int((value - low) / step))] += 1
    top = max(counts)
    return [
        f"{low + index * step:9.2f} ms  {'#' * round(width * count / top):<{width}} {count}"
        for index, count in enumerate(counts)
    ]
