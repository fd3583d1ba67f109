"""The STOP latch on disk, and the thread that writes it without blocking the control loop. Shell."""

import errno
import fcntl
import logging
import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from sightline.protocol.errors import ConfigError, home_path
from sightline.protocol.log import count_fault

_log: Final = logging.getLogger(__name__)

_NO_SYNC: Final = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)  # for a folder, on some user-space file systems


class StopLatch:
    """A mark file for each robot, which exists while the robot is STOPPED."""

    def __init__(self, directory: Path, robot: str) -> None:
        self._path = home_path(directory) / f"{robot}.stopped"
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"state_dir {directory}: {error.strerror}; choose a writable directory") from None

    def is_set(self) -> bool:
        """Return True if the robot was STOPPED when it last ran. Raises ConfigError if this is unknown."""
        try:
            self._path.lstat()
        except FileNotFoundError:
            return False
        except OSError as error:
            raise ConfigError(f"cannot read the STOP mark {self._path}: {error.strerror}; make it readable") from None
        return True

    def write(self, stopped: bool) -> None:
        """Write or remove the mark. After the return a power cut cannot undo this. May wait for the disk."""
        if stopped:
            with self._path.open("ab") as mark:
                os.fsync(mark.fileno())
        else:
            self._path.unlink(missing_ok=True)
        self._sync_folder()

    def _sync_folder(self) -> None:
        """Write the folder to disk, because its entry for the mark is not written with the file."""
        folder = os.open(self._path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        except OSError as error:
            if error.errno not in _NO_SYNC:
                raise
        finally:
            os.close(folder)


@contextmanager
def state_locked(directory: Path, robot: str) -> Iterator[None]:
    """Lock the mark of a robot until the end of the block. Log if another robot has it.

    The lock is advice: a folder that is read-only, or cannot lock, has none. The kernel removes it with its process.
    """
    with ExitStack() as ending:
        try:
            lock = os.open(home_path(directory) / f"{robot}.lock", os.O_RDWR | os.O_CREAT, 0o644)
            ending.callback(os.close, lock)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _log.warning("another robot with the id %s uses state_dir %s, so a reset of one removes the STOP mark of "
                         "the other; give each its own --robot ID or --set state_dir=DIR", robot, directory)
        except OSError as error:
            _log.debug("no lock in state_dir %s: %s", directory, error.strerror)
        yield


_RETRY_S: Final = 0.5
_CLOSE_S: Final = 1.0


class LatchWriter:
    """Writes the newest requested STOP latch on a separate thread, because the disk must not block the loop.

    The latch is a level: a failed write is repeated until it succeeds.
    """

    def __init__(self, latch: StopLatch) -> None:
        self._latch = latch
        self._wanted = latch.is_set()
        self._stored: bool | None = self._wanted
        """State on disk; None if unknown after a write that failed half-way."""
        self.failed = ""
        """Why the disk does not have the requested state, or empty."""
        self._changed = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._write_all, name="latch", daemon=True)
        self._thread.start()

    @property
    def is_stored(self) -> bool:
        """Return True if the mark of a STOP is on disk."""
        return self._stored is True

    def want(self, stopped: bool) -> None:
        """Request a state of the latch; never waits."""
        if stopped is not self._wanted:
            self._wanted = stopped
            self._changed.set()

    def close(self) -> None:
        """Write the requested state, for one second at most. Idempotent: a later call writes later requests."""
        self._closing = True
        self._changed.set()
        self._thread.join(_CLOSE_S)
        if not self._thread.is_alive():
            self._write()

    def _write_all(self) -> None:
        while not (self._closing and self._stored == self._wanted):
            self._changed.wait(_RETRY_S)
            self._changed.clear()
            self._write()

    def _write(self) -> None:
        wanted = self._wanted
        if wanted == self._stored:
            return
        try:
            self._stored = None
            self._latch.write(wanted)
            self._stored, self.failed = wanted, ""
        except OSError as error:
            count_fault("STOP mark")
            if not self.failed:
                _log.warning(
                    "the STOP mark is not kept over a restart: %s; is the disk full or read-only?", error.strerror
                )
            self.failed = error.strerror or str(error)
