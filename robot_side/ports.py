"""The ports of a robot's devices: `Camera`, `Drive`, `RangeSensor`, `Battery`. Pure.

A plug-in is a class with a pydantic `Config` attribute. Sightline creates it as `Plugin(config)`. All times are
microseconds of the robot's monotonic clock. Every method raises HardwareError when the device is gone. The error text
contains the fix.
"""

from __future__ import annotations

import array
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol, runtime_checkable

from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import CameraModel


@dataclass(frozen=True, slots=True)
class Picture:
    """One image with its capture time.

    Args:
        jpeg: the encoded image.
        t_us: capture time on the robot's monotonic clock, us.
        scale_percent: side lengths relative to the camera's model, 1 to 100.
    """

    jpeg: bytes
    t_us: int
    scale_percent: int = 100


def check_image(camera: Camera, picture: object) -> None:
    """Raise TypeError or ValueError, with the error, for an invalid image or an invalid attribute of its `Camera`."""
    if not isinstance(picture, Picture):
        raise TypeError(f"read() returned {type(picture).__name__}; expected Picture or None")
    for name, value, kind in (
        ("Picture.jpeg", picture.jpeg, bytes | bytearray), ("Picture.t_us", picture.t_us, int),
        ("Picture.scale_percent", picture.scale_percent, int), ("model", camera.model, CameraModel),
        ("live", camera.live, object),  # any value, but it must exist
    ):
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise TypeError(f"{name} is {type(value).__name__}; expected {getattr(kind, '__name__', kind)}")
    if not 1 <= picture.scale_percent <= 100:
        raise ValueError(f"Picture.scale_percent is {picture.scale_percent}; expected 1 to 100")


@dataclass(frozen=True, slots=True)
class WheelAngles:
    """The total angle of each wheel, forward positive.

    Args:
        left_rad: angle of the left wheel since the start, rad.
        right_rad: angle of the right wheel since the start, rad.
        t_us: time of the reading, us, not of the call. A reading with the time of the last one, or an older one, is
            ignored. An old reading with a new time looks like a wheel that stands, and then like one that races.
    """

    left_rad: float
    right_rad: float
    t_us: int


def check_wheels(reading: object) -> None:
    """Raise TypeError, with the error, for an invalid result of `Drive.wheels`."""
    if reading is not None and not isinstance(reading, WheelAngles):
        raise TypeError(f"wheels() returned {type(reading).__name__}; expected WheelAngles or None")


@dataclass(frozen=True, slots=True)
class Ranges:
    """One turn of a range sensor. `ranges_m[i]` is the distance at `angle_min_rad + i * angle_increment_rad`.

    Angles start at the robot's x axis, counter-clockwise positive. Distances start at the sensor.

        range_min_m to range_max_m    an obstacle at this distance
        below range_min_m, but not 0  an obstacle too close to measure; it counts as one at range_min_m
        inf                           no obstacle within the range of the sensor
        0, or above range_max_m       no echo; neither an obstacle nor a free path
        nan                           a broken scan

    A scan with a nan, without rays or without any echo is invalid. A plug-in translates the codes of its device to this
    table. Some devices write 0 also for an object that is too close. Their plug-in writes half of `range_min_m`
    instead. A ray that hits the robot itself is 0.

    Args:
        t_us: time of the scan, us.
        angle_min_rad: angle of the first ray, rad.
        angle_increment_rad: angle between two rays, rad.
        range_min_m: smallest distance that the sensor measures, m.
        range_max_m: largest distance that the sensor measures, m.
        ranges_m: one distance per ray, m; at most MAX_RAYS. A scan of over 4096 rays limits the speed, and is too long
            to be published.
    """

    t_us: int
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    ranges_m: array.array[float]


MAX_RAYS: Final = 16_384
"""Largest number of rays of a scan; more would delay the control loop."""


def check_scan(scan: object) -> None:
    """Raise TypeError or ValueError, with the error, for an invalid result of `RangeSensor.read`."""
    if not isinstance(scan, Ranges):
        raise TypeError(f"read() returned {type(scan).__name__}; expected Ranges or None")
    if not isinstance(scan.t_us, int):
        raise TypeError(f"Ranges.t_us is {type(scan.t_us).__name__}; expected int")
    if not 0 <= scan.t_us < 2**53:  # what a message can hold
        raise ValueError(f"Ranges.t_us is {scan.t_us}; take the robot's clock, in microseconds")
    for name in ("angle_min_rad", "angle_increment_rad", "range_min_m", "range_max_m"):
        if math.isnan(getattr(scan, name)):
            raise ValueError(f"Ranges.{name} is nan")
    if len(scan.ranges_m) > MAX_RAYS:
        raise ValueError(f"a scan of {len(scan.ranges_m)} rays; at most {MAX_RAYS}")


