"""A drive plug-in to copy: two wheels on a motor controller that reads `left right` lines from a serial port.

A drive is a class with a `Config`, `set`, `wheels`, `close` and `zero` (robot_side/ports.py defines the promises of
each).
"""

import os
import termios
import time
import tty
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from sightline.protocol.config import Config
from sightline.protocol.errors import HardwareError
from sightline.robot_side.ports import WheelAngles


class MyDriveConfig(Config):
    """Settings of the drive. `port` is the serial port of the motor controller."""

    port: Path


BAUD = termios.B115200
"""Baud rate of the motor controller."""


def opened(port: Path) -> TextIO:
    """Open the port to write lines."""
    try:
        # Without O_CREAT: if the port is missing, root would create a file and drive that.
        descriptor = os.open(port, os.O_WRONLY | os.O_NOCTTY)
    except OSError as error:
        raise HardwareError(f"motor controller {port}: {error.strerror}; is it plugged in?") from None
    if os.isatty(descriptor):
        set_up(descriptor)
    return os.fdopen(descriptor, "w", buffering=1)


def set_up(descriptor: int) -> None:
    """Set the speed of a serial port, and send bytes as they are."""
    # By default a port echoes its input. The controller would receive its own answers as commands.
    tty.setraw(descriptor, termios.TCSANOW)
    settings = termios.tcgetattr(descriptor)
    settings[4] = settings[5] = BAUD  # both directions
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)


class MyDrive:
    """A drive without encoders: the wheels are assumed to turn at the set speeds."""

    Config = MyDriveConfig

    def __init__(self, config: MyDriveConfig) -> None:
        self._port = opened(config.port)
        self._speeds = (0.0, 0.0)
        self._angles = WheelAngles(0.0, 0.0, time.monotonic_ns() // 1000)

    @staticmethod
    def zero(config: Mapping[str, Any]) -> None:
        """Stop the wheels after the process of the drive has died."""
        with opened(Path(config["port"])) as port:
            port.write("0 0\n")

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Send both speeds."""
        self._angles = self.wheels()
        self._speeds = (left_rad_s, right_rad_s)
        try:
            self._port.write(f"{left_rad_s:.3f} {right_rad_s:.3f}\n")
        except OSError as error:
            raise HardwareError(f"motor controller: {error.strerror}; check its cable") from None

    def wheels(self) -> WheelAngles:
        """Return the assumed angles of the wheels now."""
        now_us = time.monotonic_ns() // 1000
        seconds = (now_us - self._angles.t_us) / 1e6
        left, right = self._speeds
        return WheelAngles(self._angles.left_rad + left * seconds, self._angles.right_rad + right * seconds, now_us)

    def close(self) -> None:
        """Close the port."""
        self._port.close()
