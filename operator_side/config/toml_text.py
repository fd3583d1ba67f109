"""A configuration as TOML text, with the origin of each value as a comment. Pure."""

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

Key = tuple[str, ...]


def toml_text(table: Mapping[str, Any], comment: Callable[[Key], str] = lambda _key: "") -> str:
    """`table` (JSON types) as TOML; a None is a comment, for TOML has none. `comment` says more of a key."""
    return "\n".join(_lines(table, (), comment)).strip() + "\n"


def _lines(table: Mapping[str, Any], above: Key, comment: Callable[[Key], str]) -> Iterator[str]:
    """Values first, then tables: TOML's order."""
    for name, value in table.items():
        if not isinstance(value, dict):
            said = comment((*above, name))
            line = f"# {name} is not set" if value is None else f"{_name(name)} = {_value(value)}"
            yield f"{line:<50}  # {said}" if said else line
    for name, value in table.items():
        if isinstance(value, dict) and value:
            yield f"\n[{'.'.join(_name(part) for part in (*above, name))}]"
            yield from _lines(value, (*above, name), comment)


def _name(name: str) -> str:
    return name if name.isascii() and name.replace("_", "a").replace("-", "a").isalnum() else _text(name)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_name(name)} = {_value(inner)}" for name, inner in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_value(inner) for inner in value) + "]"
    return _text(value) if isinstance(value, str) else json.dumps(value)


def _text(text: str) -> str:
    """JSON's string is TOML's, but for DEL, which TOML wants escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")
