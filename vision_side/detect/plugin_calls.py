"""Calls a detector plug-in safely: optional methods, notices, validated results. Pure."""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from numbers import Real
from typing import Any, Final

from sightline.protocol.config import PLUGIN_ERRORS
from sightline.protocol.errors import ConfigError, SightlineError
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

MAX_NOTICES: Final = 16
"""Lines kept for who asks for them seldom; the oldest go first."""


class Notices:
    """Lines for a person, until somebody takes them; may be added to on another thread."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=MAX_NOTICES)

    def add(self, line: str) -> None:
        """One line."""
        self._lines.append(line)

    def take(self) -> list[str]:
        """All since the last time."""
        lines = []
        while self._lines:
            lines.append(self._lines.popleft())
        return lines


# What a detector may have besides `detect`, asked for through whatever is around it. Pure.


_LONGEST: Final = 160


class DetectorWrapper:
    """The base of combinators: one detector inside."""

    def __init__(self, inner: Detector) -> None:
        self.inner = inner

    def attach(self, link: Link) -> None:
        """Give the one inside a robot's link."""
        attach_detector(self.inner, link)

    def news(self) -> list[str]:
        """What the one inside has to say."""
        return notices_of(self.inner)

    @property
    def maker(self) -> Maker | None:
        """Who the one inside is, if it says."""
        return maker_of(self.inner)

    def close(self) -> None:
        """Close the one inside."""
        close_detector(self.inner)


def attach_detector(detector: Any, link: Link) -> None:
    """Give a detector that hears something else of a robot than frames its link, before the first frame."""
    attach: Callable[[Link], None] | None = getattr(detector, "attach", None)
    if attach is not None:
        with plugin_guard("the detector's attach()"):
            attach(link)


def notices_of(detector: Any) -> list[str]:
    """Lines for a person since the last time; none from a detector that has no `news`. One that raises is told of."""
    news: Callable[[], list[str]] | None = getattr(detector, "news", None)
    if news is None:
        return []
    try:
        return [" ".join(str(line).split()) for line in news()]
    except PLUGIN_ERRORS as error:  # who only talks badly may still see well
        return [_raises("the detector's news()", error)]


def maker_of(detector: Any) -> Maker | None:
    """Who makes its results, where that is known before the first of them."""
    maker: Maker | None = getattr(detector, "maker", None)
    return maker


def close_detector(detector: Any) -> None:
    """Let go of what a detector holds; nothing to do for one that has no `close`."""
    close: Callable[[], None] | None = getattr(detector, "close", None)
    if close is not None:
        with plugin_guard("the detector's close()"):
            close()


@contextmanager
def plugin_guard(what: str) -> Iterator[None]:
    """Whatever a plug-in's own code raises becomes a ConfigError that says whose fault it is."""
    try:
        yield
    except SightlineError:
        raise
    except PLUGIN_ERRORS as error:
        raise ConfigError(f"{_raises(what, error)}; it has to be mended") from error


def _raises(what: str, error: BaseException) -> str:
    return f"{what} raises {type(error).__name__}: {' '.join(str(error).split())}"[:_LONGEST]


# Makes sure that a detector's answer is one: of this frame, finite, within the picture, not too many. Pure.
#
# The detector may be a plug-in or another machine; whatever it says, no more than this gets to a mission.


_LONGEST_WHY: Final = 160
NO_ANSWER_IN_TIME: Final = "the detector gave no answer in time"
_FURTHEST_PX: Final = 1e6
"""As for any number on the wire."""


def checked_results(
    detector: Detector, frames: Sequence[DetectFrame], deadline_us: int, clock: Callable[[], int] = lambda: 0
) -> list[DetectionResult | str]:
    """What `detector` sees in each frame, or why that is no answer; whatever a plug-in does ends here.

    Where it fails on several frames, it is asked about each, as long as `clock` is not past the deadline.
    """
    try:
        results = detector.detect(frames, deadline_us)
        if len(results) != len(frames):
            raise ValueError(f"{len(results)} results for {len(frames)} frames")
    except PLUGIN_ERRORS as error:
        if len(frames) > 1:  # whose frame it failed for is not known, and should cost no other robot its answer
            why = _why(error)
            return [
                why if clock() > deadline_us else checked_results(detector, [one], deadline_us)[0] for one in frames
            ]
        return [_why(error)] * len(frames)
    return [_answer(frame, result) for frame, result in zip(frames, results, strict=True)]


