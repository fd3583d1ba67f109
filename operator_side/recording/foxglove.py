"""Writes messages as JSON with schemas that Foxglove and Lichtblick show, and reads them back byte for byte. Pure.

A message is `{"message_header": HEADER, "data": PAYLOAD, ...}`. Header and JSON payload stay as they came; a twist is
text, and any other payload base64. The further fields are those of the schema: a JPEG is a foxglove.CompressedImage, a
scan a foxglove.LaserScan, the camera model a foxglove.CameraCalibration. The topic `transform` has the pose of the
robot and the mounting of its camera as foxglove.FrameTransform.

Source: docs.foxglove.dev, message schemas; JSON in MCAP files.
"""

import base64
import json
import math
from collections.abc import Mapping
from typing import Any, Final, NoReturn

from sightline.protocol.channels import CAMERA, FRAME, JPEG, SCAN, TWIST, Channel
from sightline.protocol.codec import decode, decode_ranges
from sightline.protocol.errors import WireError
from sightline.protocol.messages import CameraModel, FrameHeader, ScanHeader, WireModel
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import Message

ENCODING: Final = "json"
SCHEMA_ENCODING: Final = "jsonschema"
TRANSFORM: Final = "transform"
"""Topic of the poses, and the name of its schema."""
_ODOMETRY, _BASE, _CAMERA = "odometry", "base", "camera"
# Viewers take a message with a field `header` for one of ROS.
_HEADER, _DATA = '{"message_header":', '"data":'
_Fields = dict[str, Any]


def _reject(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")


_JSON: Final = json.JSONDecoder(parse_constant=_reject)


def shown(message: Message, log_time_ns: int) -> bytes:
    """Return `message` as JSON. Raises ValueError for an invalid one, which would not come back as it is."""
    channel, payload = message.channel, message.payload
    try:
        more = json.dumps(_fields(message, log_time_ns), separators=(",", ":"))
        if channel.payload is None:
            payload = json.dumps(_text(channel, payload)).encode()
        data = b'"data":%b%b}' % (payload, (more[1:-1] and "," + more[1:-1]).encode())
        data = b"%b%b,%b" % (_HEADER.encode(), message.header, data) if message.header else b"{" + data
        # Valid JSON has no Infinity; readers take a number beyond their range for it. Viewers draw null at the sensor.
        data = data.replace(b"Infinity", b"1e999") if channel is SCAN else data
        if received(channel, message.source, data) == message:
            return data
    except WireError as error:
        raise ValueError(str(error)) from None
    raise ValueError("the message is not two values of JSON")


def received(channel: Channel, source: str, data: bytes) -> Message:
    """Return the message that `shown` wrote. Raises ValueError for other data."""
    header, at = "", 0
    try:
        text = data.decode()
        if text.startswith(_HEADER):
            _, at = _value(text, len(_HEADER))
            header = text[len(_HEADER) : at]
        start = at + 1 + len(_DATA)
        value, end = _value(text, start)
    except (RecursionError, UnicodeDecodeError):
        raise ValueError("not JSON in UTF-8, or nested too deep") from None
    if text[at + 1 : start] != _DATA or not (channel.payload or isinstance(value, str)):
        raise ValueError("not a message of a recording")
    if channel.payload:
        payload = text[start:end].encode()
    else:
        payload = value.encode() if channel is TWIST else base64.b64decode(value, validate=True)
    return Message(channel, source, header.encode(), payload)


def _value(text: str, at: int) -> tuple[Any, int]:
    """Return the value at `at`, and the place after it and its spaces."""
    value, end = _JSON.raw_decode(text, _past_spaces(text, at))
    return value, _past_spaces(text, end)


def _past_spaces(text: str, at: int) -> int:
    return len(text) - len(text[at:].lstrip(" \t\n\r"))


def transform(message: Message, log_time_ns: int) -> bytes | None:
    """Return the pose in a frame, or the mounting of a camera model; None for another or an invalid message."""
    try:
        if message.channel is FRAME:
            x_m, y_m, yaw_rad = decode(FrameHeader, message.header).pose
            turn = (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))
            return _transform(log_time_ns, (_ODOMETRY, _BASE), (x_m, y_m, 0.0), turn)
        if message.channel is CAMERA:
            model = _camera(message)
            # Optical axes: x to the right, y down, z ahead; tilted up around the robot's axis to the left.
            up, ahead = math.sin(model.pitch_rad / 2) / 2, math.cos(model.pitch_rad / 2) / 2
            turn = (up - ahead, ahead - up, -ahead - up, ahead + up)
            return _transform(log_time_ns, (_BASE, _CAMERA), (model.x_m, model.y_m, model.z_m), turn)
    except WireError:
        return None
    return None


def _transform(
    log_time_ns: int, frames: tuple[str, str], place: tuple[float, ...], turn: tuple[float, ...]
) -> bytes:
    return json.dumps({
        "timestamp": _time(log_time_ns), "parent_frame_id": frames[0], "child_frame_id": frames[1],
        "translation": dict(zip("xyz", place, strict=True)), "rotation": dict(zip("xyzw", turn, strict=True)),
    }).encode()


def _text(channel: Channel, payload: bytes) -> str:
    return payload.decode() if channel is TWIST else base64.b64encode(payload).decode()


