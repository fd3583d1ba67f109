"""Takes a snapshot or a video of what a robot sees. Shell (waits, writes files)."""

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2

from sightline.operator_side.film import Film
from sightline.operator_side.recording.film import jpeg_pixels
from sightline.operator_side.out_file import check_out_file
from sightline.operator_side.pictures import Pictures, Shot
from sightline.protocol.channels import OVERLAY, Channel
from sightline.protocol.errors import ConfigError, LinkError, WireError

PICTURES: Final = (".png", ".jpg", ".jpeg")
VIDEO: Final = ".mp4"
PATIENCE_S: Final = 5.0
_WAIT_S: Final = 0.5
_FPS: Final = 30


@dataclass(frozen=True, slots=True)
class Captured:
    """What was written."""

    path: Path
    frames: int
    seconds: float
    width_px: int
    height_px: int


def check_target(path: Path, seconds: float | None) -> None:
    """Raise ConfigError for a file that is neither picture nor video, or that cannot be there."""
    kind = path.suffix.lower()
    if kind not in (*PICTURES, VIDEO):
        raise ConfigError(f"{path}: a snapshot ends in .png or .jpg, a video in .mp4")
    if kind in PICTURES and seconds is not None:
        raise ConfigError(f"--seconds is for a video, and {path} is a picture: write --out NAME.mp4")
    check_out_file(path)


def snapshot(pictures: Pictures, path: Path, wanted: Channel) -> Captured:
    """Write the next picture to `path`: as PNG, or as the JPEG that came. Raises LinkError if none comes."""
    ends_s = time.monotonic() + PATIENCE_S
    while (shot := _wanted(pictures, wanted, ends_s)) is not None:
        with suppress(WireError):  # the next one may be whole
            data = shot.jpeg if path.suffix.lower() != ".png" else cv2.imencode(".png", jpeg_pixels(shot.jpeg))[1]
            _write(path, bytes(data))
            return Captured(path, 1, 0.0, shot.width_px, shot.height_px)
    raise LinkError(_silence(pictures, wanted))


def film(pictures: Pictures, path: Path, wanted: Channel, seconds: float) -> Captured:
    """Write what is seen for `seconds`, or until Ctrl-C, to `path`. Raises LinkError if no picture comes."""
    unfinished = path.with_name(f".{path.name}.part.mp4")
    size = (0, 0)
    try:
        with Film(unfinished, _FPS) as made, suppress(KeyboardInterrupt):
            ends_s = 0.0  # from the first picture on
            while (shot := _wanted(pictures, wanted, ends_s or time.monotonic() + PATIENCE_S)) is not None:
                ends_s = ends_s or time.monotonic() + seconds
                size = size if any(size) else (shot.width_px, shot.height_px)
                with suppress(WireError):  # one lost picture
                    made.add(jpeg_pixels(shot.jpeg), shot.t_us)
        if not made.frames:
            raise LinkError(_silence(pictures, wanted))
        unfinished.replace(path)
        return Captured(path, made.frames, made.seconds, *size)
    finally:
        unfinished.unlink(missing_ok=True)


def _wanted(pictures: Pictures, wanted: Channel, ends_s: float) -> Shot | None:
    """The next picture of that channel; None at the end."""
    while (left_s := ends_s - time.monotonic()) > 0:
        shot = pictures.take(min(left_s, _WAIT_S))
        if shot is not None and shot.channel is wanted:
            return shot
    return None


def _silence(pictures: Pictures, wanted: Channel) -> str:
    robot = pictures.robot
    if not pictures.is_heard:
        return f"robot {robot!r} is not heard within {PATIENCE_S:g} s; `sightline robots` lists who is"
    if wanted is OVERLAY:
        return f"no overlay of robot {robot!r} within {PATIENCE_S:g} s; does `sightline vision` run for it?"
    return f"no picture of robot {robot!r} within {PATIENCE_S:g} s; does its camera deliver? see `sightline status`"


def _write(path: Path, data: bytes) -> None:
    unfinished = path.with_name(f".{path.name}.part")
    try:
        unfinished.write_bytes(data)
        unfinished.replace(path)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
