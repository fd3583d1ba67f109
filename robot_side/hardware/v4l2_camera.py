"""A USB or built-in camera through V4L2: its own JPEGs and times, its own thread, unplugged and plugged in. Shell.

The thread takes every capture from the driver, so that nothing old waits there, but copies it only while somebody asks.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path

from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import CameraModel
from sightline.robot_side.hardware.cameras.lens import camera_model
from sightline.robot_side.hardware.newest import LatestPicture
from sightline.robot_side.hardware.v4l2_device import Capture, V4l2CameraConfig, V4l2Device, open_capture
from sightline.robot_side.ports import Picture

_RETRY_S = 0.5
_INTEREST_S = 1.0  # after the last `read`, captures are copied for this long
_FIRST_PICTURE_S = 5.0  # some cameras take seconds to start
_CLOSING_S = 2.5


class V4l2Camera:
    """`open_capture` is the one seam: whatever it returns is taken for a `cv2.VideoCapture`."""

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
        self._asked_s = self._heard_s = time.monotonic()
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
            self._asked_s = time.monotonic()
            if self._newest.take(0.1):
                return
        self.close()
        raise self._fault or self._frozen()

    def read(self, timeout_s: float) -> Picture | None:
        """The next capture; None if none came in time. Raises HardwareError while the camera is gone or frozen."""
        self._asked_s = time.monotonic()
        picture = self._newest.take(timeout_s)
        if picture is None and self._fault is not None:
            raise self._fault
        if picture is None and time.monotonic() - self._heard_s > self._config.frozen_after_s:
            raise self._frozen()
        return picture

    def adjust(self, quality_percent: int, scale_percent: int) -> bool:
        """As `Adjustable` says: with YUYV, which is encoded here; MJPG is the camera's own and stays as it is."""
        self._wish = (quality_percent, scale_percent)
        return self._config.format == "YUYV"

    def missed_captures(self) -> int:
        """Pictures that nobody took before the next one came."""
        return self._newest.dropped

    def close(self) -> None:
        """Idempotent; the device is released by its thread, which a frozen driver can hold up."""
        self._ending.set()
        self._thread.join(_CLOSING_S)

    # --- the thread ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                self._capture_one()
            except HardwareError as error:
                self._fail(error)
            except Exception as error:  # OpenCV raises its own for what a broken driver hands over
                self._fail(HardwareError(f"camera {self._config.device} failed: {' '.join(str(error).split())}"))
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
        asked = time.monotonic() - self._asked_s < _INTEREST_S
        picture = self._device.picture() if asked else None
        if picture is not None:
            self._newest.put(picture)
        if picture is not None or not asked:
            self._heard_s = time.monotonic()
            self._fault = None

    def _release(self) -> None:
        if self._device is not None:
            self._device.close()
            self._device = None

    def _frozen(self) -> HardwareError:
        return HardwareError(
            f"camera {self._config.device} has given no usable picture for {self._config.frozen_after_s:g} s; unplug "
            "it and plug it in again, or check its cable and power"
        )
