"""Endpoints as people write them, `tcp/<host>:<port>`: the check, and the transport options added to them. Pure."""

import re
from collections.abc import Sequence
from typing import Final

from sightline.protocol.errors import ConfigError

SEND_BUFFER_BYTES: Final = 262_144
"""A bounded socket buffer keeps frames young: what waits in the socket can no longer be dropped, and credit bounds it.
It holds what is under way, 200 ms of the whole stream; with a quarter of it, pictures over such a distance had 16 kB in
place of 34, and their age a p95 of 351 ms in place of 219 (`bench network --only rtt200`)."""

_ZENOH_ENDPOINT = re.compile(r"(tcp|tls|quic|udp|ws)/(\[[0-9A-Fa-f:.]+\]|[^\s:/?#\[\]]+):([0-9]{1,5})(\?[^#\s]*)?(#\S*)?")
_BUFFERED = ("tcp", "tls")


def parse_zenoh_endpoint(endpoint: str) -> tuple[str, str, int]:
    """Split `endpoint` into (protocol, host, port 1..65535); raise ConfigError with the right form otherwise."""
    match = _ZENOH_ENDPOINT.fullmatch(endpoint)
    if match is None or not 1 <= int(match[3]) <= 65_535:
        raise ConfigError(
            f"endpoint {endpoint!r} is none: write <protocol>/<host>:<port> with a port from 1 to 65535, "
            "e.g. tcp/127.0.0.1:7447"
        )
    return match[1], match[2].strip("[]"), int(match[3])


def with_send_buffer(endpoint: str) -> str:
    """`endpoint` with a small socket buffer asked for, unless it has options (`#...`) of its own or no such socket."""
    if "#" in endpoint or parse_zenoh_endpoint(endpoint)[0] not in _BUFFERED:
        return endpoint
    return f"{endpoint}#so_sndbuf={SEND_BUFFER_BYTES}"


def check_zenoh_endpoints(listen: Sequence[str], connect: Sequence[str]) -> None:
    """Raise ConfigError unless there is at least one endpoint, every one well formed and listened on once."""
    if not listen and not connect:
        raise ConfigError("no endpoint: give one to listen on (--listen) or to connect to (--connect)")
    for endpoint in (*listen, *connect):
        parse_zenoh_endpoint(endpoint)
        if listen.count(endpoint) > 1:
            raise ConfigError(f"{endpoint} is given twice to listen on: name it once")
