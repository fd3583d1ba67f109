"""Shared by remote detectors: addresses, reasons for no answer, reading boxes, one request for each frame. Shell (a
clock).
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
    result_of,
)

DEFAULT_PORTS: Final = {"oip+http": 8000, "http+jpeg": 80}
"""Those of Triton, and of HTTP."""
_HOST = r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+)"
_FORM = re.compile(rf"(oip\+http|http\+jpeg)://{_HOST}(?::([0-9]{{1,5}}))?(/[!-~]*)?")
_MODEL = re.compile(r"/([A-Za-z0-9_.-]{1,128})(?:/([0-9]{1,9}))?")
EXAMPLES: Final = {
    "oip+http": "oip+http://127.0.0.1:8000/ball",
    "http+jpeg": "http+jpeg://127.0.0.1:8080/detect",
}


@dataclass(frozen=True, slots=True)
class Address:
    """A server, and the path there, or the model and perhaps its version."""

    scheme: str
    host: str
    port: int
    path: str
    model: str = ""
    version: str = ""


def parse_address(kind: str) -> Address:
    """Split an address. Raises ConfigError, with the right form, for an invalid one."""
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


# Reasons why a remote detector gave no valid answer: one list, one exception, one counter. Pure.


_LONGEST: Final = 160
_REPORTED_AT: Final = frozenset(10**power for power in range(10))
"""A server that fails is reported at the 1st, 10th, 100th ... rejection of a kind, when its answers are good again, and
when they are bad again."""
_IN_A_ROW: Final = 10
"""After so many good answers, or so many rejections, it is bad again. Fewer come and go, as where one robot of several
is not answered; a line for each of them would be one for each frame."""


class NoAnswerReason(StrEnum):
    """Reasons that are counted. All of them mean "no answer": none of them moves the robot."""

    LATE = "LATE"  # not there by the deadline
    UNREACHABLE = "UNREACHABLE"  # no server there, or gone in the middle of the answer
    REJECTED = "REJECTED"  # it answered with an error of its own
    TOO_LARGE = "TOO_LARGE"  # more bytes than any answer needs
    ENCODED = "ENCODED"  # compressed, which was not requested; never unpacked
    MALFORMED = "MALFORMED"  # not the protocol: grammar, type, shape
    NOT_FINITE = "NOT_FINITE"  # a box or score that is nan or infinite
    TOO_MANY = "TOO_MANY"  # more boxes than any scene has
    OTHER_FRAME = "OTHER_FRAME"  # it names another frame than the request
    OTHER_SIZE = "OTHER_SIZE"  # it looked at an image of another size
    UNFIT = "UNFIT"  # its model takes or gives what this end does not speak
    BAD_PICTURE = "BAD_PICTURE"  # the robot's own frame is not a JPEG of its size: nothing was requested


class NoAnswerError(Exception):
    """There is no valid answer; `detail` is one line for the operator."""

    def __init__(self, reason: NoAnswerReason, detail: str) -> None:
        self.reason = reason
        self.detail = " ".join(detail.split())[:_LONGEST]
        super().__init__(f"{reason}: {self.detail}")


class ErrorCounters:
    """Counts the rejected answers of one remote detector, and reports each change."""

    def __init__(self, name: str) -> None:
        self.rejected: Counter[str] = Counter()
        self.notices = Notices()
        self._name = name
        self._reported = ""
        self._good = self._bad = 0
        """In a row."""

    def reject(self, error: NoAnswerError) -> None:
        """Count one answer that does not count."""
        self.rejected[error.reason] += 1
        count, good_before = self.rejected[error.reason], self._good
        self._good, self._bad = 0, self._bad + 1
        again = self._reported == "good" and (good_before >= _IN_A_ROW or self._bad == _IN_A_ROW)
        if again or count in _REPORTED_AT:
            self._reported = error.reason
            self.notices.add(f"detector {self._name}: no answer: {error.reason}: {error.detail} ({count} so far)")

    def good(self) -> None:
        """Count one answer that counts."""
        self._good, self._bad = self._good + 1, 0
        if self._reported != "good":
            before, self._reported = self._reported, "good"
            self.notices.add(f"detector {self._name} answers" + (" again" if before else ""))


# Columns of numbers from a server -> detections, nothing taken on trust. Pure.


MAX_ROWS: Final = 1024
"""Security limit: a model with a fixed number of rows fills up with scores of 0; no detector needs more."""
MIN_SCORE: Final = 0.25
"""The least score of a box, as for boxes on the wire, unless configured otherwise."""
_HASH: Final = re.compile("[0-9a-fA-F]{8,64}")
Numbers = NDArray[Any]


def read_columns(
    boxes: Numbers, scores: Numbers, labels: Sequence[str], *, stretch: tuple[float, float], size_px: tuple[int, int],
    min_score: float,
) -> tuple[Detection, ...]:
    """Boxes (K, 4) xyxy, scores (K,) and labels (K) as detections, best first, at most as many as the wire allows.

    `stretch` turns the boxes' pixels into those of the encoded image. Rows below `min_score` are left out and
    may hold anything finite. Raises NoAnswerError for a wrong shape or order, too many rows, and what is not finite.
    """
    _check_shapes(boxes, scores, labels)
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
        raise NoAnswerError(NoAnswerReason.NOT_FINITE, "a box or score is nan or infinite")
    order = [int(row) for row in np.argsort(-scores, kind="stable") if scores[row] >= min_score]
    found = [_detection(boxes[row], float(scores[row]), labels[row], stretch, size_px) for row in order]
    return tuple(one for one in found if one)[:MAX_DETECTED_BOXES]


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
        corners = f"{x1:g} {y1:g} {x2:g} {y2:g}"
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"a box inside out or a score over 1: {corners}, {score:g}")
    one = Detection(x1 * across, y1 * down, x2 * across, y2 * down, score, clean_label(label))
    return clipped(one, *size_px)


def read_boxes(boxes: Sequence[DetectedBox], size_px: tuple[int, int], min_score: float) -> tuple[Detection, ...]:
    """Boxes of the wire, which checked each by itself, as detections in the image, best first."""
    found = [clipped(_of_wire(box), *size_px) for box in boxes if box.score >= min_score]
    return tuple(sorted((one for one in found if one), key=lambda one: one.score, reverse=True))


def _of_wire(box: DetectedBox) -> Detection:
    ring = box.circle
    circle = Circle(ring.cx_px, ring.cy_px, ring.radius_px) if ring else None
    label = clean_label(box.label)
    return Detection(box.x1_px, box.y1_px, box.x2_px, box.y2_px, box.score, label, circle, track_id=box.track)


def hash_of(text: str) -> str:
    """Return the first 16 digits of a model's hash, or "" for an invalid one."""
    return text[:16].lower() if _HASH.fullmatch(text) else ""


