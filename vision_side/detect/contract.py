"""Check the promises of a detector: `sightline detector check NAME`. Shell (a clock).

A seed defines the images: disks and boxes in all colors, noise, black, odd sizes, and bytes that are not an image.
"""

import math
import queue
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from random import Random
from statistics import median
from typing import Final

import cv2
import numpy as np

from sightline.protocol.config import PLUGIN_ERRORS
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import report_fault
from sightline.protocol.messages import MAX_DETECTED_BOXES, FrameHeader
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.onnx.self_test import difference
from sightline.vision_side.detect.plugin_calls import annotation_problem, close_detector, labels_of
from sightline.vision_side.detect.port import (
    NO_DEADLINE,
    NORMALIZED_PX,
    DetectFrame,
    DetectionResult,
    Detector,
    corners,
    overlap,
)

SIZES: Final = ((320, 240), (640, 480), (97, 61), (16, 16), (1280, 720), (641, 481))
LATE_S: Final = 0.25
"""Longest delay of an answer after the deadline of its frame. By then the caller no longer waits."""
MOST_S: Final = 120.0
"""Longest time for one promise, that is 2.5 s for each of its images. The time to build a detector is extra."""
LOAD_S: Final = 600.0
"""Longest time to build a detector, which may load a large model."""
_WAKE_S: Final = 0.5
_MAX_PIXELS: Final = 1920 * 1080
_FRAME_US: Final = 33_333
_QUALITY: Final = 80
_HASH = re.compile(r"[0-9a-f]{0,64}")
_BALL_BGR: Final = 13, 199, 242
_PLACES: Final = ((0.3, 0.7), (0.7, 0.3), (0.75, 0.75))
"""Centers of a ball, as shares of width and height. Exchanged coordinates or half the scale name a place outside it."""
_SAME_SCORE: Final = 0.5  # on a device that rounds, less certain detections may come and go

Make = Callable[[], Detector]
_Check = Callable[[Detector, Make, int], str]


@dataclass(frozen=True, slots=True)
class PromiseResult:
    """One promise: its name, its text, and the violation, which is empty for a fulfilled promise."""

    name: str
    promise: str
    wrong: str = ""


@dataclass(frozen=True, slots=True)
class Times:
    """Time for one image in milliseconds, as the detector reports it, or of its call if it reports none."""

    width_px: int
    height_px: int
    p50_ms: float
    p95_ms: float
    boxes: int
    """Boxes in all images. Without any, the check has seen no box."""


class _Loading:
    """Builds detectors, and gives that more time than the check of a promise, which begins with it."""

    def __init__(self, make: Make) -> None:
        self._make, self._left_s = make, MOST_S
        self.is_now, self.until_s = True, time.monotonic() + LOAD_S
        """Time at which the promise is not kept, on the clock of `time.monotonic`."""

    def __call__(self) -> Detector:
        if not self.is_now:
            self._left_s = self.until_s - time.monotonic()
        self.is_now, self.until_s = True, time.monotonic() + LOAD_S
        try:
            return self._make()
        finally:
            self.is_now, self.until_s = False, time.monotonic() + self._left_s


def check_detector(make: Make, seed: int = 1) -> list[PromiseResult]:
    """Check every promise in turn, until one takes `MOST_S`. `make` builds a new detector, in `LOAD_S` at most."""
    verdicts = []
    for check in _CHECKS:
        promise = (check.__doc__ or "").split("\n")[0].rstrip(".")
        ended, loading = queue.SimpleQueue[str | BaseException](), _Loading(make)
        threading.Thread(target=_check, args=(ended, check, loading, seed), name="check", daemon=True).start()
        wrong = _ended_in_time(ended, loading)
        if isinstance(wrong, BaseException):
            raise wrong
        hangs = wrong is None  # the next promise would wait as long
        if hangs:
            what, most_s = ("loading it", LOAD_S) if loading.is_now else ("it", MOST_S)
            wrong = f"{what} takes more than {most_s:g} s; the rest was not checked"
        verdicts.append(PromiseResult(check.__name__.removeprefix("_keeps_"), promise, wrong or ""))
        if hangs:
            break
    return verdicts


