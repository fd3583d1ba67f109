"""Run many demos and check their median: real processes over Zenoh, in real time. Shell (processes)."""

import json
import subprocess
import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

from sightline.evaluation.processes import SIGHTLINE, ProcessError

_SCORED: Final = (0, 5)


@dataclass(frozen=True, slots=True)
class Kinds:
    """Figures whose check is not a median below its bound."""

    at_least: str
    """Prefix of the figures that must not fall below their bound."""
    exact: Collection[str]
    """Figures without tolerance: every run is checked."""


@dataclass(frozen=True, slots=True)
class DemoFigure:
    """One figure over the seeds of a scenario, and its bound."""

    name: str
    median: float | None
    worst: float | None
    unit: str
    bound: float
    ok: bool


def measure_demos(
    scenarios: Sequence[str], seeds: Sequence[int], seconds: float | None, kinds: Kinds, show: Callable[[str], None]
) -> list[DemoFigure]:
    """Run every scenario with every seed; `seconds` None is the length of a demo.

    Raises ProcessError with the last output and the exit code of a demo that cannot run.
    """
    figures: list[DemoFigure] = []
    for scenario in scenarios:
        results = []
        for seed in seeds:
            show(f"{scenario}, seed {seed}")
            results.append(_demo(scenario, seed, seconds))
        figures += _figures(scenario, results, kinds)
    return figures


def _demo(scenario: str, seed: int, seconds: float | None) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="sightline-demo-") as folder:
        lasting = [] if seconds is None else ["--seconds", f"{seconds:g}"]
        arguments = ["demo", "--scenario", scenario, "--seed", str(seed), *lasting, "--out", folder, "--json"]
        command = [*SIGHTLINE, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in _SCORED:
        last = done.stderr.strip().rpartition("\n")[2].removeprefix("error: ")
        raise ProcessError(f"demo of {scenario}, seed {seed}: {last}", done.returncode)
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _figures(scenario: str, results: Sequence[dict[str, Any]], kinds: Kinds) -> list[DemoFigure]:
    names = [check["name"] for check in results[0]["checks"]]
    figures = [_figure(scenario, [_named(result, name) for result in results], kinds) for name in names]
    differing = [_differing(result["replayed"]) for result in results]
    none = all(result["replayed"]["total"] > 0 for result in results) and not any(differing)
    name = f"{scenario}: twists that replay otherwise"
    return [*figures, DemoFigure(name, median(differing), max(differing), "", 0.0, none)]


def _differing(replayed: dict[str, Any]) -> int:
    """Count the different answers and the missing records, without which an answer cannot be compared."""
    lost: int = replayed["gaps"] + replayed["missing_frames"]
    return lost + int(replayed["total"]) - int(replayed["equal"])


def _named(result: dict[str, Any], name: str) -> dict[str, Any]:
    return next(dict(check) for check in result["checks"] if check["name"] == name)


def _figure(scenario: str, checks: Sequence[dict[str, Any]], kinds: Kinds) -> DemoFigure:
    name, bound = checks[0]["name"], float(checks[0]["bound"])
    values = [check["value"] for check in checks]
    numbers = [value for value in values if value is not None]
    if len(numbers) < len(values):
        return DemoFigure(f"{scenario}: {name}", None, None, checks[0]["unit"], bound, False)
    at_least = name.startswith(kinds.at_least)
    middle, worst = median(numbers), min(numbers) if at_least else max(numbers)
    held = worst if name in kinds.exact else middle
    ok = held >= bound if at_least else held <= bound
    return DemoFigure(f"{scenario}: {name}", middle, worst, checks[0]["unit"], bound, ok)
