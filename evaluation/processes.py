"""Processes and worker pools that always end together, each process with its log. Shell."""

import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Final, Self

from sightline.protocol.errors import HardwareError
from sightline.protocol.log import LOG_FORMAT_VARIABLE, LOG_FORMATS


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """Convert SIGTERM to KeyboardInterrupt inside, as Ctrl-C does, so that all processes are ended."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


# Processes started together and ended together, each with its log. Shell.
#
# Waits are for facts (a printed line), never for time alone. Nothing is left running in any case.


COMMAND_LINE: Final = "sightline.operator_side.cli.app"
SIGHTLINE: Final = (sys.executable, "-P", "-m", COMMAND_LINE)
"""The command `sightline` of this environment. No file in the current folder can replace a package of it."""
READY_S: Final = 30.0
"""Time for one process to print that it is ready. A first start reads hundreds of megabytes from disk."""
_END_S: Final = 4.0
"""Time from SIGTERM to a kill. The robot takes up to 2 s to bring the wheels to zero."""
_POLL_S: Final = 0.02
_MARK: Final = re.compile(r"^(error: |\S+Z (info|warning|error) )")
_REAPER: Final = Path(__file__).with_name("reaper.py")


class ProcessError(HardwareError):
    """A process ended by itself, with an exit code that is passed on, or was not ready in time."""

    def __init__(self, text: str, code: int = 1) -> None:
        super().__init__(text)
        self.exit_code = code if code > 0 else 1


class Processes:
    """A context manager. Each process has its own session, so that Ctrl-C reaches only the process that starts them.

    However this program ends, within 2 s no process and no folder of `temporary_folder` is left.
    """

    def __init__(self, folder: Path, *, oldest_first: bool = False) -> None:
        """Start empty. With `oldest_first`, processes end in the order of their start."""
        self._folder = folder
        self._oldest_first = oldest_first
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._reaper: subprocess.Popen[bytes] | None = None

    def start(
        self, name: str, arguments: Sequence[str], *, module: str = COMMAND_LINE, namespace: str = "",
        environment: Mapping[str, str] | None = None,
    ) -> int:
        """Run `sightline ARGUMENTS`, or another module, inside a network namespace if one is named.

        Its output goes to `<name>.log` as text. Returns its process id.
        """
        entering = ["ip", "netns", "exec", namespace] if namespace else []
        with self.log(name).open("wb") as log:
            self._running[name] = subprocess.Popen(
                [*entering, sys.executable, "-u", "-P", "-m", module, *arguments],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
                env={**os.environ, LOG_FORMAT_VARIABLE: LOG_FORMATS[0], **(environment or {})},
            )
        self._note(f"+{self.pid(name)}")
        return self.pid(name)

    def temporary_folder(self) -> str:
        """Create a folder that is removed when these processes have ended."""
        folder = tempfile.mkdtemp(prefix="sightline-")
        self._note(f"folder {folder}")
        return folder

    def _note(self, line: str) -> None:
        """Send the reaper one line. The first line starts it."""
        if self._reaper is None:
            self._reaper = subprocess.Popen(
                [sys.executable, "-I", "-S", str(_REAPER)], stdin=subprocess.PIPE, bufsize=0, start_new_session=True,
            )
        assert self._reaper.stdin is not None
        with suppress(BrokenPipeError):  # it ended; the processes still end with this `with`
            self._reaper.stdin.write(line.encode() + b"\n")

    def log(self, name: str) -> Path:
        """Return the log of process `name`."""
        return self._folder / f"{name}.log"

    def pid(self, name: str) -> int:
        """Return the process id of `name`."""
        return self._running[name].pid

    def driver(self, name: str) -> int:
        """Return the process id of the driver process of robot `name`, or 0 without one. `name` is its guardian."""
        return driver_of(self.pid(name))

    def network(self, name: str) -> int:
        """Return the process id of the network process of robot `name`, or 0 without one."""
        return next(reversed(children_of(self.driver(name))), 0)

    def stop(self, name: str) -> int:
        """Return the process id of the STOP receiver of robot `name`, or the forwarder of a router; 0 without one."""
        return next((pid for pid in children_of(self.pid(name)) if _is_stop(pid)), 0)

    @property
    def names(self) -> list[str]:
        """Return the names of the started processes that were not ended here, the oldest first."""
        return list(self._running)

    def wait_line(self, name: str, text: str, timeout_s: float = READY_S) -> None:
        """Wait until a line of `name` contains `text`. Raises ProcessError if a process ends or it takes longer."""
        deadline_s = time.monotonic() + timeout_s
        while text not in self.log(name).read_text("utf-8", "replace"):
            self.check()
            if time.monotonic() > deadline_s:
                last = last_line(self.log(name))
                raise ProcessError(f"{name} is not ready after {timeout_s:g} s; its last line: {last}")
            time.sleep(_POLL_S)

    def check(self, wait_s: float = 0.0) -> None:
        """Raise ProcessError with its last output if a process has ended or ends within `wait_s`."""
        deadline_s = time.monotonic() + wait_s
        while True:
            for name, process in self._running.items():
                code = process.poll()
                if code is not None:
                    last = f"{last_line(self.log(name))}; its log is {self.log(name)}"
                    raise ProcessError(f"{name} ended by itself (exit code {code}): {last}", code)
            if time.monotonic() >= deadline_s:
                return
            time.sleep(_POLL_S)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process."""
        self._running[name].send_signal(number)

    def exit_code(self, name: str, timeout_s: float) -> int | None:
        """Wait for the end of a process. Returns its exit code, or None if it does not end in time."""
        try:
            code = self._running[name].wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        self._forget(name)
        return code

    def kill(self, name: str) -> None:
        """Kill a process with SIGKILL, and forget it."""
        process = self._running[name]
        process.kill()
        process.wait()
        self._forget(name)

    def _forget(self, name: str) -> None:
        self._note(f"-{self._running.pop(name).pid}")

    def end_one(self, name: str) -> bool:
        """End a process with SIGTERM, and forget it. Returns True if it had to be killed."""
        self.signal(name, signal.SIGTERM)
        if self.exit_code(name, _END_S) is not None:
            return False
        self.kill(name)
        return True

    def end(self) -> list[str]:
        """Continue stopped processes and end all in turn. Idempotent.

        The newest ends first, so that no process observes the end of another, or the oldest first, so that a robot
        writes its events before its peer ends. Returns the names of killed processes.
        """
        for name in self._running:
            self.signal(name, signal.SIGCONT)
        names = self.names if self._oldest_first else reversed(self.names)
        return [name for name in names if self.end_one(name)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        if self._reaper is not None:
            with self._reaper:  # closes its pipe and waits until it has removed the folders
                self._reaper = None


def children_of(pid: int) -> list[int]:
    """Return the process ids of the children of a main thread, the oldest first."""
    try:
        return [int(text) for text in Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii").split()]
    except OSError:  # it has ended
        return []


def driver_of(guardian: int) -> int:
    """Return the process id of the driver process of a guardian, or 0 without one: its child that receives no STOP."""
    with suppress(OSError):
        own = _command(guardian)
        for pid in reversed(children_of(guardian)):
            command = _command(pid)  # our own while it is a fork; no line after its end
            if command not in (b"", own) and not _is_stop(pid):
                return pid
    return 0


def _is_stop(pid: int) -> bool:
    """Return True for a STOP receiver or forwarder."""
    with suppress(OSError):
        return b"guardian.stop_" in _command(pid)
    return False


def is_running(pid: int) -> bool:
    """Return True unless the process has ended. A zombie has ended."""
    with suppress(OSError):
        return bool(_command(pid))
    return False


def _command(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()


def last_line(log: Path) -> str:
    """Return the error that ended a process, or else the last line of its log, without time, level and `error: `."""
    lines = [line for line in log.read_text("utf-8", "replace").splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]  # a traceback may follow
    return _MARK.sub("", (errors or lines)[-1]) if lines else "nothing"


def free_port() -> int:
    """Return a free port on loopback. The next port is free too."""
    while True:
        with socket.socket() as probe, socket.socket() as next_probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
            try:
                next_probe.bind(("127.0.0.1", port + 1))
            except (OSError, OverflowError):
                continue
            return port


# Work on several processes that ends on request. Shell (processes).


@contextmanager
def worker_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Run a pool of `jobs` workers within the context. On an error, queued work never starts; a plain pool
    would do all of it first. Ctrl-C at the terminal reaches every process and ends them immediately.

    Workers are spawned, since a fork would share PyBullet's state. Raises HardwareError if one is ended from outside.
    """
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _begin_worker) as pool:
        try:
            yield pool
        except BrokenProcessPool:
            fewer = "; --jobs 1 needs less of it" if jobs > 1 else ""
            ended = f"a worker (of {jobs}) was ended from outside, perhaps as memory ran out{fewer}"
            raise HardwareError(ended) from None
        except BaseException:
            pool.shutdown(cancel_futures=True)  # waits; the exit of the pool would undo the cancellation
            raise


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # an exception would end only the present work and start the next
    threading.Thread(target=_end_with_parent, name="parent's end", daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # the queue of a dead parent never closes, because each worker holds both of its ends
