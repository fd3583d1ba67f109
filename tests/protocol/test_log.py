"""The log of a service: text or JSON, written without holding up the caller, few lines about what repeats."""

import fcntl
import io
import itertools
import json
import logging
import os
import pty
import random
import subprocess
import sys
import threading
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sightline.evaluation.processes import SIGHTLINE
from sightline.protocol import log
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import (
    LOG_FORMAT_VARIABLE,
    JsonFormatter,
    QueueHandler,
    RepeatLimiter,
    TextFormatter,
    faults,
    start_log,
)
from tests.fixtures.robot_process import RobotProcess

SECOND_US = 1_000_000


def test_an_exception_that_zenoh_logs_of_a_callback_is_counted_and_logged_once(caplog):
    start_log("text", "robot")
    for _ in range(3):
        try:
            raise ValueError("in a callback")
        except ValueError:
            logging.getLogger("zenoh.handlers").exception("callback error")
    logging.getLogger("zenoh.handlers").warning("something else")
    assert caplog.messages == ["callback raised ValueError: in a callback", "something else"]
    assert faults() == {"callback": 3}


class SlowToShowError(ValueError):
    """An exception whose text takes long, as the source lines of a traceback do on a bad disk."""

    def __str__(self):
        time.sleep(0.3)
        return "slow"


def test_a_traceback_is_formatted_without_its_caller():
    handler = QueueHandler()
    handler.setFormatter(TextFormatter())
    record = _record("broken", logging.ERROR)
    record.exc_info = (SlowToShowError, SlowToShowError(), None)
    begin_s = time.monotonic()
    handler.handle(record)
    assert time.monotonic() - begin_s < 0.3
    handler.flush()


@pytest.mark.parametrize("formatter", [TextFormatter(), JsonFormatter("robot")])
def test_no_text_of_a_peer_reaches_the_terminal_as_a_command(formatter):
    record = _record("from \x1b[2J and ball\udce9.onnx")
    record.exc_info = (OSError, OSError("\x1b[2J\udce9"), None)
    line = formatter.format(record)
    line.encode()
    assert "\x1b" not in line and "\\udce9" in line and "OSError" in line


def _record(message, level=logging.INFO):
    return logging.makeLogRecord({"msg": message, "levelno": level, "levelname": logging.getLevelName(level)})


def test_an_object_has_time_level_service_and_message():
    record = _record('"x" is \u00e9', logging.WARNING)
    record.created = datetime(2026, 3, 1, 10, 0, 0, 123_456, UTC).timestamp()
    assert json.loads(JsonFormatter("vision").format(record)) == {
        "time": "2026-03-01T10:00:00.123Z", "level": "warning", "service": "vision", "message": '"x" is \u00e9',
    }  # fmt: skip


def test_a_line_has_time_level_and_message():
    record = _record("robot r1: ACTIVE", logging.WARNING)
    record.created = datetime(2026, 3, 1, 10, 0, 0, 123_456, UTC).timestamp()
    assert TextFormatter().format(record) == "2026-03-01T10:00:00.123Z warning robot r1: ACTIVE"


@pytest.mark.parametrize(("form", "begin"), [("text", "2026-03-01T10:00:00.123Z error it broke\n"),
                                             ("json", '{"time":"2026-03-01T10:00:00.123Z"')])
def test_an_error_is_marked_and_keeps_its_traceback(form, begin):
    record = _record("it broke", logging.ERROR)
    record.created = datetime(2026, 3, 1, 10, 0, 0, 123_456, UTC).timestamp()
    record.exc_info = (ValueError, ValueError("no such wheel"), None)
    line = (JsonFormatter("robot") if form == "json" else TextFormatter()).format(record)
    assert line.startswith(begin) and "ValueError: no such wheel" in line
    if form == "json":
        assert "\n" not in line and json.loads(line)["level"] == "error"


def test_an_unknown_form_is_rejected(monkeypatch):
    with pytest.raises(ConfigError, match=r"invalid --log 'xml': expected text or json"):
        start_log("xml", "robot")
    monkeypatch.setenv(LOG_FORMAT_VARIABLE, "yaml")
    with pytest.raises(ConfigError, match=LOG_FORMAT_VARIABLE):
        start_log(None, "robot")


