"""The detector `oip+http`: JSON with binary tensors. Shell."""

import json
from typing import Annotated, Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sightline.protocol.config import first_problem
from sightline.vision_side.detect.port import DetectFrame, Maker
from sightline.vision_side.detect.remote.client import (
    REMOTE,
    Address,
    NoAnswerError,
    NoAnswerReason,
    ServerAnswer,
    ServerDetector,
    parse_address,
)
from sightline.vision_side.detect.remote.deadline import DeadlineDetector
from sightline.vision_side.detect.remote.http_client import HttpExchange
from sightline.vision_side.detect.remote.oip import (
    MAX_DIMENSIONS,
    MAX_TENSORS,
    NUMBERS,
    Inferred,
    OipModel,
    OipSettings,
    OipTensor,
    TensorSlot,
    detections_of,
    elements_of,
    model_of,
    read_number_tensor,
    read_text_tensor,
    tensor_of,
)

HEADER_LENGTH: Final = "Inference-Header-Content-Length"
"""Header with the number of JSON bytes in a body; binary tensors follow them."""
_Name = Annotated[str, Field(max_length=256)]
_Shape = Annotated[tuple[int, ...], Field(max_length=MAX_DIMENSIONS)]


class _FromServer(BaseModel):
    """A part of an answer; unknown fields are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


FromServer = TypeVar("FromServer", bound=_FromServer)


class _Slot(_FromServer):
    name: _Name
    datatype: _Name
    shape: _Shape


class _Metadata(_FromServer):
    name: _Name
    versions: Annotated[tuple[_Name, ...], Field(max_length=1024)] = ()
    inputs: Annotated[tuple[_Slot, ...], Field(max_length=MAX_TENSORS)]
    outputs: Annotated[tuple[_Slot, ...], Field(max_length=MAX_TENSORS)]


class _Parameters(_FromServer):
    binary_data_size: Annotated[int | None, Field(ge=0)] = None


class _Output(_Slot):
    parameters: _Parameters = _Parameters()
    data: Any = None


class _Answer(_FromServer):
    id: str | None = None
    model_version: _Name = ""
    outputs: Annotated[tuple[_Output, ...], Field(max_length=MAX_TENSORS)]


def read_metadata(body: bytes) -> OipModel:
    """Parse the answer of `GET v2/models/NAME`. Raises NoAnswerError."""
    metadata = _validated(_Metadata, body)
    slots = [
        [TensorSlot(one.name, one.datatype, one.shape) for one in of] for of in (metadata.inputs, metadata.outputs)
    ]
    return model_of(metadata.name, metadata.versions[-1] if metadata.versions else "", *slots)


def infer_body(model: OipModel, tensor: OipTensor, number: str) -> tuple[int, bytes]:
    """Return the body of `POST v2/models/NAME/infer` and its number of JSON bytes. The answer repeats `number`."""
    head = json.dumps({
        "id": number,
        "inputs": [{"name": tensor.name, "shape": tensor.shape, "datatype": tensor.datatype,
                    "parameters": {"binary_data_size": len(tensor.data)}}],
        "outputs": [{"name": name, "parameters": {"binary_data": True}} for name in model.outputs],
    }, separators=(",", ":")).encode()
    return len(head), head + tensor.data


def read_infer(body: bytes, json_length: str | None, number: str) -> Inferred:
    """Parse an answer. Raises NoAnswerError, also for the answer to another request."""
    length = _json_length(json_length, len(body))
    answer = _validated(_Answer, body[:length])
    if answer.id not in (None, "", number):
        raise NoAnswerError(NoAnswerReason.OTHER_FRAME, f"the answer's id is {answer.id[:40]!r}, not {number!r}")
    tensors, at = {}, length
    for one in answer.outputs:
        size = one.parameters.binary_data_size
        if size is None:
            tensors[one.name] = _from_list(one)
            continue
        if at + size > len(body):
            raise NoAnswerError(NoAnswerReason.MALFORMED, f"output {one.name[:40]!r} ends behind the end of the answer")
        tensors[one.name] = _from_bytes(one, body[at : at + size])
        at += size
    return Inferred(tensors, answer.model_version)


def _json_length(text: str | None, whole: int) -> int:
    if text is None:
        return whole
    if not (text.isascii() and text.isdecimal() and len(text) < 10 and int(text) <= whole):
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"{HEADER_LENGTH} {text[:20]!r} of an answer of {whole} bytes")
    return int(text)


def _from_bytes(one: _Output, data: bytes) -> NDArray[Any] | list[str]:
    if one.datatype == "BYTES":
        return read_text_tensor(one.shape, data)
    return read_number_tensor(one.datatype, one.shape, data)


def _from_list(one: _Output) -> NDArray[Any] | list[str]:
    """Read a tensor from JSON, flat or nested, of a server without the binary extension."""
    try:
        values = np.asarray(one.data, dtype=object if one.datatype == "BYTES" else NUMBERS[one.datatype]).reshape(-1)
    except (ValueError, TypeError, OverflowError, KeyError) as error:
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"output {one.name[:40]!r}: {error}") from None
    if values.size != elements_of(one.shape):
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"{values.size} values for a tensor of shape {list(one.shape)}")
    return [str(value) for value in values] if one.datatype == "BYTES" else values.reshape(one.shape)


def _validated(model: type[FromServer], data: bytes) -> FromServer:
    try:
        return model.model_validate_json(data)
    except ValidationError as error:
        raise NoAnswerError(NoAnswerReason.MALFORMED, first_problem(error, whole="answer")) from None


# `oip+http://HOST/MODEL`: a model of an inference server (Triton, OpenVINO Model Server) over HTTP. Shell.


class HttpServer:
    """A `DetectorServer` for OIP. It requests the model's metadata once, and again after each error except LATE and
    after each connection that the server closed."""

    def __init__(self, address: Address, settings: OipSettings) -> None:
        self._http = HttpExchange(address.host, address.port)
        version = f"/versions/{address.version}" if address.version else ""
        self._path = f"/v2/models/{address.model}{version}"
        self._settings = settings
        self._scheme = address.scheme
        self._model: OipModel | None = None
        self._lost_before = 0
        """Lost connections at the time of the metadata request."""

    def request(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        """See `DetectorServer`."""
        try:
            return self._answer(frame, until_us)
        except NoAnswerError as error:
            if error.reason is not NoAnswerReason.LATE:  # a metadata request would delay the next answer even more
                self._model = None
            raise

    def _answer(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        model = self._known_model(until_us)
        tensor, stretch = tensor_of(model, frame, self._settings.order == "rgb")
        number = f"{frame.header.session}-{frame.header.seq}"
        length, body = infer_body(model, tensor, number)
        reply = self._http.post(f"{self._path}/infer", {HEADER_LENGTH: str(length)}, body, until_us)
        answer = read_infer(reply.body, reply.headers.get(HEADER_LENGTH.lower()), number)
        found = detections_of(answer, self._settings, stretch, (frame.width_px, frame.height_px))
        return ServerAnswer(found, Maker(model.title(self._scheme, answer.version), device=REMOTE))

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def _known_model(self, until_us: int) -> OipModel:
        if self._model is None or self._lost_before != self._http.lost:
            self._model = read_metadata(self._http.get(self._path, until_us).body)
            self._lost_before = self._http.lost
        return self._model


class OipHttp(DeadlineDetector):
    """The detector `oip+http://HOST[:PORT]/MODEL[/VERSION]`."""

    Config = OipSettings

    def __init__(self, config: OipSettings) -> None:
        """Raises ConfigError for an invalid address. The first frame opens the connection."""
        server = HttpServer(parse_address(config.address), config)
        super().__init__(ServerDetector(config.address, server), config.max_pixels)
