"""Checks before a command runs: its extra is installed, and its result can be written. Shell (files)."""

import os
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Final

from sightline.protocol.errors import ConfigError, install_command

_PYBULLET_UP_TO = (3, 11)
_LONGEST_NAME: Final = 240
"""Limit in bytes. A file system permits 255, but the unfinished file next to the result has a longer name."""


@contextmanager
def needs(extra: str, version: tuple[int, int] = sys.version_info[:2]) -> Iterator[None]:
    """Convert a failed import to a ConfigError that names the extra. A failed import of Sightline is not converted."""
    try:
        yield
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if not package or package == "sightline":
            raise
        raise ConfigError(_advice(package, extra, version)) from None


def _advice(package: str, extra: str, version: tuple[int, int]) -> str:
    if package == "pybullet" and version > _PYBULLET_UP_TO:
        return (
            f"PyBullet has no wheel for Python {version[0]}.{version[1]}: use Python 3.11, or "
            f"`docker compose up`, or compile it (minutes): {install_command('sim')}"
        )
    return f"{package} is not installed: {install_command(extra)}"


# --- the file of a result, checked before the work ---------------------------------------------------------------


def check_out_file(path: Path) -> None:
    """Raise ConfigError if the file cannot be created or changed."""
    if len(os.fsencode(path.name)) > _LONGEST_NAME:
        raise ConfigError(f"cannot write {path}: its name has more than {_LONGEST_NAME} bytes; choose a shorter one")
    try:
        if not path.parent.is_dir():
            raise ConfigError(f"cannot write {path}: no folder {path.parent}; name a file in an existing folder")
        if path.is_dir():
            raise ConfigError(f"cannot write {path}: it is a folder; name a file in it")
        may = os.access(path if path.exists() else path.parent, os.W_OK)
    except OSError:  # a folder in the path belongs to another user
        may = False
    if not may:
        raise ConfigError(f"cannot write {path}: permission denied; name a file in a folder that you may write")


@contextmanager
def writes(path: Path, fix: str = "choose another file") -> Iterator[None]:
    """Convert a failed write, e.g. on a full disk, to a ConfigError that names `path`."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror or error}; {fix}") from None


@contextmanager
def whole(target: Path, suffix: str = ".part") -> Iterator[Path]:
    """Yield an unfinished file next to `target`. At the end of the context it replaces `target`; an error removes it.

    Its name is different each time, because two programs may write `target`.
    """
    part = target.with_name(f".{target.name}.{secrets.token_hex(4)}{suffix}")
    try:
        yield part
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes, fix: str = "choose another file") -> None:
    """Write a file atomically. A symbolic link is preserved. Raises ConfigError.

    A file that cannot be replaced, e.g. `/dev/stdout` or one in a folder of another user, is written in place.
    """
    target = Path(os.path.realpath(path))
    is_replaced = not target.exists() or (target.is_file() and os.access(target.parent, os.W_OK))
    with writes(path, fix), whole(target) if is_replaced else nullcontext(target) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        if is_replaced and target.exists():
            shutil.copymode(target, part)
