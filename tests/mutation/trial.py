"""Run tests: tables once for coverage, then against each mutant or planted bug in a forked child with bounds. Shell."""

import contextlib
import importlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import types
from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from pathlib import Path

import cv2  # noqa: F401
import hypothesis  # noqa: F401
import numpy  # noqa: F401

# All children share what is loaded here. It imports no file that has mutants, or no mutant of that file would run.
import sightline.protocol.messages  # noqa: F401

# A table takes about one second of CPU. The bounds end a mutant that loops or allocates without end.
CPU_SECONDS = 20
_WALL_SECONDS = 120.0
_MEMORY_BYTES = 4 << 30
OPTIONS = ("-q", "--tb=no", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:hypothesispytest")
"""Options of pytest in each child."""


class Outcome(Enum):
    """The end of a trial."""

    SURVIVED = "survived"
    KILLED = "killed"
    TIMEOUT = "reached the time limit"


def module_name(file: str) -> str:
    """Return the dotted name of a file of the repository."""
    return "sightline." + file.removesuffix(".py").replace("/", ".")


def uncovered(files: Iterable[str], suites: Iterable[str]) -> str:
    """Return the report on lines and branches of `files` that `suites` miss, or on their failure; "" if all is well.

    Without files only a failure counts.
    """
    files = list(files)
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "COVERAGE_FILE": str(Path(folder, "data"))}
        include = "--include=" + ",".join(files)
        run = ("run", "--branch", include, "-m", "pytest", "-q", "-p", "no:cacheprovider", *suites)
        report = ("report", include, "--show-missing", "--skip-covered", "--fail-under=100", "--precision=2")
        for command in (run, report) if files else (run,):
            coverage = [sys.executable, "-m", "coverage", *command]
            ran = subprocess.run(coverage, env=environment, capture_output=True, text=True, check=False)
            if ran.returncode:
                return ran.stdout + ran.stderr
    return ""


def demand_not_imported(file: str) -> None:
    """Raise RuntimeError if this process has imported the module of `file`: a change of it would not be noticed."""
    if module_name(file) in sys.modules:
        raise RuntimeError(f"{file} was imported before its mutants; find its importer in this process")


def fork(work: Callable[[], int], cpu_seconds: int = CPU_SECONDS) -> int:
    """Fork a child that exits with the result of `work`; return its pid."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_seconds, cpu_seconds))
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        status = work()
    finally:
        os._exit(status)  # the child never returns into the parent's code, whatever the mutant raised


def finish(pid: int, started_s: float, wall_seconds: float = _WALL_SECONDS) -> Outcome:
    """Wait for a child of `fork`, which began at `started_s` (time.monotonic); it ends after `wall_seconds`."""
    while True:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            break
        if time.monotonic() - started_s > wall_seconds:
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.005)
    if os.WIFSIGNALED(status):
        return Outcome.TIMEOUT
    return Outcome.KILLED if os.waitstatus_to_exitcode(status) else Outcome.SURVIVED


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Discard what is printed."""
    with (
        Path(os.devnull).open("w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        yield


def install(file: str, code: types.CodeType) -> None:
    """Put `code` in place of `file`, where every later import of its module finds it."""
    name = module_name(file)
    module = types.ModuleType(name)
    module.__file__ = str(Path(file).resolve())
    sys.modules[name] = module
    exec(code, module.__dict__)
    parent, _, leaf = name.rpartition(".")
    setattr(importlib.import_module(parent), leaf, module)
