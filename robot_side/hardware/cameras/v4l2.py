"""A V4L2 camera through OpenCV: unchanged JPEGs, capture times, reconnection, diagnosis. Shell."""

from __future__ import annotations

import errno
import grp
import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from sightline.protocol.errors import ConfigError, HardwareError, install_command
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.log import report_fault
from sightline.protocol.messages import CameraModel
from sightline.protocol.transports.diagnosis import process_with_open
from sightline.robot_side.hardware.cameras.lens import LensConfig, camera_model
from sightline.robot_side.hardware.cameras.timing import CaptureClock, LatestPicture, read_clocks
from sightline.robot_side.ports import Picture, scaled_quality, scaled_size

_SET: Final = "set camera.options.device, after --camera with --camera-set device=/dev/videoN"


def check_device(path: Path) -> None:
    """Raise HardwareError if `path` is missing, not a device, or not permitted. OpenCV reports only "failed"."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        raise _trouble(path, error) from None
    try:
        if not stat.S_ISCHR(os.fstat(descriptor).st_mode):
            raise HardwareError(f"{path} is not a camera device{_others(path)}; {_SET}")
    finally:
        os.close(descriptor)


def open_error(path: Path) -> HardwareError:
    """Return the error of an existing and permitted device that did not open as a camera."""
    owner = device_owner(path)
    if owner:
        return HardwareError(f"camera {path} is busy: {owner} has it open; end that program")
    return HardwareError(
        f"camera {path} does not open: busy, or the second node of a camera, which delivers no images"
        f"{_others(path)}; {_SET}"
    )


def device_owner(path: Path) -> str:
    """Return another process that has `path` open, e.g. `cheese (pid 4711)`, or "" if the system hides it."""
    return process_with_open({str(path.resolve())}, besides=os.getpid())


def _trouble(path: Path, error: OSError) -> HardwareError:
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR):
        return HardwareError(f"camera {path} is not there{_others(path)}; plug it in, or {_SET}")
    if error.errno in (errno.EACCES, errno.EPERM):
        return HardwareError(
            f"camera {path} may not be opened by this user, only by its group {_group(path)!r}: "
            f"sudo usermod -aG {_group(path)} $USER, then log in again"
        )
    if error.errno == errno.EBUSY:
        return open_error(path)
    return HardwareError(f"camera {path} cannot be opened: {error.strerror}; {_SET}")


def _others(path: Path) -> str:
    """List the other video devices, for the error text."""
    there = [str(other) for other in sorted(Path("/dev").glob("video*")) if other != path]
    return f" (there are: {', '.join(there)})" if there else " (no /dev/video* is there)"


def _group(path: Path) -> str:
    """Return the group of the device, or `video` if it has no name."""
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
    except (OSError, KeyError):
        return "video"
    return group if group != "root" else "video"


# An open V4L2 device, through OpenCV: fixed format, undecoded JPEGs, times of the buffers. Shell.
#
# OpenCV is imported when a device is opened, because the base install does not have it.


_SELECT_TIMEOUT_S = 2  # longest wait of OpenCV for an image; its default of 10 would hide a frozen camera
_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"


class V4l2CameraConfig(LensConfig):
    """`device` may also be a stable name, /dev/v4l/by-id/...; `quality` applies to YUYV only."""

    device: Path = Path("/dev/video0")
    format: Literal["MJPG", "YUYV"] = "MJPG"
    """MJPG: the camera's own JPEG, unchanged. YUYV: encoded here, which costs CPU for each image."""
    width_px: Annotated[int, Field(ge=16, le=8192)] = 640
    height_px: Annotated[int, Field(ge=16, le=8192)] = 480
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    quality: Annotated[int, Field(ge=10, le=100)] = 80
    delay_ms: Annotated[float, Field(ge=0, le=1000)] = 30.0
    """Age of an image at its reading, ms, for drivers without a valid time."""
    frozen_after_s: Annotated[float, Field(ge=0.2, le=2)] = 2.0
    """Time without an image after which the camera counts as frozen; after 2 s a new process opens it."""


Capture = Any
"""The interface of `cv2.VideoCapture`: isOpened, set, get, grab, retrieve, release."""


def open_capture(path: Path) -> Capture:
    """Open a V4L2 device as a `cv2.VideoCapture`.

    Raises HardwareError with the cause, and ConfigError without OpenCV.
    """
    check_device(path)
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(_SELECT_TIMEOUT_S))
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # the errors of this module replace its warnings
    cv2 = _opencv()
    capture = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
    if not capture.isOpened():
        raise open_error(path)
    return capture


def _opencv() -> Any:
    try:
        import cv2
    except ImportError:
        raise ConfigError(f"camera v4l2 needs OpenCV: {install_command('camera')}") from None
    return cv2