def test_a_service_prints_its_errors_as_json_too():
    command = [*SIGHTLINE, "vision", "--connect", "nowhere", "--log", "json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2 and done.stdout == ""
    said = json.loads(done.stderr)
    assert (said["level"], said["service"]) == ("error", "vision") and "nowhere" in said["message"]


def test_both_processes_of_a_robot_log_json(tmp_path, monkeypatch):
    """The command of the driver process selects its form of log; the network process reads its environment."""
    monkeypatch.setenv(LOG_FORMAT_VARIABLE, "json")
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        network = next(line for line in robot.output().splitlines() if "robot r1: on" in line)
    assert json.loads(network)["service"] == "robot"


@pytest.fixture(params=["pipe", "terminal"])
def unread(request):
    """Both ends of a stream that the test may read or leave unread; the second is a text stream."""
    reader, writer = os.pipe() if request.param == "pipe" else pty.openpty()
    if request.param == "pipe":
        fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    with suppress(OSError), os.fdopen(writer, "w") as written, os.fdopen(reader, "rb", buffering=0) as read:
        yield read, written


@pytest.fixture
def handler(monkeypatch):
    """A handler with a thread of its own that writes information to `sys.stdout` of the test."""
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    return QueueHandler()


@pytest.mark.parametrize("formatter", [TextFormatter(), JsonFormatter("robot")])
def test_a_stream_that_is_not_read_costs_no_time_and_its_lines_come_later(unread, handler, formatter):
    read, sys.stdout = unread
    handler.setFormatter(formatter)
    begin_s = time.monotonic()
    for number in range(1000):
        handler.handle(_record(f"{number} " + 100 * "\U0001f600"))
    handler.flush()
    assert time.monotonic() - begin_s < 2
    received = b""
    while b"once more" not in received:  # once it is read, what waited comes, and what is logged then
        received += read.read(1 << 16)
        handler.handle(_record("once more"))
    assert received.startswith(b'{"time"' if isinstance(formatter, JsonFormatter) else b"20")
    waited = [line for line in received.splitlines() if b"once more" not in line]
    held = 65536 // min(map(len, waited[:-1]))  # a terminal or a pipe stores at most 64 KiB, Linux: tty(4), pipe(7)
    assert len(waited) <= log._MAX_WAITING_LINES + held + 2, "no more lines wait than the queue and the stream hold"


def test_all_lines_are_there_after_a_flush_where_they_are_read(unread, handler):
    read, sys.stdout = unread
    for number in range(20):
        handler.handle(_record(f"line {number}"))
    handler.flush()
    os.set_blocking(read.fileno(), False)
    received = b"".join(iter(lambda: read.read(999), None))  # a terminal gives a line at a time
    assert received.split() == b" ".join(b"line %d" % number for number in range(20)).split()


@pytest.mark.parametrize("level", ["info", "error"])
def test_end_of_a_process_whose_lines_nothing_reads_keeps_its_exit_code(unread, level):
    """The writing thread had the lock of the stream, so the interpreter aborted, or waited for ever."""
    _, written = unread
    lines = (f"import logging, sys; from {log.__name__} import start_log; start_log('text', 'robot')\n"
             f"for _ in range(100): logging.getLogger('sightline').{level}(999 * 'x')\n"
             "logging.shutdown(); sys.stdout.flush(); sys.exit(7)")
    done = subprocess.run(
        [sys.executable, "-P", "-c", lines], stdout=written, stderr=written, timeout=20, check=False,
        env={name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"})
    assert done.returncode == 7


def test_a_level_chooses_its_stream_and_a_stream_without_reader_costs_lines_only(monkeypatch, handler):
    reader, writer = os.pipe()
    os.close(reader)
    with suppress(BrokenPipeError), os.fdopen(writer, "w") as sys.stdout:
        handler.handle(_record("gone"))
        handler.flush()
    monkeypatch.setattr(sys, "stderr", None)
    handler.handle(_record("nowhere", logging.WARNING))
    handler.flush()
    sys.stdout = io.StringIO()
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    handler.handle(_record("kept", logging.WARNING))
    handler.handle(_record("known"))
    handler.flush()
    assert (sys.stdout.getvalue(), sys.stderr.getvalue()) == ("known\n", "kept\n")


def test_full_disk_costs_only_the_lines_while_it_is_full(tmp_path, handler):
    file = tmp_path / "log"
    with file.open("w") as sys.stdout, Path("/dev/full").open("w") as full:
        number = sys.stdout.fileno()
        room = os.dup(number)
        os.dup2(full.fileno(), number)
        handler.handle(_record("lost"))
        handler.flush()
        os.dup2(room, number)
        os.close(room)
        handler.handle(_record("the next"))
        handler.flush()
    assert file.read_text() == "the next\n"


def test_pipe_that_must_not_block_costs_only_the_lines_without_room(handler):
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with os.fdopen(reader, "rb", buffering=0) as read, os.fdopen(writer, "w") as sys.stdout:
        size = fcntl.fcntl(writer, fcntl.F_GETPIPE_SZ)
        assert os.write(writer, bytes(size)) == size
        handler.handle(_record("lost"))
        handler.flush()
        assert read.read(size) == bytes(size)
        handler.handle(_record("the next"))
        handler.flush()
        assert read.read(size) == b"the next\n"


class Failing(io.StringIO):
    """A stream that fails as no stream should."""

    def write(self, _text):
        raise ZeroDivisionError


def test_a_stream_that_fails_in_any_way_costs_its_line_only(handler):
    sys.stdout = Failing()
    handler.handle(_record("a line"))
    handler.flush()
    sys.stdout = io.StringIO()
    handler.handle(_record("the next"))
    handler.flush()
    assert sys.stdout.getvalue() == "the next\n"


def test_a_letter_that_the_terminal_does_not_have_is_shown_as_its_code(handler):
    written = io.BytesIO()
    sys.stdout = io.TextIOWrapper(written, encoding="ascii", errors="strict")
    handler.handle(_record("AnswerHeader is of version 'é'"))
    handler.handle(_record("and then \udce9"))
    handler.flush()
    assert written.getvalue().decode("ascii").splitlines() == ["AnswerHeader is of version '\\xe9'", "and then \\udce9"]


def test_an_object_keeps_every_letter(handler):
    sys.stdout = io.StringIO()
    handler.setFormatter(JsonFormatter("robot"))
    handler.handle(_record("AnswerHeader is of version 'é'"))
    handler.flush()
    assert json.loads(sys.stdout.getvalue())["message"] == "AnswerHeader is of version 'é'"


def logged(limiter, key, from_us, until_us, step_us):
    """(when, count) of each line that is due for a key that comes every `step_us`."""
    due = ((now_us, limiter.due(key, now_us)) for now_us in range(from_us, until_us, step_us))
    return [(now_us, count) for now_us, count in due if count]


@pytest.mark.parametrize("step_us", [100, 20_000, 100_000])
def test_key_is_logged_immediately_and_then_less_often_with_its_count(step_us):
    lines = logged(RepeatLimiter(), "STALE", 0, 8 * SECOND_US, step_us)
    assert [when_us for when_us, _ in lines] == [0, SECOND_US, 3 * SECOND_US, 7 * SECOND_US]
    assert [count for _, count in lines] == [1, *(share * SECOND_US // step_us for share in (1, 2, 4))]


def test_repeated_key_is_logged_at_least_once_a_minute():
    times = [when_us for when_us, _ in logged(RepeatLimiter(), "STALE", 0, 600 * SECOND_US, SECOND_US)]
    assert max(b - a for a, b in itertools.pairwise(times)) == 60 * SECOND_US


def test_two_keys_do_not_hide_one_another():
    limiter = RepeatLimiter()
    assert (limiter.due("a", 0), limiter.due("b", 1), limiter.due("a", 2)) == (1, 1, 0)


@pytest.mark.parametrize(("gap_us", "again"), [(9_999_999, False), (10_000_000, True)])
def test_key_is_logged_immediately_after_ten_seconds_of_silence(gap_us, again):
    limiter = RepeatLimiter()
    last_us = logged(limiter, "STALE", 0, 70 * SECOND_US, SECOND_US)[-1][0] + 1
    assert not limiter.due("STALE", last_us, 7)
    assert limiter.due("STALE", last_us + gap_us) == (6 + 7 + 1 if again else 0)


def test_many_different_keys_need_bounded_memory_and_few_lines():
    limiter, draw = RepeatLimiter(), random.Random(3)
    counts = [limiter.due(f"{draw.random()}", number * 1_000) for number in range(2_000)]
    assert counts[:16] == [1] * 16, "the first 16 keys have a count each"
    assert sum(map(bool, counts)) == 18 and max(counts) == 1_000, "the others share one key"
    assert len(limiter._repeats) == 17
    assert limiter.due("later", 20 * SECOND_US) == 1, "an old key makes room"


class Slow:
    """An argument whose text takes its time."""

    def __init__(self, begun, go_on):
        self.begun, self.go_on = begun, go_on

    def __str__(self):
        self.begun.set()
        self.go_on.wait(5.0)
        return "slow"


def handled(message, *arguments):
    return logging.LogRecord("plugin", logging.INFO, "", 0, message, arguments, None)


def test_no_caller_waits_while_a_line_of_another_thread_is_formatted():
    handler, begun, go_on = QueueHandler(), threading.Event(), threading.Event()
    other = threading.Thread(target=handler.handle, args=(handled("%s", Slow(begun, go_on)),), daemon=True)
    other.start()
    assert begun.wait(5.0)
    began_s = time.monotonic()
    handler.handle(handled("mine"))
    assert time.monotonic() - began_s < 1.0
    go_on.set()
    other.join(5.0)


def test_a_log_call_whose_arguments_do_not_fit_raises_nothing_and_is_named(capsys):
    handler = QueueHandler()
    handler.handle(handled("volts %d", "many"))
    handler.flush()
    assert capsys.readouterr().out == "plugin: invalid log call 'volts %d'\n"


def test_without_a_thread_lines_are_dropped_and_nothing_is_raised(monkeypatch):
    def fail(_thread):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", fail)
    handler = QueueHandler()
    handler.handle(handled("lost"))
    assert handler._lines.empty()
