"""The bench's processes: as `Processes`, and started in namespaces, signalled, killed and looked into. Shell."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from sightline.operator_side.processes import END_S, Processes

COMMAND_LINE: Final = "sightline.operator_side.cli.app"
_RESIDENT: Final = "RssAnon:"


class Fleet(Processes):
    """Processes that may be hurt; all are brought down at the end, hurt or not."""

    def run(
        self, name: str, module: str, arguments: Sequence[str], *, namespace: str = "",
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Start `python -m MODULE ARGUMENTS` as `name`, inside a network namespace if one is named."""
        entering = ["ip", "netns", "exec", namespace] if namespace else []
        with self.log(name).open("ab") as log:
            self._running[name] = subprocess.Popen(
                [*entering, sys.executable, "-u", "-m", module, *arguments],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
                env={**os.environ, **(environment or {})},
            )

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal."""
        self._running[name].send_signal(number)

    def kill(self, name: str) -> None:
        """SIGKILL, and forget it."""
        process = self._running.pop(name)
        process.kill()
        process.wait()

    def end_one(self, name: str) -> None:
        """SIGTERM, and forget it."""
        self._running[name].terminate()
        if self.exit_code(name, END_S) is None:
            self.kill(name)

    def exit_code(self, name: str, timeout_s: float) -> int | None:
        """Its exit code once it has ended, None if it does not in time; an ended one is forgotten."""
        try:
            code = self._running[name].wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        del self._running[name]
        return code

    def child(self, name: str) -> int:
        """The newest child's process id; 0 without one."""
        pid = self.pid(name)
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii").split()
        return int(children[-1]) if children else 0

    def memory_kib(self, names: Iterable[str]) -> dict[tuple[str, bool], int]:
        """Memory that each of these that runs holds for itself, and (True) its child: one started anew counts as it."""
        running = self._running.keys() & names
        pids = {(name, is_child): self.child(name) if is_child else self.pid(name)
                for name in running for is_child in (False, True)}
        return {who: held for who, pid in pids.items() if pid and (held := _resident_kib(pid)) is not None}

    def end(self) -> list[str]:
        """As `Processes.end`, after waking whoever is stopped."""
        for process in self._running.values():
            with suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
        return super().end()


def _resident_kib(pid: int) -> int | None:
    try:
        lines = Path(f"/proc/{pid}/status").read_text("ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) for line in lines if line.startswith(_RESIDENT)), None)


def raise_priority(pid: int) -> bool:
    """Real-time scheduling for every thread of a process, where this user may; whether it was granted."""
    try:
        for thread in Path(f"/proc/{pid}/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(1))
    except OSError:
        return False
    return True
