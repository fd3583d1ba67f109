"""What a command checks before its work: the extra that it needs is installed, its result can be written. Shell
(files).
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sightline.protocol.errors import ConfigError

_PYBULLET_UP_TO = (3, 11)


@contextmanager
def needs(extra: str, version: tuple[int, int] = sys.version_info[:2]) -> Iterator[None]:
    """Imports inside that fail become a ConfigError that names the extra; ours are faults and stay as they are."""
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
            f"PyBullet has no ready-made package for Python {version[0]}.{version[1]}: use Python 3.11, or "
            "`docker compose up`, or let pip compile it (minutes): pip install '.[sim]'"
        )
    return f"{package} is not installed: pip install '.[{extra}]'"


# Whether a result can be written where it is to go, looked at before the work that makes it. Shell.


def check_out_file(path: Path) -> None:
    """Raise ConfigError where no file of that name can be made or changed."""
    try:
        if not path.parent.is_dir():
            raise ConfigError(f"{path}: there is no folder {path.parent}; name a file in one that exists")
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder; name a file in it")
        may = os.access(path if path.exists() else path.parent, os.W_OK)
    except OSError:  # a folder on the way is somebody else's
        may = False
    if not may:
        raise ConfigError(f"{path}: cannot be written; name a file in a folder of yours")
