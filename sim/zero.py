"""Set the simulated wheels to zero after their owner process has died. Shell (a socket).

The guardian imports this module alone, so it needs no pydantic.
"""

import socket
import struct
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

from sightline.protocol.errors import HardwareError

MOTION: Final = "motion.sock"
MOTION_SET: Final = struct.Struct("<dd")
MOTION_BUSY: Final = b"busy"
"""Answer to a client that sets speeds while the connection of another one owns the motors."""
_ANSWER_S: Final = 1.0
_FREE_S: Final = 0.1
_QUERY: Final = b"?"
"""A packet that is not a command: it changes no speed, and its answer shows whether the motors have an owner."""


def zero(config: Mapping[str, Any]) -> None:
    """Set the simulated motors to zero. `config`: the `Config` of the drive as plain values."""
    folder = config["socket_dir"]
    try:
        _offer(folder, MOTION_SET.pack(0.0, 0.0), _ANSWER_S)
    except OSError as error:
        why = error.strerror or "no answer"
        raise HardwareError(f"the simulation in {folder} takes no motor commands ({why}); is it running?") from None


def check_free(folder: str) -> None:
    """Raise HardwareError if another process owns the simulated motors. A simulation that hangs counts as free."""
    with suppress(OSError):
        _offer(folder, _QUERY, _FREE_S)


def _offer(folder: str, packet: bytes, answer_s: float) -> None:
    """Send one packet on a connection of its own. Raises HardwareError for an owner, OSError without an answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        ends_s = time.monotonic() + answer_s
        connection.settimeout(answer_s)
        connection.connect(f"{folder}/{MOTION}")
        connection.send(packet)
        connection.shutdown(socket.SHUT_WR)
        while (left_s := ends_s - time.monotonic()) > 0:  # until it has read all; encoder readings come first
            connection.settimeout(left_s)
            answer = connection.recv(64)
            if answer == MOTION_BUSY:
                raise HardwareError(f"another process owns the simulated motors in {folder}; end it")
            if not answer:
                return
    raise TimeoutError
