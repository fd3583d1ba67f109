"""Shared parts of remote detectors: addresses, reasons for no answer, parsing of boxes, one request per frame. Shell
(a clock).
"""

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import MAX_DETECTED_BOXES, DetectedBox
from sightline.vision_side.detect.plugin_calls import Notices
from sightline.vision_side.detect.port import (
    Circle,
    DetectFrame,
    Detection,
    DetectionResult,
    Maker,
    clean_label,
    clipped,
    corners,
    is_normalized,
    result_of,
)

DEFAULT_PORTS: Final = {"oip+http": 8000, "http+jpeg": 80}
"""Default ports of Triton and of HTTP."""
_HOST = r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+)"
_FORM = re.compile(rf"(oip\+http|http\+jpeg)://{_HOST}(?::([0-9]{{1,5}}))?(/[!-~]*)?")
_MODEL = re.compile(r"/([A-Za-z0-9_.-]{1,128})(?:/([0-9]{1,9}))?")
EXAMPLES: Final = {
    "oip+http": "oip+http://127.0.0.1:8000/ball",
    "http+jpeg": "http+jpeg://127.0.0.1:8080/detect",
}


@dataclass(frozen=True, slots=True)
class Address:
    """A server with a path, or with a model and an optional version."""

    scheme: str
    host: str
    port: int
    path: str
    model: str = ""
    version: str = ""


def parse_address(kind: str) -> Address:
    """Split an address. Raises ConfigError, with the expected form, for an invalid one."""
    scheme = kind.partition("://")[0]
    example = EXAMPLES.get(scheme, EXAMPLES["oip+http"])
    match = _FORM.fullmatch(kind)
    port = int(match[3]) if match and match[3] else DEFAULT_PORTS.get(scheme, 0)
    if match is not None and not 1 <= port <= 65_535:
        raise ConfigError(f"detector {kind!r}: invalid port {port}; expected 1 to 65535, e.g. {example}")
    if match is None:
        raise ConfigError(f"detector {kind!r}: write scheme://HOST[:PORT]/..., e.g. {example}")
    host, path = match[2].strip("[]"), match[4] or "/"
    if scheme == "http+jpeg":
        return Address(scheme, host, port, path)
    named = _MODEL.fullmatch(path)
    if named is None:
        raise ConfigError(f"detector {kind!r} names no model: write {example}, or .../MODEL/VERSION")
    return Address(scheme, host, port, path, named[1], named[2] or "")


# Reasons why a remote detector gave no valid answer: a list, an exception, a counter. Pure.


_LONGEST: Final = 160
_REPORTED_AT: Final = frozenset(10**power for power in range(10))
"""The 1st, 10th, 100th ... rejection of a kind is logged. A change between good and bad answers is logged, too."""
_IN_A_ROW: Final = 10
"""After this many good answers or rejections in a row, the log reports a bad server again. Otherwise, if a server
answers all robots but one, the log would have a line for each frame. The number of good answers doubles each time."""
_MOST_IN_A_ROW: Final = 1800
"""A minute at 30 fps."""


class NoAnswerReason(StrEnum):
    """Counted reasons. Each of them means "no answer", which never moves the robot."""

    LATE = "LATE"  # no answer by the deadline
    UNREACHABLE = "UNREACHABLE"  # no connection, or lost during the answer
    REJECTED = "REJECTED"  # the server returned an error
    TOO_LARGE = "TOO_LARGE"  # more bytes than a valid answer needs
    ENCODED = "ENCODED"  # compressed without request; it is not decompressed
    MALFORMED = "MALFORMED"  # wrong syntax, type or shape
    NOT_FINITE = "NOT_FINITE"  # a box or score is nan or infinite
    TOO_MANY = "TOO_MANY"  # more boxes than the limit
    OTHER_FRAME = "OTHER_FRAME"  # it names another frame than the request
    OTHER_SIZE = "OTHER_SIZE"  # it is for another image size
    UNFIT = "UNFIT"  # the inputs or outputs of the model are not supported
    BAD_PICTURE = "BAD_PICTURE"  # the frame is not a JPEG of the robot's size; nothing was sent


class NoAnswerError(Exception):
    """There is no valid answer; `detail` is one line for the operator."""

    def __init__(self, reason: NoAnswerReason, detail: str) -> None:
        self.reason = reason
        self.detail = " ".join(detail.split())[:_LONGEST]
        super().__init__(f"{reason}: {self.detail}")


