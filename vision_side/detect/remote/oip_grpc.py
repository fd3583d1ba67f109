"""The detector `oip+grpc`. Shell.

Numbers of fields: grpc_service.proto of https://github.com/kserve/open-inference-protocol (service
`inference.GRPCInferenceService`).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any, Final

from numpy.typing import NDArray

from sightline.protocol.errors import ConfigError
from sightline.vision_side.detect.port import DetectFrame, Maker
from sightline.vision_side.detect.protobuf import Bytes, as_bytes, fields, integers, put, put_integers, text
from sightline.vision_side.detect.remote.client import (
    REMOTE,
    Address,
    NoAnswerError,
    NoAnswerReason,
    ServerAnswer,
    ServerDetector,
    parse_address,
    seconds_left,
)
from sightline.vision_side.detect.remote.deadline import DeadlineDetector
from sightline.vision_side.detect.remote.http_client import MAX_ANSWER_BYTES
from sightline.vision_side.detect.remote.oip import (
    MAX_TENSORS,
    Inferred,
    OipModel,
    OipSettings,
    OutputOptions,
    Slot,
    Tensor,
    detections_of,
    model_of,
    read_number_tensor,
    read_text_tensor,
    tensor_of,
)

METADATA: Final = "/inference.GRPCInferenceService/ModelMetadata"
INFER: Final = "/inference.GRPCInferenceService/ModelInfer"


@contextmanager
def _malformed() -> Iterator[None]:
    """What is no message is no answer."""
    try:
        yield
    except ValueError as error:
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"not Protocol Buffers: {error}") from None


def metadata_request(model: str, version: str) -> bytes:
    """ModelMetadataRequest."""
    return put(1, model) + (put(2, version) if version else b"")


@_malformed()
def read_metadata(data: bytes) -> OipModel:
    """ModelMetadataResponse. Raises NoAnswerError."""
    name, versions, slots = "", [""], {4: list[Slot](), 5: list[Slot]()}
    for number, value in fields(data):
        if number == 1:
            name = text(value)
        elif number == 2:
            versions.append(text(value))
        elif number in slots:
            slots[number].append(_slot(as_bytes(value)))
    if max(len(some) for some in slots.values()) > MAX_TENSORS:
        raise NoAnswerError(NoAnswerReason.UNFIT, f"model {name[:40]!r} has more than {MAX_TENSORS} inputs or outputs")
    return model_of(name, versions[-1], slots[4], slots[5])


def infer_request(model: OipModel, asked_version: str, tensor: Tensor, number: str) -> bytes:
    """ModelInferRequest, its tensor as raw contents; `number` comes back as the answer's id."""
    one = put(1, tensor.name) + put(2, tensor.datatype) + put_integers(3, tensor.shape)
    return b"".join((
        put(1, model.name), put(2, asked_version) if asked_version else b"", put(3, number), put(5, one),
        *(put(6, put(1, name)) for name in model.outputs), put(7, tensor.data),
    ))


@_malformed()
def read_infer(data: bytes, number: str) -> Inferred:
    """A ModelInferResponse. Raises NoAnswerError, also if it answers something else."""
    version, slots, contents = "", list[Slot](), list[bytes]()
    for which, value in fields(data):
        if which == 3 and text(value) not in ("", number):
            raise NoAnswerError(
                NoAnswerReason.OTHER_FRAME, f"the answer's id is {text(value)[:40]!r}, asked was {number!r}"
            )
        if which == 2:
            version = text(value)
        elif which == 5:
            slots.append(_slot(as_bytes(value)))
        elif which == 6:
            contents.append(bytes(as_bytes(value)))
    if len(slots) != len(contents) or len(slots) > MAX_TENSORS:
        raise NoAnswerError(
            NoAnswerReason.MALFORMED, f"{len(slots)} outputs, {len(contents)} raw contents; they go together"
        )
    return Inferred({slot.name: _tensor(slot, raw) for slot, raw in zip(slots, contents, strict=True)}, version)


def _tensor(slot: Slot, raw: bytes) -> NDArray[Any] | list[str]:
    if slot.datatype == "BYTES":
        return read_text_tensor(slot.shape, raw)
    return read_number_tensor(slot.datatype, slot.shape, raw)


def _slot(data: Bytes) -> Slot:
    """TensorMetadata and InferOutputTensor alike: name, datatype, shape."""
    name, datatype, shape = "", "", list[int]()
    for number, value in fields(data):
        if number == 1:
            name = text(value)
        elif number == 2:
            datatype = text(value)
        elif number == 3:
            shape.extend(integers(value))
    return Slot(name, datatype, tuple(shape))


# `oip+grpc://HOST/MODEL`: a model of an inference server over gRPC; needs the extra `grpc`. Shell.


_OPTIONS: Final = (
    ("grpc.max_receive_message_length", MAX_ANSWER_BYTES),  # security limit, of what is unpacked too
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),  # its own default waits up to two minutes for a server that is back
    ("grpc.enable_http_proxy", 0),
    ("grpc.enable_retries", 0),
)
_NO_GRPC: Final = "grpcio is not installed: pip install 'sightline-robot[grpc]', or use oip+http://"
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
