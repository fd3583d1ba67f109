"""The Open Inference Protocol's gRPC messages: the four that are spoken here. Pure.

Numbers of fields: grpc_service.proto of https://github.com/kserve/open-inference-protocol (service
`inference.GRPCInferenceService`).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from numpy.typing import NDArray

from sightline.vision_side.detect.protobuf import Bytes, as_bytes, fields, integers, put, put_integers, text
from sightline.vision_side.detect.remote.oip import (
    MAX_TENSORS,
    Inferred,
    OipModel,
    Slot,
    Tensor,
    model_of,
    read_number_tensor,
    read_text_tensor,
)
from sightline.vision_side.detect.remote.refusing import NoAnswerError, NoAnswerReason

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
            raise NoAnswerError(NoAnswerReason.OTHER_FRAME, f"the answer's id is {text(value)[:40]!r}, asked was {number!r}")
        if which == 2:
            version = text(value)
        elif which == 5:
            slots.append(_slot(as_bytes(value)))
        elif which == 6:
            contents.append(bytes(as_bytes(value)))
    if len(slots) != len(contents) or len(slots) > MAX_TENSORS:
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"{len(slots)} outputs, {len(contents)} raw contents; they go together")
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
