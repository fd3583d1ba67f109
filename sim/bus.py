"""The sockets between robot and simulation: device plug-ins, truth, labels. Shell (sockets).

Imported on the robot: no NumPy, no PyBullet. Each port has its own local SOCK_SEQPACKET socket, so that a slow picture
never delays a motor. Formats, all little-endian:

    motion.sock   robot -> sim  MOTION_SET      left_rad_s, right_rad_s; latched; the first to send owns the motors
                  sim -> robot  MOTION_ANGLES   left_rad, right_rad, t_us; 100 Hz; or MOTION_BUSY
    range.sock    sim -> robot  RANGE_HEAD + float32 ranges
    camera.sock   sim -> robot  first the CameraModel as JSON, then per request PICTURE_HEAD (t_us, scale_percent), JPEG
                  robot -> sim  PICTURE_REQUEST (quality_percent, scale_percent): for the next capture
    truth.sock    sim -> reader first what is simulated, then Truth as JSON; 50 Hz
"""

from __future__ import annotations

import array
import json
import math
import os
import select
import socket
import struct
import tempfile
import time
from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from sightline.protocol.codec import decode
from sightline.protocol.config import Config
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import CameraModel
from sightline.robot_side.ports import Picture, Ranges, WheelAngles
from sightline.sim.truth import Truth
from sightline.sim.zero import MOTION, MOTION_BUSY, MOTION_SET, zero

RANGE, CAMERA, TRUTH = "range.sock", "camera.sock", "truth.sock"
MOTION_ANGLES = struct.Struct("<ddq")
RANGE_HEAD = struct.Struct("<qdddd")
PICTURE_HEAD = struct.Struct("<qB")
PICTURE_REQUEST = struct.Struct("<BB")
MAX_MESSAGE_BYTES = 1 << 20
HELLO_TIMEOUT_S = 2.0
_BATTERY_WAIT_S = 0.1


def default_socket_dir() -> str:
    """A folder of this user's own, short enough for a socket's path."""
    return str(Path(tempfile.gettempdir()) / f"sightline-sim-{os.getuid()}")


class SimSocketConfig(Config):
    """Address of the simulation."""

    socket_dir: Annotated[str, Field(min_length=1, max_length=90)] = Field(default_factory=default_socket_dir)
    """Folder of the sockets between the simulation and the robot."""


class BusConnection:
    """Connects to the simulation, and again after a loss. Never blocks without a timeout."""

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
        """Send now; False if the simulation is too busy to take it. Raises HardwareError when it is gone."""
        connection = self.open()
        try:
            connection.send(data)
        except BlockingIOError:
            return False
        except OSError:
            raise self._lost() from None
        return True

    def receive(self) -> bytes | None:
        """Return the oldest waiting message, or None. Raises HardwareError when the simulation is gone."""
        connection = self.open()
        try:
            size = connection.recv_into(self._buffer)
        except BlockingIOError:
            return None
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
        """The newest waiting message; older ones are dropped."""
        newest = None
        while (message := self.receive()) is not None:
            newest = message
        return newest

    def wait(self, timeout_s: float) -> bytes | None:
        """The oldest message, waiting for one up to `timeout_s`."""
        message = self.receive()
        if message is not None:
            return message
        poll = select.poll()
        poll.register(self.open(), select.POLLIN)
        poll.poll(max(0.0, timeout_s) * 1000)
        return self.receive()

    def hello(self) -> bytes:
        """Connect and return the first message. Raises HardwareError when none comes."""
        hello = self.wait(HELLO_TIMEOUT_S)
        if hello is None:
            self.close()
            raise HardwareError(f"the simulation does not answer within {HELLO_TIMEOUT_S} s; restart `sightline sim`")
        return hello

    def close(self) -> None:
        """Idempotent; a later call would connect again."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _lost(self) -> HardwareError:
        self.close()
        return self._absent()

    def _absent(self) -> HardwareError:
        return HardwareError(f"nothing simulates a robot in {self._dir}; start it with `sightline sim`")


class SimCamera:
    """The simulated camera. The simulation draws an image only for a call of `read`."""

    class Config(SimSocketConfig):
        """Address of the simulation."""

    live = True

    def __init__(self, config: SimSocketConfig) -> None:
        self._connection = BusConnection(config.socket_dir, CAMERA)
        self._request = PICTURE_REQUEST.pack(100, 100)
        self.model: CameraModel
        self._greet()

    def _greet(self) -> None:
        """Connect if need be; a new connection begins with the camera's model."""
        if not self._connection.is_open:
            self.model = decode(CameraModel, self._connection.hello(), max_bytes=4096)

    def read(self, timeout_s: float) -> Picture | None:
        """The next capture; None if none came within `timeout_s`. Raises HardwareError when the simulation is gone."""
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
        """Encode the next images so, see `sightline.robot_side.ports.Adjustable`."""
        self._request = PICTURE_REQUEST.pack(quality_percent, scale_percent)
        return True

    def close(self) -> None:
        """Idempotent."""
        self._connection.close()


