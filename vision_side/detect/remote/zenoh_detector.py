"""`zenoh`: a detector service on another box, which looks at the robot's own frames and says what it saw. Shell.

    sightline detector --serve onnx:ball.onnx --connect tcp/192.168.1.20:7447
    sightline vision --detector zenoh --connect tcp/192.168.1.20:7447

Nothing is sent: robot and service meet by themselves. Here it is waited, by the deadline, for what cites the frame.
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
"""The source under which a detector service speaks."""
_NEWER_US: Final = 1_000_000
"""Boxes of a frame so much newer than the one asked about are kept for it; of what claims to be from later it may never
come, and one such message would stand in the way of all others."""
_SILENT_US: Final = 500_000
"""A service that says nothing for so long is gone; another one of its name takes its place."""


class _OfSource(LatestSlot[Message]):
    """The newest boxes of one source, and of one service while several speak as that: what one of them tracks or calls
    a thing is nothing to the other."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self._source = source
        self._session, self._heard_us = "", 0
        self.others = 0
        """Boxes of other services than the one that is kept to."""

    def put(self, item: Message) -> None:
        """Others' boxes are for others. What cannot be read goes on, to be counted by who reads it."""
        if item.source == self._source and self._is_kept_to(item):
            super().put(item)

    def keep_to(self, session: str) -> None:
        """Boxes of this one were good: only such a one keeps others out, for who talks nonsense must not."""
        self._session, self._heard_us = session, monotonic_us()

    def _is_kept_to(self, item: Message) -> bool:
        try:
            session = decode(DetectionsHeader, item.header).session
        except WireError:
            return True
        now_us = monotonic_us()
        if session == self._session:
            self._heard_us = now_us
        elif self._session and now_us - self._heard_us <= _SILENT_US:
            self.others += 1
            return False
        return True


class _Heard:
    """What is heard of one robot."""

    def __init__(self, link: Link, source: str) -> None:
        self.slot = _OfSource(source)
        self.kept: Message | None = None
        """Boxes of a frame that was not asked about yet."""
        self.told = False
        """That there are several services."""
        link.subscribe(DETECTIONS, self.slot.put)

    def take(self, wait_s: float) -> Message | None:
        """The newest boxes."""
        message, self.kept = self.kept or self.slot.take(wait_s), None
        return message


class ZenohDetector(FrameByFrame):
    """The detector `zenoh`: waits for one source's boxes on the links that vision has to its robots."""

    waits: ClassVar[bool] = True
    only_hears: ClassVar[bool] = True

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
            raise NoAnswerError(
                NoAnswerReason.UNREACHABLE, f"there is no link to robot {robot}: it works within a vision only"
            )
        return self._heard[robot]

    def _wait(self, heard: _Heard, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        """The boxes that cite `frame`. Raises NoAnswerError if none come by the deadline, or those of a newer one."""
        while True:
            message = heard.take(seconds_left(deadline_us))
            if heard.slot.others and not heard.told:
                heard.told = True
                self._tally.news.add(f"detector zenoh ({self._config.source}): several services look at robot "
                                     f"{frame.robot}; the first is kept to. End the others, or share the robots out "
                                     "among them with --robot")
            if message is None:
                raise NoAnswerError(
                    NoAnswerReason.LATE, f"no boxes from {self._config.source} by the deadline; does it run?"
                )
            try:
                header, ahead = _cites(message, frame)
            except NoAnswerError as error:
                self._tally.refuse(error)
                continue
            if ahead < 0:  # who asked about that one has counted it as late
                continue
            if ahead > 0:
                heard.kept = message
                raise NoAnswerError(NoAnswerReason.OTHER_FRAME, "it looked at a newer frame instead")
            result = _result(message, header, frame, self._config.min_score)
            heard.slot.keep_to(header.session)
            return result


def _cites(message: Message, frame: DetectFrame) -> tuple[DetectionsHeader, int]:
    """The header of boxes of `frame`, or of one so many frames after it, or before it if negative. Raises NoAnswerError
    for those of any other."""
    try:
        header = decode(DetectionsHeader, message.header)
    except WireError as error:
        raise NoAnswerError(NoAnswerReason.MALFORMED, error.detail) from None
    echo, asked = header.echo, frame.header
    if header.source != message.source or echo is None or echo.channel != FRAME.name or echo.session != asked.session:
        raise NoAnswerError(
            NoAnswerReason.OTHER_FRAME, "boxes of no frame of this robot's session, or not of who says so"
        )
    ahead = echo.seq - asked.seq
    is_newer = ahead > 0 and asked.t_us < echo.t_us <= asked.t_us + _NEWER_US
    is_older = ahead < 0 and echo.t_us < asked.t_us
    if not (is_newer or is_older or (echo.seq, echo.t_us) == (asked.seq, asked.t_us)):
        raise NoAnswerError(NoAnswerReason.OTHER_FRAME, f"boxes of frame {echo.seq}, asked about is {asked.seq}")
    return header, ahead


def _result(message: Message, header: DetectionsHeader, frame: DetectFrame, min_score: float) -> DetectionResult:
    try:
        said = decode(Detections, message.payload, DETECTIONS.max_payload_bytes)
    except WireError as error:
        raise NoAnswerError(NoAnswerReason.MALFORMED, error.detail) from None
    size = frame.width_px, frame.height_px
    if (said.width_px, said.height_px) != size:
        raise NoAnswerError(NoAnswerReason.OTHER_SIZE, f"boxes of a {said.width_px}x{said.height_px} picture")
    name = clean_label(said.detector) if said.detector else f"zenoh ({header.source})"
    maker = Maker(name, hash_of(said.model), clean_label(said.device) if said.device else REMOTE)
    return result_of(frame, read_boxes(said.boxes, size, min_score), maker, header.compute_us)
