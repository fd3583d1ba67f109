"""Calls a detector plug-in safely: optional methods, notices, validated results. Pure."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from numbers import Real
from operator import index
from typing import Any, Final, SupportsIndex

from sightline.protocol.config import PLUGIN_ERRORS
from sightline.protocol.errors import ConfigError, SightlineError
from sightline.protocol.log import error_text, printable, report_ending, report_fault
from sightline.protocol.messages import MAX_DETECTED_BOXES, MAX_INTEGER
from sightline.protocol.transports.link import Link
from sightline.vision_side.detect.port import (
    LONGEST_LABEL,
    Circle,
    DetectFrame,
    Detection,
    DetectionResult,
    Detector,
    Maker,
    clipped,
    is_label,
)

OLD_NOTICES: Final = "news"
"""The name of `notices` in the last release; accepted for one release."""
MAX_NOTICES: Final = 16
"""Lines stored between two calls of `take`; the oldest are dropped first."""


class Notices:
    """Lines for the operator, stored until `take`; another thread may add lines."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=MAX_NOTICES)

    def add(self, line: str) -> None:
        """Add one line."""
        self._lines.append(line)

    def take(self) -> list[str]:
        """Take all lines since the last call."""
        lines = []
        while self._lines:
            lines.append(self._lines.popleft())
        return lines


# Optional methods of a detector, called through the wrappers around it. Pure.


_LONGEST: Final = 160


class DetectorWrapper:
    """Base class of combinators: one inner detector."""

    def __init__(self, inner: Detector) -> None:
        self.inner = inner

    def attach(self, link: Link) -> None:
        """Pass a robot's link to the inner detector."""
        attach_detector(self.inner, link)

    def notices(self) -> list[str]:
        """Return the lines of the inner detector."""
        return notices_of(self.inner)

    @property
    def labels(self) -> Sequence[str]:
        """Return the labels of the inner detector."""
        return labels_of(self.inner)

    @property
    def maker(self) -> Maker | None:
        """Return the maker of the results, if the inner detector provides it."""
        return maker_of(self.inner)

    def close(self) -> None:
        """Close the inner detector."""
        close_detector(self.inner)


def attach_detector(detector: Any, link: Link) -> None:
    """Pass a robot's link, before its first frame, to a detector that has `attach`."""
    attach: Callable[[Link], None] | None = getattr(detector, "attach", None)
    if attach is not None:
        with plugin_guard("the detector's attach()"):
            attach(link)


def notices_of(detector: Any) -> list[str]:
    """Return the detector's lines for the operator since the last call, or a line about its error."""
    notices: Callable[[], list[str]] | None = getattr(detector, "notices", getattr(detector, OLD_NOTICES, None))
    if notices is None:
        return []
    try:
        return [" ".join(str(line).split()) for line in notices()]
    except PLUGIN_ERRORS as error:  # a detector with broken notices may still detect well
        report_fault("detector", error)
        return [_raises("the detector's notices()", error)]


def labels_of(detector: Any) -> Sequence[str]:
    """Return all labels that a detector can give; empty if they are unknown."""
    with plugin_guard("the detector's labels"):
        labels: object = getattr(detector, "labels", None) or ()
        if isinstance(labels, str) or not isinstance(labels, Iterable):
            raise TypeError(f"{labels!r} is not a sequence of texts")
        return tuple(map(str, labels))


def maker_of(detector: Any) -> Maker | None:
    """Return the maker of its results, if it is known before the first result."""
    maker: Maker | None = getattr(detector, "maker", None)
    return maker


def close_detector(detector: Any) -> None:
    """Close a detector that has `close`."""
    close: Callable[[], None] | None = getattr(detector, "close", None)
    if close is not None:
        with plugin_guard("the detector's close()"):
            close()


@contextmanager
def plugin_guard(what: str) -> Iterator[None]:
    """Turn any error of a plug-in into a ConfigError that names the plug-in."""
    try:
        yield
    except SightlineError:
        raise
    except PLUGIN_ERRORS as error:
        report_ending("detector", error)
        raise ConfigError(f"{_raises(what, error)}; fix the plug-in") from error


def _raises(what: str, error: BaseException) -> str:
    return f"{what} raises {type(error).__name__}: {error_text(error)}"[:_LONGEST]


# Validates the result of a detector: right frame, finite numbers, boxes in the image, not too many. Pure.
#
# The detector may be a plug-in or another machine. A mission receives only validated results.


_LONGEST_WHY: Final = 160
NO_ANSWER_IN_TIME: Final = "the detector gave no answer in time"
_FURTHEST_PX: Final = 1e6
"""The limit of any coordinate on the wire."""


