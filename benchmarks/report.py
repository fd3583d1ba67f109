"""Writes docs/performance.md: runs the judging commands, one after the other, and sets down what each printed. Shell.

Nothing in the page is typed by hand: a figure is there because its command measured it in this run.
"""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

CHECK_FAILED: Final = 5
_PACKAGES: Final = ("eclipse-zenoh", "pydantic", "numpy", "opencv-python-headless", "simplejpeg", "pybullet")


@dataclass(frozen=True, slots=True)
class Section:
    """One command of the page and why it is there."""

    title: str
    why: str
    arguments: tuple[str, ...]


_SEEDS: Final = "201,202,203,204,205,206"
SECTIONS: Final = (
    Section(
        "Following, in virtual time",
        "The services' own logic in lockstep with the simulated world; scored from world truth, judged by the worst "
        "run. Seeds that nothing was tuned on; loss is on each leg.",
        ("score", "--seeds", _SEEDS, "--latency-ms", "50", "--loss", "0.1"),
    ),
    Section(
        "A figure of eight under latency",
        "Added latency from capture to command, half on each leg. At 400 ms no frame is young enough: the robot is to "
        "stand still.",
        ("score", "--scenario", "eight", "--seeds", _SEEDS, "--latency-ms", "0,100,200,400", "--loss", "0.1"),
    ),
    Section(
        "The same in real time",
        "`sightline demo`: real processes over Zenoh. The median of six seeds is held against the bounds above x 1.5; "
        "every run's recorded frames, replayed through a fresh pipeline, must give the twists that were on the wire.",
        ("bench", "demo", "--seeds", _SEEDS, "--seconds", "12"),
    ),
    Section(
        "Killed at speed",
        "Vision and the network process, killed with -9 while driving at 0.3 m/s or more, ten times each; judged "
        "from the simulated motors' own log. [faults.md](faults.md) has more faults.",
        ("faults", "--only", "vision.kill", "--only", "network.kill", "--only", "vision.restart", "--repeat", "10"),
    ),
    Section("Odometry", "Against the simulated world's truth.", ("bench", "odometry")),
    Section("Gate", "One command judged and one step decided.", ("bench", "gate")),
    Section("Messages", "Encode and decode, hot.", ("bench", "codec")),
    Section("Vision", "`Pipeline.step`, decoding included, hot, one thread.", ("bench", "pipeline")),
    Section(
        "A robot without NumPy, OpenCV and PyBullet",
        "`sightline[zenoh]` in a new environment, driving in the simulation; memory is the kernel's high-water mark.",
        ("bench", "robot", "--seconds", "60"),
    ),
)


def write_report(path: Path, sections: Sequence[Section], say: Callable[[str], None]) -> bool:
    """Run every section's command and write the page; whether all checks held."""
    parts, ok = [_head()], True
    for section in sections:
        say(f"sightline {' '.join(section.arguments)}")
        result = _run(section.arguments)
        ok &= bool(result["ok"])
        parts.append(_section(section, result))
    path.write_text("\n".join(parts), "utf-8")
    return ok


def _run(arguments: Sequence[str]) -> dict[str, Any]:
    """The command's JSON object. Raises RuntimeError with its error line if it printed none."""
    command = [sys.executable, "-m", "operator_side.cli", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, CHECK_FAILED):
        raise RuntimeError(f"{' '.join(arguments)}: {done.stderr.strip()}")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _head() -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    return (
        "# Performance\n\nWritten by `sightline bench report`; every figure is of that run. Shared machines are noisy: "
        "read medians and ratios, not third digits.\n\n"
        f"{datetime.now(UTC):%Y-%m-%d}, {_processor()}, {os.cpu_count()} cores, Linux {platform.release()}, "
        f"Python {platform.python_version()}, {packages}.\n"
    )


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.machine())


def _section(section: Section, result: dict[str, Any]) -> str:
    with_median = any("median" in check for check in result["checks"])
    head = "| figure | median | worst | bound | |" if with_median else "| figure | value | bound | |"
    rows = [_row(check, with_median) for check in result["checks"]]
    rule = "|---" * (head.count("|") - 1) + "|"
    command = f"`sightline {' '.join(section.arguments)}`"
    return "\n".join([f"\n## {section.title}\n", f"{section.why}\n", f"{command}\n", head, rule, *rows, ""])


def _row(check: dict[str, Any], with_median: bool) -> str:
    cells = [check["name"], *([_number(check.get("median"))] if with_median else []), _number(check["value"])]
    bound = f"{_number(check['bound'])} {check['unit']}"
    return "| " + " | ".join([*cells, bound, "ok" if check["ok"] else "**not reached**"]) + " |"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"
