"""Try a file's mutants in a process that has collected its tables already: most die there, in a fraction of the time.

Only the code of a function can be exchanged there. A mutant of anything else, and one that no test notices there (the
collection may have called the function), needs a trial that begins with the import. Shell.
"""

import gc
import inspect
import json
import mmap
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import CodeType, FunctionType

import pytest

from tests.mutation.mutants import Mutant
from tests.mutation.trial import OPTIONS, Outcome, demand_not_imported, finish, fork, module_name, silence

_ALL_CPU_SECONDS = 600
_SLOT = 4
_Change = tuple[CodeType, CodeType]


def try_in_place(
    found: Sequence[Mutant], original: CodeType, suites: Sequence[str], jobs: int
) -> tuple[dict[Mutant, Outcome], list[str]]:
    """Return how those of one file's mutants end that do not survive, and the tests in the order to try them.

    `original` is the code of the file. Both are empty if the tests cannot be collected.

    Raises:
        RuntimeError: this process has imported the module, so no mutant of it would run.
    """
    file = found[0].file
    demand_not_imported(file)
    with tempfile.NamedTemporaryFile("r") as report:
        changes = [_changed(original, mutant.code) for mutant in found]

        def work() -> int:
            trials = _Trials(module_name(file), changes, jobs, Path(report.name))
            with silence():
                return int(pytest.main(["-x", *OPTIONS, *suites], plugins=[trials]))

        finish(fork(work, _ALL_CPU_SECONDS), time.monotonic(), _ALL_CPU_SECONDS)
        ends, order = json.loads(report.read() or "[{}, []]")
    return {found[int(number)]: Outcome(end) for number, end in ends.items()}, order


def _changed(original: CodeType, mutant: CodeType) -> _Change | None:
    """Return the one function that differs, before and after; None if anything else differs."""
    if original.co_flags & inspect.CO_OPTIMIZED:
        return original, mutant
    if _without_nested(original) != _without_nested(mutant):
        return None
    nested = zip(original.co_consts, mutant.co_consts, strict=True)
    (pair,) = (pair for pair in nested if pair[0] != pair[1])
    return _changed(*pair)


def _without_nested(code: CodeType) -> CodeType:
    return code.replace(co_consts=tuple(None if isinstance(value, CodeType) else value for value in code.co_consts))


class _Trials:
    """A plugin of pytest: after the collection, each change gets a fork of the session, where it meets the tests.

    The tests that failed for the latest changes come first, then the fast ones.
    """

    def __init__(self, module: str, changes: Sequence[_Change | None], jobs: int, report: Path) -> None:
        self._module = module
        self._changes = changes
        self._jobs = jobs
        self._report = report
        # Of each change the number of the test that failed for it, from 1; 0 if none did.
        self._killers = mmap.mmap(-1, len(changes) * _SLOT)
        self._items: list[pytest.Item] = []
        self._ends: dict[int, Outcome] = {}
        self._note: Callable[[int, pytest.TestReport], None] | None = None

    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        if self._note is not None:
            return None  # a trial runs its tests as usual
        self._items = list(session.items)
        self._sort_by_duration(session)
        functions = _functions(self._module)
        running: list[tuple[int, int, float]] = []
        for number, change in enumerate(self._changes):
            if change and change[0] in functions:
                pid = fork(partial(self._try, session, number, functions[change[0]], change[1]))
                running.append((number, pid, time.monotonic()))
            if running and len(running) >= self._jobs:
                self._finish(session, *running.pop(0))
        for trial in running:
            self._finish(session, *trial)
        ends = {number: outcome.value for number, outcome in self._ends.items()}
        self._report.write_text(json.dumps([ends, [item.nodeid for item in session.items]]))
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if self._note is not None:
            self._note(next(at for at, item in enumerate(self._items) if item.nodeid == report.nodeid), report)

    def _sort_by_duration(self, session: pytest.Session) -> None:
        with mmap.mmap(-1, len(self._items) * _SLOT) as durations_us:

            def note(at: int, report: pytest.TestReport) -> None:
                _set(durations_us, at, _get(durations_us, at) + int(report.duration * 1e6))

            finish(fork(lambda: self._run(session, note)), time.monotonic())
            of_item = {item: _get(durations_us, at) for at, item in enumerate(self._items)}
            session.items.sort(key=of_item.__getitem__)

    def _try(self, session: pytest.Session, number: int, functions: Sequence[FunctionType], code: CodeType) -> int:
        def note(at: int, report: pytest.TestReport) -> None:
            if report.failed:
                _set(self._killers, number, at + 1)

        for function in functions:
            function.__code__ = code
        return self._run(session, note)

    def _run(self, session: pytest.Session, note: Callable[[int, pytest.TestReport], None]) -> int:
        self._note = note
        session.config.hook.pytest_runtestloop(session=session)
        return 0

    def _finish(self, session: pytest.Session, number: int, pid: int, started_s: float) -> None:
        outcome, killer = finish(pid, started_s), _get(self._killers, number)
        if killer or outcome is Outcome.TIMEOUT:
            self._ends[number] = outcome
        if killer:
            item = self._items[killer - 1]
            session.items.remove(item)
            session.items.insert(0, item)


def _get(slots: mmap.mmap, at: int) -> int:
    return int.from_bytes(slots[at * _SLOT : (at + 1) * _SLOT], "little")


def _set(slots: mmap.mmap, at: int, value: int) -> None:
    slots[at * _SLOT : (at + 1) * _SLOT] = value.to_bytes(_SLOT, "little")


def _functions(module: str) -> Mapping[CodeType, list[FunctionType]]:
    gc.unfreeze()  # the collection of tests has hidden its objects from get_objects
    functions = defaultdict[CodeType, list[FunctionType]](list)
    for value in gc.get_objects():
        if isinstance(value, FunctionType) and value.__module__ == module:
            functions[value.__code__].append(value)
    gc.freeze()
    return functions
