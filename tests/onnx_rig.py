"""Small ONNX models, written byte by byte: the tests need no package that makes them."""

import contextlib
import json
import struct
from pathlib import Path

import numpy as np
import pytest

TYPES = {"float32": 1, "uint8": 2, "int64": 7}


def without_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where ONNX Runtime knows of no GPU, whatever there is."""
    with contextlib.suppress(ImportError):
        import onnxruntime

        monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])


def _varint(value: int) -> bytes:
    value &= 2**64 - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def part(number: int, value: "int | bytes | str | float") -> bytes:
    """One field of a protocol buffer."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    if isinstance(value, float):
        return _varint(number << 3 | 5) + struct.pack("<f", value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def tensor(name: str, array: np.ndarray) -> bytes:
    """A constant."""
    dims = b"".join(part(1, size) for size in array.shape)
    return dims + part(2, TYPES[str(array.dtype)]) + part(8, name) + part(9, array.tobytes())


def value(name: str, kind: str, shape: tuple[int | None, ...]) -> bytes:
    """An input or output; None is a size that the model leaves open."""
    dims = b"".join(part(1, part(2, "n") if size is None else part(1, size)) for size in shape)
    return part(1, name) + part(2, part(1, part(1, TYPES[kind]) + part(2, dims)))


def node(kind: str, inputs: list[str], outputs: list[str], **attributes: "int | list[int]") -> bytes:
    """One operation; attributes are whole numbers or lists of them."""
    body = b"".join(part(1, one) for one in inputs) + b"".join(part(2, one) for one in outputs) + part(4, kind)
    for name, given in attributes.items():
        many = isinstance(given, list)
        numbers = b"".join(part(8, one) for one in given) if many else part(3, given)
        body += part(5, part(1, name) + numbers + part(20, 7 if many else 2))
    return body


def model(
    path: Path, nodes: list[bytes], constants: list[bytes], inputs: list[bytes], outputs: list[bytes],
    metadata: dict[str, str] | None = None,
) -> Path:
    """A whole file."""
    graph = b"".join(part(1, one) for one in nodes) + part(2, "test")
    graph += b"".join(part(5, one) for one in constants) + b"".join(part(11, one) for one in inputs)
    graph += b"".join(part(12, one) for one in outputs)
    data = part(1, 8) + part(7, graph) + part(8, part(1, "") + part(2, 17))
    for key, text in (metadata or {}).items():
        data += part(14, part(1, key) + part(2, text))
    path.write_bytes(data)
    return path


def brightness_model(path: Path, boxes: list[list[float]], labels: list[int], *, size: tuple[int, int] = (240, 320),
                     words: tuple[str, ...] = ("ball", "legs"), **metadata: str) -> Path:
    """Always these boxes; the score of each is how bright the picture is, 0..1."""
    shape = (1, *size, 3)
    ones = np.full(len(boxes), 1 / 255, np.float32)
    return model(
        path,
        [node("Cast", ["image"], ["floats"], to=1),
         node("ReduceMean", ["floats"], ["kept"], axes=[0, 1, 2, 3], keepdims=1),
         node("Reshape", ["kept", "one"], ["mean"]),  # OpenCV's engine has no numbers without a dimension
         node("Mul", ["ones", "mean"], ["scores"]),
         node("Identity", ["boxes_in"], ["boxes"]), node("Identity", ["labels_in"], ["labels"])],
        [tensor("one", np.array([1], np.int64)), tensor("ones", ones),
         tensor("boxes_in", np.array(boxes, np.float32).reshape(-1, 4)),
         tensor("labels_in", np.array(labels, np.int64))],
        [value("image", "uint8", shape)],
        [value("boxes", "float32", (len(boxes), 4)), value("scores", "float32", (len(boxes),)),
         value("labels", "int64", (len(boxes),))],
        {"labels": json.dumps(list(words)), **metadata},
    )


def several_model(path: Path, boxes: list[list[float]], size: tuple[int, int] = (240, 320)) -> Path:
    """The same as `brightness_model`, for any number of pictures at once; all are of label 0."""
    count = len(boxes)
    return model(
        path,
        [node("Cast", ["image"], ["floats"], to=1),
         node("ReduceMean", ["floats"], ["mean"], axes=[1, 2, 3], keepdims=0),
         node("Reshape", ["mean", "column"], ["means"]), node("Mul", ["means", "ones"], ["scores"]),
         node("Reshape", ["mean", "place"], ["places"]), node("Mul", ["places", "zero"], ["nothing"]),
         node("Add", ["boxes_in", "nothing"], ["boxes"]),
         node("Mul", ["scores", "zero"], ["zeros"]), node("Cast", ["zeros"], ["labels"], to=7)],
        [tensor("column", np.array([-1, 1], np.int64)), tensor("place", np.array([-1, 1, 1], np.int64)),
         tensor("ones", np.full((1, count), 1 / 255, np.float32)), tensor("zero", np.zeros(1, np.float32)),
         tensor("boxes_in", np.array(boxes, np.float32).reshape(1, -1, 4))],
        [value("image", "uint8", (None, *size, 3))],
        [value("boxes", "float32", (None, count, 4)), value("scores", "float32", (None, count)),
         value("labels", "int64", (None, count))],
        {"labels": json.dumps(["ball"])},
    )


def yolo_model(path: Path, columns: np.ndarray, size: tuple[int, int] = (64, 64), names: str = "{0: 'cup'}") -> Path:
    """Always these (4 + classes, N) numbers, as YOLO gives them, whatever the picture."""
    return model(
        path,
        [node("ReduceMean", ["images"], ["kept"], axes=[0, 1, 2, 3], keepdims=1),
         node("Reshape", ["kept", "one"], ["mean"]),
         node("Mul", ["mean", "zero"], ["nothing"]), node("Add", ["all", "nothing"], ["output0"])],
        [tensor("one", np.array([1], np.int64)), tensor("zero", np.zeros((1, 1, 1), np.float32)),
         tensor("all", columns[None].astype(np.float32))],
        [value("images", "float32", (1, 3, *size))],
        [value("output0", "float32", (1, *columns.shape))],
        {"names": names},
    )
