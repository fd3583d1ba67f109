"""A service's lines as JSON: every line an object, whole however it is written, and a child speaks alike."""

import fcntl
import io
import json
import os
import pty
import random
import subprocess
import sys
import time
from contextlib import suppress
from datetime import UTC, datetime

import pytest

from sightline.protocol.errors import ConfigError
from sightline.protocol.log import (
    LOG_FORMAT_VARIABLE,
    AsyncLineWriter,
    JsonLineStream,
    RepeatLimiter,
    set_log_format,
    to_json_line,
)
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess

SECOND_US = 1_000_000


def _written(*texts):
    below = io.StringIO()
    stream = JsonLineStream(below, "robot", "info")
    for text in texts:
        stream.write(text)
    return [json.loads(line)["message"] for line in below.getvalue().splitlines()]


def test_an_object_says_when_who_how_bad_and_what():
    line = to_json_line('error: "x" is \u00e9', "vision", "warning", datetime(2026, 3, 1, 10, 0, 0, 123_456, UTC))
    assert json.loads(line) == {
        "time": "2026-03-01T10:00:00.123Z", "level": "error", "service": "vision", "message": '"x" is \u00e9',
    }  # fmt: skip


@pytest.mark.parametrize("texts", [("a\nb\n",), ("a", "\n", "b\n"), ("a\n\n", "b", "\n"), tuple("a\nb\n")])
def test_a_line_is_one_object_however_it_is_written(texts):
    assert _written(*texts) == ["a", "b"]


def test_an_unfinished_line_waits_and_an_endless_one_is_cut():
    assert _written("a\nb") == ["a"]
    assert len(_written("x" * 10_001)[0]) == 10_001


def test_a_form_that_is_none_is_refused(monkeypatch):
    with pytest.raises(ConfigError, match=r"--log 'xml' is no form of a log: text or json"):
        set_log_format("xml", "robot")
    monkeypatch.setenv(LOG_FORMAT_VARIABLE, "yaml")
    with pytest.raises(ConfigError, match=LOG_FORMAT_VARIABLE):
        set_log_format(None, "robot")


def test_a_service_says_its_errors_as_json_too():
    command = [
        sys.executable,
        "-P",
        "-m",
        "sightline.operator_side.cli.app",
        "vision",
        "--connect",
        "nowhere",
        "--log",
        "json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2 and done.stdout == ""
    said = json.loads(done.stderr)
    assert (said["level"], said["service"]) == ("error", "vision") and "nowhere" in said["message"]


@pytest.mark.slow
def test_both_processes_of_a_robot_speak_json(tmp_path, monkeypatch):
    """The driver says what it does by its command line; the network process by what it finds in its environment."""
    monkeypatch.setenv(LOG_FORMAT_VARIABLE, "json")
    with RobotProcess(tmp_path) as robot:
        assert until(lambda: "robot r1: on" in robot.output(), 20)
        network = next(line for line in robot.output().splitlines() if "robot r1: on" in line)
    assert json.loads(network)["service"] == "robot"


@pytest.fixture(params=["pipe", "terminal"])
def unread(request):
    """Both ends of what somebody may read, or not; the second is a text stream."""
    reader, writer = os.pipe() if request.param == "pipe" else pty.openpty()
    if request.param == "pipe":
        fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    with suppress(OSError), os.fdopen(reader, "rb", buffering=0) as read, os.fdopen(writer, "w") as written:
        yield read, written


@pytest.mark.parametrize("wrapped", [False, True])
def test_who_tells_does_not_wait_for_who_reads(unread, wrapped):
    read, written = unread
    stream, teller, begin_s = (
        JsonLineStream(written, "robot", "info") if wrapped else written,
        AsyncLineWriter(),
        time.monotonic(),
    )
    for number in range(300):
        teller.tell(f"{number} " + 100 * "\U0001f600", stream)
    assert time.monotonic() - begin_s < 2
    heard = b""
    while b"heard" not in heard:  # once somebody reads, what waited comes, and what is told then
        heard += read.read(1 << 16)
        teller.tell("heard", stream)
    assert heard.startswith(b'{"time"' if wrapped else b"0 ")


def test_a_line_is_there_at_once_where_somebody_reads(unread):
    read, written = unread
    AsyncLineWriter().tell("heard", written)
    os.set_blocking(read.fileno(), False)
    assert read.read(99).strip() == b"heard"


def test_a_line_for_nobody_at_all_is_dropped(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    teller = AsyncLineWriter()
    with suppress(BrokenPipeError), os.fdopen(writer, "w") as written:
        teller.tell("gone", written)
    monkeypatch.setattr(sys, "stderr", None)
    teller.tell("nowhere")
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    teller.tell("kept")
    assert sys.stderr.getvalue() == "kept\n"


def test_a_cause_is_told_at_once_and_then_ever_more_seldom_with_every_one_counted():
    lines, told = RepeatLimiter(), {}
    for second in range(200):
        for tenth in range(10):
            now_us = second * SECOND_US + tenth * 100_000
            times = lines.is_due("wrong keys", now_us)
            if times:
                told[now_us / SECOND_US] = times
    assert list(told)[:7] == [0.0, 1.0, 3.0, 7.0, 15.0, 31.0, 63.0] and len(told) <= 10
    assert sum(told.values()) >= list(told)[-1] * 10


def test_two_causes_do_not_hide_one_another_and_an_old_one_is_news_again():
    lines = RepeatLimiter()
    assert (lines.is_due("a", 0), lines.is_due("b", 1), lines.is_due("a", 2)) == (1, 1, 0)
    assert lines.is_due("a", 200 * SECOND_US) == 2
    assert lines.is_due("a", 201 * SECOND_US) == 1


def test_ever_new_causes_take_no_memory():
    lines, draw = RepeatLimiter(), random.Random(3)
    for number in range(2_000):
        assert lines.is_due(f"{draw.random()}", number * 1_000) == 1
    assert len(lines._told) + len(lines._untold) <= 33
