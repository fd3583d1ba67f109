"""Writes docs/performance.md: runs the judging commands, one after the other, and sets down what each printed. Shell.

Nothing in the page is typed by hand: a figure is there because its command measured it, on the date and machine that
its section names.
"""

import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from sightline.benchmarks.report_sections import SECTIONS, Section
from sightline.protocol.errors import ConfigError

CHECK_FAILED: Final = 5
_HEADING: Final = "## "
_HEAD: Final = (
    "# Performance\n\nWritten by `sightline bench report`, section by section; each says when and on what machine it "
    "was measured. Shared machines are noisy: read medians and ratios, not third digits."
)
_PACKAGES: Final = ("eclipse-zenoh", "pydantic", "numpy", "opencv-python-headless", "simplejpeg", "onnxruntime",
                    "pybullet")


def sections_named(names: Sequence[str]) -> tuple[Section, ...]:
    """Those of `names`, in the page's order; all for none. Raises ConfigError for a name that is none."""
    known = [section.name for section in SECTIONS]
    for name in names:
        if name not in known:
            raise ConfigError(f"--section {name!r}: of {', '.join(known)}")
    return tuple(section for section in SECTIONS if not names or section.name in names)


def write_report(path: Path, sections: Sequence[Section], say: Callable[[str], None]) -> bool:
    """Run every section's command and write it into the page, where the other sections stay; whether all checks held.

    After each section, so that what was measured before a failure is kept.
    """
    ok = True
    for section in sections:
        say(f"sightline {' '.join(section.arguments)}")
        result = _measured(section, path.parent / "img")
        ok &= bool(result["ok"])
        written = path.read_text("utf-8") if path.exists() else ""
        path.write_text(page_with(written, section, _section(section, result)), "utf-8")
    return ok


def page_with(page: str, section: Section, text: str) -> str:
    """`page` with `text` as that section, all of them in the order of `SECTIONS`; sections of no name come last."""
    parts = {part.partition("\n")[0]: part.rstrip() for part in page.split(f"\n{_HEADING}")[1:]}
    parts[section.title] = text.removeprefix(_HEADING).rstrip()
    titles = [one.title for one in SECTIONS if one.title in parts]
    titles += [title for title in parts if title not in titles]
    return "\n\n\n".join([_HEAD, *(_HEADING + parts[title] for title in titles)]) + "\n"


def _measured(section: Section, pictures: Path) -> dict[str, Any]:
    """The command's result; its picture, if it has one, is copied to where the page shows it."""
    if not section.picture:
        return _run(section.arguments)
    with tempfile.TemporaryDirectory(prefix="sightline-report-") as folder:
        result = _run((*section.arguments, "--out", folder))
        pictures.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(Path(folder) / "loop.png", pictures / section.picture)
    return result


def _run(arguments: Sequence[str]) -> dict[str, Any]:
    """The command's JSON object. Raises RuntimeError with its error line if it printed none."""
    command = [sys.executable, "-m", "sightline.operator_side.cli.app", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, CHECK_FAILED):
        raise RuntimeError(f"{' '.join(arguments)}: {done.stderr.strip()}")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _machine() -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    return (
        f"{datetime.now(UTC):%Y-%m-%d}, {_processor()}, {os.cpu_count()} cores, Linux {platform.release()}, "
        f"Python {platform.python_version()}, {packages}."
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
    shown = [f"![Age at the verdict](img/{section.picture})\n"] if section.picture else []
    race = [*_race(result["contestants"]), ""] if "contestants" in result else []
    intro = [f"{_HEADING}{section.title}\n", f"{section.why}\n", f"{command}\n", f"Measured {_machine()}\n"]
    return "\n".join([*intro, *race, *shown, head, rule, *rows])


def _race(contestants: Sequence[dict[str, Any]]) -> list[str]:
    """One row for each contestant of `bench loop`."""
    heads = ("", "answered %", "p50 ms", "p95 ms", "p99 ms", "bytes a picture", "CPU ms a picture", "memory MB")
    rows = [
        (one["name"], *(_number(one[key]) for key in ("answered_percent", "p50_ms", "p95_ms", "p99_ms")),
         "none" if one["bytes_per_picture"] is None else f"{one['bytes_per_picture']:.0f}",
         *(_by_process(one[key]) for key in ("cpu_ms", "memory_mb")))
        for one in contestants
    ]
    return [f"| {' | '.join(cells)} |" for cells in (heads, ("---",) * len(heads), *rows)]


def _by_process(figures: dict[str, float]) -> str:
    return ", ".join(f"{process} {_number(figure)}" for process, figure in figures.items())


def _row(check: dict[str, Any], with_median: bool) -> str:
    cells = [check["name"], *([_number(check.get("median"))] if with_median else []), _number(check["value"])]
    bound = f"{_number(check['bound'])} {check['unit']}"
    return "| " + " | ".join([*cells, bound, "ok" if check["ok"] else "**not reached**"]) + " |"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
