"""The simulation as a real-time process: sockets, motor latch, loop. Shell."""

from __future__ import annotations

import errno
import fcntl
import logging
import math
import os
import selectors
import signal
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from io import FileIO
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError, HardwareError, home_path, install_command
from sightline.robot_side.hardware.cameras.timing import JUST_NOW_S
from sightline.sim.bus import (
    CAMERA,
    MOTION_ANGLES,
    PICTURE_HEAD,
    PICTURE_REQUEST,
    RANGE,
    RANGE_HEAD,
    TRUTH,
    SimSocketConfig,
    SimulationInfo,
    to_json,
)
from sightline.sim.robot import load_robot
from sightline.sim.scenario import load_scenario
from sightline.sim.zero import MOTION, MOTION_BUSY, MOTION_SET

if TYPE_CHECKING:
    from sightline.sim.world.world import World

_log: Final = logging.getLogger(__name__)


class PeriodicTimer:
    """Ticks exactly at its average rate, for any step of its caller."""

    def __init__(self, period_us: float) -> None:
        self._period_us = period_us
        self._count = 0

    def due(self, now_us: int) -> bool:
        """Return True once per period."""
        count = int(now_us / self._period_us)
        is_due, self._count = count > self._count, count
        return is_due


class CaptureTimer:
    """Permits one image per period: at its begin, or up to `JUST_NOW_S` later for a camera that requests it late.

    Otherwise a robot that is slightly late would get only every second image. A real camera keeps its newest image for
    the same time.
    """

    def __init__(self, period_us: float) -> None:
        self._timer = PeriodicTimer(period_us)
        self._until_us = -1

    def due(self, now_us: int, *, requested: bool) -> bool:
        """Return True if an image is to be drawn now. `requested`: a camera waits for one."""
        if self._timer.due(now_us):
            self._until_us = now_us + round(JUST_NOW_S * 1e6)
        is_due = requested and now_us <= self._until_us
        if is_due:
            self._until_us = -1
        return is_due


# The motor commands: stamped, logged, latched. Shell (clock, file); `take` is called from the receiving thread, `coast`
# from the physics loop.
#
# The log measures a stop. Each line is written before its command is applied, so that it survives kill -9.


LOG_HEADER = b"t_us,left_rad_s,right_rad_s,left_rad,right_rad\n"
COASTING_US = 20_000
"""Time between two lines of wheels that roll out without an owner: one tick of the driver."""
COASTING_RAD = 0.003
"""Smallest roll in that time, 5 mm/s at the rim: half of the limit for standing still."""


