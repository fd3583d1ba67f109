"""A camera that plays a video file at its own speed, looped or once. Shell (a file and a clock).

OpenCV and simplejpeg are imported when a video is opened; the robot's base install has neither.
"""

import math
import time
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.jpeg import JpegSize
from sightline.robot_side.hardware.cameras.lens import LensConfig, camera_model
from sightline.robot_side.hardware.pace import FrameTimer
from sightline.robot_side.ports import Picture, scaled_quality, scaled_size

_USUAL_FPS = 30.0
_CATCH_UP_S = 1.0  # after a longer pause the video goes on where it was, as if paused
_COUNT_SLACK = 0.05  # a container may only estimate how many pictures it holds


class VideoCameraConfig(LensConfig):
    """`fps` 0 is the video's own; without `loop` the end is an error that says so."""

    path: Path
    loop: bool = True
    fps: Annotated[float, Field(ge=0, le=240)] = 0.0
    quality: Annotated[int, Field(ge=10, le=100)] = 80


class VideoCamera:
    """Every picture is decoded and encoded here. A slow reader sees fewer pictures, not a slower video."""

    Config = VideoCameraConfig
    live = False

    def __init__(self, config: VideoCameraConfig) -> None:
        self._config = config
        self._encode, self._cv2 = _packages()
        self._quality, self._scale_percent = config.quality, 100
        self._open()
        self.model = camera_model(config, self._size())
        fps = config.fps or self._own_fps()
        self._pace = FrameTimer(fps)
        self._fps = fps
        self._started_s = time.monotonic()
        self._shown = 0

    def read(self, timeout_s: float) -> Picture | None:
        """The picture of the next tick. Raises HardwareError at the end without `loop`, and where the file breaks."""
        if not self._pace.wait(timeout_s):
            return None
        for _ in range(self._due()):
            self._step()
        done, bgr = self._capture.retrieve()
        if not done:
            raise self._broken()
        t_us = monotonic_us()
        scale = self._scale_percent
        if scale != 100:
            size = scaled_size(self.model.width_px, self.model.height_px, scale)
            bgr = self._cv2.resize(bgr, (size.width_px, size.height_px), interpolation=self._cv2.INTER_AREA)
        jpeg = self._encode(bgr, quality=self._quality, colorspace="BGR", colorsubsampling="420", fastdct=True)
        return Picture(jpeg, t_us, scale)

    def adjust(self, quality_percent: int, scale_percent: int) -> bool:
        """As `Adjustable` says."""
        self._quality = scaled_quality(self._config.quality, quality_percent)
        self._scale_percent = scale_percent
        return True

    def close(self) -> None:
        """Idempotent."""
        self._capture.release()

    # --- the file ------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        path = self._config.path.expanduser()
        if not path.is_file():
            raise HardwareError(f"video {self._config.path} is not there; set camera.options.path to a video file")
        self._capture: Any = self._cv2.VideoCapture(str(path), self._cv2.CAP_FFMPEG)
        self._at = 0
        if not self._capture.isOpened() or min(self._size().width_px, self._size().height_px) < 1:
            raise HardwareError(f"video {self._config.path} cannot be played: it is broken or no video; play it with "
                                "another program, or record it anew")

    def _size(self) -> JpegSize:
        get, cv2 = self._capture.get, self._cv2
        return JpegSize(int(get(cv2.CAP_PROP_FRAME_WIDTH)), int(get(cv2.CAP_PROP_FRAME_HEIGHT)), 3)

    def _own_fps(self) -> float:
        fps = float(self._capture.get(self._cv2.CAP_PROP_FPS))
        return fps if 0 < fps <= 240 else _USUAL_FPS

    def _due(self) -> int:
        """How many pictures the video has moved on since the last one shown; at least one."""
        now_s = time.monotonic()
        ahead = math.floor((now_s - self._started_s) * self._fps + 0.5) - self._shown
        if ahead > _CATCH_UP_S * self._fps or ahead < 1:
            ahead = 1
            self._started_s = now_s - (self._shown + 1) / self._fps
        self._shown += ahead
        return ahead

    def _step(self) -> None:
        """To the next picture, past the end if it is looped."""
        if self._capture.grab():
            self._at += 1
            return
        self._check_end()
        self._capture.release()
        self._open()
        if not self._capture.grab():
            raise self._broken()
        self._at = 1

    def _check_end(self) -> None:
        count = int(self._capture.get(self._cv2.CAP_PROP_FRAME_COUNT))
        if self._at == 0 or self._at < count * (1 - _COUNT_SLACK) - 1:
            raise self._broken()
        if not self._config.loop:
            raise HardwareError(f"video {self._config.path} ended after {self._at} pictures; set camera.options.loop "
                                "= true to play it again and again")

    def _broken(self) -> HardwareError:
        count = int(self._capture.get(self._cv2.CAP_PROP_FRAME_COUNT))
        return HardwareError(f"video {self._config.path} breaks off at picture {self._at} of {count}; repair or "
                             "record it anew")


def _packages() -> tuple[Any, Any]:
    try:
        import cv2
        import simplejpeg
    except ImportError:
        raise ConfigError("camera video needs OpenCV and simplejpeg: pip install 'sightline[camera]'") from None
    return simplejpeg.encode_jpeg, cv2
