"""The STOP state on disk, so that a restart cannot clear it. Shell (a file)."""

from pathlib import Path

from protocol.errors import ConfigError


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
        """Write or remove the mark."""
        if stopped:
            self._path.touch()
        else:
            self._path.unlink(missing_ok=True)
