"""Opens a camera plug-in of this machine without a robot. Shell (a device).

    --camera v4l2 --camera-set device=/dev/video2 --camera-set width_px=1280
"""

import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import PluginChoice
from sightline.robot_side.plugins import build_device
from sightline.robot_side.ports import Camera


@contextmanager
def local_camera(kind: str, sets: Sequence[str]) -> Iterator[Camera]:
    """The camera plug-in `kind` with the options of `sets` (`key=value`), closed at the end.

    Raises ConfigError for a bad kind or option, HardwareError when there is no such camera.
    """
    camera: Camera = build_device("cameras", PluginChoice(kind=kind, options=dict(_option(text) for text in sets)))
    try:
        yield camera
    finally:
        camera.close()


def _option(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ConfigError(f"--camera-set {text!r} is no option: write key=value, e.g. --camera-set device=/dev/video2")
    return name.strip(), _value(value)


def _value(text: str) -> Any:
    """`text` read as a TOML value; as a string if it is none."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
