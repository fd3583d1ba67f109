"""`http+jpeg://HOST/PATH`: POST a JPEG, JSON back. For Ray Serve, BentoML, FastAPI and whatever serves HTTP. Shell.

The answer is what the wire's channel `detections` carries: `{"width_px", "height_px", "boxes": [{"label", "score",
"x1_px", "y1_px", "x2_px", "y2_px"}]}`, and may add `model_hash`, and `session` and `seq` of the frame, which came as
headers.
"""

from typing import Annotated, Final

from pydantic import Field

from sightline.protocol.codec import decode
from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import WireError
from sightline.protocol.messages import Counter, Detections, SessionId
from sightline.protocol.refusals import RejectReason
from sightline.vision_side.config import Fraction
from sightline.vision_side.detect.labels import clean_label
from sightline.vision_side.detect.port import DetectFrame, Maker
from sightline.vision_side.detect.remote.client import Address, parse_address
from sightline.vision_side.detect.remote.asking import REMOTE, ServerAnswer, ServerDetector
from sightline.vision_side.detect.remote.boxes_read import MIN_SCORE, hash_of, read_boxes
from sightline.vision_side.detect.remote.deadline import MAX_PIXELS, DeadlineDetector, PixelBound
from sightline.vision_side.detect.remote.http_client import MAX_ANSWER_BYTES, HttpExchange
from sightline.vision_side.detect.remote.refusing import NoAnswerError, NoAnswerReason

SESSION, SEQ = "X-Sightline-Session", "X-Sightline-Seq"
"""Headers that name the frame, for servers that log or that answer out of order."""
_REASONS: Final = {RejectReason.NOT_FINITE: NoAnswerReason.NOT_FINITE}


class JpegAnswer(Detections):
    """What a server answers."""

    session: SessionId | None = None
    seq: Counter | None = None
    model_hash: Annotated[str, Field(max_length=64)] = ""


class JpegServer:
    """A `Server`."""

    def __init__(self, address: Address, min_score: float) -> None:
        self._http = HttpExchange(address.host, address.port)
        self._path, self._min_score = address.path, min_score
        self._name = f"{address.scheme}:{address.path}"[:64]

    def ask(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        """As `Server` says."""
        named = {"Content-Type": "image/jpeg", SESSION: frame.header.session, SEQ: str(frame.header.seq)}
        body = self._http.post(self._path, named, frame.jpeg, until_us).body
        said = read_jpeg_answer(body, frame)
        found = read_boxes(said.boxes, (frame.width_px, frame.height_px), self._min_score)
        device = clean_label(said.device) if said.device else REMOTE
        name = clean_label(said.detector) if said.detector else self._name
        return ServerAnswer(found, Maker(name, hash_of(said.model_hash or said.model), device))

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()


class HttpJpeg(DeadlineDetector):
    """The detector `http+jpeg://HOST[:PORT]/PATH`."""

    class Config(Settings):
        """What is asked where."""

        address: str
        min_score: Fraction = MIN_SCORE
        max_pixels: PixelBound = MAX_PIXELS

    def __init__(self, config: Config) -> None:
        """Raises ConfigError for an address that is none. Nothing is connected before the first frame."""
        address = parse_address(config.address)
        server = JpegServer(address, config.min_score)
        super().__init__(ServerDetector(config.address, server), config.max_pixels)


def read_jpeg_answer(body: bytes, frame: DetectFrame) -> JpegAnswer:
    """The answer for `frame`. Raises NoAnswerError for anything else."""
    try:
        said = decode(JpegAnswer, body, MAX_ANSWER_BYTES)
    except WireError as error:
        reason = NoAnswerReason.TOO_MANY if "at most 64 items" in error.detail else _reason(error)
        raise NoAnswerError(reason, error.detail) from None
    if said.session not in (None, frame.header.session) or said.seq not in (None, frame.header.seq):
        raise NoAnswerError(NoAnswerReason.OTHER_FRAME, f"it answers frame {said.seq} of {said.session}")
    if (said.width_px, said.height_px) != (frame.width_px, frame.height_px):
        raise NoAnswerError(NoAnswerReason.OTHER_SIZE, f"boxes of a {said.width_px}x{said.height_px} picture, the frame is "
                                          f"{frame.width_px}x{frame.height_px}")
    return said


def _reason(error: WireError) -> NoAnswerReason:
    return NoAnswerReason.NOT_FINITE if "finite number" in error.detail else _REASONS.get(error.reason, NoAnswerReason.MALFORMED)
