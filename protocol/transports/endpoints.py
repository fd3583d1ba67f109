"""Check robot ids; parse Zenoh endpoints (`tcp/host:port`) and WebSocket endpoints (`ws://host:port`). Pure."""

import ipaddress
import re
from collections.abc import Sequence
from typing import Final, NamedTuple

from sightline.protocol import NAME_PATTERN
from sightline.protocol.errors import ConfigError

# Endpoint of a robot and its peers when none is configured.
DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"

# A bounded socket buffer keeps frames young, because data in the socket can no longer be dropped. It holds the data in
# flight over 200 ms. A quarter of it gave images of 16 kB instead of 34 on such a link, and an age of 351 ms at p95
# instead of 219 (`bench network --only rtt200`).
SEND_BUFFER_BYTES: Final = 262_144

ROBOT_ID: Final = re.compile(NAME_PATTERN)
_IPV6 = r"\[[0-9A-Fa-f:.]+(?:%[0-9A-Za-z_.-]+)?\]"  # after the %: the interface of a link-local address
_ZENOH_ENDPOINT = re.compile(
    rf"(tcp|tls|quic|udp|ws)/({_IPV6}|[^\s:/?#\[\]]+):([0-9]{{1,5}})(\?[^#\s]*)?(#\S*)?"
)
_BUFFERED = ("tcp", "tls")
OVER_UDP: Final = ("udp", "quic")


def check_robot_id(robot: str) -> str:
    """Return `robot` if it is a valid id.

    Raises:
        ConfigError: the id cannot be part of a key.
    """
    if not ROBOT_ID.fullmatch(robot):
        fix = "; pass an address with --connect" if "/" in robot and ":" in robot else ""
        raise ConfigError(
            f"invalid robot id {robot!r}: expected 1 to 32 letters, digits, '_', '-' or '.', starting with a letter or "
            f"digit (no '/' or '*'), e.g. r1{fix}"
        )
    return robot


def check_endpoint(endpoint: str) -> None:
    """Raise ConfigError, with the correct form, for an endpoint that no transport accepts."""
    if "://" in endpoint:
        parse_websocket_endpoint(endpoint)
    else:
        parse_zenoh_endpoint(endpoint)


def parse_zenoh_endpoint(endpoint: str) -> tuple[str, str, int]:
    """Split a Zenoh endpoint.

    Args:
        endpoint: e.g. `tcp/127.0.0.1:7447`.

    Returns:
        Protocol, host, and port 1 to 65535.

    Raises:
        ConfigError: the endpoint is invalid; the text shows the correct form.
    """
    match = _ZENOH_ENDPOINT.fullmatch(endpoint)
    if match is None or not 1 <= int(match[3]) <= 65_535 or not _is_host(match[2]):
        raise ConfigError(
            f"invalid endpoint {endpoint!r}: expected <protocol>/<host>:<port> with a port from 1 to 65535, "
            "e.g. tcp/127.0.0.1:7447"
        )
    return match[1], match[2].strip("[]"), int(match[3])


def _is_host(name: str) -> bool:
    """Return False for a name that Python passes to no resolver: an empty label, or one of 64 characters or more."""
    if name.isascii():  # as the idna codec, whose tables take a megabyte of the locked memory of a robot
        *labels, last = name.split(".")
        return all(0 < len(label) < 64 for label in labels) and len(last) < 64
    try:
        name.encode("idna")
    except UnicodeError:
        return False
    return True


def with_send_buffer(endpoint: str) -> str:
    """Add the size of the send buffer, unless the endpoint has options (`#...`) or does not use TCP."""
    if "#" in endpoint or parse_zenoh_endpoint(endpoint)[0] not in _BUFFERED:
        return endpoint
    return f"{endpoint}#so_sndbuf={SEND_BUFFER_BYTES}"


def check_zenoh_endpoints(listen: Sequence[str], connect: Sequence[str]) -> None:
    """Raise ConfigError without an endpoint, for an invalid one, and for one that is listed twice."""
    if not listen and not connect:
        raise ConfigError("no endpoint; pass one to listen on (--listen) or to connect to (--connect)")
    for endpoint in (*listen, *connect):
        parse_zenoh_endpoint(endpoint)
        if listen.count(endpoint) > 1:
            raise ConfigError(f"{endpoint} is listed twice; name it once")


