"""The page of `sightline pick-color`, and its images. Shell (threads, files)."""

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
from sightline.protocol.messages import LEAST_SIDE_PX
from sightline.robot_side.hardware.cameras.files import quiet_videos

MAX_FILE_BYTES: Final = 50_000_000
MAX_PIXELS: Final = 25_000_000
"""Limit of an image file, for a large photograph. The limits of the vision service apply to camera frames."""
PATIENCE_S: Final = 5.0
_PAGE_QUALITY: Final = 92


class Gallery(Protocol):
    """The images of a page."""

    live: bool

    def pixels(self, number: int) -> Image:
        """Return the image with this number. Raises ConfigError if it is gone."""
        ...

    def recent(self) -> Sequence[Image]:
        """Return the newest images, for the test of a range."""
        ...

    def route(self, request: PageRequest, body: bytes) -> HttpAnswer:
        """Answer `GET /picture`."""
        ...


class StillGallery:
    """The images of a file."""

    live = False

    def __init__(self, pictures: Sequence[Image]) -> None:
        self._pictures = list(pictures)

    def pixels(self, number: int) -> Image:
        """Return an image, numbered from 1."""
        if not 1 <= number <= len(self._pictures):
            raise ConfigError(f"no image {number}; there are {len(self._pictures)}")
        return self._pictures[number - 1]

    def recent(self) -> Sequence[Image]:
        """Return all images."""
        return self._pictures

    def route(self, request: PageRequest, _body: bytes) -> HttpAnswer:
        """Answer with image `?number=N`, by default with the last image."""
        number = int(request.get("number", len(self._pictures)))
        done, data = cv2.imencode(".jpg", self.pixels(number), [cv2.IMWRITE_JPEG_QUALITY, _PAGE_QUALITY])
        if not done:
            return HttpAnswer(status=204)
        count = {"X-Number": str(number), "X-Count": str(len(self._pictures))}
        return HttpAnswer(data.tobytes(), "image/jpeg", headers=count)


class LiveGallery:
    """A robot's newest images, fetched while the page requests them."""

    live = True

    def __init__(self, frames: int) -> None:
        """`frames` is the number of images for the test of a range."""
        # The next image may arrive before the user picks in the shown image.
        self.buffer = FrameBuffer(max(2, frames))
        self.route = self.buffer.route
        self._frames = frames

    def pixels(self, number: int) -> Image:
        """Return an image of the buffer."""
        shot = self.buffer.of(number)
        if shot is None:
            raise ConfigError("that image is gone; pick in a newer one")
        return _decoded(shot.jpeg)

    def recent(self) -> Sequence[Image]:
        """Return the newest images of the buffer."""
        return [_decoded(one.shot.jpeg) for one in self.buffer.shots[-self._frames :]]


def of_picture(path: Path) -> list[Image]:
    """Read an image file. Raises ConfigError for an invalid file."""
    try:
        if not path.is_file() and path.exists():  # a device or a pipe may be endless
            raise ConfigError(f"{path} is not a file; name a PNG or JPEG")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ConfigError(f"{path} is larger than {MAX_FILE_BYTES // 1_000_000} MB; use a smaller image")
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}; choose another file") from None
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    except cv2.error:
        picture = None
    if picture is None:
        raise ConfigError(f"invalid image {path}; use a PNG or JPEG")
    if min(picture.shape[:2]) < LEAST_SIDE_PX:
        size = f"{picture.shape[1]}x{picture.shape[0]}"
        raise ConfigError(f"{path} has {size}, at least {LEAST_SIDE_PX} pixels a side; use a larger image")
    if picture.shape[0] * picture.shape[1] > MAX_PIXELS:
        size = f"{picture.shape[1]}x{picture.shape[0]}"
        raise ConfigError(f"{path} has {size}, at most {MAX_PIXELS // 1_000_000} megapixels; use a smaller image")
    return [np.asarray(picture, np.uint8)]


def of_video(path: Path, frames: int) -> list[Image]:
    """Read `frames` images spread evenly over a video, or all of a shorter one. Raises ConfigError for a bad file."""
    if not path.is_file():
        raise ConfigError(f"{path} is not a file; name a video")
    quiet_videos(cv2)
    capture = cv2.VideoCapture(str(path))
    try:
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        wanted = {round(one) for one in np.linspace(0, count - 1, min(frames, count))} if count > 0 else set()
        pictures = [np.asarray(picture, np.uint8) for number, picture in enumerate(_read(capture))
                    if (number in wanted if wanted else number < frames)]
    finally:
        capture.release()
    if not pictures:
        raise ConfigError(f"invalid video {path}; use another file")
    return pictures


def _read(capture: Any) -> Iterator[Image]:
    while (got := capture.read())[0]:
        yield got[1]


def of_robot(pictures: Pictures, frames: int) -> list[Image]:
    """Return the next `frames` images of a robot. Raises LinkError without an image."""
    found: list[Image] = []
    ends_s = time.monotonic() + PATIENCE_S
    while len(found) < frames and time.monotonic() < ends_s:
        shot = pictures.take(ends_s - time.monotonic())
        if shot is not None:
            found.append(_decoded(shot.jpeg))
    if not found:
        raise LinkError(f"no image from robot '{pictures.robot}' after {PATIENCE_S:g} s; run `sightline status`")
    return found


def _decoded(jpeg: bytes) -> Image:
    try:
        return jpeg_pixels(jpeg)
    except WireError as error:
        raise ConfigError(f"invalid image from the robot: {error.detail}") from None


# --- the page: click or draw a box, check the marks of the range, use the range ----------------------------------


_FIELDS = ("x_px", "y_px", "width_px", "height_px")


class PickPage:
    """The page state of one operator. `use` receives the ranges and returns a note."""

    def __init__(self, gallery: Gallery, title: str, use: Callable[[Ranges], str]) -> None:
        self._gallery, self._title, self._use = gallery, title, use
        self._lock = threading.Lock()
        self._picked: tuple[Ranges, Image] | None = None
        self._good: Ranges | None = None
        self.done = threading.Event()

    @property
    def routes(self) -> Mapping[str, Route]:
        """Return the routes for `served`."""
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
            found: dict[str, Any] = {"ranges": ranges_text(ranges), "toml": _toml(ranges),
                                    "trial": trial_text(trial), **asdict(trial)}
            try:
                check_trial(trial)
            except ConfigError as error:
                return as_json({**found, "error": str(error)})
            self._good = ranges
            return as_json(found)

    def _mask(self, _request: PageRequest, _body: bytes) -> HttpAnswer:
        with self._lock:
            return HttpAnswer(mask_png(*self._picked), "image/png") if self._picked else HttpAnswer(status=204)

    def _take(self, _request: PageRequest, body: bytes) -> HttpAnswer:
        shown = json.loads(body)["toml"]
        with self._lock:
            if self._good is None:
                raise ConfigError("pick a color first")
            if shown != _toml(self._good):
                raise ConfigError("another page has picked since; pick again")
            note = self._use(self._good)
        self.done.set()
        return as_json({"note": note})


def _toml(ranges: Ranges) -> str:
    return f"ranges = {ranges_toml(ranges)}"
