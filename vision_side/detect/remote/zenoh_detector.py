"""`zenoh`: a detector service on another machine that looks at the robot's own frames. Shell.

    sightline detector --serve onnx:ball.onnx --connect tcp/192.168.1.20:7447
    sightline vision --detector zenoh --connect tcp/192.168.1.20:7447

Nothing is sent: robot and service find each other. This end waits, until the deadline, for boxes that cite the frame.
"""

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
"""The source under which a detector service publishes."""
_NEWER_US: Final = 1_000_000
"""Boxes of a frame that is newer than the requested one by up to this are kept for it. A frame that claims to be from
later may never come, and one such message would stand in the way of all others."""
_SILENT_US: Final = 500_000
"""A service that is silent for so long is gone; another one of its name takes its place."""


class _SourceSlot(LatestSlot[Message]):
    """The newest boxes of one source, and of one service while several speak as that: what one of them tracks or calls
    a thing is nothing to the other."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self._source = source
        self._session, self._received_us = "", 0
        self.others = 0
        """Boxes of other services than the preferred one."""

    def put(self, item: Message) -> None:
        """Drop the boxes of other sources and services. Boxes that cannot be read pass: `detect` counts them."""
        if item.source == self._source and self._is_preferred(item):
            super().put(item)

    def prefer(self, session: str) -> None:
        """Drop the boxes of other services than `session`, whose boxes were valid: only such exclude others."""
        self._session, self._received_us = session, monotonic_us()

    def _is_preferred(self, item: Message) -> bool:
        try:
            session = decode(DetectionsHeader, item.header).session
        except WireError:
            return True
        now_us = monotonic_us()
        if session == self._session:
            self._received_us = now_us
        elif self._session and now_us - self._received_us <= _SILENT_US:
            self.others += 1
            return False
        return True


class _RobotDetections:
    """Boxes received of one robot's frames."""

    def __init__(self, link: Link, source: str) -> None:
        self.slot = _SourceSlot(source)
        self.kept: Message | None = None
        """Boxes of a frame that was not requested yet."""
        self.reported = False
        """True once it was reported that there are several services."""
        link.subscribe(DETECTIONS, self.slot.put)

    def take(self, wait_s: float) -> Message | None:
        """Take the newest boxes."""
        message, self.kept = self.kept or self.slot.take(wait_s), None
        return message


class ZenohDetector(FrameByFrame):
    """The detector `zenoh`: waits for one source's boxes on the links that vision has to its robots."""

    waits: ClassVar[bool] = True
    only_receives: ClassVar[bool] = True

    class Config(Settings):
        """The source of the boxes, and which of them count."""

        source: Source = ROLE
        min_score: Fraction = MIN_SCORE

    def __init__(self, config: Config) -> None:
        super().__init__(f"zenoh ({config.source})")
        self._config = config
        self._received: dict[str, _RobotDetections] = {}

    def attach(self, link: Link) -> None:
        """Receive the boxes of its robot's frames."""
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
        while True:
            message = received.take(seconds_left(deadline_us))
            if received.slot.others and not received.reported:
                received.reported = True
                self._error_counters.notices.add(f"detector zenoh ({self._config.source}): several services look at "
                                                 f"robot {frame.robot}; the first is used. End the others, or divide "
                                                 "the robots among them with --robot")
            if message is None:
                raise NoAnswerError(
                    NoAnswerReason.LATE, f"no boxes from {self._config.source} by the deadline; does it run?"
                )
            try:
                header, ahead = _cites(message, frame)
            except NoAnswerError as error:
                self._error_counters.reject(error)
                continue
            if ahead < 0:  # counted as late when that frame was requested
                continue
            if ahead > 0:
                received.kept = message
                raise NoAnswerError(NoAnswerReason.OTHER_FRAME, "it looked at a newer frame instead")
            result = _result(message, header, frame, self._config.min_score)
            received.slot.prefer(header.session)
            return result


def _cites(message: Message, frame: DetectFrame) -> tuple[DetectionsHeader, int]:
    """The header of boxes of `frame`, or of one so many frames after it, or before it if negative. Raises NoAnswerError
    for those of any other."""
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