# WebSocket endpoints, and the check of a browser's site. Pure.
#
#     ws://127.0.0.1:9090          `sightline.v1`; wss:// with TLS
#     ws-legacy://127.0.0.1:9091   the legacy protocol, with options after a `?`, joined by `&`:
#         dashed                         linear-angular instead of the bar
#         swapped                        angular-linear, with dashed
#         nonnegative                    zero in place of each negative number, with dashed: toward a legacy robot
#         oneline                        base64 without newlines
#         boxes                          accept boxes next to twists, see `transports.websocket.legacy_text`; toward a
#                                        legacy robot: send the box of the target in place of twists
#         from=192.168.1.7,10.0.0.0/24   addresses that may connect


_WEBSOCKET_ENDPOINT: Final = re.compile(
    rf"(ws|wss|ws-legacy)://({_IPV6}|[^\s:/?#\[\]@]+):([0-9]{{1,5}})/?(?:\?([^\s?#]*))?", re.ASCII
)
_NEVER_WEBSOCKET: Final = ("tcp", "tls", "quic", "udp")
_WORDS: Final = ("dashed", "swapped", "nonnegative", "oneline", "boxes")
_WITH_DASHED: Final = {"swapped", "nonnegative"}
_FROM: Final = "from="


class LegacyOptions(NamedTuple):
    """The variant of the legacy protocol."""

    newlines: bool = True
    """Line ends in the base64 text."""
    dashed: bool = False
    """`linear-angular` instead of the bar."""
    swapped: bool = False
    """`angular-linear`, as the legacy robot reads it."""
    nonnegative: bool = False
    """Toward a legacy robot: zero in place of each negative number."""
    boxes: bool = False
    """At a robot: boxes are accepted too, as detections of a guest. Toward a legacy robot: boxes in place of twists."""


class WebSocketEndpoint(NamedTuple):
    """A valid endpoint. `text` is the original text."""

    text: str
    host: str
    port: int
    legacy: LegacyOptions | None
    """Variant of the legacy protocol, or None for `sightline.v1`."""
    secure: bool = False
    """True for TLS."""
    allow_from: tuple[str, ...] = ()
    """Addresses and networks that may use a legacy endpoint. An empty list permits all."""

    @property
    def is_loopback(self) -> bool:
        """Return True if only this machine can reach the endpoint."""
        return self.host == "localhost" or (_is_address(self.host) and ipaddress.ip_address(self.host).is_loopback)


def parse_websocket_endpoint(text: str) -> WebSocketEndpoint:
    """Parse a WebSocket endpoint.

    Args:
        text: e.g. `ws://127.0.0.1:9090`.

    Raises:
        ConfigError: the endpoint is invalid; the text shows the correct form.
    """
    scheme, _, rest = text.partition("://")
    if scheme in _NEVER_WEBSOCKET:
        raise ConfigError(f"invalid endpoint {text!r}: write {scheme}/{rest}")
    match = _WEBSOCKET_ENDPOINT.fullmatch(text)
    port = int(match[3]) if match else 0
    is_valid = match is not None and 1 <= port <= 65_535 and _is_host(match[2])
    if match is None or not is_valid or (match[4] is not None and match[1] != "ws-legacy"):
        raise ConfigError(
            f"invalid endpoint {text!r}: expected ws://<host>:<port>, wss://<host>:<port> or ws-legacy://<host>:<port> "
            "with a port from 1 to 65535, e.g. ws://127.0.0.1:9090"
        )
    host = match[2].strip("[]")
    if match[1] != "ws-legacy":
        return WebSocketEndpoint(text, host, port, None, match[1] == "wss")
    return WebSocketEndpoint(text, host, port, *_legacy(text, [word for word in (match[4] or "").split("&") if word]))


def _legacy(text: str, words: Sequence[str]) -> tuple[LegacyOptions, bool, tuple[str, ...]]:
    """Return the options, False for TLS, and the permitted addresses."""
    unknown = [word for word in words if word not in _WORDS and not word.startswith(_FROM)]
    if unknown or (_WITH_DASHED & set(words) and "dashed" not in words):
        raise ConfigError(
            f"invalid endpoint {text!r}: after the ? use {', '.join(_WORDS)} (swapped, nonnegative with dashed) or "
            "from=<address>, joined by &, e.g. ws-legacy://127.0.0.1:9091?oneline"
        )
    networks = [part for word in words if word.startswith(_FROM) for part in word[len(_FROM) :].split(",")]
    options = LegacyOptions(newlines="oneline" not in words, dashed="dashed" in words, swapped="swapped" in words,
                            nonnegative="nonnegative" in words, boxes="boxes" in words)
    return options, False, tuple(check_network(network) for network in networks)