class V4l2Device:
    """One open device. Raises HardwareError if it rejects the requested format, or is gone."""

    def __init__(self, config: V4l2CameraConfig, opening: Callable[[Path], Capture]) -> None:
        self._config = config
        self.wish = (100, 100)
        """Requested shares of the configured quality and side lengths, for YUYV images, which are encoded here."""
        self._stamps = CaptureClock(round(config.delay_ms * 1000))
        self._capture = opening(config.device)
        try:
            self._pin_format()
        except HardwareError:
            self.close()
            raise

    def _pin_format(self) -> None:
        """Set the format first, because the driver offers sizes and rates per format."""
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
        """Wait for the next capture and take it from the driver. It takes microseconds of CPU."""
        if not self._capture.grab():
            if not self._config.device.exists():
                raise self._error("was unplugged; plug it in again")
            raise self._error("delivers no image; unplug it and plug it in again, or check its cable and power")

    def picture(self) -> Picture | None:
        """Return the capture of the last `wait`, or None for a damaged one."""
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
            bgr,
            quality=scaled_quality(self._config.quality, quality_percent),
            colorspace="BGR",
            colorsubsampling="422",
            fastdct=True,
        )
        return Picture(jpeg, t_us, scale_percent)

    def close(self) -> None:
        """Release the device. Idempotent."""
        self._capture.release()

    def _error(self, what: str) -> HardwareError:
        return HardwareError(f"camera {self._config.device} {what}")


def whole_jpeg(data: bytes) -> bytes | None:
    """Remove the padding that some cameras add. Returns None if the beginning or the end of the image is missing."""
    end = data.rfind(_EOI)
    if end < 0 or data[:2] != _SOI:
        return None
    return data[: end + 2]


def _fourcc_text(code: int) -> str:
    text = "".join(chr(code >> shift & 0xFF) for shift in (0, 8, 16, 24))
    return text if text.isalnum() else f"format {code:#x}"


# A USB or built-in camera through V4L2: its own JPEGs and times, a separate thread, reconnection. Shell. The thread
# takes every capture from the driver, so that no old image waits there. It copies an image only for a waiting reader.


_RETRY_S = 0.5
_INTEREST_S = 1.0  # time after the last `read` in which captures are copied
_FIRST_PICTURE_S = 5.0  # some cameras take seconds to start
_CLOSING_S = 2.5


class V4l2Camera:
    """Opens the device. `open_capture` returns a `cv2.VideoCapture`, or a substitute in tests."""

    Config = V4l2CameraConfig
    live = True

    def __init__(
        self, config: V4l2CameraConfig, opening: Callable[[Path], Capture] = open_capture
    ) -> None:
        self._config, self._opening = config, opening
        self._newest = LatestPicture()
        self._wish = (100, 100)
        self._fault: HardwareError | None = None
        self._ending = threading.Event()
        self._requested_s = self._received_s = time.monotonic()
        self._device: V4l2Device | None = V4l2Device(config, opening)
        self.model: CameraModel = self._model(self._device)
        self._thread = threading.Thread(target=self._run, name="v4l2 camera", daemon=True)
        self._thread.start()
        self._await_first()

    def _model(self, device: V4l2Device) -> CameraModel:
        try:
            return camera_model(self._config, device.size)
        except Exception:
            device.close()
            raise

    def _await_first(self) -> None:
        deadline_s = time.monotonic() + _FIRST_PICTURE_S
        while time.monotonic() < deadline_s and self._fault is None:
            self._requested_s = time.monotonic()
            if self._newest.take(0.1):
                return
        self.close()
        raise self._fault or self._frozen()

    def read(self, timeout_s: float) -> Picture | None:
        """Wait for the next capture. Returns None if none comes in time.

        Raises:
            HardwareError: the camera is gone or frozen.
        """
        self._requested_s = time.monotonic()
        picture = self._newest.take(timeout_s)
        if picture is None and self._fault is not None:
            raise self._fault
        if picture is None and time.monotonic() - self._received_s > self._config.frozen_after_s:
            raise self._frozen()
        return picture

    def adjust(self, quality_percent: int, scale_percent: int) -> bool:
        """Change the encoding of YUYV images, see `Adjustable`. MJPG images stay unchanged."""
        self._wish = (quality_percent, scale_percent)
        return self._config.format == "YUYV"

    def missed_captures(self) -> int:
        """Return the number of images that the next image replaced before a reader took them."""
        return self._newest.dropped

    def close(self) -> None:
        """Request the end. Idempotent. The camera thread releases the device, which a frozen driver can delay."""
        self._ending.set()
        self._thread.join(_CLOSING_S)

    # --- the thread ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                self._capture_one()
            except HardwareError as error:
                self._fail(error)
            except Exception as error:  # OpenCV raises its own errors for invalid data of a broken driver
                self._fail(HardwareError(f"camera {self._config.device} failed: {report_fault('camera', error)}"))
        self._release()

    def _fail(self, fault: HardwareError) -> None:
        self._fault = fault
        self._release()
        self._ending.wait(_RETRY_S)

    def _capture_one(self) -> None:
        if self._device is None:
            self._device = V4l2Device(self._config, self._opening)
        self._device.wish = self._wish
        self._device.wait()
        requested = time.monotonic() - self._requested_s < _INTEREST_S
        picture = self._device.picture() if requested else None
        if picture is not None:
            self._newest.put(picture)
        if picture is not None or not requested:
            self._received_s = time.monotonic()
            self._fault = None

    def _release(self) -> None:
        if self._device is not None:
            self._device.close()
            self._device = None

    def _frozen(self) -> HardwareError:
        return HardwareError(
            f"camera {self._config.device} delivered no usable image for {self._config.frozen_after_s:g} s; unplug "
            "it and plug it in again, or check its cable and power"
        )
