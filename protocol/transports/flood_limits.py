"""Limit the connections that one address opens to the ports of the links; report a flood. Shell (sockets, a thread).

Zenoh accepts connections itself and has no limit per address. So the kernel holds a connection back until its first
byte. A filter on the listening sockets drops new connections of an address that floods. Open sessions, and all other
addresses, continue; no frame is copied.
docs/explanation/decisions/0010-floods.md describes the alternatives.
"""

import ctypes
import ipaddress
import socket
import struct
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from types import MappingProxyType
from typing import Final, NamedTuple

from sightline.protocol.clock import heartbeat_us
from sightline.protocol.log import RepeatLimiter
from sightline.protocol.transports.diagnosis import (
    OWN_HOST,
    TCP_IPV4,
    connection_ends,
    listening_inodes,
    opened_connections,
    own_sockets,
)
from sightline.protocol.transports.endpoints import parse_websocket_endpoint, parse_zenoh_endpoint
from sightline.protocol.transports.zenoh.session import MAX_SESSIONS

MAX_OPEN: Final = MAX_SESSIONS
"""Connections of one address, including half-open ones: as many as Zenoh accepts from all addresses, and more than
WebSocket accepts."""
MAX_NEW: Final = MAX_SESSIONS
"""New connections of one address within `WINDOW_US`."""
WINDOW_US: Final = 3_000_000
BLOCKED_US: Final = 10_000_000
"""After this time without a flood the address may connect again."""
MAX_BLOCKED: Final = 64
"""Security limit: addresses that are blocked at the same time."""
_CHECK_S: Final = 0.2
_QUIET_US: Final = 2_000_000
"""Longest time between two readings of the table, and longest delay for a flood that opens no connection."""
_OWN: Final = (OWN_HOST, "::1")
"""Addresses of this machine. Its floods are reported but not blocked, because its services share one address."""


class Flood(NamedTuple):
    """A host above a limit: its current connections, and its new connections in a second."""

    host: str
    open: int
    new_per_s: float
    begins: bool
    """False while an earlier flood of the host continues."""


class FloodDetector:
    """Finds the hosts that flood, from samples of the connections to a port. Without side effects."""

    def __init__(self) -> None:
        self._known: frozenset[tuple[str, str]] = frozenset()
        self._new: dict[str, deque[tuple[int, int]]] = {}
        """Host -> time and count of its new connections, for each sample within the window."""
        self._blocked_until_us: dict[str, int] = {}

    def sample(
        self, ends: dict[tuple[str, str], str], now_us: int, accepted: Mapping[str, int] = MappingProxyType({})
    ) -> list[Flood]:
        """Process a sample. Returns the hosts that are above a limit now.

        Args:
            ends: connection (local and remote end) -> its host.
            now_us: time of the sample.
            accepted: host -> accepted connections since the last sample, for hosts with such a count.
        """
        new_now = Counter(ends[end] for end in ends.keys() - self._known)
        for host, count in (new_now | Counter(accepted)).items():  # the larger of both counts
            self._new.setdefault(host, deque()).append((now_us, count))
        self._known = frozenset(ends)
        for host, samples in list(self._new.items()):
            while samples and now_us - samples[0][0] > WINDOW_US:
                samples.popleft()
            if not samples:
                del self._new[host]
        # Both limits are needed: short connections are seldom open at the same time, and half-open ones are not new.
        open_now = Counter(ends.values())
        floods = []
        for host in open_now.keys() | self._new.keys():
            new = sum(count for _, count in self._new.get(host, ()))
            if open_now[host] > MAX_OPEN or new > MAX_NEW:
                begins = self._blocked_until_us.get(host, 0) <= now_us
                floods.append(Flood(host, open_now[host], new * 1e6 / WINDOW_US, begins))
        for flood in floods:
            self._blocked_until_us[flood.host] = now_us + BLOCKED_US
        return floods

    def blocked(self, now_us: int) -> list[str]:
        """Return the addresses whose new connections must be dropped now, the newest flood last."""
        self._blocked_until_us = {host: us for host, us in self._blocked_until_us.items() if us > now_us}
        return [host for host in self._blocked_until_us if host not in _OWN][-MAX_BLOCKED:]


