"""The mutation gate's command: coverage, then every mutant, then the verdict. Shell."""

import argparse
import os
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from tests.mutation.coverage_check import uncovered
from tests.mutation.mutants import Mutant, mutants
from tests.mutation.trial import Outcome, finish, start

_GATE = (
    "tests/robot_side/safety/test_gate_commands.py",
    "tests/robot_side/safety/test_gate_step.py",
    "tests/robot_side/safety/test_gate_requests.py",
    "tests/robot_side/safety/test_gate_lease.py",
)
_SAFETY = sorted(path.stem for path in Path("robot_side/safety").glob("[!_]*.py"))
TABLES = {
    **{f"robot_side/safety/{name}.py": (f"tests/robot_side/safety/test_{name}.py",) for name in _SAFETY},
    "robot_side/safety/gate.py": _GATE,
    "robot_side/safety/states.py": _GATE,
    "robot_side/kinematics.py": ("tests/robot_side/test_kinematics.py",),
    "protocol/text.py": ("tests/protocol/test_text_and_jpeg_boundaries.py",),
    "protocol/jpeg.py": ("tests/protocol/test_text_and_jpeg_boundaries.py",),
}
"""Each judged file and the tables that must notice any change to it; all of `safety/` is judged."""
EQUIVALENTS = Path(__file__).parent / "equivalents.toml"
Name = tuple[str, str, str, str, int]


def main() -> int:
    """Return the exit code: 0, or 5 when the tables fail, miss a line or branch, or let a mutant live."""
    options = _options()
    files = [file for file in TABLES if options.only in file]
    found = [mutant for file in files for mutant in mutants(file, Path(file).read_text())]
    if options.list:
        print(*map(_line, found), sep="\n")
        return 0
    missing = uncovered(files, sorted({table for file in files for table in TABLES[file]}))
    if missing:
        print(missing, "error: the tables fail, or leave lines or branches of the judged files out (above)", sep="\n")
        return 5
    return _verdict(_survivors(found, options.jobs), _equivalents(files))


def _survivors(found: list[Mutant], jobs: int) -> list[Mutant]:
    began_s, survivors, outcomes = time.monotonic(), [], Counter[Outcome]()
    for mutant, outcome in _trials(found, jobs):
        outcomes[outcome] += 1
        survivors += [mutant] if outcome is Outcome.SURVIVED else []
    counts = ", ".join(f"{count} {outcome.value}" for outcome, count in outcomes.items())
    print(f"{len(found)} mutants in {time.monotonic() - began_s:.0f} s: {counts}")
    return survivors


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--list", action="store_true", help="print the mutants and stop")
    parser.add_argument("--only", default="", metavar="TEXT", help="only judged files whose path holds TEXT")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="mutants tried at once")
    return parser.parse_args()


def _trials(found: Iterable[Mutant], jobs: int) -> Iterator[tuple[Mutant, Outcome]]:
    running: list[tuple[Mutant, int, float]] = []
    for mutant in found:
        running.append((mutant, start(mutant, TABLES[mutant.file]), time.monotonic()))
        if len(running) >= jobs:
            oldest, pid, started_s = running.pop(0)
            yield oldest, finish(pid, started_s)
    yield from ((mutant, finish(pid, started_s)) for mutant, pid, started_s in running)


def _equivalents(files: Iterable[str]) -> dict[Name, str]:
    rows = tomllib.loads(EQUIVALENTS.read_text())["equivalent"]
    named = {(row["file"], row["where"], row["before"], row["after"], row.get("nth", 1)): row["reason"] for row in rows}
    return {name: reason for name, reason in named.items() if name[0] in files}


def _verdict(survivors: list[Mutant], equivalents: dict[Name, str]) -> int:
    unexplained = [mutant for mutant in survivors if mutant.name not in equivalents]
    outdated = set(equivalents) - {mutant.name for mutant in survivors}
    for mutant in unexplained:
        print("survived:", _line(mutant))
    for name in sorted(outdated):
        print("no survivor of this name, take it out of equivalents.toml:", *name)
    print(f"{len(survivors) - len(unexplained)} named equivalents, {len(unexplained)} unexplained survivors")
    return 5 if unexplained or outdated else 0


def _line(mutant: Mutant) -> str:
    nth = f" (nth = {mutant.nth})" if mutant.nth > 1 else ""
    return f"{mutant.file}:{mutant.line} {mutant.where}: `{mutant.before}` -> `{mutant.after}`{nth}"


if __name__ == "__main__":
    sys.exit(main())
