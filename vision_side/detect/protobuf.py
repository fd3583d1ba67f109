"""As much of Protocol Buffers as ONNX files and the Open Inference Protocol's gRPC need: bytes and integers. Pure.

Encoding: https://protobuf.dev/programming-guides/encoding. Generated code would bring a package that must fit the
one that other programs in the same environment have; this needs none.
"""

from collections.abc import Iterator, Sequence
from typing import Final

Bytes = memoryview | bytes
Field = tuple[int, int | Bytes]
_VARINT, _I64, _LEN, _I32 = 0, 1, 2, 5
_FIXED: Final = {_I64: 8, _I32: 4}
_MAX_VARINT_BYTES: Final = 10
MAX_FIELDS: Final = 4096
"""Security limit: of one message of a server; ours have some dozens."""


def varint(value: int) -> bytes:
    """`value` (int64) as a varint."""
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def put(number: int, value: bytes | str) -> bytes:
    """A field of bytes, text or a message."""
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | _LEN) + varint(len(data)) + data


def put_integers(number: int, values: Sequence[int]) -> bytes:
    """A packed repeated int64."""
    return put(number, b"".join(varint(value) for value in values))


def fields(data: Bytes, most: int = MAX_FIELDS) -> Iterator[Field]:
    """(number, value) of each field in turn, bytes as parts of `data`. Raises ValueError for what is no message."""
    at = 0
    for _ in range(most):
        if at == len(data):
            return
        tag, at = _varint_at(data, at)
        number, kind = tag >> 3, tag & 7
        if kind == _VARINT:
            value, at = _varint_at(data, at)
            yield number, value
            continue
        length, at = _varint_at(data, at) if kind == _LEN else (_FIXED.get(kind, len(data) + 1), at)
        if at + length > len(data):
            raise ValueError(f"field {number} at byte {at} ends behind the end")
        yield number, data[at : at + length]
        at += length
    raise ValueError(f"more than {most} fields")


def integers(value: int | Bytes) -> list[int]:
    """A repeated int64, packed or one by one."""
    if isinstance(value, int):
        return [_signed(value)]
    found, at = [], 0
    while at < len(value):
        one, at = _varint_at(value, at)
        found.append(_signed(one))
        if len(found) > MAX_FIELDS:
            raise ValueError(f"more than {MAX_FIELDS} integers")
    return found


def text(value: int | Bytes) -> str:
    """A string."""
    return bytes(as_bytes(value)).decode("utf-8", "replace")


def as_bytes(value: int | Bytes) -> Bytes:
    """Bytes or a message. Raises ValueError if the field is an integer."""
    if isinstance(value, int):
        raise ValueError("an integer where bytes belong")
    return value


def _varint_at(data: Bytes, at: int) -> tuple[int, int]:
    value = 0
    for place, byte in enumerate(data[at : at + _MAX_VARINT_BYTES]):
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value & (1 << 64) - 1, at + place + 1
    raise ValueError(f"no integer at byte {at}")


def _signed(value: int) -> int:
    return value - (1 << 64) if value >> 63 else value
