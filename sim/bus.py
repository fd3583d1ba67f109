"""The sockets between robot and simulation: device plug-ins, truth, labels. Shell (sockets).

Imported on the robot: no NumPy, no PyBullet. Each port has its own local SOCK_SEQPACKET socket, so that a slow image
never delays a motor. Formats, all little-endian:

    motion.sock   robot -> sim  MOTION_SET      left_rad_s, right_rad_s; latched; the first to send owns the motors
                  sim -> robot  MOTION_ANGLES   left_rad, right_rad, t_us; 100 Hz; or MOTION_BUSY
    range.sock    sim -> robot  RANGE_HEAD + float32 ranges
    camera.sock   sim -> robot  first the CameraModel as JSON, then per request PICTURE_HEAD (t_us, scale_percent), JPEG
                  robot -> sim  PICTURE_REQUEST (quality_percent, scale_percent): for the next capture
    truth.sock    sim -> reader first SimulationInfo, then Truth as JSON; 50 Hz
"""

from __future__ import annotations

import array
import json
import logging
import math
import os
import select
import socket
import struct
import time
from collections import OrderedDict
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from sightline.protocol.codec import decode
from sightline.protocol.config import Config
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import CameraModel
from sightline.robot_side.ports import Picture, Ranges, WheelAngles
from sightline.sim.truth import Truth
from sightline.sim.zero import MOTION, MOTION_BUSY, MOTION_SET, check_free, zero

RANGE, CAMERA, TRUTH = "range.sock", "camera.sock", "truth.sock"
MOTION_ANGLES = struct.Struct("<ddq")
RANGE_HEAD = struct.Struct("<qdddd")
PICTURE_HEAD = struct.Struct("<qB")
PICTURE_REQUEST = struct.Struct("<BB")
MAX_MESSAGE_BYTES = 1 << 20
HELLO_TIMEOUT_S = 2.0
_BATTERY_WAIT_S = 0.1
_STARTS_WITHIN_S, _ANNOUNCED_AFTER_S, _RETRY_S = 5.0, 1.0, 0.05
_log = logging.getLogger(__name__)


def default_socket_dir() -> str:
    """Return a folder of this user that is short enough for the path of a socket.

    It is the same for simulation and robot also while a disk gets full, where `tempfile` would name another one.
    """
    named = (os.environ.get(name, "") for name in ("TMPDIR", "TEMP", "TMP"))
    folder = next((path for path in named if path and os.access(path, os.W_OK | os.X_OK)), "/tmp")
    return str(Path(folder).absolute() / f"sightline-sim-{os.getuid()}")


class SimSocketConfig(Config):
    """Address of the simulation."""

    socket_dir: Annotated[str, Field(min_length=1, max_length=90)] = Field(default_factory=default_socket_dir)
    """Folder of the sockets between the simulation and the robot."""


