"""Who comes to a TCP port and leaves it again, from the kernel's table. Shell (reads /proc, waits; Linux only)."""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Collection
from pathlib import Path
from typing import Final

TABLES: Final = Path("/proc/net")
_LISTENS: Final = "0A"
_LEAVING: Final = ("04", "05", "06", "07", "08", "09", "0B")
"""FIN_WAIT1, FIN_WAIT2, TIME_WAIT, CLOSE, CLOSE_WAIT, LAST_ACK, CLOSING."""
_LOOK_S: Final = 0.005
"""A TLS handshake takes longer than this on any radio."""


class Visitors:
    """Names hosts whose connections to `ports` did not last. Looks only while it is asked."""

    def __init__(self, ports: Collection[int]) -> None:
        self._ports = ports
        self._left: set[str] = set()

    def who_left(self, patience_s: float) -> str:
        """The host of a connection that ends, or comes and ends, within `patience_s`; "" for none or for several."""
        ends_s, stay = time.monotonic() + patience_s, {end for end, leaves in self._ends().items() if not leaves}
        came: set[str] = set()
        while True:
            ends = self._ends()
            leaving = {end for end, leaves in ends.items() if leaves}
            left = (leaving | (came - ends.keys())) - self._left
            self._left = leaving | left  # a number may come again when the kernel has forgotten it
            if left:
                hosts = {end.rpartition(":")[0] for end in left}
                return hosts.pop() if len(hosts) == 1 else ""
            came |= ends.keys() - stay - leaving
            if time.monotonic() >= ends_s:
                return ""
            time.sleep(_LOOK_S)

    def here(self) -> set[str]:
        """`address:port` of the far ends of connections that last."""
        return {end for end, leaves in self._ends().items() if not leaves}

    def _ends(self) -> dict[str, bool]:
        """`address:port` of the far ends of connections to our ports, and whether they are ending."""
        rows = [row for table in ("tcp", "tcp6") for row in _rows(table)]
        ours = [row for row in rows if int(row[1].rpartition(":")[2], 16) in self._ports and row[3] != _LISTENS]
        return {_address(row[2]): row[3] in _LEAVING for row in ours}


def _rows(table: str) -> list[list[str]]:
    try:
        return [line.split() for line in (TABLES / table).read_text("ascii").splitlines()[1:]]
    except OSError:
        return []


def _address(text: str) -> str:
    """The kernel writes each 32 bits of an address in the machine's own order, in hex digits."""
    digits, _, port = text.rpartition(":")
    words = [bytes.fromhex(digits[start:start + 8])[::-1] for start in range(0, len(digits), 8)]
    host = ipaddress.ip_address(b"".join(words))
    return f"{getattr(host, 'ipv4_mapped', None) or host}:{int(port, 16)}"