def checked_results(
    detector: Detector, frames: Sequence[DetectFrame], deadline_us: int, clock: Callable[[], int] = lambda: 0
) -> list[DetectionResult | str]:
    """Return the result of `detector` for each frame, or the reason for none. Raises nothing, even for a bad plug-in.

    After an error with several frames it gets them one by one, until `clock` is past the deadline.
    """
    try:
        results = detector.detect(frames, deadline_us)
        if len(results) != len(frames):
            raise ValueError(f"{len(results)} results for {len(frames)} frames")
    except PLUGIN_ERRORS as error:
        report_fault("detector", error)
        if len(frames) > 1:  # the frame with the error is unknown, and other robots should get their answers
            why = _why(error)
            return [
                why if clock() > deadline_us else checked_results(detector, [one], deadline_us)[0] for one in frames
            ]
        return [_why(error)] * len(frames)
    return [_answer(frame, result) for frame, result in zip(frames, results, strict=True)]


def _answer(frame: DetectFrame, result: DetectionResult | None) -> DetectionResult | str:
    try:
        return validated(frame, result) if result is not None else NO_ANSWER_IN_TIME
    except Exception as error:  # the result may be any object
        report_fault("detector", error)
        return _why(error)


def _why(error: BaseException) -> str:
    return f"invalid answer of the detector: {type(error).__name__}: {error_text(error)}"[:_LONGEST_WHY]


def validated(frame: DetectFrame, result: DetectionResult) -> DetectionResult:
    """Return `result` with boxes clipped to the image, without boxes outside, and with integer microseconds.

    Raises ValueError, with the reason, for an invalid answer to `frame`.
    """
    header, named = frame.header, (result.robot, result.session, result.seq, result.t_us)
    if named != (frame.robot, header.session, header.seq, header.t_us):
        raise ValueError("it answers another frame")
    if (result.width_px, result.height_px) != (frame.width_px, frame.height_px):
        raise ValueError(f"it is for a {result.width_px}x{result.height_px} image")
    found = result.detections
    if len(found) > MAX_DETECTED_BOXES:  # limit of the wire; only the detector knows which boxes are the best
        raise ValueError(f"{len(found)} boxes; at most {MAX_DETECTED_BOXES}")
    repaired = _repaired_maker(result)
    inside = tuple(part for one in found if (part := _validated(one, frame.width_px, frame.height_px)))
    unchanged = len(found) == len(inside) and all(one is part for one, part in zip(found, inside, strict=True))
    if unchanged and not repaired:
        return result
    return replace(result, detections=inside, **repaired)


def _repaired_maker(result: DetectionResult) -> dict[str, Any]:
    """Return changed fields of the maker and the time: printable text, integer microseconds. A plug-in may use any
    file name and any number type."""
    repaired: dict[str, Any] = {}
    for what in ("detector", "model_hash", "device"):
        text = getattr(result, what)
        if not isinstance(text, str):
            raise ValueError(f"invalid {what} {text!r}: not text")
        if not text.isprintable():
            repaired[what] = printable(text)
    took_us = result.compute_us
    if type(took_us) is int and 0 <= took_us <= MAX_INTEGER:
        return repaired
    if not isinstance(took_us, Real) or math.isnan(took_us):
        raise ValueError(f"it took {took_us!r} microseconds")
    return repaired | {"compute_us": int(min(max(took_us, 0), MAX_INTEGER))}


def _validated(one: Detection, width_px: int, height_px: int) -> Detection | None:
    if not all(map(math.isfinite, (one.x1_px, one.y1_px, one.x2_px, one.y2_px, one.score))):
        raise ValueError("a box or score is nan or infinite")
    if not 0 <= one.score <= 1:
        raise ValueError(f"invalid score {one.score:g}: not between 0 and 1")
    wrong = annotation_problem(one)
    if wrong:
        raise ValueError(wrong)
    if one.track_id is not None:  # any integer type, e.g. of NumPy
        one = replace(one, track_id=index(one.track_id))
    return clipped(one, width_px, height_px)


def annotation_problem(one: Detection) -> str:
    """Return why the wire cannot carry label, circle or track id, or ""."""
    label: object = one.label
    if not isinstance(label, str):  # e.g. a class number
        return f"invalid label {label!r}: not text"[:_LONGEST_WHY]
    if not is_label(one.label):
        return f"invalid label {one.label[:20]!r}, {len(one.label)} characters: not 1 to {LONGEST_LABEL} printable ones"
    if one.circle is not None and not _is_circle(one.circle):
        return f"a circle at ({one.circle.cx_px:g}, {one.circle.cy_px:g}) with a radius of {one.circle.radius_px:g}"
    track_id: object = one.track_id
    if track_id is not None and not (isinstance(track_id, SupportsIndex) and 0 <= index(track_id) <= MAX_INTEGER):
        return f"a track number {track_id}; expected an integer from 0"[:_LONGEST_WHY]
    return ""


def _is_circle(circle: Circle) -> bool:
    """Return True if the wire accepts the circle."""
    return (abs(circle.cx_px) <= _FURTHEST_PX and abs(circle.cy_px) <= _FURTHEST_PX
            and 0 < circle.radius_px <= _FURTHEST_PX)