def _ended_in_time(ended: "queue.SimpleQueue[str | BaseException]", loading: _Loading) -> str | BaseException | None:
    """Return the result of a check, or None if it takes too long."""
    while (left_s := loading.until_s - time.monotonic()) > 0:
        with suppress(queue.Empty):
            return ended.get(timeout=min(left_s, _WAKE_S))
    return None


def _check(ended: "queue.SimpleQueue[str | BaseException]", check: "_Check", make: Make, seed: int) -> None:
    """Put the violation of one promise, or the error of building or closing the detector, into `ended`."""
    try:
        detector = make()
        try:
            wrong = check(detector, make, seed)
        except ConfigError as error:
            wrong = str(error)
        except PLUGIN_ERRORS as error:  # violates the promise to raise nothing
            wrong = f"it raises {type(error).__name__}: {report_fault('detector', error)}"[:160]
        finally:
            close_detector(detector)
        ended.put(wrong)
    except BaseException as error:  # any, because the caller waits for it
        ended.put(error)


def time_detector(make: Make, frames: int = 60, seed: int = 1) -> list[Times]:
    """Measure the time per frame at the two usual sizes, one frame after the other."""
    return [_time_size(make, size, frames, seed) for size in SIZES[:2]]


def _time_size(make: Make, size: tuple[int, int], frames: int, seed: int) -> Times:
    detector, took, boxes = make(), [], 0
    for frame in drawn_frames(seed, frames, size):
        began_s = time.perf_counter()
        result = detector.detect([frame], NO_DEADLINE)[0]
        call_ms = (time.perf_counter() - began_s) * 1000
        took.append((result.compute_us / 1000 or call_ms) if result else math.nan)
        boxes += len(result.detections) if result else 0
    close_detector(detector)
    known = sorted(one for one in took[frames // 4 :] if not math.isnan(one))
    if not known:
        return Times(*size, math.nan, math.nan, boxes)
    return Times(*size, median(known), known[min(len(known) - 1, round(0.95 * len(known)))], boxes)


# --- the promises ----------------------------------------------------------------------------------------------------


def _keeps_order(detector: Detector, _make: Make, seed: int) -> str:
    """A batch gets as many results, in its order, each naming its frame."""
    if (given := detector.detect([], NO_DEADLINE)) != []:
        return f"an empty batch gets {given!r}"[:60] + "; expected []"
    frames = [*drawn_frames(seed, 3, SIZES[0], "r1"), *drawn_frames(seed + 1, 3, SIZES[2], "r2")]
    results = detector.detect(frames, NO_DEADLINE)
    if len(results) != len(frames):
        return f"{len(frames)} frames get {len(results)} results"
    pairs = zip(frames, results, strict=True)
    return next((wrong for frame, one in pairs if one and (wrong := _unlike(frame, one))), "")


def _keeps_answering(detector: Detector, _make: Make, seed: int) -> str:
    """Every image gets an answer, of any size, black, noise or full."""
    for size in SIZES:
        for index, frame in enumerate(drawn_frames(seed, 8, size)):
            if _answer(detector, frame) is None:
                return f"no answer to image {index} of {size[0]}x{size[1]}"
    return ""


def _keeps_bounds(detector: Detector, _make: Make, seed: int) -> str:
    """Boxes lie in the image, in pixels, of finite numbers, with scores from 0 to 1 and a word each."""
    furthest_px = 0.0
    for size in SIZES:
        for frame in drawn_frames(seed, 8, size):
            result = _answer(detector, frame)
            wrong = result and _out_of_bounds(result)
            if wrong:
                return wrong
            ends = [max(one.x2_px, one.y2_px) for one in result.detections] if result else []
            furthest_px = max(furthest_px, *ends, 0.0)
    return "all boxes lie within two pixels of the corner, as if from 0 to 1" if 0 < furthest_px < NORMALIZED_PX else ""


def _keeps_places(detector: Detector, _make: Make, _seed: int) -> str:
    """Boxes lie where the object is, in images of any size."""
    for size in SIZES[:2]:
        missed = [wrong for place in _PLACES if (wrong := _misplaced(detector, size, place)) is not None]
        if len(missed) > 1 and all(missed):  # a detector of other objects may find something else once
            return missed[0]
    return ""


def _misplaced(detector: Detector, size: tuple[int, int], place: tuple[float, float]) -> str | None:
    """Show a gray image, then a ball in it. Return None if the ball causes no box, "" for a box on the ball."""
    x_px, y_px, radius_px = round(place[0] * size[0]), round(place[1] * size[1]), size[1] // 10
    picture = np.full((size[1], size[0], 3), 120, np.uint8)
    empty = _encoded(picture)
    cv2.circle(picture, (x_px, y_px), radius_px, _BALL_BGR, -1, cv2.LINE_AA)
    jpegs = (empty, *[_encoded(picture)] * 2)  # a detector may need a second image to be sure
    before, *_, after = (one.detections if one else () for one in _seen(detector, _frames(jpegs, size, f"r{x_px}")))
    if before or not after:
        return None
    ball = x_px - radius_px, y_px - radius_px, x_px + radius_px, y_px + radius_px
    if any(overlap(corners(one), ball) for one in after):
        return ""
    box = ", ".join(f"{side:g}" for side in corners(after[0]))
    return (f"a box {box} for a ball at {x_px}, {y_px} in {size[0]}x{size[1]}; expected x1, y1, x2, y2 in pixels "
            "of the encoded image")


def _keeps_silence(detector: Detector, _make: Make, seed: int) -> str:
    """Bytes that are not an image get no answer, and the next frame gets its own."""
    good = list(drawn_frames(seed, 2, SIZES[0]))
    decoder = Decoder(*SIZES[0], _MAX_PIXELS)
    cut, other = good[0].jpeg[: len(good[0].jpeg) // 3], _jpeg(Random(seed), (64, 48))
    for jpeg in (b"", b"\xff\xd8\xff", cut, other, b"\0" * 500):
        bad = DetectFrame("r1", good[0].header, jpeg, decoder)
        if _answer(detector, bad) is not None and _is_bad(bad):
            return f"{len(jpeg)} bytes that are not an image get an answer"
        if _answer(detector, good[1]) is None:
            return "no answer to a good frame after a bad one"
    return ""


def _keeps_deadline(detector: Detector, _make: Make, seed: int) -> str:
    """A frame after its deadline does not delay the caller."""
    (frame,) = drawn_frames(seed, 1, SIZES[0])
    detector.detect([frame], NO_DEADLINE)
    began_s = time.monotonic()
    detector.detect([frame], int(began_s * 1e6) - 1)
    took_s = time.monotonic() - began_s
    return f"it takes {took_s:.2f} s; {LATE_S} s is the most" if took_s > LATE_S else ""


def _keeps_the_same(detector: Detector, make: Make, seed: int) -> str:
    """The same frames get the same answers."""
    other = make()
    try:
        return _first_difference(_seen(detector, drawn_frames(seed, 12, SIZES[0])),
                                 _seen(other, drawn_frames(seed, 12, SIZES[0])))
    finally:
        close_detector(other)


def _keeps_robots_apart(detector: Detector, make: Make, seed: int) -> str:
    """The answers to one robot's frames do not depend on another robot's frames."""
    alone = make()
    try:
        expected = _seen(alone, drawn_frames(seed, 8, SIZES[0]))
    finally:
        close_detector(alone)
    found = []
    for mine, others in zip(drawn_frames(seed, 8, SIZES[0]), drawn_frames(seed + 9, 8, SIZES[0], "r2"), strict=True):
        found.append(detector.detect([others, mine], NO_DEADLINE)[1])
    return _first_difference(expected, found)


def _keeps_its_name(detector: Detector, _make: Make, seed: int) -> str:
    """Every result names its detector, model, device and time, and `labels` is a list of texts."""
    labels_of(detector)
    for result in _seen(detector, drawn_frames(seed, 2, SIZES[0])):
        if result is None:
            continue
        if not 0 < len(result.detector) <= 64 or not 0 < len(result.device) <= 32:
            return f"detector {result.detector!r} on {result.device!r}"
        if not _HASH.fullmatch(result.model_hash):
            return f"model hash {result.model_hash!r} is not hexadecimal"
        if not isinstance(result.compute_us, int) or result.compute_us < 0:
            return f"compute_us {result.compute_us!r} is not a whole number"
    return ""


_CHECKS: Final = (_keeps_order, _keeps_answering, _keeps_bounds, _keeps_places, _keeps_silence, _keeps_deadline,
                  _keeps_the_same, _keeps_robots_apart, _keeps_its_name)


# --- frames and comparisons ------------------------------------------------------------------------------------------


def _seen(detector: Detector, frames: Iterator[DetectFrame]) -> list[DetectionResult | None]:
    return [_answer(detector, frame) for frame in frames]


def _answer(detector: Detector, frame: DetectFrame) -> DetectionResult | None:
    if len(results := detector.detect([frame], NO_DEADLINE)) != 1:
        raise ConfigError(f"1 frame gets {len(results)} results")
    return results[0]


def _unlike(frame: DetectFrame, one: DetectionResult) -> str:
    header = frame.header
    expected = (frame.robot, header.session, header.seq, header.t_us, frame.width_px, frame.height_px)
    named = (one.robot, one.session, one.seq, one.t_us, one.width_px, one.height_px)
    return "" if named == expected else f"the answer to {expected} names {named}"


def _out_of_bounds(result: DetectionResult) -> str:
    if len(result.detections) > MAX_DETECTED_BOXES:
        return f"{len(result.detections)} boxes; {MAX_DETECTED_BOXES} is the most"
    for one in result.detections:
        if not (0 <= one.x1_px < one.x2_px <= result.width_px and 0 <= one.y1_px < one.y2_px <= result.height_px):
            return f"a box {one.x1_px:g}, {one.y1_px:g}, {one.x2_px:g}, {one.y2_px:g}"
        if not 0 <= one.score <= 1:
            return f"a score of {one.score:g}"
        if wrong := annotation_problem(one):
            return wrong
    return ""


def _first_difference(expected: list[DetectionResult | None], found: list[DetectionResult | None]) -> str:
    for index, (one, other) in enumerate(zip(expected, found, strict=True)):
        if (one is None) is not (other is None):
            return f"frame {index} is answered once and once not"
        if one and other and (what := difference(one.detections, other.detections, _SAME_SCORE)):
            return f"frame {index}: {what}"
    return ""


def _is_bad(frame: DetectFrame) -> bool:
    try:
        frame.picture()
    except Exception:
        return True
    return False  # a decoder fills the missing end of a truncated image, so it is an image


def drawn_frames(seed: int, count: int, size: tuple[int, int], robot: str = "r1") -> Iterator[DetectFrame]:
    """Draw frames of one robot, 33 ms apart, each with a separate decoder, so that all stay valid."""
    return _frames(_jpegs(seed, count, size), size, robot)


def _frames(jpegs: Iterable[bytes], size: tuple[int, int], robot: str) -> Iterator[DetectFrame]:
    for index, jpeg in enumerate(jpegs):
        header = FrameHeader(session="0000abcd", seq=index + 1, t_us=5_000_000 + index * _FRAME_US)
        yield DetectFrame(robot, header, jpeg, Decoder(*size, _MAX_PIXELS))


@lru_cache(maxsize=32)  # several promises are checked with the same images
def _jpegs(seed: int, count: int, size: tuple[int, int]) -> list[bytes]:
    random = Random(seed)
    return [_jpeg(random, size, index) for index in range(count)]


def _jpeg(random: Random, size: tuple[int, int], index: int = 0) -> bytes:
    picture = np.full((size[1], size[0], 3), random.randrange(40, 200), np.uint8)
    if index % 4 == 1:
        picture = np.random.default_rng(random.randrange(2**31)).integers(0, 256, picture.shape, np.uint8)
    if index % 4 != 3:
        _draw(picture, random, _BALL_BGR)
    for _ in range(random.randrange(4)):
        _draw(picture, random, tuple(random.randrange(256) for _ in range(3)))
    return _encoded(picture)


def _encoded(picture: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])


def _draw(picture: np.ndarray, random: Random, colour: tuple[int, ...]) -> None:
    height, width = picture.shape[:2]
    x, y, radius = random.randrange(width), random.randrange(height), random.randrange(2, max(3, height // 4))
    if random.random() < 0.6:
        cv2.circle(picture, (x, y), radius, colour, -1, cv2.LINE_AA)
    else:
        cv2.rectangle(picture, (x - radius, y - radius), (x + radius, y + radius), colour, -1)
