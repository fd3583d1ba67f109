"""A detector that asks a server about one frame after the other. Shell (the clock, for how long it took)."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Maker, result_of
from sightline.vision_side.detect.remote.refusing import ErrorCounters, NoAnswerError, NoAnswerReason

REMOTE: Final = "remote"
"""What a result was made on, where the server does not say."""
LONGEST_WAIT_S: Final = 2.0
"""For an answer, whatever the deadline: twice the longest that can be configured."""


@dataclass(frozen=True, slots=True)
class ServerAnswer:
    """What a server said of one frame, checked, and who said it."""

    detections: tuple[Detection, ...]
    maker: Maker


class Server(Protocol):
    """How one kind of server is asked."""

    def ask(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        """Its answer; blocks until about `until_us`. Raises NoAnswerError for everything else."""
        ...

    def close(self) -> None:
        """Let go of its connection."""
        ...


class FrameByFrame(ABC):
    """A `Detector` that asks elsewhere about one frame after the other, and counts what it refused."""

    def __init__(self, name: str) -> None:
        self._tally = ErrorCounters(name)

    @property
    def refused(self) -> Counter[str]:
        """What was refused so far, by reason."""
        return self._tally.refused

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """As the port says."""
        return [self._one(frame, deadline_us) for frame in frames]

    def _one(self, frame: DetectFrame, deadline_us: int) -> DetectionResult | None:
        try:
            result = self._ask(frame, deadline_us)
        except NoAnswerError as error:
            self._tally.refuse(error)
            return None
        self._tally.good()
        return result

    @abstractmethod
    def _ask(self, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        """What is seen in `frame`. Raises NoAnswerError."""

    def news(self) -> list[str]:
        """What a person may want to know, since the last time."""
        return self._tally.news.take()


class ServerDetector(FrameByFrame):
    """Over one server. It may block for longer than the deadline: see `ByDeadline` for who must not."""

    def __init__(self, name: str, server: Server) -> None:
        super().__init__(name)
        self._server = server

    def close(self) -> None:
        """Let go of the server."""
        self._server.close()

    def _ask(self, frame: DetectFrame, deadline_us: int) -> DetectionResult:
        began_us = monotonic_us()
        _check_picture(frame)
        try:
            answer = self._server.ask(frame, deadline_us)
        except WireError as error:  # of pixels that were asked for
            raise NoAnswerError(NoAnswerReason.BAD_PICTURE, error.detail) from None
        ended_us = monotonic_us()
        if ended_us > deadline_us:
            raise NoAnswerError(NoAnswerReason.LATE, f"{(ended_us - deadline_us) / 1000:.0f} ms after the deadline")
        return result_of(frame, answer.detections, answer.maker, ended_us - began_us)


def _check_picture(frame: DetectFrame) -> None:
    """Bytes go on undecoded, so that they are a picture of the right size is seen from their head alone."""
    try:
        size = read_jpeg_size(frame.jpeg, frame.width_px * frame.height_px)
    except WireError as error:
        raise NoAnswerError(NoAnswerReason.BAD_PICTURE, error.detail) from None
    if (size.width_px, size.height_px) != (frame.width_px, frame.height_px):
        raise NoAnswerError(NoAnswerReason.BAD_PICTURE, f"the frame is {size.width_px}x{size.height_px}")


def seconds_left(until_us: int) -> float:
    """What is left until then, 0 if nothing is; bounded for who has no deadline."""
    return min(max(0, until_us - monotonic_us()) / 1e6, LONGEST_WAIT_S)
