"""A camera that shows one JPEG for ever, paced. Shell (a file and a clock)."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError
from sightline.robot_side.hardware.cameras.files import jpeg_size
from sightline.robot_side.hardware.cameras.lens import LensConfig, camera_model
from sightline.robot_side.hardware.pace import FrameTimer
from sightline.robot_side.ports import Picture


class StillCameraConfig(LensConfig):
    """`path` is the picture."""

    path: Path
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0


class StillCamera:
    """Not live: its picture never changes, and that is no fault."""

    Config = StillCameraConfig
    live = False

    def __init__(self, config: StillCameraConfig) -> None:
        try:
            self._jpeg = config.path.expanduser().read_bytes()
        except OSError as error:
            raise HardwareError(
                f"picture {config.path} cannot be read: {error.strerror}; set camera.options.path to a .jpg"
            ) from None
        self.model = camera_model(config, jpeg_size(config.path, self._jpeg))
        self._pace = FrameTimer(config.fps)

    def read(self, timeout_s: float) -> Picture | None:
        """The picture, at the next tick."""
        return Picture(self._jpeg, monotonic_us()) if self._pace.wait(timeout_s) else None

    def close(self) -> None:
        """Nothing to give back."""
