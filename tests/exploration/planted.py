"""`python -m tests.exploration.planted` plants each bug of planted.toml, and demands that the exploration finds it."""

import os
import sys
import tempfile
import tomllib
from pathlib import Path

from tests.mutation.planted import Bug
from tests.mutation.trial import fork, install

PLANTED = Path(__file__).with_name("planted.toml")
_STATES, _CPU_SECONDS = 150_000, 300


def bugs() -> list[tuple[Bug, str, str]]:
    """Return each bug with the part that finds it, and the promise that it breaks."""
    rows = tomllib.loads(PLANTED.read_text())["bug"]
    return [(Bug(row["name"], row["file"], row["before"], row["after"], ""), row["part"], row["promise"]) for row in rows]


def found(bug: Bug, part: str) -> list[str]:
    """Return the promise that breaks with the bug in place, and the events that lead there; nothing if it holds."""
    code = compile(bug.source, bug.file, "exec")
    with tempfile.NamedTemporaryFile("r") as report:

        def run() -> int:
            install(bug.file, code)
            from tests.exploration.search import explore

            result = explore(part, _STATES)
            Path(report.name).write_text("\n".join([result.promise, *result.words, str(result.states)]))
            return 0

        os.waitpid(fork(run, bug.file, _CPU_SECONDS), 0)
        return report.read().splitlines()


def main() -> int:
    """Return the exit code: 0, or 5 if the exploration does not print the promise of a bug."""
    rows, caught = bugs(), 0
    for bug, part, promise in rows:
        lines = found(bug, part)
        right = lines[:1] == [promise]
        caught += right
        print("found:" if right else "NOT found as expected:", bug.name, flush=True)
        for line in lines:
            print("   ", line, flush=True)
    print(f"{caught} of {len(rows)} planted bugs are found")
    return 0 if caught == len(rows) else 5


if __name__ == "__main__":
    sys.exit(main())
