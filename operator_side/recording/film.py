"""Snapshots, H.264 films and recordings of a robot. Shell (waits, writes files)."""

from __future__ import annotations

import fcntl
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Final, Literal, Self

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from sightline.operator_side.client.pictures import Pictures, Shot
from sightline.operator_side.preflight import check_out_file, needs, whole, write_whole, writes
from sightline.operator_side.recording.recorder import RECORDED, Recorder
from sightline.protocol.channels import OVERLAY, Channel
from sightline.protocol.errors import ConfigError, LinkError, RejectReason, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.transports.link import Link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Decoder


def jpeg_pixels(jpeg: bytes) -> NDArray[np.uint8]:
    """Decode a JPEG to BGR in full size. Raises WireError MALFORMED for an invalid or too large JPEG."""
    size = read_jpeg_size(jpeg)
    _checker(size.width_px, size.height_px).check(jpeg)
    try:
        pixels: NDArray[np.uint8] = simplejpeg.decode_jpeg(jpeg, "BGR")
    except ValueError as error:
        raise WireError(RejectReason.MALFORMED, f"image does not decode: {error}"[:160]) from None
    return pixels


@lru_cache(maxsize=4)
def _checker(width_px: int, height_px: int) -> Decoder:
    return Decoder(width_px, height_px, VisionConfig().max_pixels)


# --- a film: H.264 in MP4, each image at its own time ------------------------------------------------------------


Image = NDArray[np.uint8]
_TICKS_PER_S: Final = 90_000  # usual for H.264
_TIME_BASE: Final = Fraction(1, _TICKS_PER_S)
# Without B-frames, because with them the file ends before the last image.
_ENCODING: Final = {"preset": "veryfast", "crf": "23", "bf": "0"}


class Film:
    """`with Film(path, fps) as film: film.add(picture, t_us)`. Images of another size are scaled to the first size."""

    def __init__(self, path: Path, fps: int) -> None:
        """Open the file; `fps` is a hint for the encoder. Raises ConfigError without PyAV or for an invalid path."""
        with needs("report"):
            import av
        with writes(path):
            self._container = av.open(str(path), "w", options={"movflags": "+faststart"})
        self._av, self._fps = av, fps
        self._stream: Any = None
        self._first_us = self._last_ticks = -1
        self.frames = 0
        self.size_px = (0, 0)
        """Width and height of the film, both even."""

    def add(self, picture: Image, t_us: int) -> bool:
        """Append an image (BGR). An image that is not later than the last one is skipped, and returns False."""
        if self._stream is None:
            self._first_us = t_us
            self._stream = self._opened(picture)
        ticks = (t_us - self._first_us) * _TICKS_PER_S // 1_000_000
        if ticks <= self._last_ticks:
            return False
        self._last_ticks = ticks
        frame = self._av.VideoFrame.from_ndarray(self._fitted(picture), format="bgr24")
        frame.pts, frame.time_base = ticks, _TIME_BASE
        self._container.mux(self._stream.encode(frame))
        self.frames += 1
        return True

    @property
    def seconds(self) -> float:
        """Return the time from the first image to the last."""
        return max(0, self._last_ticks) / _TICKS_PER_S

    def since_first_s(self, t_us: int) -> float:
        """Return the time from the first image to `t_us`; 0 before the first image."""
        return 0.0 if self._first_us < 0 else (t_us - self._first_us) / 1e6

    def close(self) -> None:
        """Write the remaining data of the encoder and the index."""
        try:
            if self._stream is not None:
                self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:  # after a failed write, FFmpeg would crash while it writes the rest
            self._container.close()

    def _opened(self, picture: Image) -> Any:
        stream = self._container.add_stream("libx264", rate=self._fps)
        height, width = picture.shape[:2]
        self.size_px = stream.width, stream.height = max(2, width - width % 2), max(2, height - height % 2)
        stream.pix_fmt = "yuv420p"  # for all players; it needs even sides
        stream.time_base = stream.codec_context.time_base = _TIME_BASE
        stream.options = dict(_ENCODING)
        return stream

    def _fitted(self, picture: Image) -> Image:
        size = (self._stream.width, self._stream.height)
        if (picture.shape[1], picture.shape[0]) == size:
            return np.ascontiguousarray(picture)
        if (picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2) == size:
            return np.ascontiguousarray(picture[: size[1], : size[0]])
        return np.ascontiguousarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