class BusConnection:
    """Connects to the simulation and reconnects after a loss. Never blocks without a timeout."""

    def __init__(self, socket_dir: str, name: str) -> None:
        self._dir, self._name = socket_dir, name
        self._socket: socket.socket | None = None
        self._buffer = bytearray(MAX_MESSAGE_BYTES)

    @property
    def is_open(self) -> bool:
        """Return True if the connection existed at the last use."""
        return self._socket is not None

    def open(self) -> socket.socket:
        """Return the connection, and open it if needed. Raises HardwareError without a listener."""
        if self._socket is not None:
            return self._socket
        fresh = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        fresh.setblocking(False)
        try:
            fresh.connect(str(Path(self._dir) / self._name))
        except OSError:
            fresh.close()
            raise self._absent() from None
        self._socket = fresh
        return fresh

    def send(self, data: bytes) -> bool:
        """Send now. Returns False if the buffer is full. Raises HardwareError when the simulation has ended."""
        connection = self.open()
        try:
            connection.send(data)
        except BlockingIOError:
            return False
        except OSError:
            self.newest()  # raises, if the last message has the reason
            raise self._lost() from None
        return True

    def receive(self) -> bytes | None:
        """Return the oldest waiting message, or None. Raises HardwareError when the simulation has ended."""
        connection = self.open()
        try:
            size = connection.recv_into(self._buffer)
        except BlockingIOError:
            return None
        except ConnectionResetError:  # the simulation ended with unread packets; those that it sent still follow
            return self.receive()
        except OSError:
            raise self._lost() from None
        if not size:
            raise self._lost()
        message = bytes(memoryview(self._buffer)[:size])
        if message == MOTION_BUSY:  # the last message: the simulation has closed this connection
            self.close()
            raise HardwareError(f"another process owns the simulated motors in {self._dir}; end it")
        return message

    def newest(self) -> bytes | None:
        """Return the newest waiting message. Drops older ones."""
        newest = None
        while (message := self.receive()) is not None:
            newest = message
        return newest

    def wait(self, timeout_s: float) -> bytes | None:
        """Return the oldest message. Waits up to `timeout_s` for one."""
        message = self.receive()
        if message is not None:
            return message
        poll = select.poll()
        poll.register(self.open(), select.POLLIN)
        poll.poll(max(0.0, timeout_s) * 1000)
        return self.receive()

    def hello(self) -> bytes:
        """Connect and return the first message. Raises HardwareError if none arrives."""
        hello = self.wait(HELLO_TIMEOUT_S)
        if hello is None:
            self.close()
            raise HardwareError(f"the simulation does not answer within {HELLO_TIMEOUT_S} s; restart `sightline sim`")
        return hello

    def close(self) -> None:
        """Close the connection. Idempotent; a later call connects again."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _lost(self) -> HardwareError:
        self.close()
        return self._absent()

    def _absent(self) -> HardwareError:
        return HardwareError(f"nothing simulates a robot in {self._dir}; start it with `sightline sim`")


def await_simulation(socket_dir: str, seconds: float = _STARTS_WITHIN_S) -> None:
    """Wait for a simulation that starts at the same time. Without one, the devices report its absence."""
    begin_s, is_announced = time.monotonic(), False
    while (waited_s := time.monotonic() - begin_s) < seconds:
        probe = BusConnection(socket_dir, MOTION)  # it sends nothing, so it does not own the motors
        with suppress(HardwareError):
            probe.open()
            probe.close()
            return
        if waited_s >= _ANNOUNCED_AFTER_S and not is_announced:
            is_announced = True
            _log.info("waiting for `sightline sim` in %s ...", socket_dir)
        time.sleep(_RETRY_S)


class _BusClient:
    """A user of one socket of the simulation."""

    def __init__(self, socket_dir: str, name: str) -> None:
        self._connection = BusConnection(socket_dir, name)

    def close(self) -> None:
        """Close the connection. Idempotent; motors keep their last speeds."""
        self._connection.close()


class SimCamera(_BusClient):
    """The simulated camera. The simulation draws an image only on a call of `read`."""

    Config = SimSocketConfig

    live = True

    def __init__(self, config: SimSocketConfig) -> None:
        super().__init__(config.socket_dir, CAMERA)
        self._request = PICTURE_REQUEST.pack(100, 100)
        self.model: CameraModel
        self._greet()

    def _greet(self) -> None:
        """Connect if needed. A new connection begins with the camera model."""
        if not self._connection.is_open:
            self.model = decode(CameraModel, self._connection.hello(), max_bytes=4096)

    def read(self, timeout_s: float) -> Picture | None:
        """Return the next capture; None after `timeout_s`. Raises HardwareError when the simulation has ended."""
        deadline_s = time.monotonic() + timeout_s
        self._greet()
        self._connection.newest()  # drops a late answer to an earlier call, which is an old image
        self._connection.send(self._request)
        message = self._connection.wait(deadline_s - time.monotonic())
        if message is None:
            return None
        t_us, scale_percent = PICTURE_HEAD.unpack_from(message)
        return Picture(message[PICTURE_HEAD.size :], t_us, scale_percent)

    def adjust(self, quality_percent: int, scale_percent: int) -> bool:
        """Set the encoding of the next images; see `sightline.robot_side.ports.Adjustable`."""
        self._request = PICTURE_REQUEST.pack(quality_percent, scale_percent)
        return True


class SimDrive(_BusClient):
    """The simulated wheels. Their speeds latch and outlive this process."""

    zero = staticmethod(zero)

    Config = SimSocketConfig

    def __init__(self, config: SimSocketConfig) -> None:
        super().__init__(config.socket_dir, MOTION)
        self._connection.open()
        check_free(config.socket_dir)
        self._angles: WheelAngles | None = None

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Set wheel speeds, forward positive; never blocks.

        Raises HardwareError when the simulation has ended or rejects them, ValueError unless both are finite.
        """
        if not (math.isfinite(left_rad_s) and math.isfinite(right_rad_s)):
            raise ValueError(f"wheel speeds {left_rad_s}, {right_rad_s}")
        if not self._connection.send(MOTION_SET.pack(left_rad_s, right_rad_s)):
            raise HardwareError("the simulation takes no motor commands; is it stopped? restart `sightline sim`")

    def wheels(self) -> WheelAngles | None:
        """Return the newest encoder reading received. Raises HardwareError when the simulation has ended.

        Call it at 20 Hz or more. After a longer pause the first reading is old, see its `t_us`.
        """
        message = self._connection.newest()
        if message is not None:
            self._angles = WheelAngles(*MOTION_ANGLES.unpack(message))
        return self._angles


