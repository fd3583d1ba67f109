"""`zenoh`: a detector service on another machine that receives the robot's own frames. Shell.

    sightline detector --serve onnx:ball.onnx --connect tcp/192.168.1.20:7447
    sightline vision --detector zenoh --connect tcp/192.168.1.20:7447

This side sends nothing: robot and service find each other. It waits, until the deadline, for boxes that cite the frame.

Of several services this side prefers the service of the last used boxes. Boxes of another service with the same model
replace missing ones, because the preferred service may have ended or passed this robot to another service.
"""

from dataclasses import dataclass
from typing import ClassVar, Final

from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import WireError
from sightline.protocol.messages import Detections, DetectionsHeader, Source
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.vision_side.config import Fraction
from sightline.vision_side.detect.port import DetectFrame, DetectionResult, Maker, clean_label, result_of
from sightline.vision_side.detect.remote.client import (
    MIN_SCORE,
    REMOTE,
    FrameByFrame,
    NoAnswerError,
    NoAnswerReason,
    hash_of,
    read_boxes,
    seconds_left,
)

ROLE: Final = "detector"
"""The source name of a detector service."""
_NEWER_US: Final = 1_000_000
"""Boxes of a frame that is newer than the request by up to this are stored for it. A frame from further in the future
may never arrive, and one such message would block all others."""
_SILENT_US: Final = 500_000
"""After this silence the service is gone. Any other service replaces it, also with another model."""
_FIRST_RIGHT: Final = 0.5
"""Share of the remaining time for boxes of the preferred service, after those of another service have arrived."""
_MANY: Final = 10
"""Boxes of a second service before it is reported. While a robot changes services, both answer for a moment."""


class _RobotDetections:
    """The newest boxes of one robot's frames, with a preferred service.

    Labels of two models, and ids of two trackers, are not comparable. So boxes of another service count only with the
    same model, when the boxes of the preferred service are missing, or after a longer silence.
    """

    def __init__(self, link: Link, source: str) -> None:
        self._source = source
        self._slot: LatestSlot[tuple[str, Message]] = LatestSlot()
        self._has_preferred = False
        """True while boxes of the preferred service are in the slot."""
        self._session, self._received_us = "", 0
        self._maker: tuple[str, str] = ("", "")
        self.missed = False
        """True if the preferred service did not answer the last request."""
        self.others = 0
        """Number of boxes of other services than the preferred one."""
        self.kept: Message | None = None
        """Boxes of a frame that is not requested yet."""
        self.reported = False
        """True after the report of several services."""
        link.subscribe(DETECTIONS, self._put)

    def take(self, wait_s: float) -> tuple[Message, bool] | None:
        """Take the newest boxes.

        Returns:
            The message, and True if it is of another service than the preferred one; None if none came in time.
        """
        if self.kept is not None:
            message, self.kept = self.kept, None
            return message, self._is_other(_session_of(message))
        taken = self._slot.take(wait_s)
        self._has_preferred = False
        return (taken[1], self._is_other(taken[0])) if taken else None

    def prefer(self, session: str, result: DetectionResult) -> None:
        """Prefer a service after valid boxes. Invalid boxes must not exclude other services."""
        if session != self._session:
            self.others = 0
        self._session, self._received_us = session, monotonic_us()
        self._maker, self.missed = _model_of(result), False

    def may_replace(self, result: DetectionResult) -> bool:
        """Return True if boxes of another service may replace missing ones of the preferred service."""
        return _model_of(result) == self._maker or monotonic_us() - self._received_us > _SILENT_US

    def _put(self, item: Message) -> None:
        """Drop boxes of other sources. Unreadable boxes pass, because `detect` counts them."""
        if item.source != self._source:
            return
        session = _session_of(item)
        if self._is_other(session):
            self.others += 1
            if self._has_preferred:
                return
        else:
            self._has_preferred, self._received_us = True, monotonic_us()
        self._slot.put((session, item))

    def _is_other(self, session: str) -> bool:
        return bool(session and self._session and session != self._session)


def _session_of(message: Message) -> str:
    """Return the session of the service that sent the boxes, or "" if they cannot be read."""
    try:
        return decode(DetectionsHeader, message.header).session
    except WireError:
        return ""


def _model_of(result: DetectionResult) -> tuple[str, str]:
    return result.detector, result.model_hash


