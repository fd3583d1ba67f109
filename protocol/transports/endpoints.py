"""Parses Zenoh endpoints (`tcp/host:port`) and WebSocket endpoints (`ws://host:port`). Pure."""

import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sightline.protocol.errors import ConfigError

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
"""Where a robot listens and its peers connect where no endpoint is given."""

SEND_BUFFER_BYTES: Final = 262_144
"""A bounded socket buffer keeps frames young: what waits in the socket can no longer be dropped, and credit bounds it.
It holds what is under way, 200 ms of the whole stream; with a quarter of it, pictures over such a distance had 16 kB in
place of 34, and their age a p95 of 351 ms in place of 219 (`bench network --only rtt200`)."""

_ZENOH_ENDPOINT = re.compile(
    r"(tcp|tls|quic|udp|ws)/(\[[0-9A-Fa-f:.]+\]|[^\s:/?#\[\]]+):([0-9]{1,5})(\?[^#\s]*)?(#\S*)?"
)
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


# WebSocket endpoints as people write them, and whose browser may come in. Pure.  ws://127.0.0.1:9090
# `sightline.v1`; wss:// with TLS ws-legacy://127.0.0.1:9091    the older text dialect, with options after a `?`,
# joined by `&`:     dashed     linear-angular instead of the bar        swapped    angular-linear, with dashed
# oneline    base64 without newlines                  boxes      takes boxes beside twists, see
# `sightline.protocol.text`     from=192.168.1.7,10.0.0.0/24                        who may come in


_WEBSOCKET_ENDPOINT: Final = re.compile(
    r"(ws|wss|ws-legacy)://(\[[0-9A-Fa-f:.]+\]|[^\s:/?#\[\]@]+):([0-9]{1,5})/?(?:\?([^\s?#]*))?", re.ASCII
)
_WORDS: Final = ("dashed", "swapped", "oneline", "boxes")
_FROM: Final = "from="




@dataclass(frozen=True, slots=True)
class LegacyOptions:
    """How the older dialect is spoken."""

    newlines: bool = True
    """Line ends in the base64 text."""
    dashed: bool = False
    """`linear-angular` instead of the bar."""
    swapped: bool = False
    """`angular-linear`: as the older robot took it."""
    boxes: bool = False
    """Towards the robot: boxes are taken too, as detections of a guest."""
@dataclass(frozen=True, slots=True)
class WebSocketEndpoint:
    """A checked endpoint; `text` is as it was written."""

    text: str
    host: str
    port: int
    legacy: LegacyOptions | None
    """How the older dialect is spoken there; None for `sightline.v1`."""
    secure: bool = False
    """Whether it is TLS."""
    allow_from: tuple[str, ...] = ()
    """Addresses and networks that may come in at an endpoint of the older dialect; none listed: all that get there."""

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine reaches who listens there."""
        return self.host == "localhost" or (_is_address(self.host) and ipaddress.ip_address(self.host).is_loopback)


def parse_websocket_endpoint(text: str) -> WebSocketEndpoint:
    """Check an endpoint; raise ConfigError with the right form otherwise."""
    match = _WEBSOCKET_ENDPOINT.fullmatch(text)
    port = int(match[3]) if match else 0
    if match is None or not 1 <= port <= 65_535 or (match[4] is not None and match[1] != "ws-legacy"):
        raise ConfigError(
            f"endpoint {text!r} is none: write ws://<host>:<port>, wss://<host>:<port> or ws-legacy://<host>:<port> "
            "with a port from 1 to 65535, e.g. ws://127.0.0.1:9090"
        )
    host = match[2].strip("[]")
    if match[1] != "ws-legacy":
        return WebSocketEndpoint(text, host, port, None, match[1] == "wss")
    return WebSocketEndpoint(text, host, port, *_legacy(text, [word for word in (match[4] or "").split("&") if word]))


def _legacy(text: str, words: Sequence[str]) -> tuple[LegacyOptions, bool, tuple[str, ...]]:
    """The options, no TLS, and who may come in."""
    unknown = [word for word in words if word not in _WORDS and not word.startswith(_FROM)]
    if unknown or ("swapped" in words and "dashed" not in words):
        raise ConfigError(
            f"endpoint {text!r}: after the ? write {', '.join(_WORDS)} (swapped only with dashed) or from=<address>, "
            "joined by &, e.g. ws-legacy://127.0.0.1:9091?oneline"
        )
    networks = [part for word in words if word.startswith(_FROM) for part in word[len(_FROM) :].split(",")]
    options = LegacyOptions(newlines="oneline" not in words, dashed="dashed" in words, swapped="swapped" in words,
                            boxes="boxes" in words)
    return options, False, tuple(check_network(network) for network in networks)


def check_network(text: str) -> str:
    """Return an address or network that may come in; raise ConfigError for what is none."""
    try:
        return str(ipaddress.ip_network(text, strict=False))
    except ValueError:
        raise ConfigError(f"{text!r} is no address or network, e.g. 192.168.1.7 or 192.168.1.0/24") from None


def with_allowed(endpoint: str, allow_from: Sequence[str]) -> str:
    """`endpoint` with those who may come in written into it, if it is one of the older dialect without a list."""
    if not allow_from or not endpoint.startswith("ws-legacy://") or _FROM in endpoint:
        return endpoint
    return f"{endpoint}{'&' if '?' in endpoint else '?'}{_FROM}{','.join(allow_from)}"


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
    sites = [f"http://{host.lower()}"], [f"https://{host.lower()}"]
    if not origins or [origin.lower() for origin in origins] in sites:
        return ""
    return f"Origin {origins[0][:80]!r} is another site than Host {host[:80]!r}"