class SimRange(_BusClient):
    """The simulated lidar."""

    Config = SimSocketConfig

    def __init__(self, config: SimSocketConfig) -> None:
        super().__init__(config.socket_dir, RANGE)
        self._connection.open()

    def read(self) -> Ranges | None:
        """Return the newest unread scan. Raises HardwareError when the simulation has ended."""
        message = self._connection.newest()
        if message is None:
            return None
        t_us, first_rad, each_rad, least_m, most_m = RANGE_HEAD.unpack_from(message)
        ranges_m = array.array("f", message[RANGE_HEAD.size :])
        return Ranges(t_us, first_rad, each_rad, least_m, most_m, ranges_m)


class SimBattery(_BusClient):
    """A battery that the turning wheels drain, from full to empty over a distance."""

    class Config(SimSocketConfig):
        """Address of the simulation, and the voltages of the battery."""

        full_v: Annotated[float, Field(gt=0, le=100)] = 8.4
        empty_v: Annotated[float, Field(gt=0, le=100)] = 6.0
        range_m: Annotated[float, Field(gt=0, le=1e6)] = 1_000.0
        """Distance that each wheel rolls until the battery is empty."""
        wheel_radius_m: Annotated[float, Field(gt=0.005, lt=1.0)] = 0.035

    def __init__(self, config: Config) -> None:
        self._config = config
        super().__init__(config.socket_dir, MOTION)
        self._connection.open()
        self._angles_rad = (0.0, 0.0)  # of a simulation that has just started: its battery outlives this process
        self._turned_rad = 0.0

    def read(self) -> float:
        """Return the voltage now, V. Raises HardwareError when the simulation has ended."""
        self._connection.newest()  # messages that waited since the last call are old
        message = self._connection.wait(_BATTERY_WAIT_S)
        if message is not None:
            left_rad, right_rad, _ = MOTION_ANGLES.unpack(message)
            before_rad, self._angles_rad = self._angles_rad, (left_rad, right_rad)
            self._turned_rad += (abs(left_rad - before_rad[0]) + abs(right_rad - before_rad[1])) / 2
        config = self._config
        share = min(1.0, self._turned_rad * config.wheel_radius_m / config.range_m)
        return config.full_v - share * (config.full_v - config.empty_v)


class SimulationInfo(Config):
    """The description of a simulation, sufficient to load its scenario and robot again."""

    scenario: str
    robot: str
    seed: int
    pid: int


class TruthReader(_BusClient):
    """Reads the true state, for displays and scores."""

    def __init__(self, socket_dir: str) -> None:
        super().__init__(socket_dir, TRUTH)
        self.simulated = SimulationInfo.model_validate_json(self._connection.hello())

    def read(self, timeout_s: float) -> Truth | None:
        """Return the next report; None after `timeout_s`. Raises HardwareError when the simulation has ended."""
        while (message := self._connection.wait(timeout_s)) is not None:
            if b'"t_us"' in message:
                return Truth.from_json(message)
        return None


# Labels of simulated images, written to and read from the bus; `world/sensors.py` makes them. Shell (sockets).
#
# They share the truth socket, between its reports. A client of that socket may read labels; a robot reads
# neither.


KEPT = 64
"""Images whose labels are remembered: two seconds of them."""
LABELLED_US = "labelled_us"
"""Capture time of the labeled image, in a labels message."""


class Label(NamedTuple):
    """One box, in pixels of the full-size image. The image may be encoded smaller."""

    label: str
    score: float
    x1_px: float
    y1_px: float
    x2_px: float
    y2_px: float


def to_json(labels: Iterable[Label], t_us: int, width_px: int) -> bytes:
    """Return a labels message: the labels of the image captured at `t_us`, `width_px` wide."""
    return json.dumps({LABELLED_US: t_us, "width_px": width_px, "boxes": [one._asdict() for one in labels]}).encode()


class LabelReader(_BusClient):
    """The labels of the newest images, by their capture times."""

    def __init__(self, socket_dir: str) -> None:
        super().__init__(socket_dir, TRUTH)
        self._connection.hello()
        self._kept: OrderedDict[int, dict[str, Any]] = OrderedDict()

    def of(self, t_us: int, width_px: int) -> list[dict[str, Any]] | None:
        """Return the boxes of the image captured at `t_us`, in pixels of an image `width_px` wide, or None.

        Labels arrive before their image; None means that they were lost.
        """
        self.drain()
        table = self._kept.get(t_us)
        return None if table is None else [_scaled(box, width_px / table["width_px"]) for box in table["boxes"]]

    def drain(self) -> None:
        """Read all waiting labels. Call it often: a socket holds ten messages. Raises HardwareError if disconnected."""
        while (message := self._connection.receive()) is not None:
            self._keep(message)

    def _keep(self, message: bytes) -> None:
        if f'"{LABELLED_US}"'.encode() not in message:
            return
        table = json.loads(message)
        self._kept[table[LABELLED_US]] = table
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)


def _scaled(box: dict[str, Any], factor: float) -> dict[str, Any]:
    return {name: value * factor if name.endswith("_px") else value for name, value in box.items()}
