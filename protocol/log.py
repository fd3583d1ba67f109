"""The log of a service: standard `logging` through one handler that never blocks its caller, as text or JSON. Shell.

    sightline robot --log json        {"time":"2026-03-01T10:00:00.123Z","level":"info","service":"robot","message":...}

Information goes to the standard output; warnings and errors go to the standard error. The choice of the form is in the
environment, so that both processes of a robot use the same.
"""

from __future__ import annotations

import json
import logging
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

_MAX_WAITING_LINES: Final = 256
_FLUSH_S: Final = 1.0


class TextFormatter(logging.Formatter):
    """The message as it is, an error after `error: `."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of `record`, with its traceback if it has one."""
        return ("error: " if record.levelno >= logging.ERROR else "") + super().format(record)


class JsonFormatter(logging.Formatter):
    """One JSON object per record, on one line."""

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def format(self, record: logging.LogRecord) -> str:
        """Return the object of `record`; a traceback is part of its message."""
        time = datetime.fromtimestamp(record.created, UTC)
        return json.dumps({
            "time": f"{time:%Y-%m-%dT%H:%M:%S}.{time.microsecond // 1000:03}Z",
            "level": record.levelname.lower(),
            "service": self._service,
            "message": super().format(record),
        }, separators=(",", ":"))


class QueueHandler(logging.Handler):
    """Writes lines from a thread of its own. A stream that is not read costs lines, never time of the caller."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: queue.Queue[tuple[str, TextIO | None]] = queue.Queue(_MAX_WAITING_LINES)
        self._thread: threading.Thread | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the line of `record`, or drop it where no more lines may wait. `logging` holds the handler's lock."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._write_all, name="log", daemon=True)
            self._thread.start()
        with suppress(queue.Full):
            stream = sys.stderr if record.levelno >= logging.WARNING else sys.stdout
            self._lines.put_nowait((self.format(record), stream))

    def flush(self) -> None:
        """Wait until all lines are written, for a second at most. `logging` calls it when the process ends."""
        with self._lines.all_tasks_done:
            self._lines.all_tasks_done.wait_for(lambda: not self._lines.unfinished_tasks, _FLUSH_S)

    def _write_all(self) -> None:
        while True:
            _write(*self._lines.get())
            self._lines.task_done()


def _write(line: str, stream: TextIO | None) -> None:
    """Write `line` in letters that `stream` has, since peers choose some of them."""
    if stream is None:
        return
    try:
        encoding = getattr(stream, "encoding", None)
        print(line.encode(encoding, "backslashreplace").decode(encoding) if encoding else line, file=stream, flush=True)
    except OSError:  # the reader has gone: what is still buffered must not spoil the exit either
        with suppress(Exception):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    except Exception:  # whatever a line does to a stream, the next one may be shown
        return


_HANDLER: Final = QueueHandler()
_HANDLER.setFormatter(TextFormatter())


def start_log(form: str | None, service: str) -> None:
    """Log in `form` from now on, here and in processes started from here; None: as the environment has it.

    Raises ConfigError for an unknown form.
    """
    chosen = form or os.environ.get(LOG_FORMAT_VARIABLE) or LOG_FORMATS[0]
    if chosen not in LOG_FORMATS:
        where = "--log" if form else LOG_FORMAT_VARIABLE
        raise ConfigError(f"invalid {where} {chosen!r}: expected {' or '.join(LOG_FORMATS)}")
    if form:
        os.environ[LOG_FORMAT_VARIABLE] = form
    _HANDLER.setFormatter(JsonFormatter(service) if chosen == "json" else TextFormatter())
    logging.getLogger("sightline").setLevel(logging.INFO)
    logging.getLogger().addHandler(_HANDLER)  # of the root: third-party libraries and plug-ins log the same way
    logging.captureWarnings(True)
    threading.excepthook = _log_thread_error


def _log_thread_error(error: threading.ExceptHookArgs) -> None:
    name = error.thread.name if error.thread else "unknown"
    raised = error.exc_value or error.exc_type()
    logging.getLogger("sightline").error("thread %s ended", name, exc_info=raised)


def error_line(text: str) -> str:
    """Return what the log would write for an error, for a program that ends with it."""
    return _HANDLER.format(logging.makeLogRecord({"msg": text, "levelno": logging.ERROR, "levelname": "ERROR"}))


_FIRST_PERIOD_US: Final = 1_000_000

_LONGEST_PERIOD_US: Final = 60_000_000

_MOST_CAUSES: Final = 16


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
