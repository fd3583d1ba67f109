"""Which keys a configuration model has, and what each allows. Pure."""

import types
from collections.abc import Iterator
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel

Key = tuple[str, ...]


def known_keys(model: type[BaseModel]) -> Iterator[Key]:
    """Every key of `model` that holds a value, tables left out."""
    for name, field in model.model_fields.items():
        inner = table_of(field.annotation)
        if inner is None:
            yield (name,)
        else:
            yield from ((name, *key) for key in known_keys(inner))


def is_known(model: type[BaseModel], key: Key) -> bool:
    """Whether `key` names a value or a table of `model`; below a free-form table anything is."""
    field = model.model_fields.get(key[0])
    if field is None:
        return False
    inner = table_of(field.annotation)
    if len(key) == 1:
        return True
    return is_known(inner, key[1:]) if inner else is_free_form(field.annotation)


def is_free_form(annotation: Any) -> bool:
    """Whether a field is a table of whatever a plug-in understands."""
    return get_origin(annotation) is dict


def table_of(annotation: Any) -> type[BaseModel] | None:
    """The model behind a field that is a table; None for values and lists."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, types.UnionType, Annotated):
        return next((table for part in get_args(annotation) if (table := table_of(part))), None)
    return None


def allowed(model: type[BaseModel], key: Key) -> str:
    """What may stand at `key`, in words; "" where no plain bound says it."""
    schema = model.model_json_schema()
    node: Any = schema
    for name in key:
        node = _resolve(schema, node)
        node = node.get("properties", {}).get(name) if "properties" in node else node.get("items", {})
        if node is None:
            return ""
    return _in_words(_resolve(schema, node))


def _resolve(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    choices = [choice for choice in node.get("anyOf", ()) if choice.get("type") != "null"]
    node = choices[0] if choices else node
    reference = node.get("$ref")
    return schema["$defs"][reference.rpartition("/")[2]] if reference else node


_BOUNDS = {"exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "to"}
_TYPES = {"number": "a number", "integer": "a whole number", "boolean": "true or false", "string": "text",
          "array": "a list", "object": "a table"}


def _in_words(node: dict[str, Any]) -> str:
    if "enum" in node:
        return "one of " + ", ".join(str(value) for value in node["enum"])
    bounds = [f"{word} {node[name]}" for name, word in _BOUNDS.items() if name in node]
    return " ".join([_TYPES.get(node.get("type", ""), ""), *bounds]).strip()
