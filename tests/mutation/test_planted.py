"""The table of planted bugs, and that each one fails its own test and no other."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mutation import planted
from tests.mutation.planted import Bug, bugs


@pytest.mark.parametrize("bug", bugs(), ids=lambda bug: bug.name)
def test_row_names_a_text_that_compiles_and_a_test_that_exists(bug):
    compile(bug.source, bug.file, "exec")
    file, _, name = bug.test.partition("::")
    assert name in {node.name for node in ast.parse(Path(file).read_text()).body if isinstance(node, ast.FunctionDef)}


def test_each_bug_has_a_test_of_its_own():
    tests = [bug.test for bug in bugs()]
    assert len(set(tests)) == len(tests) == 13


def test_row_whose_text_is_gone_is_one_clear_line(monkeypatch, capsys):
    row = Bug("a bug", "sightline/__init__.py", "no such text", "", "tests/mutation/test_planted.py::test_x")
    monkeypatch.setattr(planted, "bugs", lambda: [row])
    assert planted.main() == 5
    output = capsys.readouterr()
    assert output.err == (
        "error: tests/mutation/planted.toml: 'a bug': sightline/__init__.py has the text 0 times; correct the row\n"
    )
    assert output.out.startswith("0 of 1 planted bugs")


@pytest.mark.slow
def test_every_planted_bug_fails_exactly_its_test():
    command = [sys.executable, "-m", "tests.mutation", "--planted"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout.splitlines()[-1]) == (
        0, "13 of 13 planted bugs fail exactly the test that is named for them"
    ), ran.stdout + ran.stderr
