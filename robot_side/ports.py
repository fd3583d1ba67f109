"""What a robot is made of, as ports: `Camera`, `Drive`, `RangeSensor`. Pure.

A plug-in is a class with a pydantic `Config` attribute, built as `Plugin(config)`. All times are microseconds of the
robot's monotonic clock. Every method raises HardwareError, with the fix in its text, when the device is gone.
"""

from __future__ import annotations

import array
from dataclasses import dataclass
from typing import Protocol

from protocol.messages import CameraModel


@dataclass(frozen=True, slots=True)
class Picture:
    """One JPEG and when it was captured."""

    jpeg: bytes
    t_us: int


@dataclass(frozen=True, slots=True)
class WheelAngles:
    """Total angle each wheel has turned, in radians, forward positive, and when it was read."""

    left_rad: float
    right_rad: float
    t_us: int


@dataclass(frozen=True, slots=True)
class Ranges:
    """One turn of a range sensor: `ranges_m[i]` is seen at `angle_min_rad + i * angle_increment_rad`, inf = nothing.

    Angles are about the robot's x axis, counter-clockwise positive; distances from the sensor.
    """

    t_us: int
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    ranges_m: array.array[float]


class Camera(Protocol):
    """Gives JPEGs. A frame is captured only when `read` asks for one.

    `live` is False for a source that may repeat a picture (files); a live one that does so is taken as frozen.
    """

    model: CameraModel
    live: bool

    def read(self, timeout_s: float) -> Picture | None:
        """The next capture; None if none came in time."""
        ...

    def close(self) -> None: ...


class Drive(Protocol):
    """Two wheels. Motors latch: the last speeds given hold until others are given."""

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Give wheel speeds; never blocks."""
        ...

    def wheels(self) -> WheelAngles | None:
        """The newest encoder reading, None before the first; never blocks."""
        ...

    def close(self) -> None: ...


class RangeSensor(Protocol):
    """Sees distances around the robot."""

    def read(self) -> Ranges | None:
        """The newest scan that was not yet read; never blocks."""
        ...

    def close(self) -> None: ...
