"""What an ONNX file says of itself: input, outputs, metadata. Pure; no package, since engines differ in what they tell.

An ONNX file is a protocol buffer; the few fields that matter are read, all else is stepped over.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from sightline.vision_side.detect.protobuf import Bytes, Field, as_bytes, fields, text

_GRAPH, _METADATA = 7, 14  # of a model
_INITIALIZER, _INPUT, _OUTPUT = 5, 11, 12  # of a graph
_TENSOR_NAME: Final = 8
_MAX_METADATA: Final = 64
_TYPES: Final = {1: "float32", 2: "uint8", 7: "int64", 10: "float16"}


@dataclass(frozen=True, slots=True)
class Tensor:
    """An input or output; `shape` has None where the model does not say."""

    name: str
    type: str
    shape: tuple[int | None, ...]


@dataclass(frozen=True, slots=True)
class OnnxHeader:
    """Of one model."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    metadata: dict[str, str] = field(default_factory=dict)


def read_onnx_header(data: Bytes) -> OnnxHeader:
    """Raises ValueError for what is no ONNX model."""
    graph: Bytes | None = None
    metadata: dict[str, str] = {}
    for number, value in _fields(memoryview(data)):
        if number == _GRAPH and not isinstance(value, int):
            graph = value
        elif number == _METADATA and not isinstance(value, int) and len(metadata) < _MAX_METADATA:
            entry = dict(_fields(value))
            metadata[text(entry.get(1, b""))] = text(entry.get(2, b""))
    if graph is None:
        raise ValueError("it holds no graph")
    inputs, outputs, constant = [], [], set()
    for number, value in _fields(graph):
        if isinstance(value, int):
            continue
        if number == _INPUT:
            inputs.append(_tensor(value))
        elif number == _OUTPUT:
            outputs.append(_tensor(value))
        elif number == _INITIALIZER:
            constant.add(text(dict(_fields(value)).get(_TENSOR_NAME, b"")))
    return OnnxHeader(tuple(one for one in inputs if one.name not in constant), tuple(outputs), metadata)


def _tensor(value: Bytes) -> Tensor:
    own = dict(_fields(value))
    kind = dict(_fields(as_bytes(own.get(2, b""))))
    tensor = dict(_fields(as_bytes(kind.get(1, b""))))
    element = tensor.get(1, 0)
    dimensions = [one for number, one in _fields(as_bytes(tensor.get(2, b""))) if number == 1]
    shape = tuple(_size(dict(_fields(as_bytes(one))).get(1)) for one in dimensions)
    return Tensor(text(own.get(1, b"")), _TYPES.get(element if isinstance(element, int) else 0, "other"), shape)


def _size(value: int | Bytes | None) -> int | None:
    return value if isinstance(value, int) and value > 0 else None


def _fields(data: Bytes) -> Iterator[Field]:
    """Of a part of any size: large models have many."""
    try:
        yield from fields(data, most=len(data) + 1)
    except ValueError:
        raise ValueError("it is cut short, or no ONNX model") from None