class ZenohDetector(FrameByFrame):
    """The detector `zenoh`: waits for boxes of one source on the links from vision to its robots."""

    waits: ClassVar[bool] = True
    only_receives: ClassVar[bool] = True

    class Config(Settings):
        """The source of the boxes, and their least score."""

        source: Source = ROLE
        min_score: Fraction = MIN_SCORE

    def __init__(self, config: Config) -> None:
        super().__init__(f"zenoh ({config.source})")
        self._config = config
        self._received: dict[str, _RobotDetections] = {}

    def attach(self, link: Link) -> None:
        """Receive the boxes of a robot's frames."""
        self._received[link.robot] = _RobotDetections(link, self._config.source)

    def _request(self, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        return self._wait(self._of(frame.robot), frame, deadline_us)

    def _of(self, robot: str) -> _RobotDetections:
        if robot not in self._received:
            raise NoAnswerError(
                NoAnswerReason.UNREACHABLE, f"there is no link to robot {robot}: it works in a vision service only"
            )
        return self._received[robot]

    def _wait(self, received: _RobotDetections, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        """Wait for boxes that cite `frame`. Raises NoAnswerError at the deadline, or after boxes of a newer frame."""
        second: _Answer | None = None
        until_us = deadline_us
        self._note_second(received, frame.robot)
        while (taken := received.take(seconds_left(until_us))) is not None:
            message, is_other = taken
            answer = self._read(message, frame, is_other)
            if answer is None or (is_other and not received.may_replace(answer.result)):
                continue
            if not is_other or received.missed:
                return _used(received, answer)
            if second is None:
                until_us = monotonic_us() + round(_FIRST_RIGHT * max(0, deadline_us - monotonic_us()))
            if second is None or not answer.is_newer:
                second = answer
        received.missed = True
        if second is not None:
            return _used(received, second)
        raise NoAnswerError(NoAnswerReason.LATE, f"no boxes from {self._config.source} by the deadline; does it run?")

    def _read(self, message: Message, frame: DetectFrame, is_other: bool) -> "_Answer | None":
        """Return the boxes, or None for boxes of another frame.

        Raises NoAnswerError for invalid boxes of the preferred service. Other invalid boxes are only counted, because
        the wait for valid boxes must continue.
        """
        cited = False
        try:
            header, ahead = _cites(message, frame)
            if ahead < 0:  # already counted as late for that frame
                return None
            cited = True
            return _Answer(message, header.session, ahead > 0, _result(message, header, frame, self._config.min_score))
        except NoAnswerError as error:
            if cited and not is_other:
                raise
            self._error_counters.reject(error)
            return None

    def _note_second(self, received: _RobotDetections, robot: str) -> None:
        if received.others >= _MANY and not received.reported:
            received.reported = True
            self._error_counters.notices.add(
                f"detector zenoh ({self._config.source}): several services look at robot {robot}; the first is used. "
                "Start them with --share, end the others, or divide the robots among them with --robot"
            )


@dataclass(frozen=True, slots=True)
class _Answer:
    """Valid boxes of the requested frame, or of a newer one."""

    message: Message
    session: str
    is_newer: bool
    result: DetectionResult


def _used(received: _RobotDetections, answer: _Answer) -> DetectionResult:
    """Return the result, and prefer its service. Raises NoAnswerError for boxes of a newer frame, which are kept."""
    received.prefer(answer.session, answer.result)
    if answer.is_newer:
        received.kept = answer.message
        raise NoAnswerError(NoAnswerReason.OTHER_FRAME, "it looked at a newer frame instead")
    return answer.result


def _cites(message: Message, frame: DetectFrame) -> tuple[DetectionsHeader, int]:
    """Return the header of the boxes, and how many frames after `frame` their frame is; negative: before. Raises
    NoAnswerError for an unrelated frame."""
    try:
        header = decode(DetectionsHeader, message.header)
    except WireError as error:
        raise NoAnswerError(NoAnswerReason.MALFORMED, error.detail) from None
    echo, wanted = header.echo, frame.header
    if header.source != message.source or echo is None or echo.channel != FRAME.name or echo.session != wanted.session:
        raise NoAnswerError(
            NoAnswerReason.OTHER_FRAME, "boxes of another session than this robot's, or under a false source"
        )
    ahead = echo.seq - wanted.seq
    is_newer = ahead > 0 and wanted.t_us < echo.t_us <= wanted.t_us + _NEWER_US
    is_older = ahead < 0 and echo.t_us < wanted.t_us
    if not (is_newer or is_older or (echo.seq, echo.t_us) == (wanted.seq, wanted.t_us)):
        raise NoAnswerError(NoAnswerReason.OTHER_FRAME, f"boxes of frame {echo.seq}, not {wanted.seq}")
    return header, ahead


def _result(message: Message, header: DetectionsHeader, frame: DetectFrame, min_score: float) -> DetectionResult:
    try:
        found = decode(Detections, message.payload, DETECTIONS.max_payload_bytes)
    except WireError as error:
        raise NoAnswerError(NoAnswerReason.MALFORMED, error.detail) from None
    size = frame.width_px, frame.height_px
    if (found.width_px, found.height_px) != size:
        raise NoAnswerError(NoAnswerReason.OTHER_SIZE, f"boxes of a {found.width_px}x{found.height_px} image")
    name = clean_label(found.detector) if found.detector else f"zenoh ({header.source})"
    maker = Maker(name, hash_of(found.model), clean_label(found.device) if found.device else REMOTE)
    return result_of(frame, read_boxes(found.boxes, size, min_score), maker, header.compute_us)
