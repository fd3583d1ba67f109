"""Writes or verifies the generated parts of the specification. Shell.

    python -m sightline.protocol.spec.generate --verify    exit code 5 and the names of files that differ
    python -m sightline.protocol.spec.generate --write
"""

import argparse
import inspect
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from sightline.protocol import errors as rejections
from sightline.protocol.channels import CHANNELS, key_for
from sightline.protocol.errors import CLAMPED, RejectReason
from sightline.protocol.spec import golden
from sightline.protocol.spec.asyncapi import document
from sightline.protocol.transports.websocket.framing import Hello

HERE: Final = Path(__file__).parent.parent
_BLOCK = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- /generated -->)", re.DOTALL)
_UNITS: Final = {
    "_mps": "m/s",
    "_mps2": "m/s²",
    "_mps3": "m/s³",
    "_rad_s": "rad/s",
    "_rad_s2": "rad/s²",
    "_rad_s3": "rad/s³",
    "_s": "s",
    "_ms": "ms",
    "_v": "V",
    "_rad": "rad",
    "_us": "µs",
    "_px": "px",
    "_m": "m",
    "fps": "1/s",
    "_percent": "%",
    "pose": "m, m, rad",
    "moving": "m/s, rad/s",
    "applied": "m/s, rad/s",
}
"""Ending of a field name -> its unit. The first match counts."""
Schema = dict[str, Any]


def unit_of(field: str) -> str:
    """Return the unit of `field`; "" for a number without a unit and for text."""
    return next((unit for ending, unit in _UNITS.items() if field.endswith(ending)), "")


def channel_table() -> str:
    """Return the channels as two Markdown tables: their meaning, and their transport."""
    rows = ["| channel | direction | key | header | payload | what it is |", "|---" * 6 + "|"]
    carried = ["| channel | payload bytes | encoding | priority | rate | when a link is full |", "|---" * 6 + "|"]
    for one in CHANNELS.values():
        key = key_for("R", one, "s" if one.has_source else "").replace("/R/", "/<robot>/")
        key = re.sub(r"/s$", "/<source>", key)
        payload = one.payload.__name__ if one.payload else one.encoding
        purpose = one.purpose.replace("|", "\\|")
        what = f"{one.header.__name__} | {payload} | {purpose}"
        rows.append(f"| `{one.name}` | {one.direction.value} | `{key}` | {what} |")
        carried.append(
            f"| `{one.name}` | <= {one.max_payload_bytes} | {one.encoding} | {one.priority.value} | {one.rate} | "
            f"{one.when_full} |"
        )
    return "\n".join([*rows, "", *carried]) + "\n"


def reject_reason_table() -> str:
    """Return every reject reason and its meaning, as a Markdown table."""
    rows = ["| reason | meaning |", "|---|---|"]
    meanings = dict(re.findall(r'"(\w+)"  # (.*)', inspect.getsource(rejections)))
    rows += [f"| `{reason}` | {meanings[reason]} |" for reason in RejectReason]
    rows.append(f"| `{CLAMPED}` | not a rejection: the command was accepted, and reduced to the robot's limits |")
    return "\n".join(rows) + "\n"


def field_tables() -> str:
    """Return one Markdown table per model, headers first."""
    return "\n".join(_model_table(name, schema) for name, schema in _definitions().items())


def _models() -> list[type[BaseModel]]:
    headers = [channel.header for channel in CHANNELS.values()]
    payloads = [channel.payload for channel in CHANNELS.values() if channel.payload]
    return list(dict.fromkeys([*headers, *payloads, Hello]))


def json_schema() -> Schema:
    """Return the JSON Schema of every header, JSON payload and the WebSocket hello, under `$defs`."""
    return models_json_schema([(model, "validation") for model in _models()], title="Sightline wire protocol 1")[1]


def _definitions() -> Schema:
    definitions: Schema = json_schema()["$defs"]
    first = [model.__name__ for model in _models()]
    rest = [name for name, schema in definitions.items() if name not in first and "properties" in schema]
    return {name: definitions[name] for name in (*first, *rest)}


def _model_table(name: str, schema: Schema) -> str:
    rows = [f"**{name}**: {_first_line(schema)}", "", "| field | type and range | unit | if absent | meaning |"]
    rows.append("|---" * 5 + "|")
    required = schema.get("required", [])
    for field, definition in schema["properties"].items():
        default = "rejected" if field in required else _default_of(definition)
        words = f"{unit_of(field)} | {default} | {definition.get('description', '')}"
        rows.append(f"| `{field}` | {_type_of(definition)} | {words} |")
    return "\n".join(rows) + "\n"


