"""The log of a service: `logging` with a handler that never blocks its caller, as text or JSON. Shell.

    sightline robot                   2026-03-01T10:00:00.123Z info robot r1: on tcp/127.0.0.1:7447
    sightline robot --log json        {"time":"2026-03-01T10:00:00.123Z","level":"info","service":"robot","message":...}

Information goes to stdout; warnings and errors go to stderr. An environment variable holds the format, so that both
processes of a robot use the same one.
"""

from __future__ import annotations

import errno
import io
import json
import logging
import os
import queue
import sys
import threading
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from typing import Final, TextIO

from sightline.protocol.errors import ConfigError, SightlineError

LOG_FORMAT_VARIABLE: Final = "SIGHTLINE_LOG"
LOG_FORMATS: Final = ("text", "json")

_MAX_WAITING_LINES: Final = 256
_FLUSH_S: Final = 1.0


def _time_of(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class TextFormatter(logging.Formatter):
    """Formats a record as time, level and message."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of `record`, with its traceback if it has one."""
        text = super().format(record)
        shown = text if text.isprintable() else "".join(map(_shown, text))
        return f"{_time_of(record)} {record.levelname.lower()} {shown}"


def _shown(letter: str) -> str:
    """Escape a control character, or a character that is not text, e.g. from a file name, for a terminal."""
    return letter if letter.isprintable() or letter in "\n\t" else letter.encode("unicode_escape").decode()


class JsonFormatter(logging.Formatter):
    """Formats each record as one JSON object on one line."""

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def format(self, record: logging.LogRecord) -> str:
        """Return the JSON object of `record`; a traceback is part of its message."""
        return json.dumps({
            "time": _time_of(record),
            "level": record.levelname.lower(),
            "service": self._service,
            "message": super().format(record),
        }, separators=(",", ":"))


class QueueHandler(logging.Handler):
    """Writes lines from a separate thread. A stream without a reader loses lines, but never delays the caller."""

    def __init__(self) -> None:
        super().__init__()
        self.forget_thread()

    def forget_thread(self) -> None:
        """Reset the handler in a forked process, where the thread does not exist."""
        self._lines: queue.Queue[tuple[str | logging.LogRecord, TextIO | None]] = queue.Queue(_MAX_WAITING_LINES)
        self._is_started = False
        self._starting = threading.Lock()

    def start(self) -> None:
        """Start the writing thread if it is not started. Raises RuntimeError if the system permits no more threads."""
        with self._starting:
            if not self._is_started:
                threading.Thread(target=self._write_all, name="log", daemon=True).start()
                self._is_started = True

    def handle(self, record: logging.LogRecord) -> bool:
        """Emit without the lock of `logging`, so that no caller waits for the formatting of another thread."""
        passed = bool(self.filter(record))
        if passed:
            self.emit(record)
        return passed

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the line of `record`, or drop it if the queue is full. Never raises."""
        # A traceback quotes source files, so the writing thread formats it. A control loop must not wait for the disk.
        line = record if record.exc_info else self._line_of(record)
        with suppress(queue.Full, RuntimeError):
            if not self._is_started:
                self.start()
            self._lines.put_nowait((line, sys.stderr if record.levelno >= logging.WARNING else sys.stdout))

    def _line_of(self, record: logging.LogRecord) -> str:
        try:
            return self.format(record)
        except Exception:  # the arguments do not fit the message
            return f"{record.name}: invalid log call {record.msg!r}"

    def flush(self) -> None:
        """Wait until all lines are written, for one second at most. `logging` calls it at the end of the process."""
        with self._lines.all_tasks_done:
            self._lines.all_tasks_done.wait_for(lambda: not self._lines.unfinished_tasks, _FLUSH_S)

    def _write_all(self) -> None:
        while True:
            line, stream = self._lines.get()
            _write(line if isinstance(line, str) else self._line_of(line), stream)
            del line  # its traceback references the variables of each frame
            self._lines.task_done()


def _write(line: str, stream: TextIO | None) -> None:
    """Write `line` with unencodable characters escaped, because peers choose some of them."""
    if stream is None:
        return
    try:
        encoding = getattr(stream, "encoding", None) or "utf-8"
        data = f"{line}\n".encode(encoding, "backslashreplace")
        stream.flush()
        number = _descriptor(stream)
        if number is None:
            print(data.decode(encoding), end="", file=stream, flush=True)
            return
        # Without the lock of the stream, for which the end of the process would wait, or abort, if nothing reads it.
        while data:
            data = data[os.write(number, data):]
    except OSError as error:
        _discard(stream, has_reader=error.errno not in (errno.EPIPE, errno.EIO))
    except Exception:  # an error with one line must not stop the next lines
        return


def _descriptor(stream: TextIO) -> int | None:
    """Return the descriptor of a stream, or None for a stream in memory."""
    try:
        return stream.fileno()
    except (AttributeError, io.UnsupportedOperation):
        return None


def _discard(stream: TextIO, *, has_reader: bool) -> None:
    """Discard the buffer, which would cause an error at exit. Without a reader, discard all later lines, too."""
    with suppress(Exception), open(os.devnull, "wb") as nowhere:  # noqa: PTH123  the guardian has no pathlib
        number = stream.fileno()
        before = os.dup(number)
        os.dup2(nowhere.fileno(), number)
        if has_reader:  # the disk is full, or the pipe has no room now
            stream.flush()
            os.dup2(before, number)
        os.close(before)


_HANDLER: Final = QueueHandler()
_HANDLER.setFormatter(TextFormatter())
os.register_at_fork(after_in_child=_HANDLER.forget_thread)


def start_log_thread() -> None:
    """Start the writing thread now, because a control loop must not wait for it at its first line."""
    with suppress(RuntimeError):
        _HANDLER.start()


_SLOW_S: Final = 3.0
_STACK_BYTES: Final = 256 * 1024


@contextmanager
def slow_logged(line: str) -> Iterator[None]:
    """Log `line` if the block takes long, because until its device or model is open a service is silent."""
    waiting = threading.Timer(_SLOW_S, logging.getLogger("sightline").info, [line])
    waiting.daemon = True
    usual_bytes = threading.stack_size(_STACK_BYTES)  # a robot locks its memory, including stacks
    waiting.start()
    threading.stack_size(usual_bytes)
    try:
        yield
    finally:
        waiting.cancel()


def start_log(form: str | None, service: str) -> None:
    """Log in the format `form` from now on, also in child processes. None: the format of the environment.

    Raises ConfigError for an unknown format.
    """
    chosen = form or os.environ.get(LOG_FORMAT_VARIABLE) or LOG_FORMATS[0]
    if chosen not in LOG_FORMATS:
        where = "--log" if form else LOG_FORMAT_VARIABLE
        raise ConfigError(f"invalid {where} {chosen!r}: expected {' or '.join(LOG_FORMATS)}")
    if form:
        os.environ[LOG_FORMAT_VARIABLE] = form
    _HANDLER.setFormatter(JsonFormatter(service) if chosen == "json" else TextFormatter())
    logging.getLogger("sightline").setLevel(logging.INFO)
    logging.getLogger().addHandler(_HANDLER)  # the root logger: third-party libraries and plug-ins use it, too
    logging.captureWarnings(True)
    threading.excepthook = _log_thread_error
    logging.getLogger("zenoh.handlers").addFilter(_is_no_fault)


def _is_no_fault(record: logging.LogRecord) -> bool:
    """Report the callback exceptions that Zenoh logs. Returns False to drop Zenoh's own line."""
    error = record.exc_info[1] if record.exc_info else None
    if error is not None:
        report_fault("callback", error)
    return error is None


def _log_thread_error(error: threading.ExceptHookArgs) -> None:
    report_fault("thread", error.exc_value or error.exc_type(), error.thread.name if error.thread else "")


_MAX_KINDS: Final = 64
_faults: Final[Counter[str]] = Counter()
_kinds: Final[set[tuple[object, ...]]] = set()
_counting: Final = threading.Lock()


def count_fault(part: str) -> None:
    """Count a fault that the caller logs, e.g. a failed write."""
    with _counting:
        _faults[part] += 1


def report_fault(part: str, error: BaseException, name: str = "") -> str:
    """Count an exception of a plug-in, callback or thread, and log the traceback of each kind once. Never raises.

    Args:
        part: where it was raised, e.g. `camera`; `status` shows the counts by part.
        error: the exception. Its kind is its class and the line that raised it.
        name: further name of the place, e.g. of the thread.

    Returns:
        The text of the exception, see `error_text`.
    """
    count_fault(part)
    *_, raised_at = None, *((frame.f_code, line) for frame, line in traceback.walk_tb(error.__traceback__))
    kind = (part, type(error), raised_at)
    text = error_text(error)
    with _counting:
        is_new = kind not in _kinds and len(_kinds) < _MAX_KINDS
        if is_new:
            _kinds.add(kind)
    if is_new:
        what = " ".join(f"{part} {name}".split())
        logging.getLogger("sightline").error("%s raised %s: %s", what, type(error).__name__, text, exc_info=error)
    return text


def report_ending(part: str, error: BaseException) -> None:
    """Report an exception that ends a program with a log. A command without a log only prints its last line."""
    if logging.getLogger().handlers:
        report_fault(part, error)


def error_text(error: BaseException) -> str:
    """Return the message of an exception, or its class, as one printable line, even if its `str` fails."""
    try:
        text = " ".join(str(error).split())
    except Exception:
        text = ""
    return printable(text) or type(error).__name__


def fault_text(part: str, error: BaseException) -> str:
    """Return the text of an exception for `status`, with place and class unless it is a SightlineError.

    A SightlineError contains the fix. Any other exception is an error in the code of a plug-in.

    Args:
        part: where it was raised, e.g. `camera`.
        error: the exception.
    """
    text, kind = error_text(error), type(error).__name__
    if isinstance(error, SightlineError):
        return text
    return f"{part} raised {kind}" if text == kind else f"{part} raised {kind}: {text}"


def printable(text: str) -> str:
    """Return `text` with `?` for each unprintable character."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def faults() -> Counter[str]:
    """Return the number of exceptions in each part of this process since the start."""
    with _counting:
        return Counter(_faults)


def error_line(text: str) -> str:
    """Return the last line of a program that ends with an error, in the format of its log."""
    record = logging.makeLogRecord({"msg": text, "levelno": logging.ERROR, "levelname": "ERROR"})
    return _HANDLER.format(record) if isinstance(_HANDLER.formatter, JsonFormatter) else (
        "error: " + "\n".join(map(printable, text.split("\n"))))


_FIRST_PERIOD_US: Final = 1_000_000
_LONGEST_PERIOD_US: Final = 60_000_000
_FORGOTTEN_US: Final = 10_000_000
"""Time after which a key counts as new again."""
_MAX_KEYS: Final = 16
_OTHERS: Final = ""


class _Repeat:  # not a dataclass, because the guardian should not load `dataclasses`
    def __init__(self, seen_us: int) -> None:
        self.seen_us = seen_us
        self.count = self.logged_us = self.period_us = 0


class RepeatLimiter:
    """Permits the first line of a key, and repeated ones after 1, 2, 4 ... 60 s. Keys beyond 16 share one limit.

    Peers choose some of the keys, so memory and lines must have limits.
    """

    def __init__(self) -> None:
        self._repeats: dict[str, _Repeat] = {}
        """Ordered by the last use of a key, the newest last."""

    def due(self, key: str, now_us: int, times: int = 1) -> int:
        """Count `times` events of `key`. Return the number since its last line if a line is due, else 0."""
        key = self._bounded(key, now_us)
        repeat = self._repeats.pop(key, _Repeat(seen_us=now_us - _FORGOTTEN_US))
        self._repeats[key] = repeat
        repeat.count += times
        seen_us, repeat.seen_us = repeat.seen_us, now_us
        if now_us - seen_us >= _FORGOTTEN_US:
            repeat.period_us = 0
        elif now_us - repeat.logged_us < repeat.period_us:
            return 0
        repeat.period_us = min(2 * repeat.period_us, _LONGEST_PERIOD_US) or _FIRST_PERIOD_US
        repeat.logged_us = now_us
        count, repeat.count = repeat.count, 0
        return count

    def _bounded(self, key: str, now_us: int) -> str:
        if key in self._repeats or len(self._repeats) < _MAX_KEYS:
            return key
        oldest = next(iter(self._repeats))
        if now_us - self._repeats[oldest].seen_us < _FORGOTTEN_US:
            return _OTHERS
        del self._repeats[oldest]
        return key
