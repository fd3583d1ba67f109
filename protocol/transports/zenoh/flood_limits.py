"""Limit the connections that one address opens to the ports of Zenoh, and report a flood. Shell (sockets, a thread).

Zenoh accepts connections itself and has no limit per address. So the kernel drops the first packet (SYN) of each new
connection from an address that floods, by a filter on Zenoh's listening sockets. Sessions that are open, and all other
addresses, go on; no frame is copied. docs/explanation/decisions/0010-floods.md states what else was tried.
"""

import ctypes
import ipaddress
import os
import socket
import struct
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

from sightline.protocol.clock import heartbeat_us
from sightline.protocol.log import RepeatLimiter
from sightline.protocol.transports.diagnosis import connection_ends, listening_inodes
from sightline.protocol.transports.endpoints import parse_zenoh_endpoint
from sightline.protocol.transports.zenoh.session import MAX_SESSIONS

MAX_OPEN: Final = MAX_SESSIONS
"""Connections of one address, half-open ones included: more than Zenoh accepts from all addresses."""
MAX_NEW: Final = MAX_SESSIONS
"""New connections of one address within `WINDOW_US`."""
WINDOW_US: Final = 3_000_000
BLOCKED_US: Final = 10_000_000
"""After this time without a flood the address may connect again."""
MAX_BLOCKED: Final = 64
"""Security limit: addresses that are blocked at a time."""
_CHECK_S: Final = 0.2
_OWN: Final = ("127.0.0.1", "::1")
"""This machine: its floods are reported and not blocked, because its services share one address."""


class Flood(NamedTuple):
    """A host over a limit: its connections now, and its new ones in a second."""

    host: str
    open: int
    new_per_s: float
    begins: bool
    """False while an earlier flood of the host goes on."""


class FloodDetector:
    """Finds the hosts that flood, from samples of the connections to a port. Computes only."""

    def __init__(self) -> None:
        self._known: frozenset[tuple[str, str]] = frozenset()
        self._new: dict[str, deque[tuple[int, int]]] = {}
        """Host -> time and count of its new connections, for each sample within the window."""
        self._blocked_until_us: dict[str, int] = {}

    def sample(self, ends: dict[tuple[str, str], str], now_us: int) -> list[Flood]:
        """Take a sample. Returns the hosts that are over a limit now.

        Args:
            ends: connection (local and remote end) -> its host.
            now_us: time of the sample.
        """
        for host, count in Counter(ends[end] for end in ends.keys() - self._known).items():
            self._new.setdefault(host, deque()).append((now_us, count))
        self._known = frozenset(ends)
        for host, samples in list(self._new.items()):
            while samples and now_us - samples[0][0] > WINDOW_US:
                samples.popleft()
            if not samples:
                del self._new[host]
        # Both limits: short connections are few at a time, and half-open ones are not new.
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


@contextmanager
def limit_floods(listen: Sequence[str], report: Callable[[str], None]) -> Iterator[None]:
    """Limit and report floods of connections to `listen` until the end of the `with`. WebSocket has its own limits."""
    ports = {parse_zenoh_endpoint(endpoint)[2] for endpoint in listen if "://" not in endpoint}
    ending = threading.Event()
    if ports:
        arguments = (ports, report, ending)
        threading.Thread(target=_watch, args=arguments, name="zenoh-floods", daemon=True).start()
    try:
        yield
    finally:
        ending.set()


def _watch(ports: set[int], report: Callable[[str], None], ending: threading.Event) -> None:
    detector, limiter, blocked, silent = FloodDetector(), RepeatLimiter(), list[str](), set[Peer]()
    while not ending.wait(_CHECK_S):
        now_us = heartbeat_us()
        floods = detector.sample(connection_ends(ports), now_us)
        # Before the report, so that what the log states is true.
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
    return (f"{over}, more than the total limit of {MAX_OPEN}; new ones are dropped for {BLOCKED_US / 1e6:.0f} s, open "
            "sessions go on; block that address or end the program there")