class SimDrive:
    """The simulated wheels: they latch, whatever becomes of this process."""

    zero = staticmethod(zero)

    class Config(SimSocketConfig):
        """Address of the simulation."""

    def __init__(self, config: SimSocketConfig) -> None:
        self._connection = BusConnection(config.socket_dir, MOTION)
        self._connection.open()
        self._angles: WheelAngles | None = None

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Give wheel speeds, forward positive; never blocks.

        Raises HardwareError when the simulation is gone or does not take them, ValueError unless both are finite.
        """
        if not (math.isfinite(left_rad_s) and math.isfinite(right_rad_s)):
            raise ValueError(f"wheel speeds {left_rad_s}, {right_rad_s}")
        if not self._connection.send(MOTION_SET.pack(left_rad_s, right_rad_s)):
            raise HardwareError("the simulation takes no motor commands; is it stopped? restart `sightline sim`")

    def wheels(self) -> WheelAngles | None:
        """The newest encoder reading received. Raises HardwareError when the simulation is gone.

        Call it at 20 Hz or more. After a longer pause the first reading is old, see its `t_us`.
        """
        message = self._connection.newest()
        if message is not None:
            self._angles = WheelAngles(*MOTION_ANGLES.unpack(message))
        return self._angles

    def close(self) -> None:
        """Idempotent; the motors keep their last speeds."""
        self._connection.close()


class SimRange:
    """The simulated lidar."""

    class Config(SimSocketConfig):
        """Address of the simulation."""

    def __init__(self, config: SimSocketConfig) -> None:
        self._connection = BusConnection(config.socket_dir, RANGE)
        self._connection.open()

    def read(self) -> Ranges | None:
        """The newest scan not yet read. Raises HardwareError when the simulation is gone."""
        message = self._connection.newest()
        if message is None:
            return None
        t_us, first_rad, each_rad, least_m, most_m = RANGE_HEAD.unpack_from(message)
        ranges_m = array.array("f", message[RANGE_HEAD.size :])
        return Ranges(t_us, first_rad, each_rad, least_m, most_m, ranges_m)

    def close(self) -> None:
        """Idempotent."""
        self._connection.close()


class SimBattery:
    """A battery that the simulated wheels drain: from full to empty over the distance that they turn."""

    class Config(SimSocketConfig):
        """Address of the simulation, and the voltages of the battery."""

        full_v: Annotated[float, Field(gt=0, le=100)] = 8.4
        empty_v: Annotated[float, Field(gt=0, le=100)] = 6.0
        range_m: Annotated[float, Field(gt=0, le=1e6)] = 1_000.0
        """Way of each wheel until it is empty."""
        wheel_radius_m: Annotated[float, Field(gt=0.005, lt=1.0)] = 0.035

    def __init__(self, config: Config) -> None:
        self._config = config
        self._connection = BusConnection(config.socket_dir, MOTION)
        self._connection.open()
        self._angles_rad = (0.0, 0.0)  # of a simulation that has just begun: its battery outlives this process
        self._turned_rad = 0.0

    def read(self) -> float:
        """Volts now. Raises HardwareError when the simulation is gone."""
        self._connection.newest()  # what has waited since the last call is old
        message = self._connection.wait(_BATTERY_WAIT_S)
        if message is not None:
            left_rad, right_rad, _ = MOTION_ANGLES.unpack(message)
            before_rad, self._angles_rad = self._angles_rad, (left_rad, right_rad)
            self._turned_rad += (abs(left_rad - before_rad[0]) + abs(right_rad - before_rad[1])) / 2
        config = self._config
        share = min(1.0, self._turned_rad * config.wheel_radius_m / config.range_m)
        return config.full_v - share * (config.full_v - config.empty_v)

    def close(self) -> None:
        """Idempotent."""
        self._connection.close()


class SimulationInfo(Config):
    """The description of a simulation, sufficient to load its scenario and robot again."""

    scenario: str
    robot: str
    seed: int
    pid: int


class TruthReader:
    """Reads what is really so, for displays and scores."""

    def __init__(self, socket_dir: str) -> None:
        self._connection = BusConnection(socket_dir, TRUTH)
        self.simulated = SimulationInfo.model_validate_json(self._connection.hello())

    def read(self, timeout_s: float) -> Truth | None:
        """The next report in order, None if none came in time. Raises HardwareError when the simulation is gone."""
        while (message := self._connection.wait(timeout_s)) is not None:
            if b'"t_us"' in message:
                return Truth.from_json(message)
        return None

    def close(self) -> None:
        """Idempotent."""
        self._connection.close()


# What a simulation labels in its pictures, written to and read from its bus; `labels.py` makes it. Shell (sockets).
#
# They come over the socket of the truth, between its reports. A client of the truth may read labels; a robot reads
# neither.


KEPT = 64
"""Pictures whose labels are remembered: two seconds of them."""
LABELLED_US = "labelled_us"
"""Key of a labels message: the capture time of the picture that they are of."""


class Label(NamedTuple):
    """One box, in pixels of the camera's whole picture; it may be encoded smaller."""

    label: str
    score: float
    x1_px: float
    y1_px: float
    x2_px: float
    y2_px: float


