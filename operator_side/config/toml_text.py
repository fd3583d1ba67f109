"""Parses a TOML value from an option's text, and writes a table as TOML with the origin of each value. Pure."""

import json
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from sightline.protocol.errors import ConfigError

Key = tuple[str, ...]


def options_of(texts: Iterable[str], option: str = "--set", example: str = "linear_mps=0.2") -> dict[str, Any]:
    """Parse the KEY=VALUE texts of one option. Raises ConfigError that shows `example`."""
    return {key: toml_value(value) for key, value in (key_and_text(text, option, example) for text in texts)}


def key_and_text(text: str, option: str, example: str) -> tuple[str, str]:
    """Split KEY=VALUE. Raises ConfigError that shows `example`."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"invalid {option} '{text}': expected KEY=VALUE, e.g. {option} {example}")
    return key.strip(), value


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML. Raises tomllib.TOMLDecodeError, also for a value that Python cannot read or print."""
    try:
        table = tomllib.loads(text)
        json.dumps(table, default=str)  # a hexadecimal number may be too long to print
        return table
    except tomllib.TOMLDecodeError:
        raise
    except (ValueError, RecursionError):
        limits = "a number has too many digits, or lists and tables are nested too deeply"
        raise tomllib.TOMLDecodeError(limits) from None


def toml_value(text: str) -> Any:
    """Parse `text` as one TOML value. Text that is not TOML is the value itself."""
    try:
        table = parse_toml(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    return table["value"] if len(table) == 1 else text


def toml_text(table: Mapping[str, Any], comment: Callable[[Key], str] = lambda _key: "") -> str:
    """Format `table` (JSON types) as TOML. None becomes a comment, because TOML has no null. `comment` adds more."""
    return "\n".join(_lines(table, (), comment)).strip() + "\n"


def _lines(table: Mapping[str, Any], above: Key, comment: Callable[[Key], str]) -> Iterator[str]:
    """Yield first values, then tables, as TOML requires."""
    for name, value in table.items():
        if not isinstance(value, dict):
            remark = comment((*above, name))
            line = f"# {name} is not set" if value is None else f"{_name(name)} = {_value(value)}"
            yield f"{line:<50}  # {remark}" if remark else line
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
    """Quote `text` as in JSON, and escape DEL, as TOML requires."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")