# --- a snapshot or a video of a robot ----------------------------------------------------------------------------


PICTURES: Final = (".png", ".jpg", ".jpeg")
VIDEO: Final = ".mp4"
MESSAGES: Final = ".mcap"
PATIENCE_S: Final = 5.0
_WAIT_S: Final = 0.5
_FPS: Final = 30
_SHORT_S: Final = 1.0  # longest gap in the status of a present robot
Cut = Literal["", "interrupted", "silent"]
"""Why a film or recording is shorter than requested: the user ended it, or nothing more came."""


@dataclass(frozen=True, slots=True)
class Captured:
    """The written file."""

    path: Path
    frames: int
    seconds: float
    width_px: int
    height_px: int
    cut: Cut = ""


def check_target(path: Path, seconds: float | None) -> None:
    """Raise ConfigError for a file that is neither image, video nor recording, or that cannot be written."""
    kind = path.suffix.lower()
    if kind not in (*PICTURES, VIDEO, MESSAGES):
        raise ConfigError(
            f"invalid file {path}: a snapshot ends in .png or .jpg, a video in .mp4, a recording in .mcap"
        )
    if kind in PICTURES and seconds is not None:
        raise ConfigError(f"--seconds needs a video, and {path} is an image; use --out NAME.mp4")
    check_out_file(path)
    if kind not in PICTURES and path.exists() and not path.is_file():
        raise ConfigError(f"cannot write {path}: it is a device or a pipe; name a file")
    if kind == MESSAGES:
        with needs("report"):
            import_module("mcap.writer")


def snapshot(pictures: Pictures, path: Path, wanted: Channel) -> Captured:
    """Write the next image to `path`, as PNG or as the received JPEG. Raises LinkError without an image."""
    ends_s = time.monotonic() + PATIENCE_S
    while (shot := _wanted(pictures, wanted, ends_s)) is not None:
        with suppress(WireError):  # the next image may be valid
            data = shot.jpeg if path.suffix.lower() != ".png" else cv2.imencode(".png", jpeg_pixels(shot.jpeg))[1]
            write_whole(path, bytes(data))
            return Captured(path, 1, 0.0, shot.width_px, shot.height_px)
    raise LinkError(_silence(pictures, wanted))


def film(pictures: Pictures, path: Path, wanted: Channel, seconds: float) -> Captured:
    """Write the images of `seconds`, or until Ctrl-C, SIGTERM or SIGHUP, to `path`. Raises LinkError without an image,
    ConfigError for a path that cannot be written.

    The capture times determine its length, so a late first image does not make the film longer.
    """
    target = Path(os.path.realpath(path))  # a symbolic link is preserved
    with _interrupted_once(), writes(path), whole(target, VIDEO) as part:
        with Film(part, _FPS) as made:
            cut = _fill(made, pictures, wanted, seconds)
        if not made.frames:
            raise LinkError(_silence(pictures, wanted))
    return Captured(path, made.frames, made.seconds, *made.size_px, cut)