def _answer(frame: DetectFrame, result: DetectionResult | None) -> DetectionResult | str:
    try:
        return validated(frame, result) if result is not None else NO_ANSWER_IN_TIME
    except Exception as error:  # of what may be no result at all
        return _why(error)


def _why(error: BaseException) -> str:
    why = " ".join(f"the detector's answer is none: {type(error).__name__}: {error}".split())
    return _printable(why[:_LONGEST_WHY])


def validated(frame: DetectFrame, result: DetectionResult) -> DetectionResult:
    """`result` with its boxes clipped to the picture, those outside of it left out, its time in whole microseconds.

    Raises ValueError, with the reason, for what is no answer to `frame`.
    """
    header, named = frame.header, (result.robot, result.session, result.seq, result.t_us)
    if named != (frame.robot, header.session, header.seq, header.t_us):
        raise ValueError("it answers another frame")
    if (result.width_px, result.height_px) != (frame.width_px, frame.height_px):
        raise ValueError(f"it is about a {result.width_px}x{result.height_px} picture")
    found = result.detections
    if len(found) > MAX_DETECTED_BOXES:  # the wire's own bound: which of more are the best is for the detector to say
        raise ValueError(f"{len(found)} boxes; {MAX_DETECTED_BOXES} is the most")
    mended = _repaired_maker(result)
    inside = tuple(part for one in found if (part := _validated(one, frame.width_px, frame.height_px)))
    unchanged = len(found) == len(inside) and all(one is part for one, part in zip(found, inside, strict=True))
    if unchanged and not mended:
        return result
    return replace(result, detections=inside, **mended)


def _repaired_maker(result: DetectionResult) -> dict[str, Any]:
    """What is to be said otherwise of who looked, and for how long: printable, and in whole microseconds. A plug-in may
    be called after any file, and count in any kind of number."""
    mended: dict[str, Any] = {}
    for what in ("detector", "model_hash", "device"):
        text = getattr(result, what)
        if not isinstance(text, str):
            raise ValueError(f"its {what} is {text!r}, which is no text")
        if not text.isprintable():
            mended[what] = _printable(text)
    took_us = result.compute_us
    if type(took_us) is int and 0 <= took_us <= MAX_INTEGER:
        return mended
    if not isinstance(took_us, Real) or math.isnan(took_us):
        raise ValueError(f"it took {took_us!r} microseconds")
    return mended | {"compute_us": int(min(max(took_us, 0), MAX_INTEGER))}


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _validated(one: Detection, width_px: int, height_px: int) -> Detection | None:
    if not all(map(math.isfinite, (one.x1_px, one.y1_px, one.x2_px, one.y2_px, one.score))):
        raise ValueError("a box with a number that is none")
    if not 0 <= one.score <= 1:
        raise ValueError(f"a score of {one.score:g}; it is between 0 and 1")
    wrong = annotation_problem(one)
    if wrong:
        raise ValueError(wrong)
    return clipped(one, width_px, height_px)


def annotation_problem(one: Detection) -> str:
    """What is wrong with its label, circle or track, which nobody could be told of; empty if nothing is."""
    if not is_label(one.label):
        return f"a label {one.label[:20]!r} of {len(one.label)} characters; it is 1 to {LONGEST_LABEL} printable ones"
    if one.circle is not None and not _is_circle(one.circle):
        return f"a circle at ({one.circle.cx_px:g}, {one.circle.cy_px:g}) with a radius of {one.circle.radius_px:g}"
    if one.track_id is not None and not 0 <= one.track_id <= MAX_INTEGER:
        return f"a track number {one.track_id}"[:_LONGEST_WHY]
    return ""


def _is_circle(circle: Circle) -> bool:
    """Whether the wire can say it."""
    return (abs(circle.cx_px) <= _FURTHEST_PX and abs(circle.cy_px) <= _FURTHEST_PX
            and 0 < circle.radius_px <= _FURTHEST_PX)
