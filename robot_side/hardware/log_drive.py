"""Write wheel speeds to a file instead of motors, and simulate ideal wheels. Shell (a file and a clock)."""

import os
from pathlib import Path

from sightline.protocol.clock import monotonic_us
from sightline.protocol.config import Config
from sightline.robot_side.hardware.log_zero import open_log, zero
from sightline.robot_side.ports import WheelAngles


class LogDriveConfig(Config):
    """`path`: CSV of t_us,left_rad_s,right_rad_s, one line per command, appended. Without it no file is written."""

    path: Path | None = None


class LogDrive:
    """Drive for a robot without wheels. Its encoders reach every speed immediately."""

    Config = LogDriveConfig
    zero = staticmethod(zero)

    def __init__(self, config: LogDriveConfig) -> None:
        self._file = os.fdopen(open_log(str(config.path)), "a", buffering=1) if config.path else None
        self._speeds = (0.0, 0.0)
        self._angles = WheelAngles(0.0, 0.0, monotonic_us())

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Log the speeds. The wheels turn with them from now on."""
        self._angles = self.wheels()
        self._speeds = (left_rad_s, right_rad_s)
        if self._file:
            self._file.write(f"{self._angles.t_us},{left_rad_s:.4f},{right_rad_s:.4f}\n")

    def wheels(self) -> WheelAngles:
        """Return the current angles of the ideal wheels."""
        now_us = monotonic_us()
        seconds = (now_us - self._angles.t_us) / 1e6
        left, right = self._speeds
        return WheelAngles(self._angles.left_rad + left * seconds, self._angles.right_rad + right * seconds, now_us)

    def close(self) -> None:
        """Close the file."""
        if self._file:
            self._file.close()
