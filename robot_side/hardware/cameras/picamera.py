"""A Raspberry Pi camera through picamera2: JPEGs of the hardware encoder, times of the sensor. Shell (threads).

picamera2 comes from apt on a Raspberry Pi (python3-picamera2) and is imported when the camera is opened.
"""

import time
from typing import Annotated, Any

from pydantic import Field

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.jpeg import JpegSize
from sightline.robot_side.hardware.cameras.lens import LensConfig, camera_model
from sightline.robot_side.hardware.cameras.timing import CaptureClock, LatestPicture, read_clocks
from sightline.robot_side.ports import Picture

_LIST = "`rpicam-hello --list-cameras` lists what is connected"


class PiCameraConfig(LensConfig):
    """`bitrate_mbit_s` sets the JPEG quality: 8 is about 33 kB per image at 30 fps. 62 degrees: Camera Module 2."""

    index: Annotated[int, Field(ge=0, le=3)] = 0
    width_px: Annotated[int, Field(ge=64, le=4096)] = 640
    height_px: Annotated[int, Field(ge=64, le=4096)] = 480
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    bitrate_mbit_s: Annotated[float, Field(gt=0, le=100)] = 8.0
    upside_down: bool = False
    hfov_deg: Annotated[float, Field(gt=5, lt=175)] = 62.0
    delay_ms: Annotated[float, Field(ge=0, le=1000)] = 30.0
    """Age of an image at its encoding, ms, if the sensor gives no valid time."""
    frozen_after_s: Annotated[float, Field(ge=0.2, le=2)] = 2.0


class PiCamera:
    """Stores the newest image. picamera2 captures and encodes on its own threads."""

    Config = PiCameraConfig
    live = True

    def __init__(self, config: PiCameraConfig) -> None:
        self._config = config
        self._newest = LatestPicture()
        self._stamps = CaptureClock(round(config.delay_ms * 1000))
        self._received_s = time.monotonic()
        self.model = camera_model(config, JpegSize(config.width_px, config.height_px, 3))
        self._camera = _opened(config)
        try:
            self._start()
        except Exception as error:
            self._camera.close()
            raise HardwareError(f"Raspberry Pi camera {config.index} does not start: {_line(error)}; {_LIST}") from None

    def _start(self) -> None:
        from libcamera import Transform
        from picamera2.encoders import MJPEGEncoder

        config = self._config
        turned = Transform(hflip=config.upside_down, vflip=config.upside_down)
        self._camera.configure(
            self._camera.create_video_configuration(
                main={"size": (config.width_px, config.height_px)}, controls={"FrameRate": config.fps}, transform=turned
            )
        )
        self._encoder = MJPEGEncoder(bitrate=round(config.bitrate_mbit_s * 1e6))
        self._camera.start_recording(self._encoder, _output(self))

    def encoded(self, jpeg: bytes, since_first_us: int | None) -> None:
        """Store the image. The thread of the encoder calls this; its times count from the first image."""
        first_us = getattr(self._encoder, "firsttimestamp", None)
        stamp_us = 0 if first_us is None or since_first_us is None else first_us + since_first_us
        t_us = self._stamps.captured_us(stamp_us, read_clocks())
        self._received_s = time.monotonic()
        self._newest.put(Picture(jpeg, t_us))

    def read(self, timeout_s: float) -> Picture | None:
        """Wait for the next capture. Returns None if none comes in time. Raises HardwareError for a frozen camera."""
        picture = self._newest.take(timeout_s)
        if picture is None and time.monotonic() - self._received_s > self._config.frozen_after_s:
            raise HardwareError(
                f"Raspberry Pi camera {self._config.index} delivered no image for {self._config.frozen_after_s:g} s; "
                "check its ribbon cable and restart the robot service"
            )
        return picture

    def missed_captures(self) -> int:
        """Return the number of images that the next image replaced before a reader took them."""
        return self._newest.dropped

    def close(self) -> None:
        """Close the camera. Idempotent."""
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.stop_recording()
            camera.close()


def _opened(config: PiCameraConfig) -> Any:
    try:
        from picamera2 import Picamera2
    except ImportError:
        raise ConfigError(
            "camera picamera needs picamera2: sudo apt install python3-picamera2, and a virtual environment made with "
            "--system-site-packages"
        ) from None
    count = len(Picamera2.global_camera_info())
    if config.index >= count:
        raise HardwareError(f"Raspberry Pi camera {config.index} is not there ({count} found); {_LIST}")
    try:
        return Picamera2(config.index)
    except Exception as error:
        raise HardwareError(
            f"Raspberry Pi camera {config.index} does not open: {_line(error)}; is another program using it?"
        ) from None


def _output(camera: PiCamera) -> Any:
    """Return the output of the encoder. Its base class exists only with picamera2 installed."""
    from picamera2.outputs import Output

    class ToCamera(Output):  # type: ignore[misc]
        """Forward every image. Newer versions pass more arguments, which are not needed."""

        def outputframe(
            self, frame: Any, _keyframe: bool = True, timestamp: int | None = None, *_more: Any, **_named: Any
        ) -> None:
            camera.encoded(bytes(frame), timestamp)

    return ToCamera()


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
