"""Processes and worker pools that end together whatever happens, each process with its log. Shell."""

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Final, Self

from sightline.protocol.errors import HardwareError, SightlineError
from sightline.protocol.log import LOG_FORMAT_VARIABLE, LOG_FORMATS


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM raises KeyboardInterrupt inside, as Ctrl-C does, so that whoever is running is ended."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


# Sightline processes started together and ended together, each with its log. Shell.
#
# Waits are for facts (a printed line), never for time alone; whatever happens, nothing is left behind.


END_S: Final = 4.0
"""A process that has not ended this long after SIGTERM is killed; the robot takes up to 2 s to bring wheels to zero."""
_POLL_S = 0.02


class ProcessError(SightlineError):
    """A process ended by itself; the text is its last word and the exit code its own."""

    def __init__(self, name: str, code: int, log: Path) -> None:
        super().__init__(f"{name} ended by itself (exit code {code}): {last_line(log)}; its log is {log}")
        self.exit_code = code if code > 0 else 1


class Processes:
    """Use it in a `with`. Each process leads a session of its own, so that Ctrl-C reaches only who starts them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """Run `sightline ARGUMENTS`, its output going to `<name>.log`, as text: who starts them reads it."""
        command = [sys.executable, "-u", "-P", "-m", "sightline.operator_side.cli.app", *arguments]
        with self.log(name).open("wb") as log:
            self._running[name] = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
                env={**os.environ, LOG_FORMAT_VARIABLE: LOG_FORMATS[0]},
            )

    def log(self, name: str) -> Path:
        """Where `name` writes."""
        return self._folder / f"{name}.log"

    def pid(self, name: str) -> int:
        """The process id of `name`."""
        return self._running[name].pid

    def wait_line(self, name: str, text: str, timeout_s: float) -> None:
        """Wait until a line of `name` contains `text`. Raises SightlineError if one ends or it takes longer."""
        deadline_s = time.monotonic() + timeout_s
        while text not in self.log(name).read_text("utf-8", "replace"):
            self.check()
            if time.monotonic() > deadline_s:
                last = last_line(self.log(name))
                raise SightlineError(f"{name} is not ready within {timeout_s:g} s; it last said: {last}")
            time.sleep(_POLL_S)

    def check(self, wait_s: float = 0.0) -> None:
        """Raise ProcessError if one has ended, or does so within `wait_s`."""
        deadline_s = time.monotonic() + wait_s
        while True:
            for name, process in self._running.items():
                code = process.poll()
                if code is not None:
                    raise ProcessError(name, code, self.log(name))
            if time.monotonic() >= deadline_s:
                return
            time.sleep(_POLL_S)

    def end(self) -> list[str]:
        """End one after the other, the newest first, so that nobody sees another vanish; idempotent.

        Returns the names of those that had to be killed.
        """
        killed = []
        for name, process in reversed(self._running.items()):
            process.terminate()
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                killed.append(name)
        self._running.clear()
        return killed

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()


def last_line(log: Path) -> str:
    """The last line of a log, without `error: `."""
    lines = [line for line in log.read_text("utf-8", "replace").splitlines() if line.strip()]
    return lines[-1].removeprefix("error: ") if lines else "nothing"


def free_port() -> int:
    """A port on loopback on which nothing listens, and nothing on the next one."""
    while True:
        with socket.socket() as probe, socket.socket() as next_probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
            try:
                next_probe.bind(("127.0.0.1", port + 1))
            except (OSError, OverflowError):
                continue
            return port


# Work on several processes that ends when it is told to. Shell (processes).


@contextmanager
def worker_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """So many, for as long as the context lasts. Left by an error, what has not begun never does: a pool by itself
    would first do all of it. Ctrl-C at the terminal, which every process hears, ends them at once.

    Spawned, since a forked child would share PyBullet's state. Raises HardwareError when something else ends one.
    """
    at_once = (signal.SIGINT, signal.SIG_DFL)  # an exception would only end what each does now, and begin the next
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), signal.signal, at_once) as pool:
        try:
            yield pool
        except BrokenProcessPool:
            fewer = "; --jobs 1 needs less of it" if jobs > 1 else ""
            said = f"a worker (of {jobs}) was ended from outside, perhaps as memory ran out{fewer}"
            raise HardwareError(said) from None
        except BaseException:
            pool.shutdown(cancel_futures=True)  # waits: the pool's own end would take it back
            raise
