"""The channels as an AsyncAPI 3.0 document. Pure."""

from typing import Any, Final

from sightline.protocol import NAME_PATTERN, VERSION
from sightline.protocol.channels import CHANNELS, KEY_PREFIX, MAX_HEADER_BYTES, REPLY, REQUEST, Channel, Direction
from sightline.protocol.text import MAX_TWIST_BYTES
from sightline.protocol.transports.websocket.framing import MAX_HELLO_BYTES, SUBPROTOCOL
from sightline.protocol.transports.websocket.legacy_text import MAX_BOXES_BYTES

Node = dict[str, Any]
_SCHEMAS: Final = "#/components/schemas/"
_OLDER: Final = {
    "picture": ("send", None, "base64 of a JPEG, a newline after every 76 characters and at the end"),
    "twist": ("receive", MAX_TWIST_BYTES, "linear|angular in m/s and rad/s, as a guest"),
    "boxes": ("receive", MAX_BOXES_BYTES, "y_min,x_min,y_max,x_max in fractions of the image, joined by -"),
}
"""Texts of the legacy protocol: direction, maximum size in bytes, meaning."""


def document(definitions: Node) -> Node:
    """Return the whole document. `definitions` are the JSON Schemas of all models by name."""
    older = {f"older_{name}": _text(most, purpose) for name, (_, most, purpose) in _OLDER.items()}
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "Sightline",
            "version": f"{VERSION}.0.0",
            "description": "What a robot sends and receives. protocol/README.md is the specification.",
        },
        "defaultContentType": "application/json",
        "servers": _servers(),
        "channels": {**{one.name: _channel(one) for one in CHANNELS.values()}, **_connections()},
        "operations": _operations(),
        "components": {
            "messages": {**{one.name: _message(one) for one in CHANNELS.values()}, "hello": _hello(), **older},
            "schemas": {name: _draft_07(schema) for name, schema in definitions.items()},
        },
    }


def _servers() -> Node:
    host = {"host": {"default": "127.0.0.1", "description": "the robot's address, or the router's"}}
    return {
        "websocket": {
            "host": "{host}:9090", "pathname": "/", "protocol": "ws", "variables": host,
            "description": f"sub-protocol {SUBPROTOCOL}; one connection carries all channels; wss beyond loopback",
        },
        "zenoh": {
            "host": "{host}:7447", "protocol": "zenoh", "variables": host,
            "description": "attachment = header; the channel's address is the key",
        },
        "older": {
            "host": "{host}:9091", "pathname": "/", "protocol": "ws", "variables": host,
            "description": "the legacy protocol: text without headers and sub-protocol, if the owner enabled it",
        },
    }  # fmt: skip


def _channel(one: Channel) -> Node:
    robot = {"description": f"the robot's id, ^{NAME_PATTERN}$", "examples": ["r1"]}
    source = {"description": "the publisher's role", "examples": ["vision", "teleop", "guest"]}
    address = f"{KEY_PREFIX}/{{robot}}/{one.name}"
    return {
        "address": f"{address}/{{source}}" if one.has_source else address,
        "description": one.purpose,
        "servers": _references("servers", "websocket", "zenoh"),
        "parameters": {"robot": robot, "source": source} if one.has_source else {"robot": robot},
        "messages": {one.name: _reference("components/messages", one.name)},
        "x-rate": one.rate,
        "x-priority": one.priority.value,
        "x-when-full": one.when_full,
    }


def _connections() -> Node:
    """Return the messages of a connection that have no key."""
    names = [f"older_{name}" for name in _OLDER]
    return {
        "hello": {
            "address": None,
            "description": "the first message each way: who the sender is and which channels it wants",
            "servers": _references("servers", "websocket"),
            "messages": {"hello": _reference("components/messages", "hello")},
        },
        "older": {
            "address": None,
            "description": "all messages of the legacy protocol",
            "servers": _references("servers", "older"),
            "messages": {name: _reference("components/messages", name) for name in names},
        },
    }


def _operations() -> Node:
    operations = {}
    for one in CHANNELS.values():
        actions = ["send"] if one.direction is Direction.FROM_ROBOT else ["receive"]
        for action in [*actions, *(["send"] if one.passed_on else [])]:
            operations[f"{action}_{one.name}"] = _operation(action, one.name, one.name)
    operations[f"receive_{REQUEST.name}"]["reply"] = {
        "channel": _reference("channels", REPLY.name),
        "messages": [_reference(f"channels/{REPLY.name}/messages", REPLY.name)],
    }
    for action in ("receive", "send"):
        operations[f"{action}_hello"] = _operation(action, "hello", "hello")
    for name, (action, _, _) in _OLDER.items():
        operations[f"{action}_older_{name}"] = _operation(action, "older", f"older_{name}")
    return operations


def _operation(action: str, channel: str, message: str) -> Node:
    messages = [_reference(f"channels/{channel}/messages", message)]
    return {"action": action, "channel": _reference("channels", channel), "messages": messages}


def _message(one: Channel) -> Node:
    return {
        "name": one.name,
        "contentType": one.encoding,
        "summary": one.purpose,
        "headers": {"$ref": _SCHEMAS + one.header.__name__},
        "payload": {"$ref": _SCHEMAS + one.payload.__name__} if one.payload else _bytes(one),
        "x-max-header-bytes": MAX_HEADER_BYTES,
        "x-max-payload-bytes": one.max_payload_bytes,
    }


def _bytes(one: Channel) -> Node:
    if one.encoding == "text/plain":
        return {"type": "string", "maxLength": one.max_payload_bytes}
    return {"type": "string", "format": "binary", "maxLength": one.max_payload_bytes}


def _hello() -> Node:
    payload = {"$ref": f"{_SCHEMAS}Hello"}
    return {"name": "hello", "payload": payload, "x-max-payload-bytes": MAX_HELLO_BYTES}


def _text(most: int | None, purpose: str) -> Node:
    payload: Node = {"type": "string"} if most is None else {"type": "string", "maxLength": most}
    return {"contentType": "text/plain", "summary": purpose, "payload": payload}


def _reference(path: str, name: str) -> Node:
    return {"$ref": f"#/{path}/{name}"}


def _references(path: str, *names: str) -> list[Node]:
    return [_reference(path, name) for name in names]


def _draft_07(schema: Any) -> Any:
    """Convert `schema` to draft 07 of JSON Schema, which AsyncAPI uses: tuples and references differ."""
    if isinstance(schema, list):
        return [_draft_07(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    read = {name: _draft_07(value) for name, value in schema.items()}
    if "prefixItems" in read:
        read |= {"items": read.pop("prefixItems"), "additionalItems": False}
    if isinstance(read.get("$ref"), str):
        read["$ref"] = read["$ref"].replace("#/$defs/", _SCHEMAS)
    return read
