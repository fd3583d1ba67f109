"""The page of `sightline pick-color`, and the pictures that it shows. Shell (threads, files)."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, Protocol

import cv2
import numpy as np

from sightline.operator_side.calibrate.color import (
    Box,
    Image,
    Ranges,
    check_trial,
    pick,
    ranges_text,
    trial_text,
    try_out,
)
from sightline.operator_side.calibrate.color_file import mask_png, ranges_toml
from sightline.operator_side.client.pictures import Pictures
from sightline.operator_side.cockpit.frame_buffer import FrameBuffer
from sightline.operator_side.cockpit.http_server import HttpAnswer, PageRequest, Route, as_json, page
from sightline.operator_side.recording.film import jpeg_pixels
from sightline.protocol.errors import ConfigError, LinkError, WireError

MAX_FILE_BYTES: Final = 50_000_000
MAX_PIXELS: Final = 25_000_000
"""Of a picture from a file: a large photograph; a camera's frames are bounded by vision's own limits."""
MAX_FRAMES: Final = 200
PATIENCE_S: Final = 5.0
_PAGE_QUALITY: Final = 92


class Gallery(Protocol):
    """Where a page's pictures come from."""

    live: bool

    def pixels(self, number: int) -> Image:
        """The picture of that number. Raises ConfigError for one that is not kept."""
        ...

    def recent(self) -> Sequence[Image]:
        """The last pictures, to try a range on."""
        ...

    def route(self, request: PageRequest, body: bytes) -> HttpAnswer:
        """`GET /picture`."""
        ...


class StillGallery:
    """Pictures that are all there."""

    live = False

    def __init__(self, pictures: Sequence[Image]) -> None:
        self._pictures = list(pictures)

    def pixels(self, number: int) -> Image:
        """Numbered from 1."""
        if not 1 <= number <= len(self._pictures):
            raise ConfigError(f"there is no picture {number}; there are {len(self._pictures)}")
        return self._pictures[number - 1]

    def recent(self) -> Sequence[Image]:
        """All of them."""
        return self._pictures

    def route(self, request: PageRequest, _body: bytes) -> HttpAnswer:
        """`?number=N`, else the last."""
        number = int(request.get("number", len(self._pictures)))
        done, data = cv2.imencode(".jpg", self.pixels(number), [cv2.IMWRITE_JPEG_QUALITY, _PAGE_QUALITY])
        if not done:
            return HttpAnswer(status=204)
        count = {"X-Number": str(number), "X-Count": str(len(self._pictures))}
        return HttpAnswer(data.tobytes(), "image/jpeg", headers=count)


class LiveGallery:
    """A robot's newest pictures, taken while the page asks for them."""

    live = True

    def __init__(self, buffer: FrameBuffer) -> None:
        self._buffer = buffer
        self.route = buffer.route

    def pixels(self, number: int) -> Image:
        """Of the buffer."""
        shot = self._buffer.of(number)
        if shot is None:
            raise ConfigError("that picture is gone by now; pick in a newer one")
        return _decoded(shot.jpeg)

    def recent(self) -> Sequence[Image]:
        """All that are kept."""
        return [_decoded(one.shot.jpeg) for one in self._buffer.shots]


def of_picture(path: Path) -> list[Image]:
    """The picture in a file. Raises ConfigError for what is none."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ConfigError(f"{path}: is larger than {MAX_FILE_BYTES // 1_000_000} MB")
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    except cv2.error:
        picture = None
    if picture is None:
        raise ConfigError(f"{path}: is no picture that can be read (PNG, JPEG ...)")
    if picture.shape[0] * picture.shape[1] > MAX_PIXELS:
        size = f"{picture.shape[1]}x{picture.shape[0]}"
        raise ConfigError(f"{path}: is {size}, at most {MAX_PIXELS // 1_000_000} megapixels")
    return [np.asarray(picture, np.uint8)]


def of_video(path: Path, frames: int) -> list[Image]:
    """`frames` pictures spread evenly over a video, or all if it has fewer. Raises ConfigError for what is none."""
    if not path.is_file():
        raise ConfigError(f"{path}: is no file; name a video")
    capture = cv2.VideoCapture(str(path))
    try:
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        wanted = {round(one) for one in np.linspace(0, count - 1, min(frames, count))} if count > 0 else set()
        pictures = [np.asarray(picture, np.uint8) for number, picture in enumerate(_read(capture))
                    if (number in wanted if wanted else number < frames)]
    finally:
        capture.release()
    if not pictures:
        raise ConfigError(f"{path}: is no video that can be read")
    return pictures


def _read(capture: Any) -> Iterator[Image]:
    while (got := capture.read())[0]:
        yield got[1]


def of_robot(pictures: Pictures, frames: int) -> list[Image]:
    """The next `frames` pictures of a robot. Raises LinkError if none comes."""
    found: list[Image] = []
    ends_s = time.monotonic() + PATIENCE_S
    while len(found) < frames and time.monotonic() < ends_s:
        shot = pictures.take(ends_s - time.monotonic())
        if shot is not None:
            found.append(_decoded(shot.jpeg))
    if not found:
        raise LinkError(f"no picture of robot {pictures.robot!r} within {PATIENCE_S:g} s; does its camera deliver?")
    return found


def _decoded(jpeg: bytes) -> Image:
    try:
        return jpeg_pixels(jpeg)
    except WireError as error:
        raise ConfigError(f"the robot's picture cannot be used: {error.detail}") from None


# The page of `sightline pick-color`: click or box in a picture, see what the range marks, use it. Shell (threads).


_FIELDS = ("x_px", "y_px", "width_px", "height_px")


class PickPage:
    """One person's picking. `use` takes the ranges and says what became of them."""

    def __init__(self, gallery: Gallery, title: str, use: Callable[[Ranges], str]) -> None:
        self._gallery, self._title, self._use = gallery, title, use
        self._lock = threading.Lock()
        self._picked: tuple[Ranges, Image] | None = None
        self._good: Ranges | None = None
        self.done = threading.Event()

    @property
    def routes(self) -> Mapping[str, Route]:
        """For `served`."""
        return {
            "GET /": lambda _request, _body: page("pick.html", title=self._title, live=str(self._gallery.live).lower()),
            "GET /pick.mjs": lambda _request, _body: page("pick.mjs"),
            "GET /picture": self._gallery.route,
            "POST /pick": self._pick,
            "GET /mask": self._mask,
            "POST /use": self._take,
        }

    def _pick(self, _request: PageRequest, body: bytes) -> HttpAnswer:
        picked = json.loads(body)
        picture = self._gallery.pixels(int(picked["number"]))
        with self._lock:
            self._picked = self._good = None
            ranges = pick(picture, Box(*(int(picked[name]) for name in _FIELDS)))
            self._picked = ranges, picture
            trial = try_out(ranges, self._gallery.recent())
            said: dict[str, Any] = {"ranges": ranges_text(ranges), "toml": f"ranges = {ranges_toml(ranges)}",
                                    "trial": trial_text(trial), **asdict(trial)}
            try:
                check_trial(trial)
            except ConfigError as error:
                return as_json({**said, "error": str(error)})
            self._good = ranges
            return as_json(said)

    def _mask(self, _request: PageRequest, _body: bytes) -> HttpAnswer:
        with self._lock:
            return HttpAnswer(mask_png(*self._picked), "image/png") if self._picked else HttpAnswer(status=204)

    def _take(self, _request: PageRequest, _body: bytes) -> HttpAnswer:
        with self._lock:
            if self._good is None:
                raise ConfigError("pick a colour first")
            said = self._use(self._good)
        self.done.set()
        return as_json({"said": said})
