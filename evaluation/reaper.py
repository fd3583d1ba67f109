"""Ends the processes and removes the folders of a program after its end, however it ended. Shell (processes).

    python -I -S reaper.py    lines on standard input: +PID, -PID, folder PATH

Standard input is a pipe whose other end only the program holds, so the kernel closes it even after SIGKILL. It imports
no module of Sightline, because every demo and bench starts this process. `processes.py` starts it.
"""

import os
import select
import shutil
import signal
import sys
import time
from contextlib import suppress

ENDS_WITHIN_S = 0.8
"""Time for all but the oldest process after SIGTERM. The oldest is the simulation, which the robot still needs."""
KILLED_AFTER_S = 1.2
"""Time from the end of the program to SIGKILL for each remaining process and its children.

On a busy machine a vision service does not end within this, and a killed process takes 0.5 s to end.
"""


class Reaper:
    """The processes and folders of one program, in the order of their start."""

    def __init__(self) -> None:
        self._running: dict[int, int] = {}
        self._folders: list[str] = []

    def note(self, line: str) -> None:
        """Apply one line of the program."""
        if line.startswith("folder "):
            self._folders.append(line.removeprefix("folder "))
        elif line.startswith("+"):
            with suppress(OSError):  # it has already ended
                pid = int(line)
                self._running[pid] = os.pidfd_open(pid)
        elif (pidfd := self._running.pop(-int(line), -1)) >= 0:
            os.close(pidfd)

    def end(self) -> None:
        """End the remaining processes, the oldest last, then remove the folders."""
        ended_s = time.monotonic()
        pids = list(self._running)
        for pid in pids[1:]:
            self._terminate(pid)
        self._wait(pids[1:], ended_s + ENDS_WITHIN_S)
        for pid in pids[:1]:
            self._terminate(pid)
        self._wait(pids, ended_s + KILLED_AFTER_S)
        for pid in pids:  # each leads a group; an ended one may have left a child
            with suppress(OSError):
                os.killpg(pid, signal.SIGKILL)
        for folder in self._folders:
            shutil.rmtree(folder, ignore_errors=True)

    def _terminate(self, pid: int) -> None:
        for number in (signal.SIGTERM, signal.SIGCONT):
            with suppress(OSError):
                signal.pidfd_send_signal(self._running[pid], number)

    def _wait(self, pids: list[int], deadline_s: float) -> None:
        """Wait until all of them have ended, or until the deadline."""
        left = [self._running[pid] for pid in pids]
        while left and (wait_s := deadline_s - time.monotonic()) > 0:
            ended, _, _ = select.select(left, [], [], wait_s)
            left = [one for one in left if one not in ended]


def main() -> None:
    """Follow the program until it ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    reaper = Reaper()
    for line in sys.stdin:
        reaper.note(line.rstrip("\n"))
    reaper.end()


if __name__ == "__main__":
    main()