def _time(log_time_ns: int) -> _Fields:
    return {"sec": log_time_ns // 10**9, "nsec": log_time_ns % 10**9}


def _camera(message: Message) -> CameraModel:
    return decode(CameraModel, message.payload, CAMERA.max_payload_bytes)


def _fields(message: Message, log_time_ns: int) -> _Fields:
    """Return the fields of the schema. Raises WireError for an invalid message."""
    if message.channel is TWIST:
        twist = parse_twist(message.payload)
        return {"linear_mps": twist.linear_mps, "angular_rad_s": twist.angular_rad_s}
    if message.channel.encoding == JPEG:
        return {"timestamp": _time(log_time_ns), "frame_id": _CAMERA, "format": "jpeg"}
    if message.channel is SCAN:
        return {"timestamp": _time(log_time_ns), "frame_id": _BASE, **_scan(message)}
    if message.channel is CAMERA:
        return {"timestamp": _time(log_time_ns), "frame_id": _CAMERA, **_calibration(_camera(message))}
    return {}


def _scan(message: Message) -> _Fields:
    header, ranges_m = decode(ScanHeader, message.header), decode_ranges(message.payload).tolist()
    last_rad = header.angle_min_rad + header.angle_increment_rad * max(0, len(ranges_m) - 1)
    pose = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    return {"pose": pose, "start_angle": header.angle_min_rad, "end_angle": last_rad, "ranges": ranges_m,
            "intensities": []}


def _calibration(model: CameraModel) -> _Fields:
    fx, fy, cx, cy = model.fx_px, model.fy_px, model.cx_px, model.cy_px
    count, name = (5, "plumb_bob") if len(model.distortion) <= 5 else (8, "rational_polynomial")
    distortion = [*model.distortion, *[0.0] * count][:count]
    return {"width": model.width_px, "height": model.height_px, "distortion_model": name, "D": distortion,
            "K": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "R": [1, 0, 0, 0, 1, 0, 0, 0, 1],
            "P": [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]}


# --- schemas -----------------------------------------------------------------------------------------------------


_TEXT, _NUMBER, _INTEGER = {"type": "string"}, {"type": "number"}, {"type": "integer"}
_NUMBERS: Final = {"type": "array", "items": _NUMBER}


def _object(properties: Mapping[str, Any]) -> _Fields:
    return {"type": "object", "properties": dict(properties)}


_STAMPED: Final = {"timestamp": _object({"sec": _INTEGER, "nsec": _INTEGER}), "frame_id": _TEXT}
_VECTOR, _QUATERNION = _object(dict.fromkeys("xyz", _NUMBER)), _object(dict.fromkeys("xyzw", _NUMBER))
_IMAGE: Final = {**_STAMPED, "format": _TEXT}
_WELL_KNOWN: Final = {
    SCAN: ("foxglove.LaserScan", {
        **_STAMPED, "pose": _object({"position": _VECTOR, "orientation": _QUATERNION}), "start_angle": _NUMBER,
        "end_angle": _NUMBER, "ranges": _NUMBERS, "intensities": _NUMBERS,
    }),
    CAMERA: ("foxglove.CameraCalibration", {
        **_STAMPED, "width": _INTEGER, "height": _INTEGER, "distortion_model": _TEXT, **dict.fromkeys("DKRP", _NUMBERS),
    }),
    TWIST: ("sightline.twist", {"linear_mps": _NUMBER, "angular_rad_s": _NUMBER}),
}
_TRANSFORM: Final = ("foxglove.FrameTransform", _object({
    "timestamp": _STAMPED["timestamp"], "parent_frame_id": _TEXT, "child_frame_id": _TEXT, "translation": _VECTOR,
    "rotation": _QUATERNION,
}))


def schema_of(channel: Channel | None) -> tuple[str, bytes]:
    """Return the name of a channel's schema, and the schema; of the transforms for None."""
    if channel is None:
        name, schema = _TRANSFORM
    else:
        image = ("foxglove.CompressedImage", _IMAGE) if channel.encoding == JPEG else (f"sightline.{channel.name}", {})
        name, more = _WELL_KNOWN.get(channel, image)
        schema = _object({"message_header": _model(channel.header), "data": _payload(channel), **more})
    return name, json.dumps({"title": name, **schema}).encode()


def _payload(channel: Channel) -> _Fields:
    if channel.payload is not None:
        return _model(channel.payload)
    return _TEXT if channel is TWIST else {"type": "string", "contentEncoding": "base64"}


def _model(model: type[WireModel]) -> _Fields:
    schema = model.model_json_schema()
    return _plain(schema, schema.get("$defs", {})) or _object({})


def _plain(schema: Mapping[str, Any], parts: Mapping[str, Any]) -> _Fields | None:
    """Reduce a JSON Schema to the kinds that viewers read: one type each, no array of arrays. None for another kind."""
    if "$ref" in schema:
        schema = parts[schema["$ref"].rpartition("/")[2]]
    kinds = [one for one in schema.get("anyOf", [schema]) if one.get("type") != "null"]
    if kinds != [schema]:
        return _plain(kinds[0], parts) if len(kinds) == 1 else None
    kind = schema.get("type")
    if kind == "object":
        fields = {name: _plain(one, parts) for name, one in schema.get("properties", {}).items()}
        return _object({name: one for name, one in fields.items() if one is not None})
    if kind == "array":
        item = _plain(schema.get("items") or schema["prefixItems"][0], parts)
        return None if item is None or item["type"] == "array" else {"type": "array", "items": item}
    return {"type": kind} if kind in ("boolean", "string", "number", "integer") else None
