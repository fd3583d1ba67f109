"""Write docs/reference/results/faults.md, and its worst values into the safety page. Shell.

    python -m docs.make.faults --repeat 10 --jobs 3                     # all rows: about an hour
    python -m docs.make.faults --only wire.thin --repeat 10 --jobs 3    # these again; other rows keep their results

docs/reference/results/faults.json has the results. Both pages are generated from it, so that they agree.
"""

import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from docs.make.performance import processor
from sightline.evaluation.faults.cases import CASES
from sightline.evaluation.faults.report import figure_text, value_text
from sightline.evaluation.processes import SIGHTLINE
from sightline.operator_side.cli.options import CHECK_FAILED

DOCS: Final = Path(__file__).parents[1]
RESULTS: Final = Path("reference", "results")
SAFETY: Final = Path("reference", "safety-limits.md")
PACKAGES: Final = ("eclipse-zenoh", "pybullet", "opencv-python-headless", "pydantic")
_SHOWN_IF_WRONG: Final = ("on an old frame", "drives again", "reset rejected", "exit code", "last speed set")
"""Yes or no: the table shows them in the requirement."""
_MARKS: Final = re.compile(r"(<!-- worst values[^\n]*-->\n).*?(<!-- /worst values -->)", re.DOTALL)
_FIGURES: Final = {"falls": "ms", "zero": "ms", "distance": "m", "memory": "MB"}
_STOP_BOUND: Final = re.compile(r"falls <= [0-9.]+ ms, zero <= [0-9.]+ ms, <= [0-9.]+ m")
_HEAD: Final = "| what broke | rows | required stop | " + " | ".join(
    f"{name}, {unit}" for name, unit in _FIGURES.items()
) + " | rows passed |"
_LEGEND: Final = (
    "Real processes, one fault each, injected at 0.3 m/s or more (the vision service follows a ball) or at 0.5 m/s (a",
    "scripted driver), and scored from the log of the simulated motors. Times count from the last valid command.",
    "*Falls*: the wheels leave their highest speed for good. *Zero*: their command is zero and they roll slower than",
    "0.01 m/s. *Injected*: the number of times that the fault occurred; a row that injected nothing fails. Two more",
    "rules apply to each row: no motion without a frame younger than 400 ms, and no process grows by 5 MB.",
    "A row runs again, three times at most, if this machine stood still for over 20 ms in the second after the fault.",
    "After a failed check, this applies to the whole time from the first measurement to the end.",
)

Record = Mapping[str, Any]
"""The JSON object of the command, with the command, the machine and the commands that repeated rows."""


def describe_machine() -> list[str]:
    """Return CPU, cores, load, date, kernel, Python and the packages that matter, one line each."""
    load = f"load average at the start {os.getloadavg()[0]:.1f}, on {datetime.now(UTC):%Y-%m-%d}"
    return [
        f"CPU: {processor()}, {os.cpu_count()} cores; {load}",
        f"system: {platform.system()} {platform.release()}, {platform.machine()}",
        f"Python {platform.python_version()}; " + ", ".join(f"{name} {version(name)}" for name in PACKAGES),
    ]


def measured(arguments: Sequence[str]) -> Record:
    """Run the command. Raises RuntimeError with its error line if it printed no result."""
    machine, command = describe_machine(), ["faults", *arguments]
    done = subprocess.run([*SIGHTLINE, *command, "--json"], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, CHECK_FAILED):
        raise RuntimeError(f"sightline {' '.join(command)} ended with {done.returncode}")
    result = json.loads(done.stdout.splitlines()[-1])
    return {"command": f"sightline {' '.join(command)}", "machine": machine, "again": [], **result}


def merged(record: Record, newer: Record) -> Record:
    """Return `record` with its rows replaced by those of `newer`; rows that only `newer` has come last.

    A row that had not passed keeps its figures in the note of the later run.
    """
    again = {row["id"]: row for row in newer["rows"]}
    failed = {row["id"]: _figures(row, _checks(record, row)) for row in record["rows"]
              if row["id"] in again and not row["ok"]}
    rows = {row["id"]: row for row in record["rows"]} | again
    checks = [one for one in record["checks"] if _id_of(one) not in again] + newer["checks"]
    note = {"command": newer["command"], "machine": newer["machine"], "rows": list(again), "failed": failed}
    is_ok = all(row["ok"] for row in rows.values() if not row["skipped"])
    return {**record, "ok": is_ok, "rows": list(rows.values()), "checks": checks, "again": [*record["again"], note]}