def record(link: Link, pictures: Pictures, path: Path, wanted: Channel, seconds: float) -> tuple[Recorder, Cut]:
    """Write the messages of `seconds`, or until Ctrl-C, SIGTERM or SIGHUP, to `path`. `wanted` may add the overlay.

    A file that is there already stays until then. Raises LinkError if none arrives, KeyboardInterrupt if Ctrl-C comes
    first, ConfigError for a file that another recording writes, or that cannot be written to its end. Its beginning is
    kept, next to a file that was there.
    """
    target = Path(os.path.realpath(path))
    beside = whole(target, MESSAGES) if target.is_file() else nullcontext(target)
    ends_s, has_begun = time.monotonic() + PATIENCE_S, False  # the end is counted from the first message
    channels = dict.fromkeys((*RECORDED, wanted))
    cut: Cut = "interrupted"
    with _interrupted_once(), writes(path), _locked(target), beside as part:
        with Recorder(link, part, {"robot": link.robot}, channels) as recorder, suppress(KeyboardInterrupt):
            while (left_s := ends_s - time.monotonic()) > 0 and not recorder.failed:
                pictures.take(min(left_s, _WAIT_S))  # it acknowledges frames; without a vision service no client does
                if recorder.counts and not has_begun:
                    ends_s, has_begun = time.monotonic() + seconds, True
            cut = ""
        if not (recorder.failed or recorder.counts):
            part.unlink()
            raise KeyboardInterrupt if time.monotonic() < ends_s else LinkError(_silence(pictures, wanted))
        if recorder.failed:
            is_beside = part != target
            kept = part.rename(part.with_name(part.name.removeprefix("."))) if is_beside else path
            raise ConfigError(f"recording {kept} ends early: {recorder.failed}; "
                              + f"{path} is unchanged; " * is_beside + "free some space or name another file")
    return recorder, cut or _ended(seconds, recorder.seconds)


@contextmanager
def _locked(target: Path) -> Iterator[None]:
    """Lock the file of a recording, because a second one would replace it. Raises ConfigError if it is locked."""
    number = os.open(target, os.O_RDONLY | os.O_CREAT | os.O_NONBLOCK, 0o666)  # a pipe must not wait for a writer
    try:
        with suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConfigError(f"cannot write {target}: another recording writes it; name another file") from None
        yield
    finally:
        os.close(number)


def _fill(made: Film, pictures: Pictures, wanted: Channel, seconds: float) -> Cut:
    """Add the images of `seconds`. Ctrl-C ends the film; before its first image it ends the command."""
    session: str | None = None
    offset_us, ends_s = 0, 0.0  # the end is counted from the first image
    try:
        while (shot := _wanted(pictures, wanted, ends_s or time.monotonic() + PATIENCE_S)) is not None:
            now_s = time.monotonic()
            ends_s = ends_s or now_s + seconds
            if shot.session != session:  # the robot's clock may have restarted; this machine's clock covers the gap
                elapsed_s = max(now_s + seconds - ends_s, made.seconds + 0.001)
                session, offset_us = shot.session, round(elapsed_s * 1e6) - shot.t_us
            if made.since_first_s(shot.t_us + offset_us) > seconds:
                break
            with suppress(WireError):  # the image is invalid
                made.add(jpeg_pixels(shot.jpeg), shot.t_us + offset_us)
    except KeyboardInterrupt:
        if not made.frames:
            raise
        return "interrupted"
    return _ended(seconds, made.seconds)


def _ended(wanted_s: float, made_s: float) -> Cut:
    """Return the end of a film or recording that the user did not end."""
    return "silent" if wanted_s - made_s > _SHORT_S else ""


@contextmanager
def _interrupted_once() -> Iterator[None]:
    """Convert the first Ctrl-C, SIGTERM or SIGHUP to KeyboardInterrupt. A second one must not lose the file."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        for number in before:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    ending = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    numbers = [one for one in ending if signal.getsignal(one) is not signal.SIG_IGN]  # nohup
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        for number in numbers:
            signal.signal(number, interrupt)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _wanted(pictures: Pictures, wanted: Channel, ends_s: float) -> Shot | None:
    """Return the next image of the channel, or None at `ends_s`."""
    while (left_s := ends_s - time.monotonic()) > 0:
        shot = pictures.take(min(left_s, _WAIT_S))
        if shot is not None and shot.channel is wanted:
            return shot
    return None


def _silence(pictures: Pictures, wanted: Channel) -> str:
    robot = pictures.robot
    if not pictures.is_online:
        return f"no status from robot '{robot}' after {PATIENCE_S:g} s; run `sightline robots`"
    if wanted is OVERLAY:
        return f"no overlay of robot '{robot}' after {PATIENCE_S:g} s; run `sightline vision`"
    return f"no image from robot '{robot}' after {PATIENCE_S:g} s; run `sightline status {robot}`"
