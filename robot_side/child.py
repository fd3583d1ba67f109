"""The driver's hold on its network process: start it, talk to it without ever waiting for it, start it again. Shell."""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Final

from sightline.protocol.config import Config
from sightline.protocol.messages import SessionId
from sightline.robot_side import pipe as ipc
from sightline.robot_side.config import RobotConfig

_PACKETS_PER_WAKE = 64  # a flood is drained in portions, so that no tick waits for its end
_PACKETS_ASIDE = 1024  # more than that socket holds: all of it, but not for ever
_DRAIN_US = 500_000  # to read what a dead process sent; a descendant may hold its end open
_FIRST_BACKOFF_US = 700_000  # the wheels are at zero before anybody can drive them again
_LONGEST_BACKOFF_US = 2_000_000
_WEDGED_US = 2_000_000
_STARTS_WITHIN_US = 30_000_000  # a first start reads its packages from a slow card
_END_S = 1.0
_CHILD: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); from sightline.robot_side.network.process import main; main()"
)
"""It looks for modules where the driver does: neither first in the folder that it starts in, where a file of the user's
may be called as one of Python's, nor in another copy of this package than the driver's."""


class NetworkSetup(Config):
    """What the network process is told at its start, as its first packet."""

    config: RobotConfig
    session: SessionId
    first_seq: int


class DriverEnd:
    """The network process as the driver sees it. No method waits for it, except `close`."""

    def __init__(self, config: RobotConfig, session: str, say: Callable[[str], None]) -> None:
        self._say = say
        self._heard = False
        self._heard_us = 0
        self._config = config
        self._session = session
        self._process: subprocess.Popen[bytes] | None = None
        self.socket: socket.socket | None = None
        """To wait on: commands from it, verdicts and messages to it."""
        self._aside: socket.socket | None = None
        """Nobody waits on it: frames issued, and the robot's motion. It wakes neither end."""
        self._gone_us = 0
        self._start_at_us = 0
        self._backoff_us = _FIRST_BACKOFF_US
        self._was_ready = False
        self.restarts = -1
        self.exit_code = 0
        self.failed_at_start = False

    def keep_alive(self, now_us: int, first_seq: int) -> None:
        """Start it if it is not there and its time has come."""
        if self._process is not None and self._process.poll() is not None and self._is_read(now_us):
            self._on_exit(self._process.returncode, now_us)
        if self._heard:
            self._heard, self._heard_us = False, now_us
        if self._process is not None and self._was_ready and now_us - self._heard_us > _WEDGED_US:
            self._process.kill()  # stopped or wedged: it reports five times a second while it is well
        if self._process is None and now_us >= self._start_at_us and not self.failed_at_start:
            self._heard_us = now_us + _STARTS_WITHIN_US
            try:
                self._start(first_seq)
            except OSError as error:
                self._say(f"network process does not start: {error.strerror}; trying again")
                self._start_at_us = now_us + _LONGEST_BACKOFF_US

    def _start(self, first_seq: int) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        aside, their_aside = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ExitStack() as undo, theirs, their_aside:
            for end in (ours, aside):
                undo.callback(end.close)
                end.setblocking(False)
            setup = NetworkSetup(config=self._config, session=self._session, first_seq=first_seq)
            ours.send(setup.model_dump_json().encode())
            ends = (theirs.fileno(), their_aside.fileno())
            self._process = subprocess.Popen(_command(ends), pass_fds=ends, stdin=subprocess.DEVNULL)
            undo.pop_all()
        self.socket, self._aside = ours, aside
        self.restarts += 1

    def _is_read(self, now_us: int) -> bool:
        """Whether all is read that the dead process sent: its last packet may be a STOP."""
        self._gone_us = self._gone_us or now_us
        return self.socket is None or now_us - self._gone_us >= _DRAIN_US

    def _on_exit(self, code: int, now_us: int) -> None:
        self._process, self._gone_us = None, 0
        self._hang_up()
        if not self._was_ready:  # it said why itself
            self.failed_at_start, self.exit_code = True, code if code > 0 else 1
            return
        self._say(f"network process ended ({code}); starting it again")
        self._start_at_us = now_us + self._backoff_us
        self._backoff_us = min(2 * self._backoff_us, _LONGEST_BACKOFF_US)

    def on_ready(self) -> None:
        """Its endpoint is open: from here on it is restarted whatever happens."""
        self._was_ready = True
        self._backoff_us = _FIRST_BACKOFF_US

    def send(self, packet: bytes) -> None:
        """Hand over a packet or drop it: a child that does not read must not slow the driver."""
        _send_or_drop(self.socket, packet)

    def send_aside(self, packet: bytes) -> None:
        """As `send`, without waking it: it looks when it needs to know."""
        _send_or_drop(self._aside, packet)

    def packets(self) -> Iterator[bytes]:
        """What it has sent, a bounded portion: first all that it sent aside before."""
        arrived = list(self._arrived())
        for _ in range(_PACKETS_ASIDE):
            packet = _receive(self._aside) if self._aside else None
            if not packet:
                break
            yield packet
        self._heard = self._heard or bool(arrived)
        yield from arrived

    def _arrived(self) -> Iterator[bytes]:
        for _ in range(_PACKETS_PER_WAKE):
            packet = _receive(self.socket) if self.socket else None
            if packet:
                yield packet
            elif packet is None:
                return
            elif self.socket:  # it is gone, and all that it sent is read
                self.socket.close()
                self.socket = None

    def _hang_up(self) -> None:
        for end in (self.socket, self._aside):
            if end:
                end.close()
        self.socket = self._aside = None

    def close(self) -> None:
        """End it: it leaves when its socket closes, and is killed if it does not within a second."""
        self._hang_up()
        if self._process is None:
            return
        deadline_s = time.monotonic() + _END_S
        while self._process.poll() is None and time.monotonic() < deadline_s:
            time.sleep(0.01)
        self._process.kill()
        self._process.wait()


def _command(ends: Sequence[int]) -> list[str]:
    folders = [one for one in sys.path if isinstance(one, str)]  # Python ignores all else that a plug-in puts there
    return [sys.executable, "-P", "-c", _CHILD, *map(str, ends), json.dumps(folders)]


def _send_or_drop(end: socket.socket | None, packet: bytes) -> None:
    if end:
        try:
            end.send(packet)
        except OSError:
            return


def _receive(end: socket.socket) -> bytes | None:
    """The next packet; None while there is none; empty when the other end is gone and all it sent has been read."""
    for _ in range(2):
        try:
            return end.recv(ipc.MAX_PACKET_BYTES)
        except BlockingIOError:
            return None
        except OSError:  # that it left packets of ours unread is told first, once; what it sent still waits
            continue
    return b""