def _default_of(definition: Schema) -> str:
    default = definition.get("default")
    return "its own defaults" if isinstance(default, dict) and default else f"`{json.dumps(default)}`"


def _first_line(schema: Schema) -> str:
    return str(schema.get("description", "")).partition("\n\n")[0].replace("\n", " ")


def _type_of(schema: Schema) -> str:
    """Describe the type of a JSON Schema in a few words."""
    if "$ref" in schema:
        return _named(schema["$ref"].rpartition("/")[2])
    if "anyOf" in schema:
        return " or ".join(_type_of(option) for option in schema["anyOf"])
    if "const" in schema or "enum" in schema:
        return " or ".join(f"`{json.dumps(value)}`" for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        return _array(schema)
    if schema.get("type") == "object":
        return _object(schema)
    return " ".join([schema["type"], *_bounds(schema)])


def _object(schema: Schema) -> str:
    most = f" (at most {schema['maxProperties']})" if "maxProperties" in schema else ""
    if "patternProperties" not in schema:
        return f"object of {_type_of(schema['additionalProperties'])}{most}"
    [(pattern, values)] = schema["patternProperties"].items()
    return f"object of {_type_of(values)}{most}, names `{pattern}`"


def _named(name: str) -> str:
    definition = json_schema()["$defs"][name]
    return name if "properties" in definition else _type_of(definition)


def _array(schema: Schema) -> str:
    if "prefixItems" in schema:
        return f"array of {len(schema['prefixItems'])}: {_type_of(schema['prefixItems'][0])}"
    most = f" (at most {schema['maxItems']})" if "maxItems" in schema else ""
    return f"array of {_type_of(schema['items'])}{most}"


def _bounds(schema: Schema) -> Iterator[str]:
    if "minimum" in schema and "maximum" in schema:
        yield f"{schema['minimum']:.17g} to {schema['maximum']:.17g}"
    elif "exclusiveMinimum" in schema:
        yield f"above {schema['exclusiveMinimum']:g}, at most {schema['maximum']:g}"
    elif "minimum" in schema:
        yield f"at least {schema['minimum']:g}"
    if "maxLength" in schema:
        yield f"of at most {schema['maxLength']} characters"
    if "pattern" in schema:
        yield f"`{schema['pattern']}`"


GENERATED: Final = {
    "channels": channel_table,
    "fields": field_tables,
    "rejections": reject_reason_table,
    "vectors": golden.vector_table,
    "examples": golden.examples,
}


def readme(text: str) -> str:
    """Return `text` with every generated block updated."""
    return _BLOCK.sub(lambda block: block[1] + GENERATED[block[2]]() + block[3], text)


def expected_files() -> dict[Path, str]:
    """Return every generated file, relative to this package, with its expected content."""
    files = {Path("README.md"): readme((HERE / "README.md").read_text("utf-8"))}
    schema = json_schema()
    files[Path("schema.json")] = json.dumps(schema, indent=1) + "\n"
    files[Path("asyncapi.json")] = json.dumps(document(schema["$defs"]), indent=1) + "\n"
    return files | {Path("vectors") / path: text for path, text in golden.files().items()}


def differing() -> list[Path]:
    """Return the generated files that are missing, not expected, or different."""
    expected = expected_files()
    there = {path.relative_to(HERE) for path in (HERE / "vectors").rglob("*.json")}
    wrong = [path for path, text in expected.items() if _read(HERE / path) != text]
    return sorted({*wrong, *(there - set(expected))})


def _read(path: Path) -> str | None:
    return path.read_text("utf-8") if path.is_file() else None


def write() -> None:
    """Write every generated file, and remove vectors without a case."""
    expected = expected_files()
    for path in differing():
        if path not in expected:
            (HERE / path).unlink()
            continue
        (HERE / path).parent.mkdir(parents=True, exist_ok=True)
        (HERE / path).write_text(expected[path], "utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Returns the exit code: 0, or 5 if `--verify` found a difference."""
    parser = argparse.ArgumentParser(
        prog="python -m sightline.protocol.spec.generate", description=__doc__.partition("\n")[0]
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--write", action="store_true", help="bring the generated files up to date")
    what.add_argument("--verify", action="store_true", help="exit 5 if they are not")
    if parser.parse_args(arguments).write:
        write()
        return 0
    wrong = differing()
    for path in wrong:
        print(
            f"protocol/{path} differs from the code; run python -m sightline.protocol.spec.generate --write",
            file=sys.stderr,
        )
    return 5 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
