"""The processes of one contestant of `bench loop`: started, waited for by what they print, ended. Shell (processes)."""

import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from sightline.protocol.errors import HardwareError

READY_S: Final = 20.0
_END_S: Final = 4.0
_POLL_S: Final = 0.02


class BenchProcesses:
    """Use it in a `with`; whatever happens, nothing is left running."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, module: str, *arguments: str, namespace: str = "") -> int:
        """Run `python -m MODULE ARGUMENTS`, its output going to `<name>.log`; returns its process id.

        In a network `namespace` if one is named.
        """
        entering = ["ip", "netns", "exec", namespace] if namespace else []
        command = [*entering, sys.executable, "-P", "-u", "-m", module, *arguments]
        with self._log(name).open("wb") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        self._running[name] = process
        return process.pid

    def wait_line(self, name: str, text: str) -> None:
        """Wait until `name` has printed `text`. Raises HardwareError if one ends or it takes over 20 s."""
        deadline_s = time.monotonic() + READY_S
        while text not in self._log(name).read_text("utf-8", "replace"):
            self.check()
            if time.monotonic() > deadline_s:
                raise HardwareError(f"{name} is not ready within {READY_S:g} s; it said: {self._last_words(name)}")
            time.sleep(_POLL_S)

    def check(self) -> None:
        """Raise HardwareError, with its last words, if a process has ended."""
        for name, process in self._running.items():
            if process.poll() is not None:
                raise HardwareError(f"{name} ended by itself ({process.returncode}): {self._last_words(name)}")

    def wake(self) -> None:
        """Let a process that was stopped run again, so that it can end."""
        for process in self._running.values():
            process.send_signal(signal.SIGCONT)

    def end(self) -> None:
        """End one after the other, the oldest first: a robot keeps its notes before its peer vanishes. Idempotent."""
        for process in self._running.values():
            process.terminate()
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._running.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.wake()
        self.end()

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _last_words(self, name: str) -> str:
        lines: Sequence[str] = self._log(name).read_text("utf-8", "replace").split("\n")
        return next((line for line in reversed(lines) if line.strip()), "nothing").removeprefix("error: ")
