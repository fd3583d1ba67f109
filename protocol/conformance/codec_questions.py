"""What a codec is asked: every golden vector, every accepted one cut short, and twists to write. Pure.

A vector's outcome is what its file says; what a cut message must come to is what our own decoders say of it. The files
alone decide what is asked: a new vector is a new case.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sightline.conformance.codec import Question
from sightline.protocol.spec.golden import outcome

VECTORS: Final = Path(__file__).parent.parent / "vectors"
_HEX: Final = "_hex"
_CUT_EVERY: Final = 8
"""Of all but a channel's usual message: each is much like that one, and a kit should not take minutes."""
_VECTORS_FROM, _CUTS_FROM, _WRITES_FROM = 1001, 2001, 3001

_WRITTEN: Final = {
    "usual": ("four decimals", 0.2, -0.35, "0.2000|-0.3500"),
    "zero": ("four decimals though it is zero", 0, 0, "0.0000|0.0000"),
    "minus_zero": ("no sign where it is zero", -0.0, -0.0, "0.0000|0.0000"),
    "rounds_to_minus_zero": ("no sign where it rounds to zero", -1e-5, -4.9e-5, "0.0000|0.0000"),
    "rounds_away": ("the last decimal rounded", 0.00006, -0.00006, "0.0001|-0.0001"),
    "integers": ("four decimals though they are integers", 1, -2, "1.0000|-2.0000"),
    "small": ("no exponent though it is small", 1e-7, 1e-300, "0.0000|0.0000"),
    "large": ("no exponent and no groups though it is large", 123456.75, -9876543.5, "123456.7500|-9876543.5000"),
    "tenths": ("the nearest decimals", 0.1, 0.30000000000000004, "0.1000|0.3000"),
}


@dataclass(frozen=True, slots=True)
class CodecCase:
    """One line of the report: all of its questions must be answered rightly; `family` is vector, cut or write."""

    number: int
    family: str
    purpose: str
    must: bool
    clause: str
    questions: Callable[[], Iterator[Question]]
    """Made anew each time: there are tens of thousands."""


def codec_cases(vectors: Path = VECTORS) -> list[CodecCase]:
    """Every case: one per vector, one per vector that is accepted and can be cut, one per twist to write."""
    read = [(path.relative_to(vectors).with_suffix("").as_posix(), json.loads(path.read_text("utf-8")))
            for path in sorted(vectors.rglob("*.json"))]
    able = [(name, vector) for name, vector in read if "accept" in vector and "key" in vector]
    return [
        *(_vector_case(_VECTORS_FROM + count, *one) for count, one in enumerate(read)),
        *(_cut_case(_CUTS_FROM + count, *one) for count, one in enumerate(able)),
        *(_write_case(_WRITES_FROM + count, *one) for count, one in enumerate(_WRITTEN.items())),
    ]


def _vector_case(number: int, name: str, vector: dict[str, Any]) -> CodecCase:
    expected = {"ok": vector["accept"]} if "accept" in vector else {"refusal": vector["refuse"]}
    asked = {field: value for field, value in vector.items() if field not in ("purpose", "accept", "refuse")}
    kind = name.partition("/")[0]
    if "key" in vector:
        kind = "message"
        asked = {field.removesuffix(_HEX): bytes.fromhex(value) if field.endswith(_HEX) else value
                 for field, value in asked.items()}
    purpose = f"`vectors/{name}.json`: {vector['purpose']}."
    clause = "17.1 Golden vectors"
    return CodecCase(number, "vector", purpose, True, clause, lambda: iter((Question(kind, asked, expected),)))


def _cut_case(number: int, name: str, vector: dict[str, Any]) -> CodecCase:
    key, header, payload = vector["key"], bytes.fromhex(vector["header_hex"]), bytes.fromhex(vector["payload_hex"])

    step = 1 if name.endswith("/usual") else _CUT_EVERY

    def questions() -> Iterator[Question]:
        for size in range(0, min(len(header), len(header.rstrip()) + 1), step):
            yield _message(key, header[:size], payload)
        for size in range(0, len(payload), step):
            yield _message(key, header, payload[:size])

    where = "every byte" if step == 1 else f"every {step}th byte"
    purpose = f"`vectors/{name}.json`, header or payload cut short at {where}."
    return CodecCase(number, "cut", purpose, True, "17.2 Golden vectors", questions)


def _message(key: str, header: bytes, payload: bytes) -> Question:
    came_to = json.loads(json.dumps(outcome(key, header, payload)))
    expected = {"ok": came_to["accept"]} if "accept" in came_to else {"refusal": came_to["refuse"]}
    return Question("message", {"key": key, "header": header, "payload": payload}, expected)


def _write_case(number: int, name: str, twist: tuple[str, float, float, str]) -> CodecCase:
    purpose, linear, angular, text = twist
    asked = Question("write_twist", {"linear_mps": linear, "angular_rad_s": angular}, {"ok": text})
    return CodecCase(number, "write", f"A twist is written with {purpose} ({name}).", False, "4.2 Writing",
                     lambda: iter((asked,)))