def to_json(labels: Iterable[Label], t_us: int, width_px: int) -> bytes:
    """The labels of the picture captured at `t_us`, `width_px` wide, as they go over the bus."""
    return json.dumps({LABELLED_US: t_us, "width_px": width_px, "boxes": [one._asdict() for one in labels]}).encode()


class LabelReader:
    """The labels of the newest pictures, by their capture times."""

    def __init__(self, socket_dir: str) -> None:
        self._connection = BusConnection(socket_dir, TRUTH)
        self._connection.hello()
        self._kept: OrderedDict[int, dict[str, Any]] = OrderedDict()

    def of(self, t_us: int, width_px: int) -> list[dict[str, Any]] | None:
        """The boxes of the picture captured at `t_us`, in pixels of one `width_px` wide; None if they were lost.

        They come before their picture.
        """
        self.drain()
        table = self._kept.get(t_us)
        return None if table is None else [_scaled(box, width_px / table["width_px"]) for box in table["boxes"]]

    def drain(self) -> None:
        """Take in what waits; often, for a socket holds ten messages. Raises HardwareError without a simulation."""
        while (message := self._connection.receive()) is not None:
            self._keep(message)

    def _keep(self, message: bytes) -> None:
        if f'"{LABELLED_US}"'.encode() not in message:
            return
        table = json.loads(message)
        self._kept[table[LABELLED_US]] = table
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)

    def close(self) -> None:
        """Idempotent."""
        self._connection.close()


def _scaled(box: dict[str, Any], factor: float) -> dict[str, Any]:
    return {name: value * factor if name.endswith("_px") else value for name, value in box.items()}
