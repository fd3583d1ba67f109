"""The codec suite: golden vectors sent to any program over a line protocol. Shell (a process).

    {"id", "kind": "message", "key", "header", "payload"}      header and payload in base64
    {"id", "kind": "hello" | "websocket" | "older_...", fields}  a vector of that folder, with its fields
    {"id", "kind": "write_twist", "linear_mps", "angular_rad_s"}
    -> `{"id", "ok": ...}`  or  `{"id", "refusal": reason}`  or  `{"id", "unsupported": true}`

Answers may come in any order; each question gets exactly one.
"""

import base64
import contextlib
import json
import math
import os
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, Self

from sightline.conformance.case import Bench, Case, Level, NotApplicableError, Suite
from sightline.conformance.runner import Outcome, Result
from sightline.protocol.errors import ConfigError, RejectReason, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import MAX_INTEGER
from sightline.protocol.spec.golden import outcome

MAX_ANSWER_BYTES: Final = 1_048_576
"""Security limit: a longer line is not an answer."""
_PRINTED: Final = 120
Fields = Mapping[str, Any]
_RESULTS: Final = ("ok", "refusal", "unsupported")


class ProgramError(Exception):
    """The program violates the line protocol, or has ended. The text is one line for the user."""


@dataclass(frozen=True, slots=True)
class Question:
    """One line to the program, without its id, and the expected answer, as in a golden vector."""

    kind: str
    fields: Fields
    """As in the line; bytes become base64."""
    expected: Fields
    """The expected answer with "ok", or with the reason of a rejection."""
    permitted: str = ""
    """A reason that is also correct, because the specification leaves the choice."""

    def line(self, number: int) -> bytes:
        """Return the line as sent, with its line end."""
        fields = {name: base64.b64encode(value).decode("ascii") if isinstance(value, bytes) else value
                  for name, value in self.fields.items()}
        return json.dumps({"id": number, "kind": self.kind, **fields}).encode("ascii") + b"\n"


def read_question(line: str | bytes) -> tuple[int, str, dict[str, Any]]:
    """Return id, kind and fields of a received line. Raises ValueError unless it is a question."""
    fields = json.loads(line)
    number, kind = fields.pop("id"), fields.pop("kind")
    return number, kind, fields


def read_answer(line: bytes) -> tuple[int, dict[str, Any]]:
    """Return the id and the rest of an answer. Raises ProgramError for an invalid one."""
    try:
        answer = json.loads(line)
    except (ValueError, RecursionError):
        raise ProgramError(f"this line is not JSON: {shown(line)}") from None
    number = answer.pop("id", None) if isinstance(answer, dict) else None
    if not isinstance(number, int) or isinstance(number, bool):
        raise ProgramError(f"this answer has no id: {shown(line)}")
    if len(answer.keys() & set(_RESULTS)) != 1:
        raise ProgramError(f"invalid answer: expected exactly one of {', '.join(_RESULTS)}: {shown(line)}")
    return number, answer


def shown(line: bytes) -> str:
    """Return the beginning of the line, without characters that could disturb a terminal."""
    text = line[:_PRINTED].decode("utf-8", "replace")
    return ascii(text) + ("..." if len(line) > _PRINTED else "")


def same(expected: Any, got: Any, where: str = "") -> str:
    """Return the place of the first difference, or an empty text.

    Numbers compare by value: 0, 0.0 and -0.0 are equal.
    """
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


# A third-party codec as a process: questions to its stdin, answers from its stdout, with time limits. Shell.


START_S: Final = 10.0
"""Time until the first answer: an interpreter may have to start and compile."""
ANSWER_S: Final = 2.0
"""Time between later answers, in any order."""
END_S: Final = 2.0
_READ_BYTES: Final = 65_536
_STDERR_TAIL: Final = 200


