"""Who is connected with which certificate, and what access rules turned away, from Zenoh's own log. Pure.

Zenoh tells nobody that it dropped a publication or subscription which a certificate's role does not have: not the
peer, and its own side only by a line without a name. So the certificates of those who are connected stand beside it.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Final

ACCESS_LOG_FILTER: Final = (
    "zenoh_link_tls::unicast=debug,zenoh_link_quic::unicast=debug,"
    "zenoh::net::routing::interceptor=trace,zenoh::net::routing::interceptor::access_control=off"
)
"""A line for each connection, and one for each message that is turned away; none for what passes."""
WHY: Final = "a certificate's role may not say or hear that, or it is too large (docs/security.md)"

DENIED: Final = b"Msg intercepted!"
"""How the line about a message that was turned away ends."""

_ANSI_ESCAPES: Final = re.compile(r"\x1b\[[0-9;]*m")
_OURS: Final = re.compile(r"\S+Z +(?:DEBUG|TRACE) .*?(?:zenoh_link_(?:tls|quic)::|zenoh::net::routing::interceptor)")
_ACCEPTED: Final = re.compile(r"Accepted \S+ connection on \S+: (\S+):(\d+)\. Common Name: (.*)\.$")
_MOST_ENDS: Final = 256
"""Security limit: four times as many as Zenoh lets in at once."""
_MOST_NAMED: Final = 4


class Certificates:
    """What the log said of each far end, `address:port`, the newest last."""

    def __init__(self) -> None:
        self._roles: dict[str, str] = {}

    def note(self, line: str) -> bool:
        """Take a line of the log; False for one that `LOG_FILTER` did not ask for."""
        text = _ANSI_ESCAPES.sub("", line).rstrip()
        if _OURS.match(text) is None:
            return False
        accepted = _ACCEPTED.search(text)
        if accepted is not None:
            host, port, role = accepted.groups()
            self._keep(f"{host.strip('[]').removeprefix('::ffff:')}:{port}", role)
        return True

    def connected(self, ends: Collection[str]) -> str:
        """`viewer from 192.168.1.7 or vision from ...` for those of `ends` that are known; "" for none."""
        named = [f"{role} from {end.rpartition(':')[0]}" for end, role in self._roles.items() if end in ends]
        newest = list(dict.fromkeys(reversed(named)))
        more = f" or {len(newest) - _MOST_NAMED} others" if len(newest) > _MOST_NAMED else ""
        return " or ".join(newest[:_MOST_NAMED]) + more

    def _keep(self, end: str, role: str) -> None:
        self._roles.pop(end, None)
        self._roles[end] = "".join(sign for sign in role[:32] if sign.isprintable())
        if len(self._roles) > _MOST_ENDS:
            del self._roles[next(iter(self._roles))]
