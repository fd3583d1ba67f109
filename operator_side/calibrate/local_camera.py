"""Opens a camera plug-in of this machine without a robot. Shell (a device).

    --camera v4l2 --camera-set device=/dev/video2 --camera-set width_px=1280
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from sightline.operator_side.config.toml_text import options_of
from sightline.robot_side.config import PluginChoice
from sightline.robot_side.plugins import CAMERAS
from sightline.robot_side.ports import Camera


def camera_choice(kind: str, sets: Sequence[str]) -> PluginChoice:
    """Return the plug-in `kind` with the options `sets`. Raises ConfigError for a text without `=`."""
    return PluginChoice(kind=kind, options=options_of(sets, "--camera-set", "device=/dev/video2"))


@contextmanager
def local_camera(kind: str, sets: Sequence[str]) -> Iterator[Camera]:
    """Open the camera plug-in `kind` with the options `sets` (`key=value`); close it at the end.

    Raises:
        ConfigError: the kind or an option is invalid.
        HardwareError: the camera is missing.
    """
    camera = CAMERAS.build(camera_choice(kind, sets))
    try:
        yield camera
    finally:
        camera.close()
