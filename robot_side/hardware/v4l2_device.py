"""An open V4L2 device, through OpenCV: its format pinned, its JPEGs undecoded, its buffers' times. Shell.

OpenCV is imported when a device is opened; the robot's base install has none.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.jpeg import JpegSize
from sightline.robot_side.hardware.cameras.timing import CaptureClock
from sightline.robot_side.hardware.cameras.lens import LensConfig
from sightline.robot_side.hardware.pace import read_clocks
from sightline.robot_side.hardware.cameras.v4l2 import check_device, open_error
from sightline.robot_side.ports import Picture, scaled_quality, scaled_size

_SELECT_TIMEOUT_S = 2  # OpenCV waits this long for a picture; its own default of 10 would hide a frozen camera
_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"


class V4l2CameraConfig(LensConfig):
    """`device` may also be a stable name, /dev/v4l/by-id/...; `quality` and the copy it costs are for YUYV only."""

    device: Path = Path("/dev/video0")
    format: Literal["MJPG", "YUYV"] = "MJPG"
    """MJPG: the camera's own JPEG, passed through. YUYV: encoded here, some milliseconds of CPU a picture."""
    width_px: Annotated[int, Field(ge=16, le=8192)] = 640
    height_px: Annotated[int, Field(ge=16, le=8192)] = 480
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    quality: Annotated[int, Field(ge=10, le=100)] = 80
    delay_ms: Annotated[float, Field(ge=0, le=1000)] = 30.0
    """Age of a picture when it is read, for drivers that write no usable time on it."""
    frozen_after_s: Annotated[float, Field(ge=0.2, le=60)] = 2.0
    """Without a picture for this long the camera is said to be frozen."""


Capture = Any
"""Shaped like `cv2.VideoCapture`: isOpened, set, get, grab, retrieve, release."""


def open_capture(path: Path) -> Capture:
    """A `cv2.VideoCapture` of a V4L2 device.

    Raises HardwareError that says why not; ConfigError without OpenCV.
    """
    check_device(path)
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(_SELECT_TIMEOUT_S))
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # its warnings say less than the errors here
    cv2 = _opencv()
    capture = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
    if not capture.isOpened():
        raise open_error(path)
    return capture


def _opencv() -> Any:
    try:
        import cv2
    except ImportError:
        raise ConfigError("camera v4l2 needs OpenCV: pip install 'sightline[camera]'") from None
    return cv2


class V4l2Device:
    """One opening of a device; raises HardwareError when it does not give what was asked for, or is gone."""

    def __init__(self, config: V4l2CameraConfig, opening: Callable[[Path], Capture]) -> None:
        self._config = config
        self.wish = (100, 100)
        """Shares of the configured quality and side lengths; for YUYV, whose pictures are encoded here."""
        self._stamps = CaptureClock(round(config.delay_ms * 1000))
        self._capture = opening(config.device)
        try:
            self._pin_format()
        except HardwareError:
            self.close()
            raise

    def _pin_format(self) -> None:
        """The format first: the driver chooses size and rate among what it has in that format."""
        cv2, config = _opencv(), self._config
        for name, value in (
            (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.format)),
            (cv2.CAP_PROP_FRAME_WIDTH, config.width_px),
            (cv2.CAP_PROP_FRAME_HEIGHT, config.height_px),
            (cv2.CAP_PROP_FPS, config.fps),
            (cv2.CAP_PROP_CONVERT_RGB, 0),
        ):
            self._capture.set(name, value)
        self._check_format(_fourcc_text(int(self._capture.get(cv2.CAP_PROP_FOURCC))))
        width, height = (int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if (width, height) != (config.width_px, config.height_px):
            raise self._error(
                f"gives {width}x{height}, not {config.width_px}x{config.height_px}; set camera.options.width_px and "
                "height_px to a size it has (`v4l2-ctl --list-formats-ext`)"
            )
        self.size = JpegSize(width, height, 3)

    def _check_format(self, given: str) -> None:
        if given == self._config.format:
            return
        if given == "YUYV":
            raise self._error(
                'gives YUYV, not MJPG: set camera.options.format = "YUYV" to have it encoded here, which costs CPU'
            )
        raise self._error(f"gives {given}, not {self._config.format}; set camera.options.format to MJPG or YUYV")

    def wait(self) -> None:
        """Wait for the next capture and take it from the driver; microseconds of CPU."""
        if not self._capture.grab():
            if not self._config.device.exists():
                raise self._error("was unplugged; plug it in again")
            raise self._error("gives no picture; unplug it and plug it in again, or check its cable and power")

    def picture(self) -> Picture | None:
        """The capture last waited for; None if it was damaged on its way."""
        cv2 = _opencv()
        t_us = self._stamps.captured_us(round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1000), read_clocks())
        done, data = self._capture.retrieve()
        if not done:
            return None
        if self._config.format == "YUYV":
            return self._encoded(data, t_us)
        jpeg = whole_jpeg(data.tobytes())
        return Picture(jpeg, t_us) if jpeg else None

    def _encoded(self, yuyv: Any, t_us: int) -> Picture:
        import simplejpeg

        cv2 = _opencv()
        quality_percent, scale_percent = self.wish
        full = self.size
        bgr = cv2.cvtColor(yuyv.reshape(full.height_px, full.width_px, 2), cv2.COLOR_YUV2BGR_YUYV)
        if scale_percent != 100:
            size = scaled_size(full.width_px, full.height_px, scale_percent)
            bgr = cv2.resize(bgr, (size.width_px, size.height_px), interpolation=cv2.INTER_AREA)
        jpeg: bytes = simplejpeg.encode_jpeg(
            bgr, quality=scaled_quality(self._config.quality, quality_percent), colorspace="BGR", colorsubsampling="422",
            fastdct=True,
        )
        return Picture(jpeg, t_us, scale_percent)

    def close(self) -> None:
        """Idempotent."""
        self._capture.release()

    def _error(self, what: str) -> HardwareError:
        return HardwareError(f"camera {self._config.device} {what}")


def whole_jpeg(data: bytes) -> bytes | None:
    """`data` less the padding that some cameras add; None if its beginning or end is missing."""
    end = data.rfind(_EOI)
    if end < 0 or data[:2] != _SOI:
        return None
    return data[: end + 2]


def _fourcc_text(code: int) -> str:
    text = "".join(chr(code >> shift & 0xFF) for shift in (0, 8, 16, 24))
    return text if text.isalnum() else f"format {code:#x}"
