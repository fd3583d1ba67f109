"""The command of the mutation gate: coverage, then every mutant, then the result. Shell."""

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from tests.mutation.changes import EQUIVALENTS, select
from tests.mutation.forks import try_mutants
from tests.mutation.mutants import Mutant, Name, equivalents, mutants
from tests.mutation.planted import main as plant
from tests.mutation.trial import Outcome, uncovered

_GATE = (
    "tests/robot_side/safety/test_gate_commands.py",
    "tests/robot_side/safety/test_gate_step.py",
    "tests/robot_side/safety/test_gate_requests.py",
    "tests/robot_side/safety/test_gate_lease.py",
    "tests/robot_side/safety/test_gate_proof.py",
    "tests/robot_side/safety/test_gate_tokens.py",
)
_SAFETY = sorted(path.stem for path in Path("robot_side/safety").glob("[!_]*.py"))
TABLES = {
    **{f"robot_side/safety/{name}.py": (f"tests/robot_side/safety/test_{name}.py",) for name in _SAFETY},
    "robot_side/safety/gate.py": _GATE,
    "robot_side/safety/lease.py": (
        "tests/robot_side/safety/test_lease.py",
        "tests/robot_side/safety/test_gate_tokens.py",
    ),
    "robot_side/safety/states.py": _GATE,
    "robot_side/kinematics.py": ("tests/robot_side/test_kinematics.py",),
    "robot_side/driver/core.py": ("tests/robot_side/driver/test_core.py",),
    "robot_side/guardian/core.py": ("tests/robot_side/guardian/test_core.py",),
    "robot_side/network/core.py": ("tests/robot_side/network/test_core.py",),
    "robot_side/network/stream.py": ("tests/robot_side/network/test_credit.py",),
    "robot_side/network/bitrate_control.py": ("tests/robot_side/network/test_bitrate_control.py",),
    "robot_side/network/congestion_window.py": ("tests/robot_side/network/test_congestion_window.py",),
    "vision_side/serving/assignment.py": ("tests/vision_side/serving/test_assignment.py",),
    "vision_side/serving/sharing.py": ("tests/vision_side/serving/test_sharing_rules.py",),
    "vision_side/missions/switch.py": ("tests/vision_side/missions/test_switch.py",),
    "vision_side/missions/follow.py": ("tests/vision_side/missions/test_follow.py",),
    "vision_side/tracking/appearance.py": ("tests/vision_side/tracking/test_appearance.py",),
    "vision_side/tracking/locate.py": ("tests/vision_side/tracking/test_locate.py",),
    "vision_side/tracking/prediction.py": ("tests/vision_side/tracking/test_prediction.py",),
    "vision_side/tracking/track.py": ("tests/vision_side/tracking/test_track.py",),
    "vision_side/tracking/steering.py": (
        "tests/vision_side/tracking/test_search.py",
        "tests/vision_side/tracking/test_steer.py",
    ),
    "operator_side/client/requests.py": ("tests/operator_side/client/test_request_repetition.py",),
    "operator_side/teleop/control.py": ("tests/operator_side/teleop/test_ramp.py",),
    "evaluation/score/figures.py": ("tests/evaluation/score/test_bounds.py",),
    "protocol/text.py": ("tests/protocol/test_text_and_jpeg_boundaries.py",),
    "protocol/jpeg.py": ("tests/protocol/test_text_and_jpeg_boundaries.py",),
}
"""Each file under the gate, all of `safety/` among them, and the tables that must notice any change to it."""
PARTS = {
    "operator_side/teleop/control.py": ("Speeds", "SpeedUp", "_towards", "_STEP", "_LEAST_", "_RAMP_", "_FIRST_STEP_US",
                                        "_LONGEST_STEP_US"),
}
"""Of these files only the mutants inside these names, or of the constants that begin so. The rest decides nothing."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code: 0; 2 for an unknown commit; 5 if the tables fail, miss a branch or let a mutant live."""
    options = _options(arguments)
    if options.planted:
        return plant()
    try:
        files = [file for file in _selected(options.changed) if options.only in file]
    except ValueError as error:
        print("error:", error, file=sys.stderr)
        return 2
    if options.list:
        print(*(_line(mutant) for file in files for mutant in _mutants(file)), sep="\n")
        return 0
    if not files:
        return 0
    whole = [file for file in files if file not in PARTS]
    missing = uncovered(whole, sorted({table for file in files for table in TABLES[file]}))
    if missing:
        print(missing, "error: the tables fail or miss lines or branches (above); correct or extend them", sep="\n")
        return 5
    named = {name for name in equivalents(Path(EQUIVALENTS).read_text()) if name[0] in files}
    return _result(_run(files, named, options.jobs), named)


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--list", action="store_true", help="print the mutants and stop")
    parser.add_argument("--planted", action="store_true", help="plant the bugs of planted.toml instead, one by one")
    parser.add_argument("--only", default="", metavar="TEXT", help="only files whose path contains TEXT")
    parser.add_argument(
        "--changed",
        nargs="?",
        const="",
        metavar="BASE",
        help="only files that changed since BASE (default: newest tag, else origin/main, else HEAD~1)",
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="number of parallel trials")
    return parser.parse_args(arguments)


