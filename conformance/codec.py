"""The line protocol between the kit and any codec: questions out, answers in, each one line of JSON. Pure.

    {"id", "kind": "message", "key", "header", "payload"}      header and payload in base64
    {"id", "kind": "hello" | "websocket" | "older_...", fields}  a vector of that folder, in its own words
    {"id", "kind": "write_twist", "linear_mps", "angular_rad_s"}
    -> {"id", "ok": ...}  or  {"id", "refusal": reason}  or  {"id", "unsupported": true}

The order of answers is free; each question gets exactly one.
"""

import base64
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

MAX_ANSWER_BYTES: Final = 1_048_576
"""Security limit: a longer line is no answer."""
_PRINTED: Final = 120
Fields = Mapping[str, Any]


class ProgramError(Exception):
    """The program does not keep to the line protocol, or is gone; the text is one line for a person."""


@dataclass(frozen=True, slots=True)
class Question:
    """One line to the program, but for its id, and what the answer must be, as in a golden vector."""

    kind: str
    fields: Fields
    """As in the line; bytes stand for base64."""
    expected: Fields
    """{"ok": ...} or {"refusal": reason}."""

    def line(self, number: int) -> bytes:
        """As sent, with its line end."""
        fields = {name: base64.b64encode(value).decode("ascii") if isinstance(value, bytes) else value
                  for name, value in self.fields.items()}
        return json.dumps({"id": number, "kind": self.kind, **fields}).encode("ascii") + b"\n"


def read_question(line: str | bytes) -> tuple[int, str, dict[str, Any]]:
    """The other end's: id, kind and fields, as they came. Raises ValueError for what is no question."""
    fields = json.loads(line)
    number, kind = fields.pop("id"), fields.pop("kind")
    return number, kind, fields


def read_answer(line: bytes) -> tuple[int, dict[str, Any]]:
    """The id and the rest of an answer. Raises ProgramError for what is none."""
    try:
        answer = json.loads(line)
    except (ValueError, RecursionError):
        raise ProgramError(f"this line is no JSON: {shown(line)}") from None
    number = answer.pop("id", None) if isinstance(answer, dict) else None
    if not isinstance(number, int) or isinstance(number, bool):
        raise ProgramError(f"this answer has no id: {shown(line)}")
    if len(answer.keys() & {"ok", "refusal", "unsupported"}) != 1:
        raise ProgramError(f"this answer is not one of ok, refusal, unsupported: {shown(line)}")
    return number, answer


def shown(line: bytes) -> str:
    """The line's beginning, without anything that could confuse a terminal."""
    text = line[:_PRINTED].decode("utf-8", "replace")
    return ascii(text) + ("..." if len(line) > _PRINTED else "")


def same(expected: Any, got: Any, where: str = "") -> str:
    """Where two values differ first, or an empty text. Numbers compare by value: 0, 0.0 and -0.0 are one."""
    if isinstance(expected, bool) or isinstance(got, bool) or not isinstance(expected, (dict, list, int, float)):
        return "" if type(expected) is type(got) and expected == got else _differ(expected, got, where)
    if isinstance(expected, (int, float)):
        return "" if isinstance(got, (int, float)) and expected == got else _differ(expected, got, where)
    if type(expected) is not type(got) or len(expected) != len(got):
        return _differ(expected, got, where)
    if isinstance(expected, dict) and set(expected) != set(got):
        return _differ(sorted(expected), sorted(got), f"{where} fields")
    names: Iterable[Any] = expected if isinstance(expected, dict) else range(len(expected))
    found = (same(expected[name], got[name], f"{where}.{name}" if where else str(name)) for name in names)
    return next(filter(None, found), "")


def _differ(expected: Any, got: Any, where: str) -> str:
    return f"{where or 'the answer'}: {_short(got)} where {_short(expected)} is right"


def _short(value: Any) -> str:
    text = ascii(value)
    return text if len(text) <= _PRINTED else text[:_PRINTED] + "..."
