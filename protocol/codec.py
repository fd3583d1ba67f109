"""Convert messages to header and payload bytes, and back. Decoders raise only WireError, for any input. Pure."""

from __future__ import annotations

import array
import math
import sys
from typing import TypeVar, cast

from pydantic import ValidationError

from sightline.protocol import VERSION
from sightline.protocol.channels import MAX_HEADER_BYTES, REQUEST, SCAN, Channel
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Request, Verb, WireModel

Model = TypeVar("Model", bound=WireModel)


def encode(message: WireModel) -> bytes:
    """Encode a message as compact JSON.

    Args:
        message: any header or payload model.

    Returns:
        UTF-8 bytes without the fields that are None. A decoder reads an absent field as its default.
    """
    return message.__pydantic_serializer__.to_json(message, exclude_none=True)


def decode(model: type[Model], data: bytes, max_bytes: int = MAX_HEADER_BYTES) -> Model:
    """Decode JSON bytes.

    Args:
        model: class of the header or payload.
        data: bytes from the wire.
        max_bytes: security limit for the length of `data`.

    Raises:
        WireError: UNSUPPORTED_VERSION, or MALFORMED with the name of the first invalid field.
    """
    if len(data) > max_bytes:
        raise WireError(RejectReason.MALFORMED, f"{model.__name__} is {len(data)} bytes, at most {max_bytes}")
    try:
        return cast(Model, model.__pydantic_validator__.validate_json(data))
    except ValidationError as error:
        raise _wire_error(model.__name__, error) from None


def _wire_error(name: str, error: ValidationError) -> WireError:
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    if where == "v":
        got = repr(first["input"])[:20]
        return WireError(RejectReason.UNSUPPORTED_VERSION, f"{name} has version {got}; this peer uses {VERSION}")
    return WireError(RejectReason.MALFORMED, f"{name}{'.' + where if where else ''}: {first['msg']}"[:200])


def check_sizes(channel: Channel, header: bytes, payload: bytes) -> None:
    """Check both parts of a message against the bounds of its channel.

    Args:
        channel: the channel.
        header: header bytes, may be empty.
        payload: payload bytes.

    Raises:
        WireError: MALFORMED for a part above its bound.
    """
    if len(header) > MAX_HEADER_BYTES:
        raise WireError(
            RejectReason.MALFORMED, f"{channel.name} header is {len(header)} bytes, at most {MAX_HEADER_BYTES}"
        )
    if len(payload) > channel.max_payload_bytes:
        raise WireError(
            RejectReason.MALFORMED,
            f"{channel.name} payload is {len(payload)} bytes, at most {channel.max_payload_bytes}",
        )


def request_verb(payload: bytes) -> Verb | None:
    """Read the verb of a `request` payload.

    Args:
        payload: payload bytes, any content.

    Returns:
        The verb, or None for an invalid payload.
    """
    try:
        return decode(Request, payload, REQUEST.max_payload_bytes).verb
    except WireError:
        return None


def encode_ranges(ranges_m: array.array[float]) -> bytes:
    """Encode a scan payload.

    Args:
        ranges_m: one distance per ray, m.

    Returns:
        Little-endian float32.
    """
    floats = array.array("f", ranges_m)
    if sys.byteorder == "big":
        floats.byteswap()
    return floats.tobytes()


def decode_ranges(data: bytes) -> array.array[float]:
    """Decode a scan payload.

    Args:
        data: little-endian float32.

    Returns:
        One distance per ray, m.

    Raises:
        WireError: MALFORMED for an invalid length, NOT_FINITE for a nan or a negative range.
    """
    check_sizes(SCAN, b"", data)
    if len(data) % 4:
        raise WireError(RejectReason.MALFORMED, f"scan payload of {len(data)} bytes is not a multiple of 4 (float32)")
    floats = array.array("f", data)
    if sys.byteorder == "big":
        floats.byteswap()
    if any(math.isnan(value) or value < 0 for value in floats):
        raise WireError(RejectReason.NOT_FINITE, "scan contains a nan or negative range")
    return floats


