"""WebSocket endpoints as people write them, and whose browser may come in. Pure.

    ws://127.0.0.1:9090           `sightline.v1`
    ws-legacy://127.0.0.1:9091    the older text dialect; `?dashed`: linear-angular, `?oneline`: no newlines
"""

import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from protocol.errors import ConfigError
from protocol.transports.websocket_dialects import LegacyOptions

_ENDPOINT: Final = re.compile(
    r"(ws|ws-legacy)://(\[[0-9A-Fa-f:.]+\]|[^\s:/?#\[\]@]+):([0-9]{1,5})/?(?:\?((?:dashed|oneline|&)*))?", re.ASCII
)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A checked endpoint; `text` is as it was written."""

    text: str
    host: str
    port: int
    legacy: LegacyOptions | None
    """How the older dialect is spoken there; None for `sightline.v1`."""


def parse_endpoint(text: str) -> Endpoint:
    """Check an endpoint; raise ConfigError with the right form otherwise."""
    match = _ENDPOINT.fullmatch(text)
    port = int(match[3]) if match else 0
    if match is None or not 1 <= port <= 65_535 or (match[4] is not None and match[1] == "ws"):
        raise ConfigError(
            f"endpoint {text!r} is none: write ws://<host>:<port> or ws-legacy://<host>:<port> with a port from 1 to "
            "65535, e.g. ws://127.0.0.1:9090"
        )
    words = (match[4] or "").split("&")
    options = LegacyOptions(newlines="oneline" not in words, dashed="dashed" in words)
    return Endpoint(text, match[2].strip("[]"), port, options if match[1] == "ws-legacy" else None)


def host_problem(hosts: Sequence[str], listen_host: str) -> str:
    """What is wrong with a request's `Host` headers; "" if nothing.

    A page of a foreign site reaches this machine by pointing a name of its own at it. So the name must be one that a
    foreign site cannot own: an address, a name without a dot, one in `.local`, or the one listened on.
    """
    if len(hosts) != 1:
        return "a request must name its Host once"
    name = re.sub(r":[0-9]+\Z", "", hosts[0]).strip("[]").lower()
    if "." not in name or name.endswith(".local") or name == listen_host.lower() or _is_address(name):
        return ""
    return f"Host {hosts[0][:80]!r} is not this machine; connect by its address or .local name"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def origin_problem(origins: Sequence[str], host: str) -> str:
    """What is wrong with a request's `Origin` headers; "" if nothing. Only browsers send one: the page's own site."""
    if not origins or [origin.lower() for origin in origins] in ([f"http://{host.lower()}"], [f"https://{host.lower()}"]):
        return ""
    return f"Origin {origins[0][:80]!r} is another site than Host {host[:80]!r}"
