"""Bytes that TCP connections on loopback have carried, as the kernel counts them for each. Shell (netlink, Linux).

The counters of the loopback interface are everybody's; these are of the sockets that a contestant listens on. What is
asked for and what comes back is described in sock_diag(7); tcp_info is that of linux/tcp.h.
"""

import socket
import struct
from collections.abc import Collection, Iterator, Mapping
from typing import Final

Connection = tuple[int, int]
"""(port listened on, port of the peer)."""

_NETLINK_SOCK_DIAG: Final = 4
_SOCK_DIAG_BY_FAMILY, _REQUEST_DUMP, _INET_DIAG_INFO, _ESTABLISHED = 20, 0x301, 2, 1
_ENDS: Final = (2, 3)  # NLMSG_ERROR, NLMSG_DONE
_HEAD: Final = struct.Struct("<IHHII")
_QUERY: Final = struct.Struct("<BBBBI48x")
_PORTS: Final = struct.Struct(">4xHH")
_ATTRIBUTE: Final = struct.Struct("<HH")
_ACKED_AND_RECEIVED: Final = struct.Struct("<120xQQ")
_MESSAGE_BYTES: Final = 72


def carried_bytes(ports: Collection[int]) -> dict[Connection, int]:
    """Payload bytes, both ways, of every open connection to one of `ports`; empty where the kernel does not tell."""
    query = _QUERY.pack(socket.AF_INET, socket.IPPROTO_TCP, 1 << (_INET_DIAG_INFO - 1), 0, 1 << _ESTABLISHED)
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_SOCK_DIAG) as kernel:
            kernel.send(_HEAD.pack(_HEAD.size + len(query), _SOCK_DIAG_BY_FAMILY, _REQUEST_DUMP, 1, 0) + query)
            found = [_connection(message) for message in _messages(kernel)]
    except (OSError, AttributeError):
        return {}
    return {connection: count for connection, count in found if connection[0] in ports}


def carried_between(before: Mapping[Connection, int], after: Mapping[Connection, int]) -> int | None:
    """Bytes carried in the time between two readings; of several connections to one port, the busiest is taken.

    The others are of whoever watches. None where nothing was told.
    """
    busiest: dict[int, int] = {}
    for connection, count in after.items():
        carried = count - before.get(connection, 0)
        busiest[connection[0]] = max(carried, busiest.get(connection[0], 0))
    return sum(busiest.values()) if busiest else None


def _messages(kernel: socket.socket) -> Iterator[bytes]:
    while True:
        data = kernel.recv(1 << 18)
        while data:
            size, kind = _HEAD.unpack_from(data)[:2]
            if kind in _ENDS:
                return
            yield data[_HEAD.size : size]
            data = data[(size + 3) & ~3 :]


def _connection(message: bytes) -> tuple[Connection, int]:
    here, there = _PORTS.unpack_from(message)
    attributes = message[_MESSAGE_BYTES:]
    while attributes:
        size, kind = _ATTRIBUTE.unpack_from(attributes)
        if kind == _INET_DIAG_INFO:
            return (here, there), sum(_ACKED_AND_RECEIVED.unpack_from(attributes, _ATTRIBUTE.size))
        attributes = attributes[(size + 3) & ~3 :]
    return (here, there), 0
