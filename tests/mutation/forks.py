"""Try the mutants of a file in forks of a process that has started pytest. Shell.

Most mutants change the code of one function. They exchange it in a fork that has collected the tests, too. A mutant of
anything else, and one that no test notices there (the collection may have called the function), gets a fork from before
the first import of its module.
"""

import gc
import inspect
import json
import mmap
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import CodeType, FunctionType

import pytest

from tests.mutation.mutants import Mutant, Name
from tests.mutation.trial import (
    CPU_SECONDS,
    OPTIONS,
    Outcome,
    demand_not_imported,
    finish,
    fork,
    install,
    module_name,
    silence,
)

_ALL_CPU_SECONDS = 600
_SLOT = 4
_Change = tuple[CodeType, CodeType]


def try_mutants(
    found: Sequence[Mutant], equivalent: Collection[Name], suites: Sequence[str], jobs: int
) -> dict[Mutant, Outcome]:
    """Return how each mutant of one file ends. Those in `equivalent` are expected to survive.

    Raises:
        RuntimeError: this process has imported the module, so no mutant of it would run; or the tests do not start.
    """
    file = found[0].file
    demand_not_imported(file)
    original = compile(Path(file).read_text(), file, "exec")
    changes = [None if mutant.name in equivalent else _changed(original, mutant.code) for mutant in found]
    ends, order = _session(_Collected(changes, module_name(file), jobs), suites)
    rest = [mutant for mutant, end in zip(found, ends, strict=True) if end is None]
    others, _ = _session(_NotCollected(rest, order, jobs), suites)
    later = iter(others)
    return {mutant: Outcome(end or next(later)) for mutant, end in zip(found, ends, strict=True)}


def _session(plugin: "_Forks", suites: Sequence[str]) -> tuple[list[str | None], list[str]]:
    """Run pytest with `plugin` in a child; return the end of each trial, and the tests in the order of the trials."""
    with tempfile.NamedTemporaryFile("r") as report:
        plugin.report = Path(report.name)

        def work() -> int:
            with silence():
                return int(pytest.main(["-x", *OPTIONS, *suites], plugins=[plugin]))

        finish(fork(work, _ALL_CPU_SECONDS), time.monotonic(), _ALL_CPU_SECONDS)
        if text := report.read():
            ends, order = json.loads(text)
            return ends, order
    what = f"did not start, fail, or need more than {CPU_SECONDS // 4} s of CPU"
    raise RuntimeError(f"the tests {what}: {' '.join(suites)}")


class _Forks:
    """A plugin of pytest whose session forks for each trial. A trial runs its tests as usual."""

    report: Path

    def __init__(self, count: int, jobs: int) -> None:
        self._jobs = jobs
        self._is_trial = False
        self._ends: list[Outcome | None] = [None] * count

    def _try_all(self, trials: Iterable[tuple[int, Callable[[], int]]], session: pytest.Session) -> None:
        running: list[tuple[int, int, float]] = []
        for number, work in trials:
            running.append((number, fork(work), time.monotonic()))
            if len(running) >= self._jobs:
                self._finish(session, *running.pop(0))
        for trial in running:
            self._finish(session, *trial)
        ends = [end and end.value for end in self._ends]
        self.report.write_text(json.dumps([ends, [item.nodeid for item in session.items]]))

    def _finish(self, session: pytest.Session, number: int, pid: int, started_s: float) -> None:
        self._ends[number] = finish(pid, started_s)


class _NotCollected(_Forks):
    """The mutant is in place before the tests are collected, which run in the `order` of their names."""

    def __init__(self, found: Sequence[Mutant], order: Sequence[str], jobs: int) -> None:
        super().__init__(len(found), jobs)
        self._found = found
        self._rank = {name: rank for rank, name in enumerate(order)}

    def pytest_collection(self, session: pytest.Session) -> bool | None:
        if self._is_trial:
            return None
        self._try_all(((number, partial(self._try, session, one)) for number, one in enumerate(self._found)), session)
        return True

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: self._rank.get(item.nodeid, len(self._rank)))

    def _try(self, session: pytest.Session, mutant: Mutant) -> int:
        self._is_trial = True
        install(mutant.file, mutant.code)
        session.config.hook.pytest_collection(session=session)
        session.config.hook.pytest_runtestloop(session=session)
        return 0


class _Collected(_Forks):
    """A change meets the tests that failed for the latest changes, then the fast ones."""

    def __init__(self, changes: Sequence[_Change | None], module: str, jobs: int) -> None:
        super().__init__(len(changes), jobs)
        self._changes = changes
        self._module = module
        # Of each change the number of the test that failed for it, from 1; 0 if none did.
        self._killers = mmap.mmap(-1, len(changes) * _SLOT)
        self._items: list[pytest.Item] = []
        self._note: Callable[[int, pytest.TestReport], None]

    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        if self._is_trial:
            return None
        self._items = list(session.items)
        self._sort_by_duration(session)
        functions = _functions(self._module)
        self._try_all((
            (number, partial(self._try, session, number, functions[change[0]], change[1]))
            for number, change in enumerate(self._changes) if change and change[0] in functions
        ), session)  # fmt: skip
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._note(next(at for at, item in enumerate(self._items) if item.nodeid == report.nodeid), report)

    def _sort_by_duration(self, session: pytest.Session) -> None:
        with mmap.mmap(-1, len(self._items) * _SLOT) as durations_us:

            def note(at: int, report: pytest.TestReport) -> None:
                _set(durations_us, at, _get(durations_us, at) + int(report.duration * 1e6))

            # A quarter of the time of a trial, or a mutant that only computes more would count as killed.
            unchanged = finish(fork(lambda: self._run(session, note), CPU_SECONDS // 4), time.monotonic())
            if unchanged is not Outcome.SURVIVED:
                raise RuntimeError(f"the unchanged tests {unchanged.value}")
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
        self._is_trial, self._note = True, note
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


def _functions(module: str) -> Mapping[CodeType, list[FunctionType]]:
    gc.unfreeze()  # the collection of tests has hidden its objects from get_objects
    functions = defaultdict[CodeType, list[FunctionType]](list)
    for value in gc.get_objects():
        if isinstance(value, FunctionType) and value.__module__ == module:
            functions[value.__code__].append(value)
    gc.freeze()
    return functions


def _get(slots: mmap.mmap, at: int) -> int:
    return int.from_bytes(slots[at * _SLOT : (at + 1) * _SLOT], "little")


def _set(slots: mmap.mmap, at: int, value: int) -> None:
    slots[at * _SLOT : (at + 1) * _SLOT] = value.to_bytes(_SLOT, "little")
