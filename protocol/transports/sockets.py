"""The sockets of this process, also those that a library opened. Shell."""

import os
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

_LINGER: Final = struct.Struct("ii")
_OF_ZENOH: Final = _LINGER.pack(1, 10)


def own_sockets(wanted: Callable[[str], bool] = lambda name: name.startswith("socket:")) -> Iterator[socket.socket]:
    """Yield the sockets whose entry in `/proc/self/fd` is wanted, each to be used before the next."""
    try:
        links = list(Path("/proc/self/fd").iterdir())
    except OSError:  # another system
        return
    for link in links:
        with suppress(OSError):  # closed meanwhile
            if wanted(str(link.readlink())):
                with socket.socket(fileno=os.dup(int(link.name))) as one:
                    yield one


def close_without_waiting() -> None:
    """Let no connection of Zenoh wait when it closes. The system still sends what is left.

    Zenoh sets a time to linger of 10 s. For so long the close of a link whose other end hangs or is out of reach, with
    data left to send, blocks a thread that all sessions of the process need, so that none of them receives anything.
    """
    for one in own_sockets():
        with suppress(OSError):  # no such option
            if one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size) == _OF_ZENOH:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))
