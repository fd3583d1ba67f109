"""Where pictures for a calibration come from: a folder, a camera of this machine, a robot. Shell (waits, files)."""

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from sightline.operator_side.client.pictures import Viewer
from sightline.protocol.channels import CAMERA, FRAME
from sightline.protocol.codec import decode
from sightline.protocol.errors import ConfigError, LinkError, WireError
from sightline.protocol.jpeg import JpegSize, read_jpeg_size
from sightline.protocol.messages import CameraModel
from sightline.protocol.transports.link import Link
from sightline.robot_side.hardware.cameras.files import jpegs_in
from sightline.robot_side.ports import Camera

ROLE = "calibrate"
_WAIT_S = 0.2
_SILENCE_S = 5.0
_MAX_PIXELS = 4096 * 4096
Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class Collected(Generic[Found]):
    """What was found in `given` pictures of one size."""

    size: JpegSize
    found: list[Found]
    given: int


def folder_pictures(folder: Path) -> Iterator[bytes]:
    """The JPEGs of `folder` in name order. Raises HardwareError if there is none."""
    for path in jpegs_in(folder):
        yield path.read_bytes()


def camera_pictures(camera: Camera, seconds: float) -> Iterator[bytes]:
    """What a local camera sees for `seconds`. Raises HardwareError as the camera does."""
    ends_s = time.monotonic() + seconds
    while time.monotonic() < ends_s:
        picture = camera.read(_WAIT_S)
        if picture is not None:
            yield picture.jpeg


def robot_pictures(link: Link, seconds: float, role: str = ROLE, secure: str = "") -> Iterator[bytes]:
    """What a robot's camera sees for `seconds`; frames are acknowledged by who may, so that it goes on sending.

    Raises LinkError when no frame comes for five seconds.
    """
    frames, viewer = link.latest(FRAME), Viewer(link, role, secure)
    heard_s = time.monotonic()
    ends_s = heard_s + seconds
    while time.monotonic() < ends_s:
        message = frames.take(_WAIT_S)
        if message is not None and viewer.acknowledge(message):
            heard_s = time.monotonic()
            yield message.payload
        if time.monotonic() - heard_s > _SILENCE_S:
            raise LinkError(f"no frames from robot {link.robot!r} within {_SILENCE_S:g} s; is `sightline robot` "
                            "running there, with this id, and its camera working?")


def robot_model(link: Link, timeout_s: float = 3.0) -> CameraModel:
    """The model that a robot publishes now. Raises LinkError when none comes."""
    message = link.latest(CAMERA).take(timeout_s)
    try:
        if message is not None:
            return decode(CameraModel, message.payload, CAMERA.max_payload_bytes)
    except WireError as error:
        raise LinkError(f"robot {link.robot!r} speaks another version: {error.detail}") from None
    raise LinkError(f"robot {link.robot!r} is not heard within {timeout_s:g} s; `sightline robots` lists who is")


def collect(
    pictures: Iterator[bytes],
    finder: Callable[[JpegSize], Callable[[bytes], Found | None]],
    is_new: Callable[[Found, Sequence[Found], JpegSize], bool],
    enough: int,
    say: Callable[[str], None],
) -> Collected[Found]:
    """Look through `pictures` until `enough` were found that are new, or there are no more; `say` each.

    `finder` makes, for a size, the function that looks at one picture.
    Raises ConfigError when there is no picture at all, or their sizes differ.
    """
    first = next(pictures, None)
    if first is None:
        raise ConfigError("no picture came; is the camera working?")
    size = _size_of(first, None)
    find = finder(size)
    found: list[Found] = []
    given = 0
    for jpeg in itertools.chain([first], pictures):
        _size_of(jpeg, size)
        given += 1
        one = find(jpeg)
        if one is not None and is_new(one, found, size):
            found.append(one)
            say(f"{len(found)} of {enough}")
        if len(found) >= enough:
            break
    return Collected(size, found, given)


def _size_of(jpeg: bytes, size: JpegSize | None) -> JpegSize:
    try:
        own = read_jpeg_size(jpeg, _MAX_PIXELS)
    except WireError as error:
        raise ConfigError(f"a picture is no plain JPEG: {error.detail}; remove or convert it") from None
    if size is not None and (own.width_px, own.height_px) != (size.width_px, size.height_px):
        raise ConfigError(f"pictures of {own.width_px}x{own.height_px} and {size.width_px}x{size.height_px} are mixed; "
                          "a camera is calibrated at one size")
    return own