_accepted: Final = Counter[str]()


def note_accepted(host: str) -> None:
    """Count a connection that this process has accepted, because a short one may end between two samples."""
    # Without `limit_floods` in this process the counts are never cleared, so the number of hosts is limited.
    if host in _accepted or len(_accepted) < MAX_BLOCKED:
        _accepted[host] += 1


@contextmanager
def limit_floods(listen: Sequence[str], report: Callable[[str], None]) -> Iterator[None]:
    """Limit and report floods of TCP connections to `listen` until the end of the `with`."""
    listen = [endpoint for endpoint in listen if not endpoint.startswith(("quic/", "udp/"))]
    ports = {_address(endpoint)[1] for endpoint in listen}
    read = partial(connection_ends, ports)
    if all(_is_ipv4(_address(endpoint)[0]) for endpoint in listen):
        read = partial(connection_ends, ports, TCP_IPV4)
    # WebSocket ends a silent connection after 2 s itself (clause 14.4), but not one that the kernel holds back.
    zenoh_ports = {_address(endpoint)[1] for endpoint in listen if "://" not in endpoint}
    ending = threading.Event()
    if ports:
        arguments = (ports, zenoh_ports, read, report, ending)
        threading.Thread(target=_watch, args=arguments, name="floods", daemon=True).start()
    try:
        yield
    finally:
        ending.set()


def _address(endpoint: str) -> tuple[str, int]:
    if "://" in endpoint:
        return parse_websocket_endpoint(endpoint)[1:3]
    return parse_zenoh_endpoint(endpoint)[1:]


def _is_ipv4(host: str) -> bool:
    """Return True for an IPv4 address. A name may have an IPv6 address, too."""
    with suppress(ValueError):
        return ipaddress.ip_address(host).version == 4
    return False


def _watch(
    ports: set[int], zenoh_ports: set[int], read: Callable[[], dict[tuple[str, str], str]],
    report: Callable[[str], None], ending: threading.Event,
) -> None:
    detector, limiter, blocked, silent = FloodDetector(), RepeatLimiter(), list[str](), set[Peer]()
    deferred, floods, opened, read_us = 0, list[Flood](), None, 0
    while not ending.wait(_CHECK_S):
        if deferred < len(zenoh_ports):  # a link opens its ports some time after the start of this thread
            deferred = _defer(_listeners(zenoh_ports))
        now_us = heartbeat_us()
        # Without a new connection a new flood is unlikely, and reading the table takes 3 to 5 ms.
        opened_before, opened = opened, opened_connections()
        is_quiet = opened is not None and opened == opened_before and not floods and not blocked
        if is_quiet and now_us - read_us < _QUIET_US:
            continue
        read_us = now_us
        # A connection between these two lines is not counted, which does not matter for a flood.
        accepted = dict(_accepted)
        _accepted.clear()
        floods = detector.sample(read(), now_us, accepted)
        # Before the report, so that the log is correct.
        if detector.blocked(now_us) != blocked:
            blocked = detector.blocked(now_us)
            _block(ports, blocked)
        if blocked:
            silent = _end_half_open(ports, blocked, silent)
        for flood in floods:
            if flood.begins and limiter.due(flood.host, now_us):
                report(_line(flood))


def _line(flood: Flood) -> str:
    over = f"{flood.open} connections from {flood.host}, {flood.new_per_s:.0f} new ones a second"
    if flood.host in _OWN:
        return f"{over}, more than the total limit of {MAX_OPEN}; end the program on this machine"
    if ":" in flood.host:
        return (f"{over}, more than the total limit of {MAX_OPEN}; new ones go on, because an IPv6 host has many "
                "addresses; block its network or end the program there")
    return (f"{over}, more than the total limit of {MAX_OPEN}; new ones are dropped for {BLOCKED_US / 1e6:.0f} s, open "
            "sessions go on; block that address or end the program there")


# Half-open connections of a host that floods. Zenoh runs one TLS handshake at a time, and waits 10 s for a peer that
# does not continue.


