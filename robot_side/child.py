"""The driver's hold on its network process: start it, talk to it without ever waiting for it, start it again. Shell."""

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

from protocol.config import Config
from protocol.messages import SessionId
from robot_side import ipc
from robot_side.config import RobotConfig

_PACKETS_PER_WAKE = 64  # a flood is drained in portions, so that no tick waits for its end
_FIRST_BACKOFF_US = 700_000  # the wheels are at zero before anybody can drive them again
_LONGEST_BACKOFF_US = 2_000_000
_WEDGED_US = 2_000_000
_STARTS_WITHIN_US = 30_000_000  # a first start reads its packages from a slow card
_END_S = 1.0


class Setup(Config):
    """What the network process is told at its start, as its first packet."""

    config: RobotConfig
    session: SessionId
    first_seq: int


class NetworkChild:
    """The network process as the driver sees it. No method waits for it, except `close`."""

    def __init__(self, config: RobotConfig, session: str, say: Callable[[str], None]) -> None:
        self._say = say
        self._heard = False
        self._heard_us = 0
        self._config = config
        self._session = session
        self._process: subprocess.Popen[bytes] | None = None
        self.socket: socket.socket | None = None
        self._start_at_us = 0
        self._backoff_us = _FIRST_BACKOFF_US
        self._was_ready = False
        self.restarts = -1
        self.exit_code = 0
        self.failed_at_start = False

    def keep_alive(self, now_us: int, first_seq: int) -> None:
        """Start it if it is not there and its time has come."""
        if self._process is not None and self._process.poll() is not None:
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
        with ExitStack() as undo, theirs:
            undo.callback(ours.close)
            ours.setblocking(False)
            setup = Setup(config=self._config, session=self._session, first_seq=first_seq)
            ours.send(setup.model_dump_json().encode())
            command = [sys.executable, "-m", "robot_side.network", str(theirs.fileno())]
            self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
            undo.pop_all()
        self.socket = ours
        self.restarts += 1

    def _on_exit(self, code: int, now_us: int) -> None:
        self._process = None
        if self.socket:
            self.socket.close()
            self.socket = None
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
        if self.socket:
            try:
                self.socket.send(packet)
            except OSError:
                return

    def packets(self) -> Iterator[bytes]:
        """What it has sent, a bounded portion."""
        for _ in range(_PACKETS_PER_WAKE):
            packet = self._receive()
            if not packet:
                return
            self._heard = True
            yield packet

    def _receive(self) -> bytes:
        if self.socket is None:
            return b""
        try:
            packet = self.socket.recv(ipc.MAX_PACKET_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            packet = b""
        if not packet:  # it is gone, or will be: nothing more to wait for on this socket
            self.socket.close()
            self.socket = None
        return packet

    def close(self) -> None:
        """End it: it leaves when its socket closes, and is killed if it does not within a second."""
        if self.socket:
            self.socket.close()
            self.socket = None
        if self._process is None:
            return
        deadline_s = time.monotonic() + _END_S
        while self._process.poll() is None and time.monotonic() < deadline_s:
            time.sleep(0.01)
        self._process.kill()
        self._process.wait()
