"""A camera and a drive, plug-ins that fail on command. Shell (files, signals).

Spoiled images are logged in `camera.events` in the same folder, failures of the drive in `drive.events`.
"""

import ctypes
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Final

from sightline.evaluation.faults.evidence import INJECTED, EventLog
from sightline.protocol.errors import HardwareError
from sightline.robot_side.ports import Picture, WheelAngles
from sightline.sim.bus import SimCamera, SimDrive, SimSocketConfig

MODE: Final = "camera.mode"
EVENTS: Final = "camera.events"
DRIVE_MODE: Final = "drive.mode"
"""While this file exists, the drive method that it names raises an exception."""
DRIVE_EVENTS: Final = "drive.events"
DRIVE_ERROR: Final = "no answer (injected by the bench)"
GIL_HELD_S: Final = 1
SLOW_S: Final = 0.2
LOOP: Final = signal.SIGUSR2
"""Starts an endless loop in a driver process with a `FaultyDrive`."""
HEAVY_BYTES: Final = 16_700
"""At 30 fps, 4 Mbit/s."""
RESIZED_PERCENT: Final = 50
SPARE: Final = {"black": (320, 240), "bomb": (64, 64)}
"""Images that `write_spares` writes to the folder, so that the robot's process needs no encoder."""
_SOF0: Final = b"\xff\xc0\x00\x11\x08"


class FaultyCamera:
    """A `Camera`. Modes: see FAULTS; any other mode changes nothing."""

    class Config(SimSocketConfig):
        """`folder` holds the mode and the event log."""

        folder: Path

    def __init__(self, config: Config) -> None:
        self._camera = SimCamera(SimSocketConfig(socket_dir=config.socket_dir))
        self.model, self.live = self._camera.model, self._camera.live
        self._mode = config.folder / MODE
        self._event_log = EventLog(config.folder / EVENTS)
        self._spares = {name: (config.folder / f"{name}.jpg").read_bytes() for name in SPARE}
        self._last: Picture | None = None
        self._held = False

    def read(self, timeout_s: float) -> Picture | None:
        """Return the next image as changed by the mode, see `Camera`."""
        mode = self._mode.read_text("ascii") if self._mode.exists() else ""
        self._camera.adjust(100, RESIZED_PERCENT if mode == "resized" else 100)
        picture = self._camera.read(timeout_s)
        if picture is None or mode not in (*FAULTS, *SPARE) or (mode == "gil" and self._held):
            self._last = picture or self._last
            return picture
        self._held = mode == "gil"
        self._event_log.note(INJECTED)
        while mode == "hangs" and self._mode.read_text("ascii") == mode:
            time.sleep(0.05)
        if mode in SPARE:
            # New bytes after its end, or the robot would take it for a frozen image.
            return replace(picture, jpeg=self._spares[mode] + str(picture.t_us).encode())
        return FAULTS[mode](picture, self._last or picture)

    def close(self) -> None:
        """Close the camera."""
        self._camera.close()


class FaultyDrive(SimDrive):
    """The simulated wheels. They raise as the file DRIVE_MODE states. The signal LOOP starts an endless loop."""

    class Config(SimSocketConfig):
        """`folder` holds the mode and the event log."""

        folder: Path

    def __init__(self, config: Config) -> None:
        super().__init__(SimSocketConfig(socket_dir=config.socket_dir))
        self._mode, self._event_log = config.folder / DRIVE_MODE, EventLog(config.folder / DRIVE_EVENTS)
        signal.signal(LOOP, _loop)

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Set wheel speeds, see `Drive`."""
        self._fail("set")
        super().set(left_rad_s, right_rad_s)

    def wheels(self) -> WheelAngles | None:
        """Read the encoders, see `Drive`."""
        angles = super().wheels()
        self._fail("wheels")
        return angles

    def _fail(self, method: str) -> None:
        if self._mode.exists() and self._mode.read_text("ascii") == method:
            self._event_log.note(INJECTED)
            raise ArithmeticError(DRIVE_ERROR)


def _hold_gil(now: Picture, _last: Picture) -> Picture:
    ctypes.PyDLL(None).sleep(GIL_HELD_S)  # PyDLL keeps the interpreter's lock
    return now


def _unplugged(_now: Picture, _last: Picture) -> Picture:
    raise HardwareError("the camera is unplugged (injected by the bench); plug it in again")


def _frozen(now: Picture, last: Picture) -> Picture:
    return replace(now, jpeg=last.jpeg)


def _slow(now: Picture, _last: Picture) -> Picture:
    time.sleep(SLOW_S)
    return now


def _resized(now: Picture, _last: Picture) -> Picture:
    return replace(now, scale_percent=100)  # the robot still announces the full size


def _heavy(now: Picture, _last: Picture) -> Picture:
    return replace(now, jpeg=now.jpeg.ljust(HEAVY_BYTES, b"\0"))


def _nothing(_now: Picture, _last: Picture) -> None:
    time.sleep(SLOW_S)


FAULTS: Final[dict[str, Callable[[Picture, Picture], Picture | None]]] = {
    "gil": _hold_gil, "unplugged": _unplugged, "frozen": _frozen, "slow": _slow, "heavy": _heavy, "nothing": _nothing,
    "resized": _resized, "hangs": lambda now, _last: now,
}
def _loop(_number: int, _frame: FrameType | None) -> None:
    # With a core for each, the guardian would need no higher priority than this loop.
    core = {min(os.sched_getaffinity(0))}
    for process in (0, os.getppid()):
        os.sched_setaffinity(process, core)
    while True:
        pass


def write_spares(folder: Path) -> None:
    """Write the images that replace those of the camera. The bomb claims 65500 x 65500 pixels."""
    import cv2
    import numpy as np

    for name, (width_px, height_px) in SPARE.items():
        jpeg = bytes(cv2.imencode(".jpg", np.zeros((height_px, width_px, 3), np.uint8))[1])
        if name == "bomb":
            at = jpeg.index(_SOF0) + len(_SOF0)
            jpeg = jpeg[:at] + b"\xff\xdc\xff\xdc" + jpeg[at + 4 :]
        (folder / f"{name}.jpg").write_bytes(jpeg)