Peer = tuple[str, int]
_ACKED_BYTES: Final = struct.Struct("120xQ")
"""`tcpi_bytes_acked` in `struct tcp_info` of linux/tcp.h: bytes that the peer has acknowledged."""
_DEFER_S: Final = 10


def _defer(inodes: set[str]) -> int:
    """Let the kernel accept a connection with its first byte. An honest peer sends it when it connects.

    Returns the number of own sockets among `inodes`. Another process may listen on the same port of another address.
    """
    count = 0
    for listener in own_sockets(inodes.__contains__):
        # The option may be set while the socket already listens. It applies to later connections.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, _DEFER_S)
        count += 1
    return count


def _end_half_open(ports: set[int], hosts: Sequence[str], waiting: set[Peer]) -> set[Peer]:
    """End connections from `hosts` that received no byte in two turns. Returns those that now wait for the first time.

    An open session has received bytes. A peer that is silent, or stops in a handshake, has not.
    """
    unanswered: set[Peer] = set()
    for one in own_sockets():
        with suppress(OSError):  # not a TCP socket
            if one.family not in (socket.AF_INET, socket.AF_INET6) or one.getsockname()[1] not in ports:
                continue
            host, port = one.getpeername()[:2]
            info = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _ACKED_BYTES.size)
            if host.removeprefix("::ffff:") not in hosts or _ACKED_BYTES.unpack(info)[0]:
                continue
            # In two turns, because an honest peer may be in its handshake now.
            unanswered.add((host, port))
            if (host, port) in waiting:
                one.shutdown(socket.SHUT_RDWR)
    return unanswered


# The filter on a listening socket: a classic BPF program, which needs no privilege.


_SO_ATTACH_FILTER: Final = 26
_INSTRUCTION: Final = struct.Struct("HBBI")
_LOAD_BYTE, _LOAD_WORD, _AND, _IF_EQUAL, _RETURN = 0x30, 0x20, 0x54, 0x15, 0x06
_NETWORK_HEADER: Final = 0x1_0000_0000 - 0x10_0000  # SKF_NET_OFF of linux/filter.h
_IP_SOURCE: Final = 12
_PASS, _DROP = 0xFFFF_FFFF, 0


def source_filter(addresses: Sequence[int]) -> list[tuple[int, int, int, int]]:
    """Return the instructions (code, jump if true, jump if false, operand) that drop packets from IPv4 `addresses`.

    A listening socket receives only packets of connections that are not yet accepted. A session inherits the filter of
    the moment when it was opened, which did not contain its address.
    """
    # IPv6 addresses are not listed, because a sender has many of them.
    rows = len(addresses)
    checks = [(_IF_EQUAL, rows - place, 0, address) for place, address in enumerate(addresses)]
    return [
        (_LOAD_BYTE, 0, 0, _NETWORK_HEADER),
        (_AND, 0, 0, 0xF0),
        (_IF_EQUAL, 0, rows + 1, 0x40),  # IPv4
        (_LOAD_WORD, 0, 0, _NETWORK_HEADER + _IP_SOURCE),
        *checks,
        (_RETURN, 0, 0, _PASS),
        (_RETURN, 0, 0, _DROP),
    ]


def _block(ports: set[int], hosts: Sequence[str]) -> None:
    """Drop new connections from exactly `hosts` on the listening sockets of this process."""
    addresses = [int(ip) for host in hosts if (ip := ipaddress.ip_address(host.partition("%")[0])).version == 4]
    program = b"".join(_INSTRUCTION.pack(*row) for row in source_filter(addresses))
    buffer = ctypes.create_string_buffer(program)
    pointer = struct.pack("HP", len(program) // _INSTRUCTION.size, ctypes.addressof(buffer))
    for listener in own_sockets(_listeners(ports).__contains__):
        listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, pointer)


def _listeners(ports: set[int]) -> set[str]:
    """Return the names of listening sockets on `ports` in `/proc/self/fd`."""
    return {f"socket:[{inode}]" for inode in listening_inodes(ports)}
