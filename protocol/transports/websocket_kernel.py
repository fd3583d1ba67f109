"""What the kernel knows of a TCP connection's way out (Linux; elsewhere only what this end still holds). Shell."""

from __future__ import annotations

import socket
import struct
from typing import Final, NamedTuple

from sightline.protocol.transports.websocket.connection import SILENCE_US, SendPath


class _Fields(NamedTuple):
    """Of `struct tcp_info` in linux/tcp.h, whose fields never move."""

    probes: int
    unacked_packets: int
    last_ack_ms: int
    acked_bytes: int
    unsent_bytes: int


_LAYOUT: Final = struct.Struct("=3xB20xI28xI60xQ16xI")
_OPTION: Final = getattr(socket, "TCP_INFO", None)


def send_path(near: socket.socket, full: bool) -> SendPath:
    """The way out of `near`; `full` is what this end can tell of it by itself."""
    if _OPTION is None:
        return SendPath(full, 0, False)
    try:
        fields = _Fields(*_LAYOUT.unpack(near.getsockopt(socket.IPPROTO_TCP, _OPTION, _LAYOUT.size)))
    except (OSError, struct.error):  # closed, or a kernel that knows less
        return SendPath(full, 0, False)
    # A machine whose reader is slow still answers a probe of its full window: two unanswered are many.
    is_asked = fields.unacked_packets > 0 or fields.probes >= 2
    lost = is_asked and fields.last_ack_ms * 1000 >= SILENCE_US
    return SendPath(full or fields.unsent_bytes > 0, fields.acked_bytes, lost)
