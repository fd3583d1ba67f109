"""`zenoh`: a detector service on another box, which looks at the robot's own frames and says what it saw. Shell.

    sightline detector --serve onnx:ball.onnx --connect tcp/192.168.1.20:7447
    sightline vision --detector zenoh --connect tcp/192.168.1.20:7447

Nothing is sent: robot and service meet by themselves. Here it is waited, by the deadline, for what cites the frame.
"""

from typing import ClassVar, Final

from protocol.channels import DETECTIONS, FRAME
from protocol.codec import decode
from protocol.config import Config as Settings
from protocol.errors import WireError
from protocol.messages import Detections, DetectionsHeader, Source
from protocol.transports.link import LatestSlot, Link, Message
from vision_side.config import Fraction
from vision_side.detect.labels import clean_label
from vision_side.detect.port import DetectFrame, DetectionResult, Maker, result_of
from vision_side.detect.remote.asking import REMOTE, FrameByFrame, left_s
from vision_side.detect.remote.boxes_read import MIN_SCORE, hash_of, read_boxes
from vision_side.detect.remote.refusing import NoAnswerError, Reason

ROLE: Final = "detector"
"""The source under which a detector service speaks."""
_NEWER_US: Final = 1_000_000
"""Boxes of a frame so much newer than the one asked about are kept for it; of what claims to be from later it may never
come, and one such message would stand in the way of all others."""


class _OfSource(LatestSlot[Message]):
    """The newest boxes of one source."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self._source = source

    def put(self, item: Message) -> None:
        """Others' boxes are for others."""
        if item.source == self._source:
            super().put(item)


class _Heard:
    """What is heard of one robot."""

    def __init__(self, link: Link, source: str) -> None:
        self.slot = _OfSource(source)
        self.kept: Message | None = None
        """Boxes of a frame that was not asked about yet."""
        link.subscribe(DETECTIONS, self.slot.put)

    def take(self, wait_s: float) -> Message | None:
        """The newest boxes."""
        message, self.kept = self.kept or self.slot.take(wait_s), None
        return message


class ZenohDetector(FrameByFrame):
    """The detector `zenoh`: waits for one source's boxes on the links that vision has to its robots."""

    waits: ClassVar[bool] = True

    class Config(Settings):
        """Whose boxes."""

        source: Source = ROLE
        min_score: Fraction = MIN_SCORE

    def __init__(self, config: Config) -> None:
        super().__init__(f"zenoh ({config.source})")
        self._config = config
        self._heard: dict[str, _Heard] = {}

    def attach(self, link: Link) -> None:
        """Hear what is said of its robot."""
        self._heard[link.robot] = _Heard(link, self._config.source)

    def _ask(self, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        return self._wait(self._of(frame.robot), frame, deadline_us)

    def _of(self, robot: str) -> _Heard:
        if robot not in self._heard:
            raise NoAnswerError(Reason.UNREACHABLE, f"there is no link to robot {robot}: it works within a vision only")
        return self._heard[robot]

    def _wait(self, heard: _Heard, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        """The boxes that cite `frame`. Raises NoAnswerError if none come by the deadline, or those of a newer one."""
        while True:
            message = heard.take(left_s(deadline_us))
            if message is None:
                raise NoAnswerError(Reason.LATE, f"no boxes from {self._config.source} by the deadline; does it run?")
            try:
                header, newer = _cites(message, frame)
            except NoAnswerError as error:
                self._tally.refuse(error)
                continue
            if newer:
                heard.kept = message
                raise NoAnswerError(Reason.OTHER_FRAME, "it looked at a newer frame instead")
            return _result(message, header, frame, self._config.min_score)


def _cites(message: Message, frame: DetectFrame) -> tuple[DetectionsHeader, bool]:
    """The header of boxes of `frame`, or of a newer one. Raises NoAnswerError for those of any other."""
    try:
        header = decode(DetectionsHeader, message.header)
    except WireError as error:
        raise NoAnswerError(Reason.MALFORMED, error.detail) from None
    echo, asked = header.echo, frame.header
    if header.source != message.source or echo is None or echo.channel != FRAME.name or echo.session != asked.session:
        raise NoAnswerError(Reason.OTHER_FRAME, "boxes of no frame of this robot's session, or not of who says so")
    if echo.seq > asked.seq and asked.t_us < echo.t_us <= asked.t_us + _NEWER_US:
        return header, True
    if (echo.seq, echo.t_us) != (asked.seq, asked.t_us):
        reason = Reason.LATE if echo.seq < asked.seq else Reason.OTHER_FRAME
        raise NoAnswerError(reason, f"boxes of frame {echo.seq}, asked about is {asked.seq}")
    return header, False


def _result(message: Message, header: DetectionsHeader, frame: DetectFrame, min_score: float) -> DetectionResult:
    try:
        said = decode(Detections, message.payload, DETECTIONS.max_payload_bytes)
    except WireError as error:
        raise NoAnswerError(Reason.MALFORMED, error.detail) from None
    size = frame.width_px, frame.height_px
    if (said.width_px, said.height_px) != size:
        raise NoAnswerError(Reason.OTHER_SIZE, f"boxes of a {said.width_px}x{said.height_px} picture")
    name = clean_label(said.detector) if said.detector else f"zenoh ({header.source})"
    maker = Maker(name, hash_of(said.model), clean_label(said.device) if said.device else REMOTE)
    return result_of(frame, read_boxes(said.boxes, size, min_score), maker, header.compute_us)
