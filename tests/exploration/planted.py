"""`python -m tests.exploration.planted` plants each bug of planted.toml, and demands that the exploration finds it.

With arguments it plants only the bugs whose names contain one of them.
"""

import os
import sys
import tempfile
import tomllib
from pathlib import Path

from tests.mutation.planted import Bug
from tests.mutation.trial import demand_not_imported, fork, install

PLANTED = Path(__file__).with_name("planted.toml")
_STATES, _CPU_SECONDS = 20_000, 60


def bugs() -> list[tuple[Bug, str, str]]:
    """Return each bug with the part that finds it, and the promise that it breaks."""
    rows = tomllib.loads(PLANTED.read_text())["bug"]
    texts = ("name", "file", "before", "after")
    return [(Bug(*(row[text] for text in texts), test=""), row["part"], row["promise"]) for row in rows]


def found(bug: Bug, part: str) -> list[str]:
    """Return the promise that breaks with the bug in place, and the events that lead there; nothing if it holds."""
    code = compile(bug.source, bug.file, "exec")
    with tempfile.NamedTemporaryFile("r") as report:

        def run() -> int:
            install(bug.file, code)
            from tests.exploration.search import explore

            result = explore(part, _STATES)
            Path(report.name).write_text("\n".join([result.promise, *result.words, str(len(result.states))]))
            return 0

        demand_not_imported(bug.file)
        os.waitpid(fork(run, _CPU_SECONDS), 0)
        return report.read().splitlines()


def main() -> int:
    """Return the exit code: 0, or 5 if the exploration does not print the promise of a bug."""
    rows = [row for row in bugs() if not sys.argv[1:] or any(words in row[0].name for words in sys.argv[1:])]
    caught = 0
    for bug, part, promise in rows:
        lines = found(bug, part)
        right = lines[:1] == [promise]
        caught += right
        print("found:" if right else "NOT found as expected:", bug.name, flush=True)
        for line in lines if not right else ():
            print("   ", line, flush=True)
    print(f"{caught} of {len(rows)} planted bugs are found")
    return 0 if rows and caught == len(rows) else 5


if __name__ == "__main__":
    sys.exit(main())