# A detector that sends a server one frame after the other. Shell (the clock, for how long it took).


REMOTE: Final = "remote"
"""The device of a result, where the server does not name one."""
LONGEST_WAIT_S: Final = 2.0
"""For an answer, whatever the deadline: twice the longest that can be configured."""


@dataclass(frozen=True, slots=True)
class ServerAnswer:
    """A server's answer to one frame, checked, and its maker."""

    detections: tuple[Detection, ...]
    maker: Maker


class DetectorServer(Protocol):
    """The client of one kind of server."""

    def request(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        """Return its answer; block until about `until_us`. Raises NoAnswerError for everything else."""
        ...

    def close(self) -> None:
        """Close its connection."""
        ...


class FrameByFrame(ABC):
    """A `Detector` that requests one frame after the other from elsewhere, and counts the answers that it rejects."""

    def __init__(self, name: str) -> None:
        self._error_counters = ErrorCounters(name)

    @property
    def rejected(self) -> Counter[str]:
        """Answers rejected so far, by reason."""
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
    """A detector over one server. It may block for longer than the deadline; `DeadlineDetector` around it does not."""

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
        except WireError as error:  # of pixels that the model needs
            raise NoAnswerError(NoAnswerReason.BAD_PICTURE, error.detail) from None
        ended_us = monotonic_us()
        if ended_us > deadline_us:
            raise NoAnswerError(NoAnswerReason.LATE, f"{(ended_us - deadline_us) / 1000:.0f} ms after the deadline")
        return result_of(frame, answer.detections, answer.maker, ended_us - began_us)


def _check_picture(frame: DetectFrame) -> None:
    """Check the size in the JPEG's head: its bytes are sent undecoded."""
    try:
        size = read_jpeg_size(frame.jpeg, frame.width_px * frame.height_px)
    except WireError as error:
        raise NoAnswerError(NoAnswerReason.BAD_PICTURE, error.detail) from None
    if (size.width_px, size.height_px) != (frame.width_px, frame.height_px):
        raise NoAnswerError(NoAnswerReason.BAD_PICTURE, f"the frame is {size.width_px}x{size.height_px}")


def seconds_left(until_us: int) -> float:
    """Return the time left until `until_us`, at least 0; bounded where there is no deadline."""
    return min(max(0, until_us - monotonic_us()) / 1e6, LONGEST_WAIT_S)
