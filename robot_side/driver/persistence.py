"""The STOP state on disk, so that a restart cannot clear it. Shell (a file)."""

import errno
import os
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
