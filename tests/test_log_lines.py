"""A service's lines as JSON: every line an object, whole however it is written, and a child speaks alike."""

import fcntl
import io
import json
import os
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime

import pytest

from protocol.errors import ConfigError
from protocol.log_lines import ENV_NAME, JsonLines, as_json, tell, use_form
from tests.link_rigs import until
from tests.robot_process import RobotProcess


def _written(*texts):
    below = io.StringIO()
    stream = JsonLines(below, "robot", "info")
    for text in texts:
        stream.write(text)
    return [json.loads(line)["message"] for line in below.getvalue().splitlines()]


def test_an_object_says_when_who_how_bad_and_what():
    line = as_json('error: "x" is \u00e9', "vision", "warning", datetime(2026, 3, 1, 10, 0, 0, 123_456, UTC))
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
        use_form("xml", "robot")
    monkeypatch.setenv(ENV_NAME, "yaml")
    with pytest.raises(ConfigError, match=ENV_NAME):
        use_form(None, "robot")


def test_a_service_says_its_errors_as_json_too():
    command = [sys.executable, "-m", "operator_side.cli", "vision", "--connect", "nowhere", "--log", "json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2 and done.stdout == ""
    said = json.loads(done.stderr)
    assert (said["level"], said["service"]) == ("error", "vision") and "nowhere" in said["message"]


@pytest.mark.slow
def test_both_processes_of_a_robot_speak_json(tmp_path, monkeypatch):
    """The driver says what it does by its command line; the network process by what it finds in its environment."""
    monkeypatch.setenv(ENV_NAME, "json")
    with RobotProcess(tmp_path) as robot:
        assert until(lambda: "robot r1: on" in robot.output(), 20)
        network = next(line for line in robot.output().splitlines() if "robot r1: on" in line)
    assert json.loads(network)["service"] == "robot"


@pytest.fixture
def pipe():
    """A small one, both ends; the second is a text stream."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    with suppress(BrokenPipeError), os.fdopen(reader, "rb") as read, os.fdopen(writer, "w") as written:
        yield read, written


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_line_is_told_until_nobody_reads_and_again_once_somebody_does(pipe, wrapped):
    read, written = pipe
    stream = JsonLines(written, "robot", "info") if wrapped else written
    for number in range(50):
        tell(f"{number} " + 600 * "\u00e9", stream)
    assert read.read1(1 << 16).startswith(b'{"time"' if wrapped else b"0 ")
    tell("heard", stream)
    assert b"heard" in read.read1(1 << 16)


def test_a_line_for_nobody_at_all_is_dropped(pipe, monkeypatch):
    read, written = pipe
    read.close()
    tell("gone", written)
    monkeypatch.setattr(sys, "stderr", None)
    tell("nowhere")


def test_a_buffer_in_memory_takes_every_line(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    tell("kept")
    assert sys.stderr.getvalue() == "kept\n"
