"""Cameras that play one JPEG, a folder of JPEGs, or a video file. Shell."""

import math
import os
import time
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError, HardwareError, WireError, home_path, install_command
from sightline.protocol.jpeg import JpegSize, read_jpeg_size
from sightline.protocol.messages import LEAST_SIDE_PX, MOST_SIDE_PX
from sightline.robot_side.hardware.cameras.lens import LensConfig, camera_model
from sightline.robot_side.hardware.cameras.timing import FrameTimer
from sightline.robot_side.ports import Picture, scaled_quality, scaled_size


class FolderCameraConfig(LensConfig):
    """`path` is a folder of JPEGs of one size."""

    path: Path
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    hfov_deg: Annotated[float, Field(gt=5, lt=175)] = 80.0


class FolderCamera:
    """Reads all images at start. Their capture times are those of this machine's clock."""

    Config = FolderCameraConfig
    live = False

    def __init__(self, config: FolderCameraConfig) -> None:
        paths = jpegs_in(config.path)
        self._pictures = [_bytes_of(path, "remove it from the folder") for path in paths]
        sizes = {jpeg_size(path, jpeg) for path, jpeg in zip(paths, self._pictures, strict=True)}
        if len({(size.width_px, size.height_px) for size in sizes}) > 1:
            raise HardwareError(f"the images in {config.path} differ in size; name a folder with one size")
        self.model = camera_model(config, sizes.pop())
        self._pace = FrameTimer(config.fps)
        self._count = 0

    def read(self, timeout_s: float) -> Picture | None:
        """Wait for the next tick and return its image, or None if no tick comes in time."""
        if not self._pace.wait(timeout_s):
            return None
        self._count += 1
        return Picture(self._pictures[(self._count - 1) % len(self._pictures)], monotonic_us())

    def close(self) -> None:
        """Do nothing, because a file camera holds no device."""


def jpegs_in(folder: Path) -> list[Path]:
    """Return the .jpg and .jpeg files of `folder` in name order. Raises HardwareError for an empty result."""
    paths = sorted(path for path in home_path(folder).glob("*") if path.suffix.lower() in (".jpg", ".jpeg"))
    if not paths:
        raise HardwareError(f"no .jpg images in {folder}; name a folder that has some")
    return paths


def _bytes_of(path: Path, fix: str) -> bytes:
    try:
        return home_path(path).read_bytes()
    except OSError as error:
        raise HardwareError(f"image {path} cannot be read: {error.strerror}; {fix}") from None


def jpeg_size(path: Path, jpeg: bytes) -> JpegSize:
    """Return the size of `jpeg`, read from `path`. Raises HardwareError if it is not a plain JPEG."""
    try:
        size = read_jpeg_size(jpeg)
    except WireError as error:
        raise HardwareError(f"{path}: {error.detail}; remove it or convert it to a plain JPEG") from None
    return _checked_size(path, size)


def _checked_size(path: Path, size: JpegSize) -> JpegSize:
    for side_px in (size.width_px, size.height_px):
        if not LEAST_SIDE_PX <= side_px <= MOST_SIDE_PX:
            raise HardwareError(f"{path} has {size.width_px}x{size.height_px} pixels; expected {LEAST_SIDE_PX} to "
                                f"{MOST_SIDE_PX} a side")
    return size


# A camera that repeats one JPEG at a fixed rate. Shell (a file and a clock).


class StillCameraConfig(LensConfig):
    """`path` is a JPEG file."""

    path: Path
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0


class StillCamera:
    """Repeat one image. The camera is not live, so an unchanged image is not a fault."""

    Config = StillCameraConfig
    live = False

    def __init__(self, config: StillCameraConfig) -> None:
        self._jpeg = _bytes_of(config.path, "set camera.options.path to a .jpg")
        self.model = camera_model(config, jpeg_size(config.path, self._jpeg))
        self._pace = FrameTimer(config.fps)

    def read(self, timeout_s: float) -> Picture | None:
        """Wait for the next tick and return the image. Returns None if no tick comes in time."""
        return Picture(self._jpeg, monotonic_us()) if self._pace.wait(timeout_s) else None

    def close(self) -> None:
        """Do nothing, because a file camera holds no device."""


