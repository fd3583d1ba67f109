"""`oip+grpc://HOST/MODEL`: a model of an inference server over gRPC; needs the extra `grpc`. Shell."""

from importlib.util import find_spec
from typing import Any, Final

from sightline.protocol.errors import ConfigError
from sightline.vision_side.detect.port import DetectFrame, Maker
from sightline.vision_side.detect.remote.client import Address, parse_address
from sightline.vision_side.detect.remote.asking import REMOTE, ServerAnswer, ServerDetector, seconds_left
from sightline.vision_side.detect.remote.deadline import DeadlineDetector
from sightline.vision_side.detect.remote.http_client import MAX_ANSWER_BYTES
from sightline.vision_side.detect.remote.oip import OipModel, OutputOptions, detections_of, tensor_of
from sightline.vision_side.detect.remote.oip_messages import (
    INFER,
    METADATA,
    infer_request,
    metadata_request,
    read_infer,
    read_metadata,
)
from sightline.vision_side.detect.remote.oip_settings import OipSettings
from sightline.vision_side.detect.remote.refusing import NoAnswerError, NoAnswerReason

_OPTIONS: Final = (
    ("grpc.max_receive_message_length", MAX_ANSWER_BYTES),  # security limit, of what is unpacked too
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),  # its own default waits up to two minutes for a server that is back
    ("grpc.enable_http_proxy", 0),
    ("grpc.enable_retries", 0),
)
_NO_GRPC: Final = "grpcio is not installed: pip install 'sightline[grpc]', or use oip+http://"
_REASONS: Final = {"DEADLINE_EXCEEDED": NoAnswerReason.LATE, "UNAVAILABLE": NoAnswerReason.UNREACHABLE,
                   "RESOURCE_EXHAUSTED": NoAnswerReason.TOO_LARGE, "INTERNAL": NoAnswerReason.MALFORMED}


class GrpcServer:
    """A `Server`. What the model is like is asked again after every call that failed otherwise than by
    lateness."""

    def __init__(self, address: Address, looking: OutputOptions) -> None:
        """Raises ConfigError without grpcio."""
        try:
            import grpc
        except ImportError:
            raise ConfigError(_NO_GRPC) from None
        host = f"[{address.host}]" if ":" in address.host else address.host
        self._failed = grpc.RpcError
        self._channel = grpc.insecure_channel(f"{host}:{address.port}", options=_OPTIONS)
        self._calls = {path: self._channel.unary_unary(path) for path in (METADATA, INFER)}
        self._address, self._looking = address, looking
        self._model: OipModel | None = None

    def ask(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        """As `Server` says."""
        model = self._known_model(until_us)
        tensor, stretch = tensor_of(model, frame, self._looking.rgb)
        number = f"{frame.header.session}-{frame.header.seq}"
        data = self._call(INFER, infer_request(model, self._address.version, tensor, number), until_us)
        answer = read_infer(data, number)
        found = detections_of(answer, self._looking, stretch, (frame.width_px, frame.height_px))
        return ServerAnswer(found, Maker(model.title(self._address.scheme, answer.version), device=REMOTE))

    def close(self) -> None:
        """End the channel."""
        self._channel.close()

    def _known_model(self, until_us: int) -> OipModel:
        if self._model is None:
            request = metadata_request(self._address.model, self._address.version)
            self._model = read_metadata(self._call(METADATA, request, until_us))
        return self._model

    def _call(self, path: str, request: bytes, until_us: int) -> bytes:
        left = seconds_left(until_us)
        if left <= 0:
            raise NoAnswerError(NoAnswerReason.LATE, "nothing is left of the deadline")
        try:
            answer: bytes = self._calls[path](request, timeout=left)
        except self._failed as error:
            refused = _no_answer(error)
            if refused.reason is not NoAnswerReason.LATE:  # to ask anew would make the next answer later still
                self._model = None
            raise refused from None
        return answer


def _no_answer(error: Any) -> NoAnswerError:
    code = getattr(error.code(), "name", "UNKNOWN")
    return NoAnswerError(_REASONS.get(code, NoAnswerReason.REFUSED), f"{code}: {error.details()}")


class OipGrpc(DeadlineDetector):
    """The detector `oip+grpc://HOST[:PORT]/MODEL[/VERSION]`."""

    Config = OipSettings

    @staticmethod
    def unusable() -> str:
        """Why it cannot be used here, for lists; empty if it can."""
        return "" if find_spec("grpc") else _NO_GRPC

    def __init__(self, config: OipSettings) -> None:
        """Raises ConfigError for an address that is none, or without grpcio. Connects with the first frame."""
        server = GrpcServer(parse_address(config.address), config.looking())
        super().__init__(ServerDetector(config.address, server), config.max_pixels)
