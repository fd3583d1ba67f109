"""A camera that plays a folder of JPEGs in name order, looped and paced. Shell (files and a clock)."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError, WireError
from sightline.protocol.jpeg import JpegSize, read_jpeg_size
from sightline.robot_side.hardware.cameras.lens import LensConfig, camera_model
from sightline.robot_side.hardware.pace import FrameTimer
from sightline.robot_side.ports import Picture


class FolderCameraConfig(LensConfig):
    """`path` holds the pictures, all of one size."""

    path: Path
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    hfov_deg: Annotated[float, Field(gt=5, lt=175)] = 80.0


class FolderCamera:
    """Pictures are read once, at start; the stamps are this machine's clock, as if they were seen now."""

    Config = FolderCameraConfig
    live = False

    def __init__(self, config: FolderCameraConfig) -> None:
        paths = jpegs_in(config.path)
        self._pictures = [path.read_bytes() for path in paths]
        sizes = {jpeg_size(path, jpeg) for path, jpeg in zip(paths, self._pictures, strict=True)}
        if len({(size.width_px, size.height_px) for size in sizes}) > 1:
            raise HardwareError(f"the pictures in {config.path} differ in size; one camera has one size")
        self.model = camera_model(config, sizes.pop())
        self._pace = FrameTimer(config.fps)
        self._count = 0

    def read(self, timeout_s: float) -> Picture | None:
        """The picture of the next tick."""
        if not self._pace.wait(timeout_s):
            return None
        self._count += 1
        return Picture(self._pictures[(self._count - 1) % len(self._pictures)], monotonic_us())

    def close(self) -> None:
        """Nothing to give back."""


def jpegs_in(folder: Path) -> list[Path]:
    """The .jpg and .jpeg files of `folder` in name order. Raises HardwareError if there is none."""
    paths = sorted(path for path in folder.expanduser().glob("*") if path.suffix.lower() in (".jpg", ".jpeg"))
    if not paths:
        raise HardwareError(f"no .jpg pictures in {folder}; name a folder that has some")
    return paths


def jpeg_size(path: Path, jpeg: bytes) -> JpegSize:
    """The size of `jpeg`, read from `path`. Raises HardwareError if it is no plain JPEG."""
    try:
        return read_jpeg_size(jpeg)
    except WireError as error:
        raise HardwareError(f"{path}: {error.detail}; remove it or convert it to a plain JPEG") from None
