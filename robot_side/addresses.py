"""Where others reach a robot that listens on every address of its machine, for the line at its start. Shell (Linux)."""

import fcntl
import socket
import struct
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

_ASK_ADDRESS: Final = 0x8915  # SIOCGIFADDR of linux/sockios.h
_ANYWHERE: Final = ("/0.0.0.0:", "/[::]:")


def reachable_endpoints(endpoints: Sequence[str]) -> list[str]:
    """Those of `endpoints` that listen on every address, with each address in place of none."""
    open_ends = [(endpoint, anywhere) for endpoint in endpoints for anywhere in _ANYWHERE if anywhere in endpoint]
    here = own_addresses() if open_ends else []
    return [endpoint.replace(anywhere, f"/{address}:") for endpoint, anywhere in open_ends for address in here]


def own_addresses() -> list[str]:
    """The IPv4 address of every interface that has one, loopback left out."""
    found: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            with suppress(OSError):  # an interface without an address
                reply = fcntl.ioctl(asking.fileno(), _ASK_ADDRESS, struct.pack("256s", name.encode()))
                found.append(socket.inet_ntoa(reply[20:24]))
    return [address for address in dict.fromkeys(found) if not address.startswith("127.")]