def report_page(record: Record, known: Iterable[str] = ()) -> str:
    """Return docs/reference/results/faults.md, which names those `known` rows that `record` does not have."""
    ran = _ran(record)
    missing = [f"`{row}`" for row in known if row not in {one["id"] for one in record["rows"]}]
    again = [f"by `{one['command']}` on {one['machine'][0].removeprefix('CPU: ')}: "
             + ", ".join(f"`{row}`" + _before(row, one) for row in one["rows"]) for one in record["again"]]
    return "\n".join([
        "# Fault results",
        "",
        f"Written by `{record['command']}`; do not edit. {_passed(ran)} of {len(ran)} rows passed.",
        "",
        *_LEGEND,
        "",
        *(f"- {line}" for line in [*record["machine"], *again]),
        *([f"- not measured yet: {', '.join(missing)}"] if missing else []),
        "",
        f"| row | fault | required | worst of {max(row['runs'] for row in record['rows'])} | pass |",
        "|---|---|---|---|---|",
        *(_table_row(row, _checks(record, row)) for row in record["rows"]),
        "",
    ])


def _before(row: str, note: Record) -> str:
    figures = note.get("failed", {}).get(row)
    return f" (did not pass before: {figures})" if figures else ""


def _table_row(row: Record, checks: Iterable[Record]) -> str:
    name = f"| `{row['id']}` | {row['what']} | {row['demanded']} |"
    if row["skipped"]:
        return f"{name} {row['skipped']} | not run |"
    return f"{name} {_figures(row, checks)} | {'yes' if row['ok'] else '**no**'} |"


def _figures(row: Record, checks: Iterable[Record]) -> str:
    shown = [figure_text(one["name"], one["value"], one["unit"]) for one in checks
             if not one["ok"] or one["name"] not in _SHOWN_IF_WRONG]
    return ", ".join([row["trouble"], *shown] if row["trouble"] else shown)


def safety_page(page: str, record: Record) -> str:
    """Return `page` with the worst figures by cause between its marks; unchanged without marks."""
    return _MARKS.sub(lambda marks: marks[1] + _worst_values(record) + marks[2], page)


def _worst_values(record: Record) -> str:
    groups: dict[tuple[str, str], list[Record]] = {}
    for row in _ran(record):
        bound = _STOP_BOUND.search(row["demanded"])
        groups.setdefault((_broken(row["what"]), bound[0] if bound else "-"), []).append(row)
    lines = [_summary_row(record, group, bound, rows) for (group, bound), rows in groups.items()]
    later = "\n[Fault results](results/faults.md) names the later runs of some rows." if record["again"] else ""
    source = f"The worst of every run of `{record['command']}`, of what broke in the same way.{later}"
    return "\n".join([source, "", _HEAD, "|---" * (_HEAD.count("|") - 1) + "|", *lines, ""])


def _broken(what: str) -> str:
    """Return the cause, without the variant in parentheses."""
    return what.partition(":")[0].partition(" (")[0]


def _summary_row(record: Record, group: str, bound: str, rows: Sequence[Record]) -> str:
    checks = [one for row in rows for one in _checks(record, row)]
    cells = [_worst([one["value"] for one in checks if one["name"] == name]) for name in _FIGURES]
    return f"| {group} | {len(rows)} | {bound} | {' | '.join(cells)} | {_passed(rows)} of {len(rows)} |"


def _worst(values: Sequence[float | None]) -> str:
    if not values:
        return "-"
    return value_text(None if None in values else max(value for value in values if value is not None))


def _checks(record: Record, row: Record) -> list[Record]:
    """Return the worst checks of a row, by their name within it."""
    return [{**one, "name": one["name"].partition(": ")[2]} for one in record["checks"] if _id_of(one) == row["id"]]


def _id_of(check: Record) -> str:
    return str(check["name"].partition(": ")[0])


def _ran(record: Record) -> list[Record]:
    return [row for row in record["rows"] if not row["skipped"]]


def _passed(rows: Iterable[Record]) -> int:
    return sum(row["ok"] for row in rows)


def main(arguments: Sequence[str], docs: Path = DOCS) -> int:
    """Run the command with `arguments` and write its result and both pages."""
    file, safety = docs / RESULTS / "faults.json", docs / SAFETY
    record = measured(arguments)
    if "--only" in arguments and file.exists():
        record = merged(json.loads(file.read_text("utf-8")), record)
    file.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", "utf-8")
    (docs / RESULTS / "faults.md").write_text(report_page(record, (row.id for row in CASES)), "utf-8")
    safety.write_text(safety_page(safety.read_text("utf-8"), record), "utf-8")
    return 0 if all(row["ok"] for row in _ran(record)) else CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
