"""Whether a result can be written where it is to go, looked at before the work that makes it. Shell."""

import os
from pathlib import Path

from sightline.protocol.errors import ConfigError


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
