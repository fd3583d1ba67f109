"""A camera that plays a folder of JPEGs in name order, looped and paced. Shell (files and a clock)."""

import math
import time
from pathlib import Path
from typing import Annotated

from pydantic import Field

from protocol.config import Config
from protocol.errors import HardwareError, WireError
from protocol.jpeg import JpegSize, read_jpeg_size
from protocol.messages import CameraModel
from robot_side.ports import Picture


class FolderCameraConfig(Config):
    """`hfov_deg` is the horizontal field of view that the pictures were taken with."""

    path: Path
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    hfov_deg: Annotated[float, Field(gt=5, lt=175)] = 80.0


class FolderCamera:
    """Pictures are read once, at start; the stamps are this machine's clock, as if they were seen now."""

    Config = FolderCameraConfig
    live = False

    def __init__(self, config: FolderCameraConfig) -> None:
        paths = sorted(path for path in config.path.expanduser().glob("*") if path.suffix.lower() in (".jpg", ".jpeg"))
        if not paths:
            raise HardwareError(f"no .jpg pictures in {config.path}; point camera.options.path at a folder with some")
        self._pictures = [path.read_bytes() for path in paths]
        sizes = {_size(path, jpeg) for path, jpeg in zip(paths, self._pictures, strict=True)}
        if len(sizes) > 1:
            raise HardwareError(f"the pictures in {config.path} differ in size; one camera has one size")
        self.model = _model(sizes.pop(), config.hfov_deg)
        self._interval_s = 1 / config.fps
        self._next_s = time.monotonic()
        self._count = 0

    def read(self, timeout_s: float) -> Picture | None:
        """The picture of the next tick."""
        now_s = time.monotonic()
        self._next_s = max(self._next_s + self._interval_s, now_s)
        if self._next_s - now_s > timeout_s:
            time.sleep(timeout_s)
            self._next_s -= self._interval_s
            return None
        time.sleep(self._next_s - now_s)
        self._count += 1
        return Picture(self._pictures[self._count % len(self._pictures)], time.monotonic_ns() // 1000)

    def close(self) -> None:
        """Nothing to give back."""


def _size(path: Path, jpeg: bytes) -> JpegSize:
    try:
        return read_jpeg_size(jpeg)
    except WireError as error:
        raise HardwareError(f"{path}: {error.detail}; remove it or convert it to a plain JPEG") from None


def _model(size: JpegSize, hfov_deg: float) -> CameraModel:
    focal_px = size.width_px / 2 / math.tan(math.radians(hfov_deg) / 2)
    return CameraModel(
        width_px=size.width_px,
        height_px=size.height_px,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=size.width_px / 2,
        cy_px=size.height_px / 2,
    )