class Camera(Protocol):
    """A source of JPEG images. It captures an image only when `read` is called.

    `live` is False for a source that may repeat an image (files). A live camera that repeats an image counts as frozen.
    """

    model: CameraModel
    live: bool

    def read(self, timeout_s: float) -> Picture | None:
        """Wait for the next image.

        Args:
            timeout_s: longest wait, s.

        Returns:
            The image, or None if no image came in time.

        Raises:
            HardwareError: the camera is gone.
        """
        ...

    def close(self) -> None:
        """Release the camera. Idempotent."""
        ...


@runtime_checkable
class Adjustable(Protocol):
    """An optional port of a camera that encodes its images, so that they fit a slow link."""

    def adjust(self, quality_percent: int, scale_percent: int) -> bool:
        """Change the encoding within a few images. `model` stays at the full size; each image names its own scale.

        Args:
            quality_percent: share of the configured JPEG quality, 1 to 100.
            scale_percent: share of the configured side lengths, 1 to 100.

        Returns:
            False if the device encodes the images itself, so that nothing changes.
        """
        ...


class Drive(Protocol):
    """Two driven wheels. Motors latch: the last speeds hold until the next call of `set`."""

    @staticmethod
    def zero(config: Mapping[str, Any]) -> None:
        """Set the motors to zero without a drive object. Its process is dead and has released the device.

        The guardian calls this function. It imports only the module of this function. Without pydantic the guardian
        stays small. If the module has `prepare`, the guardian calls it at its start, e.g. to import a library.

        Args:
            config: the `Config` of the drive as plain values, `Config.model_dump(mode="json")`.

        Raises:
            HardwareError: the motors may still turn.
        """
        ...

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Set the wheel speeds. Never blocks.

        Args:
            left_rad_s: speed of the left wheel, rad/s, forward positive.
            right_rad_s: speed of the right wheel, rad/s, forward positive.

        Raises:
            HardwareError: the drive failed; the gate enters FAULT.
        """
        ...

    def wheels(self) -> WheelAngles | None:
        """Read the encoders. Never blocks.

        Returns:
            The newest reading in rad, or None before the first reading and without encoders.

        Raises:
            HardwareError: the drive failed; the gate enters FAULT.
        """
        ...

    def close(self) -> None:
        """Release the drive. The caller sets both speeds to zero first. Idempotent."""
        ...


class RangeSensor(Protocol):
    """A sensor that measures distances around the robot."""

    def read(self) -> Ranges | None:
        """Take the newest scan. Never blocks.

        Returns:
            The scan in m and rad, or None if the last call returned it already.

        Raises:
            HardwareError: the sensor is gone.
        """
        ...

    def close(self) -> None:
        """Release the sensor. Idempotent."""
        ...


class Battery(Protocol):
    """A sensor for the battery voltage. The driver calls it from a separate thread, so it may take a second."""

    def read(self) -> float:
        """Measure the voltage now. The battery counts as low after 5 s without a reading.

        Returns:
            The voltage, V.

        Raises:
            HardwareError: the sensor is gone.
        """
        ...

    def close(self) -> None:
        """Release the sensor. Idempotent."""
        ...


def scaled_size(width_px: int, height_px: int, scale_percent: int) -> JpegSize:
    """Return the size of a scaled image.

    Args:
        width_px: full width, px.
        height_px: full height, px.
        scale_percent: share of the side lengths, 1 to 100.

    Returns:
        The size in px; each side is at least 16 px.
    """
    return JpegSize(max(16, width_px * scale_percent // 100), max(16, height_px * scale_percent // 100), 3)


def scaled_model(model: CameraModel, scale_percent: int) -> CameraModel:
    """Scale the intrinsics of a camera model. Distortion is a property of the rays and does not change with the size.

    Args:
        model: model at full size, px.
        scale_percent: share of the side lengths, 1 to 100.

    Returns:
        The model at the reduced size, px.
    """
    if scale_percent == 100:
        return model
    size = scaled_size(model.width_px, model.height_px, scale_percent)
    across, down = size.width_px / model.width_px, size.height_px / model.height_px
    return model.model_copy(update={
        "width_px": size.width_px, "height_px": size.height_px, "fx_px": model.fx_px * across,
        "fy_px": model.fy_px * down, "cx_px": model.cx_px * across, "cy_px": model.cy_px * down,
    })


def scaled_quality(quality: int, percent: int) -> int:
    """Scale a JPEG quality.

    Args:
        quality: configured quality, 1 to 100.
        percent: share of it, 1 to 100.

    Returns:
        The share, at least 1, because some decoders reject quality 0.
    """
    return max(1, round(quality * percent / 100))
