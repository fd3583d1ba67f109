"""The AsyncAPI document: every rule of AsyncAPI 3.0 that can be checked without its own validator."""

import json
import re
from pathlib import Path

import pytest

from sightline.protocol.channels import CHANNELS, Direction
from sightline.protocol.spec import generate as schema

DOCUMENT = json.loads((Path(schema.__file__).parent.parent / "asyncapi.json").read_text("utf-8"))
ALLOWED = {
    "root": {"asyncapi", "id", "info", "servers", "defaultContentType", "channels", "operations", "components"},
    "server": {"host", "protocol", "protocolVersion", "pathname", "description", "title", "summary", "variables",
               "security", "tags", "externalDocs", "bindings"},
    "channel": {"address", "messages", "title", "summary", "description", "servers", "parameters", "tags",
                "externalDocs", "bindings"},
    "operation": {"action", "channel", "title", "summary", "description", "security", "tags", "externalDocs",
                  "bindings", "traits", "messages", "reply"},
    "message": {"headers", "payload", "correlationId", "contentType", "name", "title", "summary", "description",
                "tags", "externalDocs", "bindings", "examples", "traits"},
    "parameter": {"enum", "default", "description", "examples", "location"},
}
"""Fields of the objects in the AsyncAPI 3.0.0 specification; others must begin with `x-`."""


def resolve(reference):
    """Return the target of a local reference. Fails if the target is missing."""
    assert reference.startswith("#/")
    node = DOCUMENT
    for part in reference[2:].split("/"):
        node = node[part]
    return node


def references(node):
    """Every `$ref` below `node`."""
    if isinstance(node, dict):
        if isinstance(node.get("$ref"), str):
            yield node["$ref"]
        for value in node.values():
            yield from references(value)
    elif isinstance(node, list):
        for value in node:
            yield from references(value)


def known(kind, node):
    """Return whether `node` has only fields that an object of its kind may have."""
    return all(name in ALLOWED[kind] or re.fullmatch(r"x-[\w.-]+", name) for name in node)


def test_document_is_asyncapi_3_with_known_fields():
    assert DOCUMENT["asyncapi"] == "3.0.0" and {"title", "version"} <= set(DOCUMENT["info"])
    assert known("root", DOCUMENT)
    for kind, nodes in (("server", DOCUMENT["servers"]), ("channel", DOCUMENT["channels"]),
                        ("operation", DOCUMENT["operations"]), ("message", DOCUMENT["components"]["messages"])):
        for name, node in nodes.items():
            assert known(kind, node) and re.fullmatch(r"[\w.-]+", name), (kind, name)
    for channel in DOCUMENT["channels"].values():
        assert all(known("parameter", one) for one in channel.get("parameters", {}).values())


def test_every_reference_resolves():
    found = list(references(DOCUMENT))
    assert len(found) > 80
    for one in found:
        assert isinstance(resolve(one), dict)


@pytest.mark.parametrize("name", DOCUMENT["servers"])
def test_a_server_names_host_and_protocol_and_its_variables(name):
    server = DOCUMENT["servers"][name]
    assert server["host"] and server["protocol"]
    assert set(re.findall(r"\{(\w+)\}", server["host"])) == set(server["variables"])


@pytest.mark.parametrize("name", DOCUMENT["channels"])
def test_the_parameters_of_a_channel_are_those_of_its_address(name):
    channel = DOCUMENT["channels"][name]
    assert set(re.findall(r"\{(\w+)\}", channel["address"] or "")) == set(channel.get("parameters", {}))
    assert channel["messages"] and channel["servers"]


def test_an_operation_uses_messages_of_its_own_channel():
    for name, operation in DOCUMENT["operations"].items():
        assert operation["action"] in ("send", "receive") and name.startswith(operation["action"])
        for part in (operation, operation.get("reply", operation)):
            own = {f"{part['channel']['$ref']}/messages/{key}" for key in resolve(part["channel"]["$ref"])["messages"]}
            assert {one["$ref"] for one in part["messages"]} <= own


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
def test_every_channel_is_there_with_its_direction_and_models(channel):
    action = "send" if channel.direction is Direction.FROM_ROBOT else "receive"
    assert f"{action}_{channel.name}" in DOCUMENT["operations"]
    message = DOCUMENT["components"]["messages"][channel.name]
    assert message["headers"]["$ref"].endswith(f"/{channel.header.__name__}")
    assert message["contentType"] == channel.encoding and message["x-max-payload-bytes"] == channel.max_payload_bytes


def test_schemas_are_those_of_schema_json_in_draft_07():
    schemas = DOCUMENT["components"]["schemas"]
    assert set(schemas) == set(schema.json_schema()["$defs"])
    text = json.dumps(schemas)
    assert "prefixItems" not in text and "$defs" not in text
    pose = schemas["FrameHeader"]["properties"]["pose"]
    assert len(pose["items"]) == pose["minItems"] == pose["maxItems"] == 3 and pose["additionalItems"] is False
