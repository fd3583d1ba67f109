"""The network emulator between two network namespaces. Shell; needs root.

For kernels without netem. Shapes are JSON lines on stdin (`{"ab": {...}, "ba": {...}}`); each is answered by a line of
counts on stdout once it is in force.

    python -m sightline.sim.tun_emulator NAMESPACE_A NAMESPACE_B
"""

import ctypes
import fcntl
import json
import os
import select
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from sightline.protocol.clock import monotonic_us
from sightline.protocol.config import first_problem
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.sim.network_emulator import EmulatedLeg, EmulatedLink, LinkShapes

ADDRESS_A: Final = "10.213.77.1"
ADDRESS_B: Final = "10.213.77.2"
DEVICE: Final = "wire0"
MTU_BYTES: Final = 1400
_READS_PER_TURN: Final = 64
_LONGEST_WAIT_S: Final = 0.5
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI, _CLONE_NEWNET = 0x400454CA, 0x0001, 0x1000, 0x40000000


def why_impossible() -> str:
    """Return why this machine cannot run a wire, or ""."""
    if os.geteuid() != 0:
        return "needs root"
    return "" if Path("/dev/net/tun").exists() else "needs /dev/net/tun"


@contextmanager
def namespaces(*names: str) -> Iterator[None]:
    """Create the network namespaces while inside. Raises HardwareError if the kernel does not permit it."""
    made: list[str] = []
    try:
        for name in names:
            _ip("netns", "add", name)
            made.append(name)
            _ip("-n", name, "link", "set", "lo", "up")
        yield
    finally:
        for name in made:
            _ip("netns", "del", name)


def move_address(namespace: str, old: str, new: str) -> None:
    """Change the address of this end of the wire, as a router may do."""
    _ip("-n", namespace, "addr", "del", f"{old}/24", "dev", DEVICE)
    _ip("-n", namespace, "addr", "add", f"{new}/24", "dev", DEVICE)


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        what = f"`ip {' '.join(arguments)}`: {done.stderr.strip()}"
        raise HardwareError(f"no network namespace: {what}; run as root with iproute2 installed")


def _open_tun(namespace: str, address: str) -> int:
    """Open a TUN device inside `namespace`. Returns its descriptor."""
    libc = ctypes.CDLL(None, use_errno=True)
    ours = os.open("/proc/self/ns/net", os.O_RDONLY)
    theirs = os.open(f"/var/run/netns/{namespace}", os.O_RDONLY)
    try:
        if libc.setns(theirs, _CLONE_NEWNET):
            raise HardwareError(f"cannot enter namespace {namespace}: {os.strerror(ctypes.get_errno())}; run as root")
        tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), _IFF_TUN | _IFF_NO_PI))
    finally:
        libc.setns(ours, _CLONE_NEWNET)
        os.close(theirs)
        os.close(ours)
    _ip("-n", namespace, "addr", "add", f"{address}/24", "dev", DEVICE)
    _ip("-n", namespace, "link", "set", DEVICE, "mtu", str(MTU_BYTES), "up")
    return tun


def run(namespace_a: str, namespace_b: str) -> int:
    """Carry packets until stdin closes. Prints `wire ready`. Raises HardwareError, ConfigError."""
    wire = EmulatedLink()
    legs = {_open_tun(namespace_a, ADDRESS_A): wire.ab, _open_tun(namespace_b, ADDRESS_B): wire.ba}
    far_ends = dict(zip(reversed(legs), legs.values(), strict=True))
    print("wire ready", flush=True)
    stdin = sys.stdin.fileno()
    while True:
        readable, _, _ = select.select([*legs, stdin], [], [], _wait_s(wire))
        for tun in legs.keys() & readable:
            _read(tun, legs[tun])
        for tun, leg in far_ends.items():
            _write(leg, tun)
        if stdin in readable and not _reshape(wire):
            return 0


def _reshape(wire: EmulatedLink) -> bool:
    """Apply a line of stdin. Returns False at its end."""
    line = sys.stdin.readline()
    if line:
        wire.shape(_read_shapes(line))
        print(json.dumps(wire.counts()), flush=True)
    return bool(line)


def _wait_s(wire: EmulatedLink) -> float:
    due_us = min((leg.next_us for leg in (wire.ab, wire.ba) if leg.next_us is not None), default=float("inf"))
    return max(0.0, min(_LONGEST_WAIT_S, (due_us - monotonic_us()) / 1e6))


def _read(tun: int, leg: EmulatedLeg) -> None:
    with suppress(BlockingIOError):
        for _ in range(_READS_PER_TURN):
            leg.put(os.read(tun, 2 * MTU_BYTES), monotonic_us())


def _write(leg: EmulatedLeg, tun: int) -> None:
    for packet in leg.take_due(monotonic_us()):
        with suppress(OSError):  # the other end is closing
            os.write(tun, packet)


def _read_shapes(line: str) -> LinkShapes:
    try:
        return LinkShapes.model_validate_json(line)
    except ValidationError as error:
        raise ConfigError(f"wire: {line.strip()[:80]!r}: {first_problem(error)}") from None


if __name__ == "__main__":
    sys.exit(run(*sys.argv[1:3]))