class CodecProgram:
    """A context manager. After it, the program and its children have ended in any case."""

    def __init__(self, command: Sequence[str]) -> None:
        """Start the program. Raises ConfigError if `command` cannot be started."""
        try:
            self._process = subprocess.Popen(
                list(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            raise ConfigError(f"codec: cannot start {command[0]!r}: {error.strerror}; is it installed?") from None
        self._number = 0
        self._buffer = b""
        self._stderr_tail = b""
        self._answered = False
        assert self._process.stderr is not None
        threading.Thread(target=self._listen, args=(self._process.stderr,), name="codec-stderr", daemon=True).start()

    def request(self, questions: Iterator[Question]) -> Iterator[tuple[Question, dict[str, Any]]]:
        """Send all questions, and yield each with its answer on arrival. Raises ProgramError."""
        lines: list[bytes] = []
        waiting: dict[int, Question] = {}
        for question in questions:
            self._number += 1
            waiting[self._number] = question
            lines.append(question.line(self._number))
        threading.Thread(target=self._write, args=(b"".join(lines),), name="codec-stdin", daemon=True).start()
        while waiting:
            number, answer = read_answer(self._line())
            if number not in waiting:
                raise ProgramError(f"an answer has the id {number}, which waits for none")
            yield waiting.pop(number), answer

    def finish(self) -> None:
        """Close its input, and wait for its end. Raises ProgramError unless it ends well and in time."""
        self._close_input()
        try:
            code = self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            raise ProgramError(f"it does not end within {END_S:g} s of its input") from None
        if code != 0:
            raise ProgramError(f"it {_ended(code)}{self._stderr_line()}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._close_input()

    # --- pipes -------------------------------------------------------------------------------------------------------

    def _write(self, data: bytes) -> None:
        """Write on a thread, because a program may answer before it has read everything. The reader detects its end."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(data)
            self._process.stdin.flush()
        except (OSError, ValueError):
            return

    def _close_input(self) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # questions that a program did not read before its end
            self._process.stdin.close()

    def _listen(self, stderr: IO[bytes]) -> None:
        """Read stderr on a thread, and keep the end of it."""
        while data := os.read(stderr.fileno(), _READ_BYTES):
            self._stderr_tail = (self._stderr_tail + data)[-_STDERR_TAIL:]

    def _line(self) -> bytes:
        """Return the next line, without its end. Raises ProgramError if none arrives in time or at all."""
        deadline_s = time.monotonic() + (ANSWER_S if self._answered else START_S)
        while b"\n" not in self._buffer:
            if len(self._buffer) > MAX_ANSWER_BYTES:
                raise ProgramError(f"an answer is longer than {MAX_ANSWER_BYTES} bytes: {shown(self._buffer)}")
            self._read(deadline_s)
        line, _, self._buffer = self._buffer.partition(b"\n")
        self._answered = True
        return line

    def _read(self, deadline_s: float) -> None:
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, deadline_s - time.monotonic()))
        if not ready:
            raise ProgramError(f"no answer within {ANSWER_S if self._answered else START_S:g} s{self._stderr_line()}")
        data = os.read(self._process.stdout.fileno(), _READ_BYTES)
        if not data:
            raise ProgramError(f"it {self._ending()} before it had answered{self._stderr_line()}")
        self._buffer += data

    def _ending(self) -> str:
        try:
            return _ended(self._process.wait(END_S))
        except subprocess.TimeoutExpired:
            return "closed its output"

    def _stderr_line(self) -> str:
        """Return the end of its stderr, as one line."""
        words = self._stderr_tail.strip().splitlines()
        return f"; it printed {shown(words[-1])}" if words else ""


def _ended(code: int) -> str:
    return f"was ended by signal {-code}" if code < 0 else f"ended with {code}"


# The questions to a codec: every golden vector, every accepted one cut and with flipped bits, and twists to
# write. Pure.  A vector's outcome is in its file; that of a cut or flipped message is the result of our own decoders.
# Only the files define the questions: a new vector is a new case.


VECTORS: Final = Path(__file__).parent.parent / "protocol" / "vectors"
_HEX: Final = "_hex"
_CUT_EVERY: Final = 8
"""Of all but the usual message of a channel, because all are similar and a kit should not take minutes."""
_MOST_CUTS: Final = 512
"""Cuts of one payload. Each cut sends its beginning again: 90 MB for one of 32 KB that is cut at every 8th byte."""
_COMPONENT_BYTES: Final = 3
"""Of each component in a JPEG's frame header."""
_VECTORS_FROM, _CUTS_FROM, _WRITES_FROM, _FLIPS_FROM = 1001, 2001, 3001, 4001

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
    """One line of the report, passed if all questions are answered correctly. `family`: vector, cut, write, flip."""

    number: int
    family: str
    purpose: str
    must: bool
    clause: str
    questions: Callable[[], Iterator[Question]]
    """Created again each time, because there are tens of thousands."""


def codec_cases(vectors: Path = VECTORS) -> list[CodecCase]:
    """Return every case: one per vector, two per accepted one that can be cut and flipped, one per twist to write."""
    read = [(path.relative_to(vectors).with_suffix("").as_posix(), json.loads(path.read_text("utf-8")))
            for path in sorted(vectors.rglob("*.json"))]
    able = [(name, vector) for name, vector in read if "accept" in vector and "key" in vector]
    return [
        *(_vector_case(_VECTORS_FROM + count, *one) for count, one in enumerate(read)),
        *(_cut_case(_CUTS_FROM + count, *one) for count, one in enumerate(able)),
        *(_write_case(_WRITES_FROM + count, *one) for count, one in enumerate(_WRITTEN.items())),
        *(_flip_case(_FLIPS_FROM + count, *one) for count, one in enumerate(able) if one[1]["header_hex"]),
    ]


def _vector_case(number: int, name: str, vector: dict[str, Any]) -> CodecCase:
    expected = {"ok": vector["accept"]} if "accept" in vector else {"refusal": vector["refuse"]}
    requested = {field: value for field, value in vector.items() if field not in ("purpose", "accept", "refuse")}
    kind = name.partition("/")[0]
    if "key" in vector:
        kind = "message"
        requested = {field.removesuffix(_HEX): bytes.fromhex(value) if field.endswith(_HEX) else value
                 for field, value in requested.items()}
    purpose = f"`vectors/{name}.json`: {vector['purpose']}."
    clause = "17.1 Golden vectors"
    return CodecCase(number, "vector", purpose, True, clause, lambda: iter((Question(kind, requested, expected),)))


def _cut_case(number: int, name: str, vector: dict[str, Any]) -> CodecCase:
    key, header, payload = vector["key"], bytes.fromhex(vector["header_hex"]), bytes.fromhex(vector["payload_hex"])

    step = 1 if name.endswith("/usual") else _CUT_EVERY
    payload_step = max(step, math.ceil(len(payload) / _MOST_CUTS))

    def questions() -> Iterator[Question]:
        for size in range(0, min(len(header), len(header.rstrip()) + 1), step):
            yield _message(key, header[:size], payload)
        choice = _components_at(payload)
        for size in range(0, len(payload), payload_step):
            yield _message(key, header, payload[:size], RejectReason.MALFORMED if size in choice else "")

    where = "every byte" if step == 1 else f"every {step}th byte"
    apart = "" if payload_step == step else f", the payload at every {payload_step} bytes"
    purpose = f"`vectors/{name}.json`, header or payload cut short at {where}{apart}."
    return CodecCase(number, "cut", purpose, True, "17.2 Golden vectors", questions)


def _flip_case(number: int, name: str, vector: dict[str, Any]) -> CodecCase:
    key, header, payload = vector["key"], bytes.fromhex(vector["header_hex"]), bytes.fromhex(vector["payload_hex"])
    step = 1 if name.endswith("/usual") else _CUT_EVERY

    def questions() -> Iterator[Question]:
        for at in range(0, len(header), step):
            flipped = header[at] ^ 1 << at // step % 8
            yield _message(key, header[:at] + bytes((flipped,)) + header[at + 1 :], payload)

    where = "every byte" if step == 1 else f"every {step}th byte"
    purpose = f"`vectors/{name}.json`, one bit of {where} of the header flipped, each alone."
    return CodecCase(number, "flip", purpose, True, "17.2 Golden vectors", questions)


def _components_at(payload: bytes) -> range:
    """Return the cuts of a JPEG at which it may be read or rejected: within the components of its frame header (3.2).

    Any other payload has no such cut.
    """
    for size in range(len(payload)):
        with contextlib.suppress(WireError):
            return range(size, size + _COMPONENT_BYTES * read_jpeg_size(payload[:size], MAX_INTEGER).components)
    return range(0)


def _message(key: str, header: bytes, payload: bytes, permitted: str = "") -> Question:
    came_to = json.loads(json.dumps(outcome(key, header, payload)))
    expected = {"ok": came_to["accept"]} if "accept" in came_to else {"refusal": came_to["refuse"]}
    return Question("message", {"key": key, "header": header, "payload": payload}, expected, permitted)


def _write_case(number: int, name: str, twist: tuple[str, float, float, str]) -> CodecCase:
    purpose, linear, angular, text = twist
    requested = Question("write_twist", {"linear_mps": linear, "angular_rad_s": angular}, {"ok": text})
    return CodecCase(number, "write", f"A twist is written with {purpose} ({name}).", False, "4.2 Writing",
                     lambda: iter((requested,)))


# All cases for a codec, run against a program on a pipe. Shell.
#
# results = run_codec(["node", "codec_adapter.mjs"], CASES)


END: Final = "C-CODEC-9001"


def _on_a_pipe(_bench: Bench) -> None:
    raise NotApplicableError("a codec is tested on a pipe, not over a network")


def _cases(requested: Sequence[CodecCase]) -> tuple[Case, ...]:
    suite = Suite("C")
    for one in requested:
        level = Level.MUST if one.must else Level.SHOULD
        suite.add(Case(f"C-CODEC-{one.number}", level, one.clause, one.purpose, _on_a_pipe))
    title = "The program ends, with 0, when its input ends."
    suite.add(Case(END, Level.SHOULD, "17.3 A codec on a pipe", title, _on_a_pipe))
    return tuple(suite.cases)


_SENT: Final = {f"C-CODEC-{one.number}": one for one in codec_cases()}
CASES: Final[tuple[Case, ...]] = _cases(tuple(_SENT.values()))


def run_codec(
    command: Sequence[str], cases: Sequence[Case] = CASES, on_result: Callable[[Result], None] = lambda _result: None
) -> list[Result]:
    """Test the program of `command` with each of `cases`.

    A program that dies, hangs or sends an invalid answer fails the current case; later cases are not
    applicable. Raises ConfigError if it cannot be started.
    """
    results: list[Result] = []
    gone = ""
    with CodecProgram(command) as program:
        for case in cases:
            began_s = time.monotonic()
            outcome, reason = (Outcome.SKIPPED, "the program is gone") if gone else (Outcome.PASSED, "")
            try:
                if not gone:
                    outcome, reason = _result(program, case)
            except ProgramError as fault:
                gone = reason = str(fault)
                outcome = Outcome.FAILED
            results.append(Result(case, outcome, reason, round((time.monotonic() - began_s) * 1e6)))
            on_result(results[-1])
    return results


def _result(program: CodecProgram, case: Case) -> tuple[Outcome, str]:
    """Send the questions of one case. Raises ProgramError."""
    if case.id == END:
        program.finish()
        return Outcome.PASSED, ""
    wrong, unsupported = "", ""
    for question, answer in program.request(_SENT[case.id].questions()):
        if "unsupported" in answer:
            unsupported = f"the program does not know questions of kind {question.kind}"
        free = question.permitted and answer.get("refusal") == question.permitted
        wrong = wrong or ("" if unsupported or free else same(dict(question.expected), answer))
    if wrong:
        return Outcome.FAILED, wrong
    return (Outcome.SKIPPED, unsupported) if unsupported else (Outcome.PASSED, "")