def _selected(commit: str | None) -> list[str]:
    if commit is None:
        return list(TABLES)
    files, base = select(TABLES, commit)
    if base is None:
        print("all files: the history is missing (no git, a shallow clone or a first commit)", file=sys.stderr)
    else:
        names = ", ".join(files) if files else "no file of the mutation gate"
        print(f"{names} changed since {base}", file=sys.stderr)
    return files


def _mutants(file: str) -> Iterator[Mutant]:
    source = Path(file).read_text()
    lines, parts = source.splitlines(), PARTS.get(file, ("",))
    for mutant in mutants(file, source):
        if (mutant.where.partition(".")[0] or lines[mutant.line - 1]).startswith(parts):
            yield mutant


def _run(files: Iterable[str], named: set[Name], jobs: int) -> dict[Mutant, Outcome]:
    began_s, outcomes = time.monotonic(), dict[Mutant, Outcome]()
    for file in files:
        file_began_s, found = time.monotonic(), list(_mutants(file))
        outcomes |= try_mutants(found, named, TABLES[file], jobs)
        print(f"{file}: {len(found)} mutants in {time.monotonic() - file_began_s:.0f} s", flush=True)
    counts = ", ".join(f"{count} {outcome.value}" for outcome, count in Counter(outcomes.values()).items())
    print(f"{len(outcomes)} mutants in {time.monotonic() - began_s:.0f} s: {counts}")
    return outcomes


def _result(outcomes: dict[Mutant, Outcome], named: set[Name]) -> int:
    survivors = [mutant for mutant, outcome in outcomes.items() if outcome is Outcome.SURVIVED]
    unexplained = [mutant for mutant in survivors if mutant.name not in named]
    # An equivalent that only computes more reaches the time limit on a slow machine.
    outdated = named - {mutant.name for mutant, outcome in outcomes.items() if outcome is not Outcome.KILLED}
    for mutant in unexplained:
        print("survived:", _line(mutant))
    for name in sorted(outdated):
        print("no survivor has this name, remove it from equivalents.toml:", *name)
    print(f"{len(survivors) - len(unexplained)} named equivalents, {len(unexplained)} unexplained survivors")
    return 5 if unexplained or outdated else 0


def _line(mutant: Mutant) -> str:
    nth = f" (nth = {mutant.nth})" if mutant.nth > 1 else ""
    return f"{mutant.file}:{mutant.line} {mutant.where}: `{mutant.before}` -> `{mutant.after}`{nth}"


if __name__ == "__main__":
    sys.exit(main())
