"""The file of a `log` drive: its single owner, and zero after the owner has died. Shell.

The guardian imports only this module, so it needs no pydantic.
"""

import fcntl
import os
from collections.abc import Mapping
from typing import Any

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError


def zero(config: Mapping[str, Any]) -> None:
    """Append zero to the file of a `log` drive. `config`: its `Config` as plain values."""
    if config["path"]:
        file = open_log(config["path"])
        try:
            os.write(file, b"%d,%.4f,%.4f\n" % (monotonic_us(), 0.0, 0.0))
        finally:
            os.close(file)


def open_log(path: str) -> int:
    """Open the file of a `log` drive for a single owner, as for a motor pin. Raises HardwareError."""
    try:
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise HardwareError(f"drive log {path}: {error.strerror}; choose a writable file") from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        raise HardwareError(f"drive log {path} is in use by another process; end it or choose another file") from None
    return file
