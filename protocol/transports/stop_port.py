"""Serve the STOP port in a separate process, which does nothing else. Shell (sockets); standard library only."""

import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any, Final

from sightline.protocol.errors import ConfigError, home_path

Address = tuple[str, int]
Origin = tuple[int, Address]
Replies = Iterable[tuple[bytes, Origin]]

_AT_ONCE: Final = 64
"""Datagrams of one socket before the next one is read, so that a flood on one address does not delay another."""
_PERIOD_MS: Final = 100
_RETRY_US: Final = 1_000_000
_LONGEST: Final = 2048
_IGNORED: Final = (signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP, signal.SIGHUP, signal.SIGTERM)
"""Signals to all processes of a terminal or service. STOP is served until the other processes have ended."""


def now_us() -> int:
    """Return the monotonic time, us."""
    return time.monotonic_ns() // 1000


class StopPort:
    """UDP sockets on a set of addresses, and the pipe to the process that started this one."""

    def __init__(self, pipe: socket.socket, addresses: Sequence[Address], *, outgoing: bool = False) -> None:
        """Bind the addresses. An address that is in use is tried again each second.

        Args:
            pipe: `SOCK_SEQPACKET` end; `serve` returns when the other end is closed.
            addresses: addresses to listen on.
            outgoing: True to also open sockets on free ports, for datagrams to other hosts.
        """
        self._pipe, self._missing = pipe, list(addresses)
        self._sockets: dict[int, socket.socket] = {}
        self._poll = select.poll()
        self._poll.register(pipe, select.POLLIN)
        self._retry_us = 0
        self._outgoing: dict[int, socket.socket] = {}
        for host in ("0.0.0.0", "::") if outgoing else ():
            with suppress(OSError):  # the system has no IPv6
                one = self._add(_bound((host, 0)))
                self._outgoing[one.family] = one
        self._bind_missing()

    def _add(self, one: socket.socket) -> socket.socket:
        one.setblocking(False)
        self._sockets[one.fileno()] = one
        self._poll.register(one, select.POLLIN)
        return one

    def _bind_missing(self) -> None:
        # An address may appear after the start, e.g. of a Wi-Fi, or become free when an earlier receiver ends.
        first = self._retry_us == 0
        self._retry_us = now_us() + _RETRY_US
        for address in list(self._missing):
            try:
                self._add(_bound(address))
            except OSError as error:
                if first:
                    self.log(f"STOP port {address[0]}:{address[1]}/udp: {error.strerror}; trying again, until then "
                             "STOP needs the link")
                continue
            self._missing.remove(address)
            if not first:
                self.log(f"STOP port {address[0]}:{address[1]}/udp is open")

    def log(self, line: str) -> None:
        """Send a line for the log."""
        self.send(b"L" + line.encode())

    def send(self, packet: bytes) -> bool:
        """Send a packet to the process that started this one. Returns False without room."""
        # Without waiting: if the pipe is full, it already contains a STOP.
        try:
            self._pipe.send(packet, socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def send_to(self, data: bytes, origin: Origin) -> None:
        """Send a datagram or drop it."""
        # Without waiting: the sender of a STOP repeats it, and gets an answer then.
        with suppress(OSError, KeyError):
            self._sockets[origin[0]].sendto(data, origin[1])

    def send_out(self, data: bytes, address: Address) -> str:
        """Send a datagram to another host. Returns the error, or ""."""
        problems = []
        try:
            found = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:
            return str(getattr(error, "strerror", error))
        # A name may have addresses of both families while its host listens on one, so the first of each is used.
        places = {family: place for family, _, _, _, place in reversed(found) if family in self._outgoing}
        for family, place in places.items():
            try:
                self._outgoing[family].sendto(data, place)
            except OSError as error:
                problems.append(error.strerror)
        return "" if len(problems) < len(places) else str(next(iter(problems), "no IPv6 on this machine"))

    def serve(
        self, on_datagram: Callable[[bytes, Origin], Replies], on_packet: Callable[[bytes], None],
        on_turn: Callable[[], None],
    ) -> None:
        """Process datagrams and packets until the pipe closes. `on_turn` runs after each round, at least at 10 Hz."""
        while True:
            ready = self._poll.poll(_PERIOD_MS)
            for number, _ in ready:
                if number in self._sockets:
                    self._read(number, on_datagram)
                elif not self._read_pipe(on_packet):
                    return
            on_turn()
            if self._missing and now_us() >= self._retry_us:
                self._bind_missing()

    def _read(self, number: int, on_datagram: Callable[[bytes, Origin], Replies]) -> None:
        one = self._sockets[number]
        # In portions, so that the pipe is read between them even in a flood.
        for _ in range(_AT_ONCE):
            try:
                data, address = one.recvfrom(_LONGEST)
            except BlockingIOError:
                return
            except OSError:  # the ICMP error of a host without this port, for an earlier datagram
                continue
            for reply, origin in on_datagram(data, (number, address)):
                self.send_to(reply, origin)

    def _read_pipe(self, on_packet: Callable[[bytes], None]) -> bool:
        try:
            packet = self._pipe.recv(_LONGEST, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return True
        except OSError:
            return False
        if packet:
            on_packet(packet)
        return bool(packet)


def _bound(address: Address) -> socket.socket:
    family, kind, number, _, place = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)[0]
    one = socket.socket(family, kind, number)
    try:
        one.bind(place)
    except OSError:
        one.close()
        raise
    return one


def read_arguments() -> tuple[socket.socket, dict[str, Any]]:
    """Return the pipe and the options of this process, see `StopProcess`. SIGKILL or the end of the pipe ends it."""
    for number in _IGNORED:
        signal.signal(number, signal.SIG_IGN)
    return socket.socket(fileno=int(sys.argv[1])), json.loads(sys.argv[2])


STOP_SECRET_FILE: Final = "stop.secret"
"""File of the secret of STOP datagrams, which robots, routers and operators share."""
_SECRET_BYTES: Final = 16
"""Security limit: a shorter secret can be guessed from one recorded datagram. `sightline keys` writes 32 letters."""


def stop_secret_file(folder: str) -> str:
    """Return the path of the STOP secret in a folder from `sightline keys`.

    Raises:
        ConfigError: the file is missing, as in folders of earlier releases, or invalid.
    """
    file = home_path(folder) / STOP_SECRET_FILE
    if not file.is_file():
        raise ConfigError(f"{file} is missing: STOP works on the link only; copy it from where the keys were made; if "
                          f"it is missing there too, add it there with `sightline keys add {folder} stop`, and copy it "
                          "to robots, routers and operators")
    read_secret(str(file))
    return str(file)


def read_secret(file: str) -> bytes:
    """Return the STOP secret in `file`, or b"" without a file.

    Raises:
        ConfigError: the file is unreadable, or its secret is too short. An empty secret would permit every STOP.
    """
    if not file:
        return b""
    try:
        with open(file, "rb") as opened:  # noqa: PTH123  pathlib takes memory
            secret = opened.read().strip()
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}; STOP works on the link only; make it readable") from None
    if len(secret) < _SECRET_BYTES:
        raise ConfigError(f"{file} has {len(secret)} bytes, expected {_SECRET_BYTES} or more: STOP works on the link "
                          f"only; replace it with `sightline keys add {file.rpartition('/')[0]} stop`, and copy it to "
                          "robots, routers and operators")
    return secret


