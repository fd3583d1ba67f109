"""A codec of somebody else's as a process: questions to its stdin, answers from its stdout, in time. Shell."""

import contextlib
import os
import select
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import IO, Any, Final, Self

from sightline.conformance.codec import MAX_ANSWER_BYTES, ProgramError, Question, read_answer, shown
from sightline.protocol.errors import ConfigError

START_S: Final = 10.0
"""Until the first answer: an interpreter may have to start and compile."""
ANSWER_S: Final = 2.0
"""From then on until the next answer, whichever it is."""
END_S: Final = 2.0
_READ_BYTES: Final = 65_536
_LAST_WORDS: Final = 200


class CodecProgram:
    """Use it in a `with`; whatever happens, the program and what it started have ended afterwards."""

    def __init__(self, command: Sequence[str]) -> None:
        """Raises ConfigError if `command` cannot be started."""
        try:
            self._process = subprocess.Popen(
                list(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            raise ConfigError(f"codec: cannot start {command[0]!r}: {error.strerror}; is it installed?") from None
        self._number = 0
        self._buffer = b""
        self._last_words = b""
        self._answered = False
        assert self._process.stderr is not None
        threading.Thread(target=self._listen, args=(self._process.stderr,), daemon=True).start()

    def ask(self, questions: Iterator[Question]) -> Iterator[tuple[Question, dict[str, Any]]]:
        """Ask all of them, and give each with its answer as it comes. Raises ProgramError."""
        lines: list[bytes] = []
        waiting: dict[int, Question] = {}
        for question in questions:
            self._number += 1
            waiting[self._number] = question
            lines.append(question.line(self._number))
        threading.Thread(target=self._write, args=(b"".join(lines),), daemon=True).start()
        while waiting:
            number, answer = read_answer(self._line())
            if number not in waiting:
                raise ProgramError(f"an answer has the id {number}, which waits for none")
            yield waiting.pop(number), answer

    def finish(self) -> None:
        """End its input, and wait for it to end. Raises ProgramError if it does not, or not well."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            code = self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            raise ProgramError(f"it does not end within {END_S:g} s of its input") from None
        if code != 0:
            raise ProgramError(f"it {_ended(code)}{self._said()}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    # --- pipes -------------------------------------------------------------------------------------------------------

    def _write(self, data: bytes) -> None:
        """On a thread: a program may answer before it has read all. One that is gone is noticed by who reads."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(data)
            self._process.stdin.flush()
        except (OSError, ValueError):
            return

    def _listen(self, stderr: IO[bytes]) -> None:
        """On a thread: read what it complains of, and keep the end."""
        while data := os.read(stderr.fileno(), _READ_BYTES):
            self._last_words = (self._last_words + data)[-_LAST_WORDS:]

    def _line(self) -> bytes:
        """The next line, without its end. Raises ProgramError if none comes in time, or ever."""
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
            raise ProgramError(f"no answer within {ANSWER_S if self._answered else START_S:g} s{self._said()}")
        data = os.read(self._process.stdout.fileno(), _READ_BYTES)
        if not data:
            raise ProgramError(f"it {self._ending()} before it had answered{self._said()}")
        self._buffer += data

    def _ending(self) -> str:
        try:
            return _ended(self._process.wait(END_S))
        except subprocess.TimeoutExpired:
            return "closed its output"

    def _said(self) -> str:
        """Its last words on stderr, as one line."""
        words = self._last_words.strip().splitlines()
        return f"; it said {shown(words[-1])}" if words else ""


def _ended(code: int) -> str:
    return f"was ended by signal {-code}" if code < 0 else f"ended with {code}"