class ErrorCounters:
    """Counts the rejected answers of one remote detector, and logs each change."""

    def __init__(self, name: str) -> None:
        self.rejected: Counter[str] = Counter()
        self.notices = Notices()
        self._name = name
        self._reported = ""
        self._good = self._bad = 0
        """Good and bad answers in a row."""
        self._good_needed = _IN_A_ROW

    def reject(self, error: NoAnswerError) -> None:
        """Count a rejected answer."""
        self.rejected[error.reason] += 1
        count, good_before = self.rejected[error.reason], self._good
        self._good, self._bad = 0, self._bad + 1
        again = self._reported == "good" and (good_before >= self._good_needed or self._bad == _IN_A_ROW)
        if again or count in _REPORTED_AT:
            self._good_needed = min(2 * self._good_needed, _MOST_IN_A_ROW) if again else self._good_needed
            self._reported = error.reason
            self.notices.add(f"detector {self._name}: no answer: {error.reason}: {error.detail} ({count} so far)")

    def good(self) -> None:
        """Count a valid answer."""
        self._good, self._bad = self._good + 1, 0
        if self._reported != "good":
            before, self._reported = self._reported, "good"
            self.notices.add(f"detector {self._name} answers" + (" again" if before else ""))


# Convert columns of numbers from a server to detections, with every number validated. Pure.


MAX_ROWS: Final = 1024
"""Security limit. A model with a fixed number of rows fills the rest with scores of 0. No detector needs more rows."""
MIN_SCORE: Final = 0.25
"""Least score of a box, as for boxes on the wire, unless configured."""
_HASH: Final = re.compile("[0-9a-fA-F]{8,64}")
Numbers = NDArray[Any]


def read_columns(
    boxes: Numbers, scores: Numbers, labels: Sequence[str], *, stretch: tuple[float, float], size_px: tuple[int, int],
    min_score: float,
) -> tuple[Detection, ...]:
    """Convert boxes (K, 4) xyxy, scores (K,) and labels (K) to detections, best first, up to the limit of the wire.

    `stretch` converts pixels of the boxes to pixels of the encoded image. Rows below `min_score` are dropped, with any
    finite values. Raises NoAnswerError for a wrong shape or order, too many rows, and numbers that are not finite.
    """
    _check_shapes(boxes, scores, labels)
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
        raise NoAnswerError(NoAnswerReason.NOT_FINITE, "a box or score is nan or infinite")
    order = [int(row) for row in np.argsort(-scores, kind="stable") if scores[row] >= min_score]
    _check_pixels(boxes[order])
    found = [_detection(boxes[row], float(scores[row]), labels[row], stretch, size_px) for row in order]
    return tuple(one for one in found if one)[:MAX_DETECTED_BOXES]


def _check_pixels(boxes: Numbers) -> None:
    if is_normalized(boxes):
        raise NoAnswerError(NoAnswerReason.UNFIT, "all boxes lie within two pixels of the corner, as if from 0 to 1; "
                                                  "let the server give pixels")


def _check_shapes(boxes: Numbers, scores: Numbers, labels: Sequence[str]) -> None:
    rows = len(scores) if scores.ndim == 1 else -1
    if boxes.ndim != 2 or boxes.shape[1] != 4 or boxes.shape[0] != rows or len(labels) != rows:
        got = f"boxes {boxes.shape}, scores {scores.shape}, {len(labels)} labels"
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"{got}; expected (K, 4), (K,) and K")
    if rows > MAX_ROWS:
        raise NoAnswerError(NoAnswerReason.TOO_MANY, f"{rows} boxes, at most {MAX_ROWS}")


def _detection(
    box: Numbers, score: float, label: str, stretch: tuple[float, float], size_px: tuple[int, int]
) -> Detection | None:
    """Return the part inside the image, or None without one."""
    across, down = stretch
    x1, y1, x2, y2 = (float(value) for value in box)
    if x2 < x1 or y2 < y1 or score > 1:
        corners = f"{x1:g}, {y1:g}, {x2:g}, {y2:g}"
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"a box {corners} with the score {score:g}; expected x1, y1, x2, "
                                                      "y2 and a score from 0 to 1")
    one = Detection(x1 * across, y1 * down, x2 * across, y2 * down, score, clean_label(label))
    return clipped(one, *size_px)