# The process that starts a STOP process.


_RESTART_US: Final = 1_000_000
_UNREAD_BYTES: Final = 240
"""Two seconds of reports of a robot at rest. A running process reads each one immediately, also in a flood."""
_MAX_BEHIND: Final = 5
"""Checks, a second after each other, that find so many unread bytes in the pipe of a stopped or hung process."""
_START_CHECKS: Final = 30
"""Such checks after a start, which may read its modules from a slow card. They end when no packet is unread."""
_CHILD: Final = (
    "import sys; top = type(sys)('sightline'); top.__path__ = [sys.argv.pop(1)]; sys.modules['sightline'] = top; "
    "from sightline.{} import main; main()"
)
"""It runs without Python's site module, which takes 2 MB, and finds only this package."""


class StopProcess:
    """A process that serves the STOP port. It ends when all copies of `near` are closed."""

    def __init__(
        self, module: str, options: dict[str, Any], ends: tuple[socket.socket, socket.socket] | None = None
    ) -> None:
        """Prepare the process; `keep_alive` starts it.

        Args:
            module: module below `sightline` with a function `main`.
            options: options of that function, as JSON.
            ends: `near` and `far` of an earlier program, which this one continues; default: a new pair.
        """
        self.near, self.far = ends or socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        """`near` is the end of the process that applies a STOP. Packets wait in it until they are read."""
        self.near.setblocking(False)
        self.module, self.options = module, options
        self._process: Any = None
        self._start_at_us = 0
        self._behind = 0

    def keep_alive(self, at_us: int) -> None:
        """Start the process if it does not run, at most once a second. One that reads no packets is killed first."""
        if at_us < self._start_at_us:
            return
        self._start_at_us = at_us + _RESTART_US
        if self._process is not None and self._process.poll() is None:
            unread_bytes = self._unread_bytes()
            is_behind = unread_bytes >= _UNREAD_BYTES or (self._behind < 0 < unread_bytes)
            self._behind = self._behind + 1 if is_behind else 0
            if self._behind == _MAX_BEHIND:
                self._process.kill()
        else:
            # Imported here, because the STOP process itself should not load them.
            import logging
            import subprocess

            if self._process is not None:
                logging.getLogger(__name__).error(
                    "STOP %s ended (%s); starting it again", self.module.rpartition("_")[2],
                    "stopped or hung" if self._behind >= _MAX_BEHIND else self._process.poll())
            self._behind = _MAX_BEHIND - _START_CHECKS
            root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))  # noqa: PTH100, PTH120
            number = self.far.fileno()
            command = [sys.executable, "-I", "-S", "-c", _CHILD.format(self.module), root, str(number)]
            command.append(json.dumps(self.options))
            # The child inherits the mask, so that no signal interrupts its imports. Later it ignores the signals.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, _IGNORED)
            with suppress(OSError):  # no process or descriptor is free now; the next call tries again
                self._process = subprocess.Popen(command, pass_fds=[number], stdin=subprocess.DEVNULL)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _unread_bytes(self) -> int:
        """Return the size of the packets that the process has not read."""
        import fcntl
        import termios

        return int.from_bytes(fcntl.ioctl(self.far, termios.FIONREAD, bytes(4)), sys.byteorder)

    @property
    def pid(self) -> int:
        """Return its process id, 0 before the first start."""
        return self._process.pid if self._process is not None else 0

    def note_end(self, status: int) -> None:
        """Store the wait status that the caller received, if it waits for all its children."""
        self._process.returncode = os.waitstatus_to_exitcode(status)

    def close(self) -> None:
        """End the process."""
        self.near.close()
        self.far.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def read_packets(near: socket.socket) -> Iterable[bytes]:
    """Yield the received packets of a STOP process, up to a limit."""
    for _ in range(_AT_ONCE):
        try:
            packet = near.recv(_LONGEST)
        except OSError:
            return
        if not packet:
            return
        yield packet


def send_packet(near: socket.socket, packet: bytes) -> None:
    """Send a packet to a STOP process, or drop it."""
    with suppress(OSError):
        near.send(packet)
