"""Plant each bug of `planted.toml`, and demand that of all tests named there exactly its own fails. Shell."""

import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.mutation.trial import OPTIONS, demand_not_imported, finish, fork, install, silence

PLANTED = "tests/mutation/planted.toml"
# The tests of all bugs together. They import the transports, NumPy and OpenCV.
_CPU_SECONDS = 30


@dataclass(frozen=True, slots=True)
class Bug:
    """In `file`, the text `before` becomes `after`, and `test` must fail."""

    name: str
    file: str
    before: str
    after: str
    test: str

    @property
    def source(self) -> str:
        """Return the file with the bug.

        Raises:
            ValueError: the file does not have the text exactly once.
        """
        text = Path(self.file).read_text()
        if (found := text.count(self.before)) != 1:
            raise ValueError(f"{PLANTED}: '{self.name}': {self.file} has the text {found} times; correct the row")
        return text.replace(self.before, self.after)


def bugs() -> list[Bug]:
    """Read the table."""
    return [Bug(**row) for row in tomllib.loads(Path(PLANTED).read_text())["bug"]]


def main() -> int:
    """Return the exit code: 0, or 5 if a bug passes its test, fails another test, or cannot be planted."""
    rows, caught = bugs(), 0
    for bug in rows:
        try:
            failed = _failed(bug, [row.test for row in rows])
        except ValueError as error:
            print("error:", error, file=sys.stderr)
            continue
        caught += failed == {bug.test}
        print("caught by its test:" if failed == {bug.test} else "NOT caught by exactly its test:", bug.name)
        for test in sorted(failed ^ {bug.test}):
            print("   fails:" if test in failed else "   passes:", test)
    print(f"{caught} of {len(rows)} planted bugs fail exactly the test that is named for them")
    return 0 if caught == len(rows) else 5


def _failed(bug: Bug, tests: Sequence[str]) -> set[str]:
    """Return the tests that fail with the bug in place, without their parameters."""
    code = compile(bug.source, bug.file, "exec")
    with tempfile.NamedTemporaryFile("r") as report:

        def run() -> int:
            with silence():
                install(bug.file, code)
                pytest.main([*OPTIONS, *tests], plugins=[_Failures(report.name)])
            return 0

        demand_not_imported(bug.file)
        finish(fork(run, _CPU_SECONDS), time.monotonic())
        lines = report.read().splitlines()
    if lines[-1:] != ["end"]:
        raise ValueError(f"{PLANTED}: '{bug.name}': the tests did not run to their end; run them without the bug first")
    return set(lines[:-1])


class _Failures:
    """Writes the failed tests to a file, and "end" when all have run."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._failed: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._failed.add(report.nodeid.partition("[")[0])

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        if exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            Path(self._path).write_text("\n".join([*sorted(self._failed), "end"]))
