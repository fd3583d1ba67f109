"""No order of events breaks a promise, and the exploration finds each planted bug. Each runs in a process of its own,
since the exploration replaces functions of modules by ones that remember their results."""

import re
import subprocess
import sys

import pytest

from tests.exploration.planted import bugs

pytestmark = pytest.mark.computes

QUICK = ("two drivers of equal rank", "the gate forgets STOP over a restart", "a repeated image counts as new")


def run(*arguments: str) -> tuple[int, str]:
    """Run a module; return its exit code and its last line, after all that it printed."""
    ran = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, check=False)
    print(ran.stdout, ran.stderr)
    return ran.returncode, ran.stdout.splitlines()[-1]


@pytest.mark.parametrize("row", bugs(), ids=lambda row: row[0].name)
def test_row_names_a_text_that_compiles_and_a_promise(row):
    bug, _, promise = row
    compile(bug.source, bug.file, "exec")
    assert promise


def test_there_are_twenty_bugs_of_all_files():
    names = {bug.name for bug, _, _ in bugs()}
    assert len(names) == len(bugs()) >= 20
    assert {bug.file.rpartition("/")[2] for bug, _, _ in bugs()} == {
        "gate.py", "lease.py", "limits.py", "persistence.py", "states.py", "validation.py"
    }


@pytest.mark.slow
def test_no_promise_breaks_in_fifty_thousand_states():
    code, last = run("tests.exploration", "--states", "10000", "--jobs", "1")
    assert (code, int(last.split()[0]) >= 50_000) == (0, True), last


@pytest.mark.slow
def test_quick_planted_bugs_are_found():
    assert run("tests.exploration.planted", *QUICK) == (0, "3 of 3 planted bugs are found")


@pytest.mark.long
def test_no_promise_breaks_in_a_million_states_within_four_minutes_of_one_core():
    code, last = run("tests.exploration")
    states, cpu_s = int(last.split()[0]), int(re.search(r"\((\d+) s of CPU", last)[1])
    assert (code, states >= 1_000_000, cpu_s < 240) == (0, True, True), last


@pytest.mark.long
def test_every_planted_bug_is_found():
    assert run("tests.exploration.planted") == (0, f"{len(bugs())} of {len(bugs())} planted bugs are found")
