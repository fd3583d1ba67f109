"""Set the simulated wheels to zero after their owner process has died. Shell (a socket).

The guardian imports this module alone, so it needs no pydantic.
"""

import socket
import struct
from collections.abc import Mapping
from typing import Any, Final

from sightline.protocol.errors import HardwareError

MOTION: Final = "motion.sock"
MOTION_SET: Final = struct.Struct("<dd")
MOTION_BUSY: Final = b"busy"
"""Answer to a client that sets speeds while the connection of another one owns the motors."""
_ANSWER_S: Final = 1.0


def zero(config: Mapping[str, Any]) -> None:
    """Set the simulated motors to zero. `config`: the `Config` of the drive as plain values."""
    folder = config["socket_dir"]
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(_ANSWER_S)
        try:
            connection.connect(f"{folder}/{MOTION}")
            connection.send(MOTION_SET.pack(0.0, 0.0))
            connection.shutdown(socket.SHUT_WR)
            while answer := connection.recv(64):  # until the simulation has read all of it
                if answer == MOTION_BUSY:
                    raise HardwareError(f"another process owns the simulated motors in {folder}; end it")
        except OSError as error:
            why = error.strerror or "no answer"
            raise HardwareError(f"the simulation in {folder} takes no motor commands ({why}); is it running?") from None
