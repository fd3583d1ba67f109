"""Become the guardian of a fork of this process, and the fork's end of their sockets. Shell.

The process that the user or systemd started becomes the guardian, so that it is the parent of each driver process. The
fork continues as the first driver process, without a second start of the interpreter.
"""

import json
import logging
import os
import select
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NoReturn

from sightline.protocol.clock import heartbeat_us
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.transports.endpoints import own_stop_addresses, stop_addresses
from sightline.protocol.transports.stop_datagram import STOP_PORT
from sightline.protocol.transports.stop_port import StopProcess, stop_secret_file
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.driver.supervision import EXIT_SIGNALS, GUARDIAN_PRIORITY, schedule_real_time
from sightline.robot_side.guardian import stop_receiver
from sightline.robot_side.guardian.core import FAILED, LOST, STARTS_WITHIN_US, pack_beat
from sightline.robot_side.guardian.zero import write_note
from sightline.robot_side.plugins import DRIVES

_log: Final = logging.getLogger(__name__)

_GUARDIAN: Final = (
    "import json, sys; setup = json.load(open(int(sys.argv.pop()))); sys.path[:] = setup['path']; "
    "top = type(sys)('sightline'); top.__path__ = [setup['root']]; sys.modules['sightline'] = top; "
    "from sightline.robot_side.guardian.process import main; main(setup)"
)
"""It uses the module search path of this process, without Python's site module, which takes 2 MB."""


class GuardianEnd:
    """The driver process's end of the sockets to its guardian."""

    def __init__(
        self, heartbeats: socket.socket, stops: socket.socket | None = None, *, is_restart: bool = False
    ) -> None:
        for end in filter(None, (heartbeats, stops)):
            end.setblocking(False)
        self.heartbeats = heartbeats
        """Readable when the guardian is gone."""
        self.stops = stops
        """STOPs of the STOP receiver, also earlier ones than this process; None without a receiver."""
        self.is_restart = is_restart
        """True if the guardian started this process after another one."""

    def wait(self) -> None:
        """Wait until the guardian watches this process. Before that, nothing may move.

        Raises:
            HardwareError: the guardian ended, or is not ready in time.
        """
        if not select.select([self.heartbeats], [], [], STARTS_WITHIN_US / 1e6)[0] or self.is_gone():
            raise HardwareError("the guardian of this process does not start; see its line above")

    def beat(self, kind: bytes) -> None:
        """Send a heartbeat; never waits."""
        with suppress(OSError):
            self.heartbeats.send(pack_beat(kind, heartbeat_us()))
            if kind in (LOST, FAILED):  # the last heartbeat: the end of the socket wakes the guardian immediately
                self.heartbeats.shutdown(socket.SHUT_WR)

    def is_gone(self) -> bool:
        """Return True if the guardian is dead."""
        try:
            return not self.heartbeats.recv(1)
        except BlockingIOError:
            return False
        except OSError:
            return True


def become_guardian(config: RobotConfig, *, restarts: bool) -> GuardianEnd:
    """Fork. The parent becomes the guardian and never returns; the fork returns its end of the sockets.

    Args:
        config: the robot; its drive must have `zero(config)`.
        restarts: True if the guardian starts a new driver process after this one. Interactive tools end instead.

    Raises:
        ConfigError: the drive cannot be loaded or has no `zero`.
    """
    zero, options = zero_of(config)
    beats, their_beats = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    receiver = stop_receiver_of(config) if restarts else None
    setup = {
        "root": str(Path(__file__).parent.parent.parent),
        "path": [one for one in sys.path if isinstance(one, str)],
        "robot": config.robot,
        "zero": {"module": zero.__module__, "name": zero.__qualname__, "config": options},
        "driver": config.model_dump_json() if restarts else None,
        "beats": beats.fileno(),
        "receiver": receiver and {
            "module": receiver.module, "options": receiver.options,
            "near": receiver.near.fileno(), "far": receiver.far.fileno(),
        },
    }
    try:
        write_note(setup)
    except OSError as error:
        _log.warning("robot %s: no note of its drive: %s, so its wheels stop a second later if all its processes die "
                     "at once; see that the folder RUNTIME_DIRECTORY can be written", config.robot, error.strerror)
    for handler in (*logging.getLogger().handlers, sys.stdout, sys.stderr):
        handler.flush()
    signal.pthread_sigmask(signal.SIG_BLOCK, EXIT_SIGNALS)  # until the guardian can forward them
    setup["pid"] = os.fork()
    if setup["pid"]:
        _execute(setup, [end.fileno() for end in (beats, *((receiver.near, receiver.far) if receiver else ()))])
    signal.pthread_sigmask(signal.SIG_UNBLOCK, EXIT_SIGNALS)
    beats.close()
    if receiver is None:
        return GuardianEnd(their_beats)
    receiver.far.close()
    return GuardianEnd(their_beats, receiver.near)


def _execute(setup: dict[str, Any], ends: list[int]) -> NoReturn:
    try:
        schedule_real_time(GUARDIAN_PRIORITY)  # now, because the fork gets real-time scheduling during this start
        file = os.memfd_create("guardian", 0)  # the setup stays out of the process list
        os.write(file, json.dumps(setup).encode())
        os.lseek(file, 0, os.SEEK_SET)
        for number in ends:
            os.set_inheritable(number, True)
        os.execv(sys.executable, [sys.executable, "-I", "-S", "-c", _GUARDIAN, str(file)])
    finally:
        os._exit(1)  # the fork detects that its guardian is gone


def stop_receiver_of(config: RobotConfig) -> StopProcess | None:
    """Prepare the STOP receiver for the links of this robot; None with keys but without a STOP secret.

    Raises:
        ConfigError: the robot listens at an endpoint without a possible STOP port.
    """
    addresses, routers = own_stop_addresses(config.listen), stop_addresses(config.connect)
    try:
        secret_file = stop_secret_file(config.secure) if config.secure else ""
    except ConfigError as error:
        _log.warning("robot %s: %s", config.robot, error)
        return None
    if not addresses and not routers:
        addresses = [("127.0.0.1", STOP_PORT)]
    return stop_receiver.start(config.robot, addresses, routers, secret_file)


def zero_of(config: RobotConfig) -> tuple[Callable[[Mapping[str, Any]], None], dict[str, Any]]:
    """Return the drive's `zero` and its argument. Raises ConfigError unless another process can import it."""
    plugin, options = DRIVES.load(config.motors)
    zero = getattr(plugin, "zero", None)
    if not callable(zero) or getattr(zero, "__module__", None) is None or "<" in getattr(zero, "__qualname__", "<"):
        raise ConfigError(
            f"drive '{config.drive.kind}' has no static method zero(config), which stops the wheels after its process "
            "has died; add it as in docs/how-to/add-a-device.md"
        )
    return zero, options.model_dump(mode="json")
