"""Runs the boundary tables against one mutant, in a forked child with bounded time and memory. Shell."""

import contextlib
import importlib
import os
import resource
import signal
import sys
import time
import types
from collections.abc import Sequence
from enum import Enum
from pathlib import Path

import pytest

# Loaded once here, shared by all children; it imports no judged file, or no mutant of that file would ever run.
import sightline.protocol.messages  # noqa: F401
from tests.mutation.mutants import Mutant

_CPU_SECONDS = 5  # a table takes well under one; a mutant that loops for ever is ended here
_WALL_SECONDS = 60.0
_MEMORY_BYTES = 4 << 30


class Outcome(Enum):
    """What became of a mutant."""

    SURVIVED = "survived"
    KILLED = "killed"
    TIMEOUT = "ran into the time limit"


def module_name(file: str) -> str:
    """The dotted name of a file of the repository."""
    return "sightline." + file.removesuffix(".py").replace("/", ".")


def start(mutant: Mutant, suites: Sequence[str]) -> int:
    """Fork a child that runs `suites` with `mutant` in place; return its pid.

    Raises RuntimeError if the mutant's module is imported here already: every trial would then end as if killed.
    """
    if module_name(mutant.file) in sys.modules:
        raise RuntimeError(f"{mutant.file} was imported before its mutants; see what imports it in this process")
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        _bound()
        status = _run(mutant, suites)
    finally:
        os._exit(status)  # never return into the parent's code, whatever the mutant raised


def finish(pid: int, started_s: float) -> Outcome:
    """Wait for a child of `start`, which began at `started_s` (time.monotonic)."""
    while True:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            break
        if time.monotonic() - started_s > _WALL_SECONDS:
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.005)
    if os.WIFSIGNALED(status):
        return Outcome.TIMEOUT
    return Outcome.KILLED if os.waitstatus_to_exitcode(status) else Outcome.SURVIVED


def _bound() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (_CPU_SECONDS, _CPU_SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _run(mutant: Mutant, suites: Sequence[str]) -> int:
    with (
        Path(os.devnull).open("w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        try:
            _install(mutant)
            options = ["-x", "-q", "--tb=no", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:hypothesispytest"]
            return int(pytest.main([*options, *suites]))
        except BaseException:  # a mutant may raise anything at import; that is noticed, so killed
            return 1


def _install(mutant: Mutant) -> None:
    """Let the mutant be what every later import of its module finds."""
    name = module_name(mutant.file)
    module = types.ModuleType(name)
    module.__file__ = str(Path(mutant.file).resolve())
    sys.modules[name] = module
    exec(mutant.code, module.__dict__)
    parent, _, leaf = name.rpartition(".")
    setattr(importlib.import_module(parent), leaf, module)
