"""What an ONNX file says of itself: input, outputs, metadata. Pure; no package, since engines differ in what they tell.

An ONNX file is a protocol buffer; the few fields that matter are read, all else is stepped over.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

Bytes = memoryview | bytes

_GRAPH, _METADATA = 7, 14  # of a model
_INITIALIZER, _INPUT, _OUTPUT = 5, 11, 12  # of a graph
_TENSOR_NAME: Final = 8
_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT: Final = 10
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
            metadata[_text(entry.get(1, b""))] = _text(entry.get(2, b""))
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
            constant.add(_text(dict(_fields(value)).get(_TENSOR_NAME, b"")))
    return OnnxHeader(tuple(one for one in inputs if one.name not in constant), tuple(outputs), metadata)


def _tensor(value: Bytes) -> Tensor:
    fields = dict(_fields(value))
    kind = dict(_fields(_part(fields.get(2, b""))))
    tensor = dict(_fields(_part(kind.get(1, b""))))
    element = tensor.get(1, 0)
    dimensions = [one for number, one in _fields(_part(tensor.get(2, b""))) if number == 1]
    shape = tuple(_size(dict(_fields(_part(one))).get(1)) for one in dimensions)
    return Tensor(_text(fields.get(1, b"")), _TYPES.get(element if isinstance(element, int) else 0, "other"), shape)


def _size(value: int | Bytes | None) -> int | None:
    return value if isinstance(value, int) and value > 0 else None


def _part(value: int | Bytes) -> Bytes:
    if isinstance(value, int):
        raise ValueError("a number where a part should be")
    return value


def _text(value: int | Bytes) -> str:
    return bytes(_part(value)).decode("utf-8", "replace")


def _fields(data: Bytes) -> Iterator[tuple[int, int | Bytes]]:
    """Every field of one message: its number, and its number or bytes."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield number, value
            continue
        size, at = _varint(data, at) if kind == _LENGTH else ({_FIXED64: 8, _FIXED32: 4}.get(kind, -1), at)
        if size < 0 or at + size > len(data):
            raise ValueError("it is cut short, or no ONNX model")
        yield number, data[at : at + size]
        at += size


def _varint(data: Bytes, at: int) -> tuple[int, int]:
    value = 0
    for index in range(_LONGEST_VARINT):
        if at + index >= len(data):
            break
        byte = data[at + index]
        value |= (byte & 127) << (7 * index)
        if byte < 128:
            return value, at + index + 1
    raise ValueError("it is cut short, or no ONNX model")
