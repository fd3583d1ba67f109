"""Message <-> (header bytes, payload bytes). Decoders raise WireError for any bytes whatever. Pure."""

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
    """`message` as compact JSON; None fields are left out, which every decoder reads as their default."""
    return message.__pydantic_serializer__.to_json(message, exclude_none=True)


def decode(model: type[Model], data: bytes, max_bytes: int = MAX_HEADER_BYTES) -> Model:
    """Read `data` as `model`. Raises WireError UNSUPPORTED_VERSION or MALFORMED with the first wrong field named."""
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
        return WireError(RejectReason.UNSUPPORTED_VERSION, f"{name} is of version {got}; this peer speaks {VERSION}")
    return WireError(RejectReason.MALFORMED, f"{name}{'.' + where if where else ''}: {first['msg']}"[:200])


def check_sizes(channel: Channel, header: bytes, payload: bytes) -> None:
    """Raise WireError MALFORMED unless both parts are within the channel's bounds."""
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
    """Read the verb of a `request` payload; None if it is invalid."""
    try:
        return decode(Request, payload, REQUEST.max_payload_bytes).verb
    except WireError:
        return None


def encode_ranges(ranges_m: array.array[float]) -> bytes:
    """Scan payload: little-endian float32 metres."""
    floats = array.array("f", ranges_m)
    if sys.byteorder == "big":
        floats.byteswap()
    return floats.tobytes()


def decode_ranges(data: bytes) -> array.array[float]:
    """Read a scan payload. Raises WireError MALFORMED for a ragged length, NOT_FINITE for nan or negative ranges."""
    check_sizes(SCAN, b"", data)
    if len(data) % 4:
        raise WireError(RejectReason.MALFORMED, f"scan payload of {len(data)} bytes is no whole number of float32")
    floats = array.array("f", data)
    if sys.byteorder == "big":
        floats.byteswap()
    if any(math.isnan(value) or value < 0 for value in floats):
        raise WireError(RejectReason.NOT_FINITE, "scan holds a nan or negative range")
    return floats