# Half-open connections of a host that floods. Zenoh does one TLS handshake at a time, and waits 10 s for a peer that
# sends nothing.


Peer = tuple[str, int]
_SENT_BYTES: Final = struct.Struct("128xQ")
"""`tcpi_bytes_received` in `struct tcp_info` of linux/tcp.h."""


def _end_half_open(ports: set[int], hosts: Sequence[str], waiting: set[Peer]) -> set[Peer]:
    """End connections from `hosts` that have not sent a byte since the last turn. Returns those that wait since now.

    A session that is open has sent bytes. An honest peer sends its first bytes when it connects.
    """
    silent: set[Peer] = set()
    for link in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # closed meanwhile, or no TCP socket
            if not str(link.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(link.name))) as one:
                if one.family not in (socket.AF_INET, socket.AF_INET6) or one.getsockname()[1] not in ports:
                    continue
                host, port = one.getpeername()[:2]
                info = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _SENT_BYTES.size)
                if host.removeprefix("::ffff:") not in hosts or _SENT_BYTES.unpack(info)[0]:
                    continue
                silent.add((host, port))
                if (host, port) in waiting:
                    one.shutdown(socket.SHUT_RDWR)
    return silent


# The filter on a listening socket: a classic BPF program, which needs no privilege.


_SO_ATTACH_FILTER: Final = 26
_INSTRUCTION: Final = struct.Struct("HBBI")
_LOAD_BYTE, _LOAD_WORD, _AND, _IF_EQUAL, _RETURN = 0x30, 0x20, 0x54, 0x15, 0x06
_NETWORK_HEADER: Final = 0x1_0000_0000 - 0x10_0000  # SKF_NET_OFF of linux/filter.h
_SYN, _SYN_ACK, _TCP_FLAGS, _IP_SOURCE = 0x02, 0x12, 13, 12
_PASS, _DROP = 0xFFFF_FFFF, 0


def syn_filter(addresses: Sequence[int]) -> list[tuple[int, int, int, int]]:
    """Return the instructions (code, jump if true, jump if false, operand) that drop a SYN from IPv4 `addresses`.

    An open session sends no SYN, so it passes even where its address is listed, and where its socket inherits this.
    """
    rows = len(addresses)
    checks = [(_IF_EQUAL, rows - place, 0, address) for place, address in enumerate(addresses)]
    return [
        (_LOAD_BYTE, 0, 0, _TCP_FLAGS),
        (_AND, 0, 0, _SYN_ACK),
        (_IF_EQUAL, 0, rows + 4, _SYN),
        (_LOAD_BYTE, 0, 0, _NETWORK_HEADER),
        (_AND, 0, 0, 0xF0),
        (_IF_EQUAL, 0, rows + 1, 0x40),  # IPv4
        (_LOAD_WORD, 0, 0, _NETWORK_HEADER + _IP_SOURCE),
        *checks,
        (_RETURN, 0, 0, _PASS),
        (_RETURN, 0, 0, _DROP),
    ]


def _block(ports: set[int], hosts: Sequence[str]) -> None:
    """Drop new connections from `hosts` on the listening sockets of this process, and from no other host."""
    addresses = [int(ip) for host in hosts if (ip := ipaddress.ip_address(host.partition("%")[0])).version == 4]
    program = b"".join(_INSTRUCTION.pack(*row) for row in syn_filter(addresses))
    buffer = ctypes.create_string_buffer(program)
    pointer = struct.pack("HP", len(program) // _INSTRUCTION.size, ctypes.addressof(buffer))
    wanted = {f"socket:[{inode}]" for inode in listening_inodes(ports)}
    for link in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # closed meanwhile, or another system
            if str(link.readlink()) in wanted:
                with socket.socket(fileno=os.dup(int(link.name))) as listener:
                    listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, pointer)
