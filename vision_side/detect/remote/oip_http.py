"""`oip+http://HOST/MODEL`: a model of an inference server (Triton, OpenVINO Model Server) over HTTP. Shell."""

from sightline.vision_side.detect.port import DetectFrame, Maker
from sightline.vision_side.detect.remote.client import Address, parse_address
from sightline.vision_side.detect.remote.asking import REMOTE, ServerAnswer, ServerDetector
from sightline.vision_side.detect.remote.deadline import DeadlineDetector
from sightline.vision_side.detect.remote.http_client import HttpExchange
from sightline.vision_side.detect.remote.oip import OipModel, OutputOptions, detections_of, tensor_of
from sightline.vision_side.detect.remote.oip_json import HEADER_LENGTH, infer_body, read_infer, read_metadata
from sightline.vision_side.detect.remote.oip_settings import OipSettings
from sightline.vision_side.detect.remote.refusing import NoAnswerError, NoAnswerReason


class HttpServer:
    """A `Server`. What the model is like is asked once, and again after every error but lateness and every
    connection that the server ended."""

    def __init__(self, address: Address, looking: OutputOptions) -> None:
        self._http = HttpExchange(address.host, address.port)
        version = f"/versions/{address.version}" if address.version else ""
        self._path = f"/v2/models/{address.model}{version}"
        self._looking = looking
        self._scheme = address.scheme
        self._model: OipModel | None = None
        self._asked_at = 0
        """Connections that were lost when the model was asked for."""

    def ask(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        """As `Server` says."""
        try:
            return self._answer(frame, until_us)
        except NoAnswerError as error:
            if error.reason is not NoAnswerReason.LATE:  # to ask anew would make the next answer later still
                self._model = None
            raise

    def _answer(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        model = self._known_model(until_us)
        tensor, stretch = tensor_of(model, frame, self._looking.rgb)
        number = f"{frame.header.session}-{frame.header.seq}"
        length, body = infer_body(model, tensor, number)
        reply = self._http.post(f"{self._path}/infer", {HEADER_LENGTH: str(length)}, body, until_us)
        answer = read_infer(reply.body, reply.headers.get(HEADER_LENGTH.lower()), number)
        found = detections_of(answer, self._looking, stretch, (frame.width_px, frame.height_px))
        return ServerAnswer(found, Maker(model.title(self._scheme, answer.version), device=REMOTE))

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()

    def _known_model(self, until_us: int) -> OipModel:
        if self._model is None or self._asked_at != self._http.lost:
            self._model = read_metadata(self._http.get(self._path, until_us).body)
            self._asked_at = self._http.lost
        return self._model


class OipHttp(DeadlineDetector):
    """The detector `oip+http://HOST[:PORT]/MODEL[/VERSION]`."""

    Config = OipSettings

    def __init__(self, config: OipSettings) -> None:
        """Raises ConfigError for an address that is none. Nothing is connected before the first frame."""
        server = HttpServer(parse_address(config.address), config.looking())
        super().__init__(ServerDetector(config.address, server), config.max_pixels)