class MotorPort:
    """Latches the last speeds, as real PWM does. The end of a client does not change them."""

    def __init__(self, log_path: str | None) -> None:
        self.speeds_rad_s = (0.0, 0.0)
        self.angles_rad = (0.0, 0.0)
        """Total angle of each wheel, from the last physics step."""
        self._lock = threading.Lock()
        """Keeps the lines in the order of their times."""
        self._logged_us, self._logged_rad = 0, (0.0, 0.0)
        self._may_roll = False
        self.lines_lost = 0
        """Commands that were applied and could not be logged, e.g. on a full disk."""
        try:
            self._log = _opened_log(home_path(log_path)) if log_path else None
        except OSError as error:
            raise ConfigError(f"motor_log {log_path}: {error.strerror}; name a file in a folder that exists") from None
        self._is_cut = False
        with suppress(OSError):  # a full disk is reported at the first command
            self._write(LOG_HEADER)

    def take(self, data: bytes) -> None:
        """Take one drive packet. A packet without two finite speeds changes nothing."""
        speeds = MOTION_SET.unpack(data) if len(data) == MOTION_SET.size else (math.nan, math.nan)
        if not all(map(math.isfinite, speeds)):
            return
        with self._lock:
            try:
                self._log_line(monotonic_us(), speeds)
            except OSError as error:  # the command matters more than its line
                if not self.lines_lost:
                    _log.warning("motor log: %s; commands are applied without a line", error.strerror)
                self.lines_lost += 1
            self.speeds_rad_s = (speeds[0], speeds[1])
            self._may_roll = True

    def coast(self) -> None:
        """Log how wheels without an owner roll out. Nothing else shows when they stop, until the next command."""
        with self._lock:
            now_us = monotonic_us()
            if any(self.speeds_rad_s) or not self._may_roll or now_us - self._logged_us < COASTING_US:
                return
            rolled = (abs(now - before) for now, before in zip(self.angles_rad, self._logged_rad, strict=True))
            self._may_roll = max(rolled) > COASTING_RAD
            with suppress(OSError):  # no command is lost
                self._log_line(now_us, self.speeds_rad_s)

    def _log_line(self, t_us: int, speeds: Sequence[float]) -> None:
        self._logged_us, self._logged_rad = t_us, self.angles_rad
        self._write(b"%d,%.5f,%.5f,%.5f,%.5f\n" % (t_us, *speeds, *self.angles_rad))

    def _write(self, line: bytes) -> None:
        """Write a whole line. Raises OSError. A line cut by a full disk gets its newline before the next one."""
        if self._log is None:
            return
        line = b"\n" * self._is_cut + line
        self._is_cut = True
        if self._log.write(line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._is_cut = False

    def close(self) -> None:
        """Close the log."""
        if self.lines_lost:
            _log.warning("motor log: %d commands have no line", self.lines_lost)
        if self._log:
            self._log.close()


def _opened_log(path: Path) -> FileIO:
    """Open a new log in place of an earlier one. Raises OSError, and ConfigError for a file that is not a log."""
    if path.is_file() and path.stat().st_size:  # not a device or a pipe
        with path.open("rb") as earlier:
            if earlier.read(len(LOG_HEADER)) != LOG_HEADER:
                raise ConfigError(f"motor_log {path}: exists and is not a motor log; name another file")
    return path.open("wb", buffering=0)


# The simulation's end of the bus: its clients and their messages. Shell (sockets, one thread).
#
# The thread accepts and receives. The physics loop only sends, and never waits: data for a full client is dropped.


SEND_BYTES = {MOTION: 4096, RANGE: 16_384, CAMERA: 1 << 20, TRUTH: 1 << 17}
"""Send buffer for a client that does not read. Small where only the newest message is useful."""
STOP_POLL_S = 0.2


class SocketFolder:
    """The folder of sockets, held by one simulation at a time through a lock that dies with its process."""

    def __init__(self, path: str) -> None:
        self.path = Path(path)
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = os.open(self.path / "sim.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            self._hold()
        except OSError as error:
            raise ConfigError(f"socket_dir {path}: {error.strerror}; choose another with --set socket_dir=") from None

    def _hold(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(self._lock, 32).decode("ascii", "replace").strip() or "?"
            os.close(self._lock)
            raise ConfigError(
                f"socket_dir {self.path} is held by another simulation, process {holder}; "
                "end it or choose another with --set socket_dir="
            ) from None
        try:
            os.ftruncate(self._lock, 0)
            os.write(self._lock, f"{os.getpid()}\n".encode())
        except OSError:  # the disk is full
            os.close(self._lock)
            raise

    def listen(self, name: str) -> socket.socket:
        """Return a listening socket. Replaces one that a dead simulation left."""
        place = self.path / name
        place.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        listener.setblocking(False)
        listener.bind(str(place))
        listener.listen(8)
        return listener

    def close(self) -> None:
        """Remove the sockets, then release the lock. Idempotent."""
        if self._lock >= 0:
            for name in SEND_BYTES:
                (self.path / name).unlink(missing_ok=True)
            os.close(self._lock)
            self._lock = -1


class BusClients:
    """The clients of the four sockets of a folder."""

    def __init__(self, folder: SocketFolder, hellos: dict[str, bytes], on_motion: Callable[[bytes], None]) -> None:
        self._hellos, self._on_motion = hellos, on_motion
        self._lock = threading.Lock()
        self._clients: dict[str, set[socket.socket]] = {name: set() for name in SEND_BYTES}
        self._wanting: dict[socket.socket, tuple[int, int]] = {}
        self._motor_owner: socket.socket | None = None
        self._selector = selectors.DefaultSelector()
        self._listeners = {name: folder.listen(name) for name in SEND_BYTES}
        for name, listener in self._listeners.items():
            self._selector.register(listener, selectors.EVENT_READ, name)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="sim-sockets", daemon=True)
        self._thread.start()

    @property
    def has_motor_owner(self) -> bool:
        """Return True if the last command came from a client that is still connected."""
        return self._motor_owner is not None

    def has(self, name: str) -> bool:
        """Return True if a client of this socket is connected."""
        return bool(self._clients[name])

    def send(self, name: str, data: bytes) -> None:
        """Send to every client of this socket that has room."""
        with self._lock:
            for client in self._clients[name]:
                _send(client, data)

    def wanted_pictures(self) -> set[tuple[int, int]]:
        """Return the (quality_percent, scale_percent) that cameras requested for the next capture."""
        with self._lock:
            return set(self._wanting.values())

    def send_picture(self, wanted: tuple[int, int], data: bytes) -> None:
        """Send to the cameras that requested this encoding, and clear their requests."""
        with self._lock:
            for client in [one for one, requested in self._wanting.items() if requested == wanted]:
                _send(client, data)
                del self._wanting[client]

    def _serve(self) -> None:
        while not self._stopping.is_set():
            for key, _ in self._selector.select(STOP_POLL_S):
                connection, name = key.fileobj, key.data
                assert isinstance(connection, socket.socket)
                if connection is self._listeners[name]:
                    self._accept(connection, name)
                else:
                    self._receive(connection, name)

    def _accept(self, listener: socket.socket, name: str) -> None:
        try:
            client, _ = listener.accept()
        except OSError:
            return  # it closed in the meantime
        client.setblocking(False)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES[name])
        if name in self._hellos:
            _send(client, self._hellos[name])
        self._selector.register(client, selectors.EVENT_READ, name)
        with self._lock:
            self._clients[name].add(client)

    def _receive(self, client: socket.socket, name: str) -> bool:
        """Handle the next packet or the end of a client. Returns False if there is neither."""
        if client not in self._clients[name]:
            return False
        data = _received(client)
        if data is None:
            return False
        if not data:
            self._drop(client, name)
        elif name == MOTION:
            self._command(client, data)
        elif name == CAMERA:
            with self._lock:
                self._wanting[client] = _wanted(data)
        return True

    def _command(self, client: socket.socket, data: bytes) -> None:
        """Set the motors for the connection that owns them until it closes, as a process owns a pin."""
        while self._motor_owner not in (None, client) and self._receive(self._motor_owner, MOTION):
            pass  # handle earlier packets and the end of the owner first
        if self._motor_owner not in (None, client):
            _send(client, MOTION_BUSY)
            self._drop(client, MOTION)
            return
        self._motor_owner = client
        self._on_motion(data)

    def _drop(self, client: socket.socket, name: str) -> None:
        self._selector.unregister(client)
        self._motor_owner = None if client is self._motor_owner else self._motor_owner
        with self._lock:
            self._clients[name].discard(client)
            self._wanting.pop(client, None)
            client.close()

    def close(self) -> None:
        """End the thread and every connection."""
        self._stopping.set()
        self._thread.join(timeout=5 * STOP_POLL_S)
        with self._lock:
            for connection in (*self._listeners.values(), *(c for held in self._clients.values() for c in held)):
                connection.close()
        self._selector.close()


def _received(client: socket.socket) -> bytes | None:
    """Return the next packet, b"" at the end of the client, or None if there is nothing at present."""
    while True:
        try:
            return client.recv(64)
        except BlockingIOError:
            return None
        except ConnectionResetError:  # it ended with unread packets; those that it sent still follow
            continue
        except OSError:
            return b""


def _send(client: socket.socket, data: bytes) -> None:
    """Send or drop. A full buffer and a client that just left must not delay the physics."""
    try:
        client.send(data)
    except OSError as error:
        if error.errno == errno.EMSGSIZE:
            raise HardwareError(
                f"a picture of {len(data)} bytes does not fit a local socket; lower jpeg_quality or the camera's size"
            ) from None


def _wanted(data: bytes) -> tuple[int, int]:
    """Return the requested encoding of an image. An unknown request returns the full quality and size."""
    if len(data) != PICTURE_REQUEST.size:
        return 100, 100
    quality_percent, scale_percent = PICTURE_REQUEST.unpack(data)
    return max(1, min(100, quality_percent)), max(1, min(100, scale_percent))


# The simulation in real time, as a process in place of the hardware. Shell.  The main thread steps and draws
# against absolute deadlines; another receives, so that a motor command is stamped and logged while a
# image is being drawn. World time and the robot's monotonic clock differ by a constant.


ENCODERS_US, TRUTH_US = 10_000, 20_000
LAG_LOGGED_US = 100_000
LAG_GIVEN_UP_US = 1_000_000  # after a suspend, time is skipped, not replayed


class SimConfig(SimSocketConfig):
    """One simulated robot."""

    scenario: Annotated[str, Field(min_length=1)] = "circle"
    """A name (`sim/scenarios/`) or the path of a `.toml` file."""
    robot: str = ""
    """A name (`sim/robots/`) or the path of a `.toml` file; empty for the robot of the scenario."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of the start and the noise."""
    fps: Annotated[float, Field(gt=0, le=240)] | None = None
    """Images per second; default: the rate of the robot's camera."""
    motor_log: str | None = None
    """CSV file of every motor command, with its arrival time; wheels that roll out without a driver have lines, too."""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """The simulation ends after this time."""


class Simulation:
    """A world, its clients and the clock that drives it."""

    def __init__(self, config: SimConfig, world: World, folder: SocketFolder) -> None:
        self._config, self._world = config, world
        self._motors = MotorPort(config.motor_log)
        self._clients = BusClients(folder, self._hellos(), self._motors.take)
        self._encoders, self._truth = PeriodicTimer(ENCODERS_US), PeriodicTimer(TRUTH_US)
        self._captures = CaptureTimer(1e6 / (config.fps or world.robot.camera.fps))
        self._scans = PeriodicTimer(1e6 / world.robot.lidar.rate_hz)
        self._offset_us = monotonic_us()
        self._lag_us = 0
        self._logged_lag = False
        self.stopping = False

    def _hellos(self) -> dict[str, bytes]:
        config = self._config
        robot = config.robot or self._world.scenario.robot
        about = SimulationInfo(scenario=config.scenario, robot=robot, seed=config.seed, pid=os.getpid())
        return {CAMERA: encode(self._world.camera_model), TRUTH: about.model_dump_json().encode()}

    def run(self) -> None:
        """Step until a signal or the end of the time."""
        end_us = self._config.seconds * 1e6 if self._config.seconds else float("inf")
        self._offset_us = monotonic_us()
        while not self.stopping and self._world.now_us < end_us:
            self._wait()
            self._world.set_wheels(*self._motors.speeds_rad_s)
            self._world.step()
            self._motors.angles_rad = self._world.wheels_turned()
            if not self._clients.has_motor_owner:
                self._motors.coast()
            self._publish(self._world.now_us)

    def _wait(self) -> None:
        """Sleep until the deadline of the next step, and record the lag."""
        from sightline.sim.world.world import STEP_US

        late_us = monotonic_us() - (self._offset_us + self._world.now_us + STEP_US)
        if late_us < 0:
            time.sleep(-late_us / 1e6)
        self._lag_us = max(0, late_us)
        if self._lag_us > LAG_LOGGED_US and not self._logged_lag:
            _log.info("simulation is %d ms behind the clock; is the machine busy?", self._lag_us // 1000)
        self._logged_lag = self._lag_us > (LAG_LOGGED_US // 5 if self._logged_lag else LAG_LOGGED_US)
        if self._lag_us > LAG_GIVEN_UP_US:
            self._offset_us += self._lag_us

    def _publish(self, now_us: int) -> None:
        """Send the data that are due and have a client."""
        t_us = now_us + self._offset_us
        if self._encoders.due(now_us):
            angles = self._world.wheel_angles()
            self._clients.send(MOTION, MOTION_ANGLES.pack(angles.left_rad, angles.right_rad, t_us))
        requested = self._clients.wanted_pictures()
        if self._captures.due(now_us, requested=bool(requested)):
            self._draw(t_us, requested)
        if self._scans.due(now_us) and self._clients.has(RANGE):
            self._clients.send(RANGE, self._scan(t_us))
        if self._truth.due(now_us) and self._clients.has(TRUTH):
            truth = replace(self._world.truth(), t_us=t_us, lag_us=self._lag_us)
            self._clients.send(TRUTH, truth.to_json())

    def _draw(self, t_us: int, requested: set[tuple[int, int]]) -> None:
        """Draw an image for each requested encoding, usually one."""
        if self._world.scenario.labels and self._clients.has(TRUTH):
            self._clients.send(TRUTH, to_json(self._world.labels(), t_us, self._world.camera_model.width_px))
        for wanted in requested:
            self._clients.send_picture(wanted, PICTURE_HEAD.pack(t_us, wanted[1]) + self._world.render(*wanted))

    def _scan(self, t_us: int) -> bytes:
        scan = self._world.scan()
        limits = (scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, scan.range_max_m)
        return RANGE_HEAD.pack(t_us, *limits) + scan.ranges_m.tobytes()

    def close(self) -> None:
        """End every connection and the log."""
        self._clients.close()
        self._motors.close()


def run(config: SimConfig) -> int:
    """Simulate until SIGTERM, SIGINT or `seconds`; call it from the main thread.

    Logs `simulation ready: ...` once everything accepts. Raises ConfigError for an unknown
    scenario or robot, a `socket_dir` in use, a missing extra.
    """
    scenario = load_scenario(config.scenario)
    robot = load_robot(config.robot or scenario.robot)
    folder = SocketFolder(config.socket_dir)
    try:
        with _world_class()(scenario, robot, config.seed) as world:
            _simulate(Simulation(config, world, folder), config, robot.name)
    finally:
        folder.close()
    return 0


def _simulate(simulation: Simulation, config: SimConfig, robot: str) -> None:
    def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  the signature is Python's
        simulation.stopping = True

    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        _log.info("simulation ready: %s, %s, seed %d, in %s", config.scenario, robot, config.seed, config.socket_dir)
        simulation.run()
    finally:
        simulation.close()
        for number, handler in before.items():
            signal.signal(number, handler)


def _world_class() -> type[World]:
    """Import the world late, because `SimConfig` alone needs neither PyBullet nor NumPy."""
    try:
        from sightline.sim.world.world import World
    except ImportError as error:
        raise ConfigError(
            f"the simulation needs {error.name}; install it with: {install_command('sim')}"
        ) from None
    return World