def check_network(text: str) -> str:
    """Return a valid address or network. Raises ConfigError for any other text."""
    try:
        return str(ipaddress.ip_network(text, strict=False))
    except ValueError:
        raise ConfigError(f"invalid address {text!r}: expected e.g. 192.168.1.7 or 192.168.1.0/24") from None


def with_allowed(endpoint: str, allow_from: Sequence[str]) -> str:
    """Add the permitted addresses to a legacy endpoint without a list. Other endpoints stay unchanged."""
    if not allow_from or not endpoint.startswith("ws-legacy://") or _FROM in endpoint:
        return endpoint
    return f"{endpoint}{'&' if '?' in endpoint else '?'}{_FROM}{','.join(allow_from)}"


def host_problem(hosts: Sequence[str], listen_host: str) -> str:
    """Return the reason to reject the `Host` headers of a request, or "" to accept them.

    Args:
        hosts: the `Host` headers.
        listen_host: host of the listening endpoint.
    """
    # A third-party site can point its own name at this machine (DNS rebinding). It cannot use an address, a name
    # without a dot, a name in `.local`, or the name of this endpoint.
    if len(hosts) != 1:
        return "a request must contain its Host once"
    name = re.sub(r":[0-9]+\Z", "", hosts[0]).strip("[]").lower()
    if "." not in name or name.endswith(".local") or name == listen_host.lower() or _is_address(name):
        return ""
    return f"Host {hosts[0][:80]!r} is not this machine; connect by its address or .local name"


def stop_addresses(endpoints: Sequence[str]) -> list[tuple[str, int]]:
    """Return the UDP addresses of the STOP ports of `endpoints`, each once: the same host, the next higher port.

    The STOP port of the default endpoint is 7448. So robots on one machine have different STOP ports, and no answer
    comes from another robot. The legacy protocol has no STOP.
    """
    places = []
    for endpoint in endpoints:
        if "://" not in endpoint:
            _, host, port = parse_zenoh_endpoint(endpoint)
        elif not endpoint.startswith("ws-legacy://"):
            web = parse_websocket_endpoint(endpoint)
            host, port = web.host, web.port
        else:
            continue
        places.append((host, min(port + 1, 65_535)))
    return list(dict.fromkeys(places))


# UDP port of discovery on each machine that listens beyond loopback: the port of Zenoh plus three.
MULTICAST_PORT: Final = 7449
LOOPBACK: Final = ("localhost", "127.", "::1")


def uses_discovery(listen: Sequence[str]) -> bool:
    """Return True if a Zenoh endpoint of `listen` is beyond loopback, so that its owner answers discovery."""
    return any("://" not in one and not parse_zenoh_endpoint(one)[1].startswith(LOOPBACK) for one in listen)


def own_stop_addresses(listen: Sequence[str]) -> list[tuple[str, int]]:
    """Return the UDP addresses of the STOP ports to open for `listen`.

    Raises:
        ConfigError: an address is also the address of discovery. Only one of the two could be opened.
    """
    for endpoint in listen if uses_discovery(listen) else ():
        if any((host, MULTICAST_PORT) in stop_addresses([endpoint]) for host in ("0.0.0.0", "::")):
            other = endpoint.replace(f":{MULTICAST_PORT - 1}", f":{MULTICAST_PORT}")
            raise ConfigError(f"port {MULTICAST_PORT - 1} in {endpoint}: its STOP port would be {MULTICAST_PORT}/udp, "
                              f"which is that of discovery; use another port, e.g. {other}")
    return stop_addresses(listen)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def origin_problem(origins: Sequence[str], host: str) -> str:
    """Return the reason to reject the `Origin` headers of a request, or "" to accept them. Only browsers send one."""
    sites = [f"http://{host.lower()}"], [f"https://{host.lower()}"]
    if not origins or [origin.lower() for origin in origins] in sites:
        return ""
    return f"Origin {origins[0][:80]!r} differs from Host {host[:80]!r}"
