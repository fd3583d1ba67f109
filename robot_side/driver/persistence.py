"""The STOP latch on disk, and the threads that write latch and log lines without blocking the loop. Shell."""

import errno
import os
import queue
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from sightline.protocol.errors import ConfigError

_NO_SYNC: Final = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)  # of a folder, on some file systems in user space


class StopLatch:
    """A mark per robot: there while it is STOPPED."""

    def __init__(self, directory: Path, robot: str) -> None:
        self._path = directory.expanduser() / f"{robot}.stopped"
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"state_dir {directory}: {error.strerror}; choose a writable directory") from None

    def is_set(self) -> bool:
        """Whether the robot was STOPPED when it last ran."""
        return self._path.exists()

    def keep(self, stopped: bool) -> None:
        """Write or remove the mark; once this returns not even a power cut changes it. May wait for the disk."""
        if stopped:
            with self._path.open("ab") as mark:
                os.fsync(mark.fileno())
        else:
            self._path.unlink(missing_ok=True)
        self._sync_folder()

    def _sync_folder(self) -> None:
        """The mark is an entry in its folder, which is not written with the file."""
        folder = os.open(self._path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        except OSError as error:
            if error.errno not in _NO_SYNC:
                raise
        finally:
            os.close(folder)


# Disk and terminal for the driver's loop, on threads of their own: neither may hold the wheels up. Shell.
#
# A full disk, a terminal that hung up or a reader that does not read costs a line or a mark, never a tick.


_LINES_WAITING: Final = 32
_RETRY_S: Final = 0.5
_CLOSE_S: Final = 1.0
_STACK_BYTES: Final = 256 * 1024


class BackgroundWriter:
    """Prints lines, and keeps the STOP latch as it was last wanted: a level, tried again until it is kept.

    Each on a thread of its own, so that a terminal that nobody reads does not hold up the mark.
    """

    def __init__(self, latch: StopLatch) -> None:
        self._latch = latch
        self._wanted = latch.is_set()
        self._kept: bool | None = self._wanted
        """What is on disk; None where that is not known: a write failed half-way."""
        self._asked = threading.Event()
        self._lines: queue.Queue[str] = queue.Queue(_LINES_WAITING)
        self._closing = False
        threading.stack_size(_STACK_BYTES)  # the driver locks its memory, a stack of the usual 8 MB with it
        self._keeper = threading.Thread(target=self._keep_all, name="latch", daemon=True)
        self._printer = threading.Thread(target=self._print_all, name="scribe", daemon=True)
        self._keeper.start()
        self._printer.start()

    def keep(self, stopped: bool) -> None:
        """Want the latch so; never waits."""
        self._wanted = stopped
        self._asked.set()

    def say(self, line: str) -> None:
        """Print `line` soon; dropped when nobody has read for long. An empty line only wakes the thread."""
        with suppress(queue.Full):
            self._lines.put_nowait(line)

    def close(self) -> None:
        """Write what waits, for a second at most."""
        ends_s = time.monotonic() + _CLOSE_S
        self._closing = True
        self._asked.set()
        self.say("")
        self._keeper.join(_CLOSE_S)
        self._printer.join(max(0.0, ends_s - time.monotonic()))

    def _keep_all(self) -> None:
        while not (self._closing and self._kept == self._wanted):
            self._asked.wait(_RETRY_S)
            self._asked.clear()
            self._keep()
        self.say("")

    def _print_all(self) -> None:
        while not (self._closing and self._lines.empty() and not self._keeper.is_alive()):
            with suppress(queue.Empty):
                self._print(self._lines.get(timeout=_RETRY_S))

    def _keep(self) -> None:
        wanted = self._wanted
        if wanted == self._kept:
            return
        try:
            self._kept = None
            self._latch.keep(wanted)
            self._kept = wanted
        except OSError as error:
            self.say(f"the STOP mark is not kept over a restart: {error.strerror}; is the disk full or read-only?")

    @staticmethod
    def _print(line: str) -> None:
        try:
            if line:
                print(_shown(line), flush=True)
        except OSError:  # whoever read has gone: what is still buffered must not spoil the exit either
            with suppress(Exception):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except Exception:  # whatever a line does to a stream, the next one may be shown
            return


def _shown(line: str) -> str:
    """`line` in letters that the terminal has: peers choose some of them. A stream of no encoding takes all."""
    encoding = getattr(sys.stdout, "encoding", None)
    return line.encode(encoding, "backslashreplace").decode(encoding) if encoding else line
