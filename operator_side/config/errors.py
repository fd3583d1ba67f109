"""Configuration errors as one line with the nearest valid name. Pure."""

import difflib
import json
import math
import types
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

Key = tuple[str, ...]


def known_keys(model: type[BaseModel]) -> Iterator[Key]:
    """Yield every key of `model` with a value, without tables."""
    for name, field in model.model_fields.items():
        inner = table_of(field.annotation)
        if inner is None:
            yield (name,)
        else:
            yield from ((name, *key) for key in known_keys(inner))


def is_known(model: type[BaseModel], key: Key) -> bool:
    """Return True if `key` names a value or table of `model`, or is below a free-form table."""
    field = model.model_fields.get(getattr(model, "renamed_keys", {}).get(key[0], key[0]))
    if field is None:
        return False
    inner = table_of(field.annotation)
    if len(key) == 1:
        return True
    return is_known(inner, key[1:]) if inner else is_free_form(field.annotation)


def wrong_type(model: type[BaseModel], key: Key, value: Any) -> str:
    """Describe a value of a file that pydantic would silently convert to another type: true to 1, 1 to true."""
    wanted = _types_of(model, key)
    if isinstance(value, bool):
        is_wrong = bool not in wanted and bool(wanted & {int, float})
    else:
        is_wrong = wanted - {type(None)} == {bool}
    return f" = {_shown(value)}: expected {allowed(model, key)}" if is_wrong else ""


def _types_of(model: type[BaseModel], key: Key) -> set[Any]:
    """Return the types of the value at `key`; empty for an unknown key or a key in a free-form table."""
    field = model.model_fields.get(getattr(model, "renamed_keys", {}).get(key[0], key[0]))
    if field is None:
        return set()
    if len(key) == 1:
        return set(get_args(field.annotation) or [field.annotation])
    inner = table_of(field.annotation)
    return _types_of(inner, key[1:]) if inner else set()


def is_free_form(annotation: Any) -> bool:
    """Return True if a field is a table with the options of a plug-in."""
    return get_origin(annotation) is dict


def table_of(annotation: Any) -> type[BaseModel] | None:
    """Return the model of a field that is a table; None for values and lists."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, types.UnionType, Annotated):
        return next((table for part in get_args(annotation) if (table := table_of(part))), None)
    return None


def allowed(model: type[BaseModel], key: Key) -> str:
    """Describe the values that `key` accepts; "" without a simple limit."""
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


# --- a configuration error as one line ---------------------------------------------------------------------------


_LONGEST_VALUE = 60
_MOST_NAMES = 12


def no_such_name(kind: str, name: str, names: Iterable[str]) -> str:
    """Report that `name` is not in `names`, with the nearest name or the first names."""
    names = list(names)
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    shown = [*names[:_MOST_NAMES], *([f"and {len(names) - _MOST_NAMES} more"] if len(names) > _MOST_NAMES else [])]
    hint = f"did you mean '{nearest[0]}'?" if nearest else f"expected {', '.join(shown)}"
    return f"unknown {kind} '{name}'; {hint}"


def explain(
    model: type[BaseModel], error: ValidationError, typed: Callable[[Key], Key], label: Callable[[Key], str]
) -> str:
    """Describe the first problem in full, with the number of other problems.

    `typed` completes an unknown key to the given key below it. `label` names a key as it was written.
    """
    problems = error.errors(include_url=False)
    first = problems[0]
    key = tuple(str(part) for part in first["loc"])
    key = typed(key) if first["type"] == "extra_forbidden" else key
    text = f"{label(key)}{_problem(model, key, first)}"
    return text if len(problems) == 1 else f"{text} (and {len(problems) - 1} more)"


def _problem(model: type[BaseModel], key: Key, problem: Any) -> str:
    if problem["type"] == "extra_forbidden":
        return f": unknown key{_nearest_key(model, key)}"
    if problem["type"] == "missing":
        return ": missing"
    if problem["type"] == "value_error":
        return f": {problem['ctx']['error']}"
    may_be = allowed(model, key)
    if may_be and problem["type"].endswith(("_type", "_parsing")):  # the message of pydantic names Python types
        return f" = {_shown(problem['input'])}: expected {may_be}"
    message = problem["msg"].replace("Input should be", "expected", 1)
    return f" = {_shown(problem['input'])}: {message}" + (f"; allowed: {may_be}" if may_be else "")


def _shown(value: Any) -> str:
    """Format a value as in TOML or JSON, not as in Python."""
    is_plain = isinstance(value, str) or (isinstance(value, float) and not math.isfinite(value))
    text = (f"'{value}'" if isinstance(value, str) else str(value)) if is_plain else json.dumps(value, default=str)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."


def _nearest_key(model: type[BaseModel], key: Key) -> str:
    in_list = any(part.isdigit() for part in key)
    names = _list_keys(model) if in_list else [".".join(known) for known in known_keys(model)]
    nearest = difflib.get_close_matches(key[-1] if in_list else ".".join(key), names, n=1, cutoff=0.6)
    return f"; did you mean '{nearest[0]}'?" if nearest else "; `sightline config show SERVICE` lists all"


def _list_keys(model: type[BaseModel]) -> list[str]:
    """Return the keys of all tables, for a key inside a list."""
    return [name for table in model.model_json_schema().get("$defs", {}).values() for name in table["properties"]]
