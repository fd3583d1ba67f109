"""Log lines as text or JSON, written by a thread that never blocks its caller, and limits on how many there are.
Shell (streams).

    sightline robot --log json        {"time":"2026-03-01T10:00:00.123Z","level":"info","service":"robot","message":...}

The choice is in the environment, so that a robot's two processes speak alike.
"""

from __future__ import annotations

import io
import json
import os
import queue
import sys
import threading
from contextlib import suppress
from datetime import UTC, datetime
from typing import Final, TextIO

from sightline.protocol.errors import ConfigError

LOG_FORMAT_VARIABLE: Final = "SIGHTLINE_LOG"
LOG_FORMATS: Final = ("text", "json")
_LONGEST_LINE: Final = 10_000
"""More without an end is no line of a log; it is cut there."""

_LINES_WAITING: Final = 32
_WRITE_TIMEOUT_S: Final = 0.1
"""Once, for a line to be read; whoever tells more meanwhile does not wait at all."""

_FIRST_PERIOD_US: Final = 1_000_000

_LONGEST_PERIOD_US: Final = 60_000_000

_MOST_CAUSES: Final = 16


class JsonLineStream(io.TextIOBase):
    """A text stream that writes every finished line to `stream` as one JSON object."""

    def __init__(self, stream: TextIO, service: str, level: str) -> None:
        self._stream, self._service, self._level = stream, service, level
        self._begun = ""

    def write(self, text: str) -> int:
        """Keep `text` until its line ends."""
        *lines, self._begun = (self._begun + text).split("\n")
        if len(self._begun) > _LONGEST_LINE:
            lines, self._begun = [*lines, self._begun], ""
        for line in lines:
            if line.strip():
                self._stream.write(to_json_line(line, self._service, self._level, datetime.now(UTC)) + "\n")
        return len(text)

    def flush(self) -> None:
        """What is finished is on its way."""
        self._stream.flush()

    def fileno(self) -> int:
        """The descriptor below."""
        return self._stream.fileno()

    def writable(self) -> bool:
        """Yes."""
        return True


def to_json_line(line: str, service: str, level: str, time: datetime) -> str:
    """One line as an object; whatever begins with `error: ` is an error on any stream."""
    message = line.removeprefix("error: ")
    return json.dumps({
        "time": f"{time:%Y-%m-%dT%H:%M:%S}.{time.microsecond // 1000:03}Z",
        "level": "error" if message != line else level,
        "service": service,
        "message": message,
    }, separators=(",", ":"))


def set_log_format(form: str | None, service: str) -> None:
    """Say everything in `form` from now on, here and in processes started from here; None is what the environment says.

    Raises ConfigError for a form that is none.
    """
    chosen = form or os.environ.get(LOG_FORMAT_VARIABLE) or LOG_FORMATS[0]
    if chosen not in LOG_FORMATS:
        where = "--log" if form else LOG_FORMAT_VARIABLE
        raise ConfigError(f"{where} {chosen!r} is no form of a log: {' or '.join(LOG_FORMATS)}")
    if form:
        os.environ[LOG_FORMAT_VARIABLE] = form
    if chosen == "json" and not isinstance(sys.stdout, JsonLineStream):
        sys.stdout = JsonLineStream(sys.stdout, service, "info")
        sys.stderr = JsonLineStream(sys.stderr, service, "warning")


class AsyncLineWriter:
    """Prints on a thread of its own, for who must not wait: a terminal that nobody reads costs lines."""

    def __init__(self) -> None:
        self._lines: queue.Queue[tuple[str, TextIO, threading.Event]] = queue.Queue(_LINES_WAITING)
        self._begin = threading.Lock()
        self._thread: threading.Thread | None = None
        self._stuck = False

    def tell(self, line: str, stream: TextIO | None = None) -> None:
        """Print `line`, to stderr unless told otherwise: at once, or while nobody reads later, or not at all."""
        where: TextIO | None = stream or sys.stderr
        if where is None:
            return
        self._be_there()
        told = threading.Event()
        with suppress(queue.Full):
            self._lines.put_nowait((line, where, told))
            if not self._stuck:
                self._stuck = not told.wait(_WRITE_TIMEOUT_S)

    def _be_there(self) -> None:
        with self._begin:
            if self._thread is None:
                self._thread = threading.Thread(target=self._print_all, name="teller", daemon=True)
                self._thread.start()

    def _print_all(self) -> None:
        while True:
            line, stream, told = self._lines.get()
            with suppress(Exception):  # whoever read has gone
                print(line, file=stream, flush=True)
            told.set()
            self._stuck = False


log_line: Final = AsyncLineWriter().tell


class RepeatLimiter:
    """Per cause a line at once, then after 1, 2, 4 ... 60 s for as long as it goes on, each with how often."""

    def __init__(self) -> None:
        self._untold: dict[str, int] = {}
        self._told: dict[str, tuple[int, int]] = {}

    def is_due(self, cause: str, now_us: int, times: int = 1) -> int:
        """`cause` was given `times` more: how often since the last line about it, if one is due; else 0."""
        self._untold[cause] = self._untold.get(cause, 0) + times
        told_us, period_us = self._told.get(cause, (now_us - _FIRST_PERIOD_US, 0))
        silent_us = now_us - told_us
        if silent_us < period_us:
            return 0
        if silent_us > 2 * _LONGEST_PERIOD_US or not period_us:
            period_us = _FIRST_PERIOD_US // 2
        self._told[cause] = (now_us, min(2 * period_us, _LONGEST_PERIOD_US))
        if len(self._told) > _MOST_CAUSES:
            self._forget_oldest()
        return self._untold.pop(cause)

    def _forget_oldest(self) -> None:
        oldest = min(self._told, key=lambda cause: self._told[cause][0])
        del self._told[oldest]
        self._untold.pop(oldest, None)


# Lines about who was turned away, for the log: few, however many knock. Pure.


MAX_LINES_PER_S: Final = 10
_SECOND_US: Final = 1_000_000


class BurstLimiter:
    """At most ten lines a second; what is left out is counted in the next."""

    def __init__(self) -> None:
        self._begin_us = -_SECOND_US
        self._lines = self._left_out = 0

    def line(self, text: str, now_us: int) -> str:
        """What to print for `text`; "" for nothing."""
        if now_us - self._begin_us >= _SECOND_US:
            self._begin_us, self._lines = now_us, 0
        if self._lines >= MAX_LINES_PER_S:
            self._left_out += 1
            return ""
        self._lines += 1
        more, self._left_out = f" ({self._left_out} more before)" if self._left_out else "", 0
        return text + more
