"""Many demos, judged by their median: real processes over Zenoh, in real time. Shell (processes)."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

_JUDGED: Final = (0, 5)


@dataclass(frozen=True, slots=True)
class DemoFigure:
    """One figure over the seeds of a scenario; `ok` holds the median against the bound (counts: every run)."""

    name: str
    median: float | None
    worst: float | None
    unit: str
    bound: float
    ok: bool


def measure_demos(
    scenarios: Sequence[str], seeds: Sequence[int], seconds: float, say: Callable[[str], None]
) -> list[DemoFigure]:
    """Run every scenario with every seed. Raises RuntimeError with the demo's own words if one cannot run."""
    figures: list[DemoFigure] = []
    for scenario in scenarios:
        results = []
        for seed in seeds:
            say(f"{scenario}, seed {seed}")
            results.append(_demo(scenario, seed, seconds))
        figures += _figures(scenario, results)
    return figures


def _demo(scenario: str, seed: int, seconds: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="sightline-demo-") as folder:
        arguments = ["demo", "--scenario", scenario, "--seed", str(seed), "--seconds", f"{seconds:g}", "--out", folder]
        command = [sys.executable, "-m", "operator_side.cli", *arguments, "--json"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in _JUDGED:
        raise RuntimeError(f"demo {scenario} seed {seed}: {done.stderr.strip()}")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _figures(scenario: str, results: Sequence[dict[str, Any]]) -> list[DemoFigure]:
    names = [check["name"] for check in results[0]["checks"]]
    figures = [_figure(scenario, [_named(result, name) for result in results]) for name in names]
    differing = [result["replayed"]["total"] - result["replayed"]["equal"] for result in results]
    none = all(result["replayed"]["total"] > 0 for result in results) and not any(differing)
    name = f"{scenario}: twists that replay otherwise"
    return [*figures, DemoFigure(name, median(differing), max(differing), "", 0.0, none)]


def _named(result: dict[str, Any], name: str) -> dict[str, Any]:
    return next(dict(check) for check in result["checks"] if check["name"] == name)


def _figure(scenario: str, checks: Sequence[dict[str, Any]]) -> DemoFigure:
    values = [check["value"] for check in checks]
    numbers = sorted(value for value in values if value is not None)
    complete = len(numbers) == len(values)
    bound = float(checks[0]["bound"])
    middle = median(numbers) if complete else None
    ok = middle is not None and (middle <= bound if bound else numbers[-1] <= 0)
    return DemoFigure(
        f"{scenario}: {checks[0]['name']}", middle, numbers[-1] if complete else None, checks[0]["unit"], bound, ok
    )
