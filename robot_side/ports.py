"""What a robot is made of, as ports: `Camera`, `Drive`, `RangeSensor`, `Battery`. Pure.

A plug-in is a class with a pydantic `Config` attribute, built as `Plugin(config)`. All times are microseconds of the
robot's monotonic clock. Every method raises HardwareError, with the fix in its text, when the device is gone.
"""

from __future__ import annotations

import array
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import CameraModel


@dataclass(frozen=True, slots=True)
class Picture:
    """One JPEG, when it was captured, and the share of the side lengths of the camera's model that it has."""

    jpeg: bytes
    t_us: int
    scale_percent: int = 100


@dataclass(frozen=True, slots=True)
class WheelAngles:
    """Total angle each wheel has turned, in radians, forward positive, and when it was read."""

    left_rad: float
    right_rad: float
    t_us: int


@dataclass(frozen=True, slots=True)
class Ranges:
    """One turn of a range sensor: `ranges_m[i]` is what it meets at `angle_min_rad + i * angle_increment_rad`.

    Angles are about the robot's x axis, counter-clockwise positive; distances from the sensor.

        range_min_m to range_max_m    something, so far away
        below range_min_m, but not 0  something, too close to measure: an obstacle at range_min_m
        inf                           nothing, as far as the sensor sees: free
        0, or above range_max_m       no echo; the ray says nothing: no obstacle, and no free way either
        nan                           a broken scan

    A scan with a nan, or of which no ray says anything (one without rays, too), is none. A plug-in whose device tells
    these cases otherwise translates: one that writes 0 also for what is too close gives half of `range_min_m` there.
    Where the robot's own parts are in the way it gives 0.
    """

    t_us: int
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    ranges_m: array.array[float]


class Camera(Protocol):
    """Gives JPEGs. A frame is captured only when `read` is called.

    `live` is False for a source that may repeat a picture (files); a live one that does so is taken as frozen.
    """

    model: CameraModel
    live: bool

    def read(self, timeout_s: float) -> Picture | None:
        """The next capture; None if none came in time."""
        ...

    def close(self) -> None: ...


@runtime_checkable
class Adjustable(Protocol):
    """What a camera that encodes its pictures itself can do besides, so that they fit a thin link."""

    def adjust(self, quality_percent: int, scale_percent: int) -> bool:
        """Encode so from the next capture on, within a few pictures: shares of the configured quality and side lengths.

        False, and nothing changes, where the device's own JPEGs are passed through. `model` stays that of the full
        size; each picture says its own scale.
        """
        ...


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


class Battery(Protocol):
    """Measures the voltage of the battery. It is called on a thread of its own and may take a second."""

    def read(self) -> float:
        """Volts now. The battery counts as low after 5 s without a reading."""
        ...

    def close(self) -> None: ...


def scaled_size(width_px: int, height_px: int, scale_percent: int) -> JpegSize:
    """The size of a picture of that scale."""
    return JpegSize(max(16, width_px * scale_percent // 100), max(16, height_px * scale_percent // 100), 3)


def scaled_model(model: CameraModel, scale_percent: int) -> CameraModel:
    """The model of a camera's pictures at that scale. Distortion is of the rays, not of the pixels."""
    if scale_percent == 100:
        return model
    size = scaled_size(model.width_px, model.height_px, scale_percent)
    across, down = size.width_px / model.width_px, size.height_px / model.height_px
    return model.model_copy(update={
        "width_px": size.width_px, "height_px": size.height_px, "fx_px": model.fx_px * across,
        "fy_px": model.fy_px * down, "cx_px": model.cx_px * across, "cy_px": model.cy_px * down,
    })


def scaled_quality(quality: int, percent: int) -> int:
    """That share of a configured JPEG quality, never below what decoders take."""
    return max(1, round(quality * percent / 100))