# A camera that plays a video file at its own speed, looped or once. Shell (a file and a clock).
#
# OpenCV and simplejpeg are imported when a video is opened, because the base install has neither.


_USUAL_FPS = 30.0
_CATCH_UP_S = 1.0  # after a longer pause the video continues at the same image
_COUNT_SLACK = 0.05  # the image count of a container may be an estimate


class VideoCameraConfig(LensConfig):
    """Settings of a video camera. `fps` 0 selects the rate of the video. Without `loop` the end raises an error."""

    path: Path
    loop: bool = True
    fps: Annotated[float, Field(ge=0, le=240)] = 0.0
    quality: Annotated[int, Field(ge=10, le=100)] = 80


class VideoCamera:
    """Decodes and encodes every image. A slow reader gets fewer images, not a slower video."""

    Config = VideoCameraConfig
    live = False

    def __init__(self, config: VideoCameraConfig) -> None:
        self._config = config
        self._encode, self._cv2 = _packages()
        self._quality, self._scale_percent = config.quality, 100
        self._open()
        self.model = camera_model(config, _checked_size(config.path, self._size()))
        fps = config.fps or self._own_fps()
        self._pace = FrameTimer(fps)
        self._fps = fps
        self._started_s = time.monotonic()
        self._shown = 0

    def read(self, timeout_s: float) -> Picture | None:
        """Wait for the next tick and decode its image.

        Raises:
            HardwareError: the video ended without `loop`, or the file is damaged.
        """
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
        """Encode at these shares of the configured quality and size, see `Adjustable`."""
        self._quality = scaled_quality(self._config.quality, quality_percent)
        self._scale_percent = scale_percent
        return True

    def close(self) -> None:
        """Release the video. Idempotent."""
        self._capture.release()

    # --- the file ------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        path = home_path(self._config.path)
        if not path.is_file():
            raise HardwareError(f"video {self._config.path} is not there; set camera.options.path to a video file")
        self._capture: Any = self._cv2.VideoCapture(str(path), self._cv2.CAP_FFMPEG)
        self._at = 0
        if not self._capture.isOpened() or min(self._size().width_px, self._size().height_px) < 1:
            raise HardwareError(f"video {self._config.path} cannot be played: damaged or not a video; try "
                                "another player, or record it again")

    def _size(self) -> JpegSize:
        get, cv2 = self._capture.get, self._cv2
        return JpegSize(int(get(cv2.CAP_PROP_FRAME_WIDTH)), int(get(cv2.CAP_PROP_FRAME_HEIGHT)), 3)

    def _own_fps(self) -> float:
        fps = float(self._capture.get(self._cv2.CAP_PROP_FPS))
        return fps if 0 < fps <= 240 else _USUAL_FPS

    def _due(self) -> int:
        """Return the number of images that are due since the last shown image, at least one."""
        now_s = time.monotonic()
        ahead = math.floor((now_s - self._started_s) * self._fps + 0.5) - self._shown
        if ahead > _CATCH_UP_S * self._fps or ahead < 1:
            ahead = 1
            self._started_s = now_s - (self._shown + 1) / self._fps
        self._shown += ahead
        return ahead

    def _step(self) -> None:
        """Go to the next image. After the last image of a looped video, go to the first one."""
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
            raise HardwareError(f"video {self._config.path} ended after {self._at} images; set camera.options.loop "
                                "= true to repeat it")

    def _broken(self) -> HardwareError:
        count = int(self._capture.get(self._cv2.CAP_PROP_FRAME_COUNT))
        return HardwareError(f"video {self._config.path} breaks off at image {self._at} of {count}; repair or "
                             "record it again")


def quiet_videos(cv2: Any) -> None:
    """Disable the video messages of OpenCV and FFmpeg, unless the environment sets their levels."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read at the first video
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)


def _packages() -> tuple[Any, Any]:
    try:
        import cv2
        import simplejpeg
    except ImportError:
        raise ConfigError(f"camera video needs OpenCV and simplejpeg: {install_command('camera')}") from None
    quiet_videos(cv2)  # the errors of this module name the file
    return simplejpeg.encode_jpeg, cv2
