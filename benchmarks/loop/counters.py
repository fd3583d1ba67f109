"""The kernel's counters: CPU time, memory, bytes of each TCP connection. Shell (/proc, netlink)."""

import os
import socket
import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sightline.protocol.errors import HardwareError

_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")
_IDLE, _IOWAIT, _STEAL = 3, 4, 7  # columns of /proc/stat, proc(5)


@dataclass(frozen=True, slots=True)
class Reading:
    """Counters of the kernel at one moment. `busy_s` is of all processes, `steal_s` of the hypervisor."""

    cpu_s: Mapping[str, float]
    own_s: float
    busy_s: float
    steal_s: float


def read_machine(pids: Mapping[str, int]) -> Reading:
    """Read all counters now. Raises HardwareError if a process has ended."""
    columns = [int(text) / _TICKS_PER_S for text in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return Reading(
        cpu_s={name: _cpu_s(pid) for name, pid in pids.items()},
        own_s=_cpu_s(os.getpid()),
        busy_s=sum(columns) - columns[_IDLE] - columns[_IOWAIT] - columns[_STEAL],
        steal_s=columns[_STEAL],
    )


def taken_percent(before: Reading, after: Reading, seconds: float) -> float:
    """Return the share of the machine's time taken by the hypervisor or by other processes."""
    ours_s = after.own_s - before.own_s + sum(after.cpu_s[name] - before.cpu_s[name] for name in after.cpu_s)
    others_s = max(0.0, after.busy_s - before.busy_s - ours_s) + after.steal_s - before.steal_s
    return 100 * others_s / (seconds * (os.cpu_count() or 1))


def high_water_mb(pid: int) -> float:
    """Return the peak memory of the process, in MB of 2**20 bytes. Raises HardwareError if it has ended."""
    return _memory_mb(pid, "VmHWM:")


def resident_mb(pid: int) -> float:
    """Return the memory of the process, in MB of 2**20 bytes. Raises HardwareError if it has ended."""
    return _memory_mb(pid, "VmRSS:")


def _memory_mb(pid: int, field: str) -> float:
    lines = _read(pid, "status").splitlines()
    held_kib = next((int(line.split()[1]) for line in lines if line.startswith(field)), None)
    if held_kib is None:  # it has ended, and its parent has not reaped it
        raise _gone(pid)
    return held_kib / 1024


def _read(pid: int, file: str) -> str:
    try:
        return Path(f"/proc/{pid}/{file}").read_text()
    except OSError:
        raise _gone(pid) from None


def _gone(pid: int) -> HardwareError:
    return HardwareError(f"process {pid} ended while it was measured; start the services by hand to see why it ends")


def _cpu_s(pid: int) -> float:
    # The command name is in parentheses and may contain anything; the fields from number 3 on follow it.
    fields = _read(pid, "stat").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


# Bytes that TCP connections on loopback have carried, per connection. Shell (netlink, Linux).  The
# counters of the loopback interface include all programs; these are of a contestant's sockets only. sock_diag(7)
# describes the query and the reply; tcp_info is that of linux/tcp.h.


Connection = tuple[int, int]
"""(listening port, port of the peer)."""

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
    """Return the payload bytes, both ways, of every open connection to `ports`; empty without kernel support."""
    query = _QUERY.pack(socket.AF_INET, socket.IPPROTO_TCP, 1 << (_INET_DIAG_INFO - 1), 0, 1 << _ESTABLISHED)
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_SOCK_DIAG) as kernel:
            kernel.send(_HEAD.pack(_HEAD.size + len(query), _SOCK_DIAG_BY_FAMILY, _REQUEST_DUMP, 1, 0) + query)
            found = [_connection(message) for message in _messages(kernel)]
    except (OSError, AttributeError):
        return {}
    return {connection: count for connection, count in found if connection[0] in ports}


def carried_between(before: Mapping[Connection, int], after: Mapping[Connection, int]) -> int | None:
    """Count the bytes between two readings. Of several connections to one port the busiest counts.

    The others belong to viewers. None without counters.
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