def read_boxes(boxes: Sequence[DetectedBox], size_px: tuple[int, int], min_score: float) -> tuple[Detection, ...]:
    """Convert boxes of the wire, which are valid one by one, to detections in the image, best first.

    Raises NoAnswerError for boxes that are not in pixels.
    """
    counted = [_of_wire(box) for box in boxes if box.score >= min_score]
    _check_pixels(np.array([corners(one) for one in counted], np.float64).reshape(-1, 4))
    found = [clipped(one, *size_px) for one in counted]
    return tuple(sorted((one for one in found if one), key=lambda one: one.score, reverse=True))


def _of_wire(box: DetectedBox) -> Detection:
    ring = box.circle
    circle = Circle(ring.cx_px, ring.cy_px, ring.radius_px) if ring else None
    label = clean_label(box.label)
    return Detection(box.x1_px, box.y1_px, box.x2_px, box.y2_px, box.score, label, circle, track_id=box.track)


def hash_of(text: str) -> str:
    """Return the first 16 digits of a model's hash, or "" for an invalid one."""
    return text[:16].lower() if _HASH.fullmatch(text) else ""


# A detector that sends one frame after the other to a server. Shell (the clock, for the computing time).


REMOTE: Final = "remote"
"""The device of a result if the server names none."""
LONGEST_WAIT_S: Final = 2.0
"""Longest wait for an answer without a deadline; twice the longest configurable deadline."""


@dataclass(frozen=True, slots=True)
class ServerAnswer:
    """A server's answer to one frame, checked, and its maker."""

    detections: tuple[Detection, ...]
    maker: Maker


class DetectorServer(Protocol):
    """Interface of a client for one kind of server."""

    def request(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        """Return the answer; block until about `until_us`. Raises NoAnswerError without a valid answer."""
        ...

    def close(self) -> None:
        """Close its connection."""
        ...


class FrameByFrame(ABC):
    """A `Detector` that requests one frame after the other from a remote side, and counts the rejected answers."""

    def __init__(self, name: str) -> None:
        self._error_counters = ErrorCounters(name)

    @property
    def rejected(self) -> Counter[str]:
        """Return the number of rejected answers, by reason."""
        return self._error_counters.rejected

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """See `Detector`."""
        return [self._one(frame, deadline_us) for frame in frames]

    def _one(self, frame: DetectFrame, deadline_us: int) -> DetectionResult | None:
        try:
            result = self._request(frame, deadline_us)
        except NoAnswerError as error:
            self._error_counters.reject(error)
            return None
        self._error_counters.good()
        return result

    @abstractmethod
    def _request(self, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        """Return the detections in `frame`. Raises NoAnswerError."""

    def notices(self) -> list[str]:
        """Return the lines since the last call."""
        return self._error_counters.notices.take()


class ServerDetector(FrameByFrame):
    """A detector with one server. It may block longer than the deadline; a `DeadlineDetector` around it does not."""

    def __init__(self, name: str, server: DetectorServer) -> None:
        super().__init__(name)
        self._server = server

    def close(self) -> None:
        """Close the server's connection."""
        self._server.close()

    def _request(self, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        began_us = monotonic_us()
        _check_picture(frame)
        try:
            answer = self._server.request(frame, deadline_us)
        except WireError as error:  # invalid image, for a model that needs pixels
            raise NoAnswerError(NoAnswerReason.BAD_PICTURE, error.detail) from None
        ended_us = monotonic_us()
        if ended_us > deadline_us:
            raise NoAnswerError(NoAnswerReason.LATE, f"{(ended_us - deadline_us) / 1000:.0f} ms after the deadline")
        return result_of(frame, answer.detections, answer.maker, ended_us - began_us)


def _check_picture(frame: DetectFrame) -> None:
    """Check the image size in the JPEG header, because the JPEG is sent undecoded."""
    try:
        size = read_jpeg_size(frame.jpeg, frame.width_px * frame.height_px)
    except WireError as error:
        raise NoAnswerError(NoAnswerReason.BAD_PICTURE, error.detail) from None
    if (size.width_px, size.height_px) != (frame.width_px, frame.height_px):
        raise NoAnswerError(NoAnswerReason.BAD_PICTURE, f"the frame is {size.width_px}x{size.height_px}")


def seconds_left(until_us: int) -> float:
    """Return the time left until `until_us`, at least 0 and at most `LONGEST_WAIT_S`."""
    return min(max(0, until_us - monotonic_us()) / 1e6, LONGEST_WAIT_S)
