"""The STOP mark is on the disk itself, not only in the kernel's memory, when it counts as kept."""

import errno
import io
import json
import os
import stat
import sys
import threading

import pytest

from sightline.protocol.log import JsonLineStream
from sightline.robot_side.driver.persistence import BackgroundWriter, StopLatch
from tests.fixtures.links import until


@pytest.fixture
def synced(monkeypatch):
    """What was synced, in order: "file" or "folder"."""
    done, fsync = [], os.fsync

    def noting(descriptor: int) -> None:
        is_folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        done.append("folder" if is_folder else "file")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", noting)
    return done


def test_a_mark_is_synced_with_its_folder(tmp_path, synced):
    latch = StopLatch(tmp_path / "state", "r1")
    synced.clear()
    latch.keep(stopped=True)
    assert synced == ["file", "folder"]
    assert latch.is_set()
    assert StopLatch(tmp_path / "state", "r1").is_set()


def test_a_mark_that_is_removed_stays_removed(tmp_path, synced):
    latch = StopLatch(tmp_path / "state", "r1")
    latch.keep(stopped=True)
    synced.clear()
    latch.keep(stopped=False)
    assert synced == ["folder"]
    assert not latch.is_set()
    latch.keep(stopped=False)
    assert not latch.is_set()


def test_a_disk_that_fails_is_no_mark_kept(tmp_path, monkeypatch):
    latch = StopLatch(tmp_path, "r1")

    def fails(_descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fails)
    for stopped in (True, False):
        with pytest.raises(OSError, match="Input/output error"):
            latch.keep(stopped)


def test_a_folder_that_knows_no_sync_keeps_the_mark_as_well_as_it_can(tmp_path, monkeypatch):
    latch, fsync = StopLatch(tmp_path, "r1"), os.fsync

    def only_files(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", only_files)
    latch.keep(stopped=True)
    assert latch.is_set()


# What a terminal cannot show, or refuses, ends neither the log nor the keeping of the STOP mark.


class Refusing(io.StringIO):
    """A stream that fails as no stream should."""

    def write(self, _text):
        raise ZeroDivisionError


class Gone(io.StringIO):
    """A pipe whose reader has gone, without a descriptor to put anything in its place."""

    def write(self, _text):
        raise BrokenPipeError


class Stuck(io.StringIO):
    """A terminal that is held by Ctrl-S."""

    def __init__(self):
        super().__init__()
        self.reached, self.read = threading.Event(), threading.Event()

    def write(self, text):
        self.reached.set()
        self.read.wait(20)
        return super().write(text)


@pytest.fixture
def latch(tmp_path):
    return StopLatch(tmp_path, "r1")


@pytest.fixture
def scribe(latch, monkeypatch):
    """With the real one's thread, but whatever stream the test puts in its place."""
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    scribe = BackgroundWriter(latch)
    yield scribe
    scribe.close()


def test_a_letter_that_the_terminal_has_not_is_shown_as_its_code(latch, scribe):
    written = io.BytesIO()
    sys.stdout = io.TextIOWrapper(written, encoding="ascii", errors="strict")
    scribe.say("AnswerHeader is of version 'é'")
    scribe.say("and then \udce9")
    scribe.keep(True)
    assert until(latch.is_set)
    assert until(lambda: written.getvalue().count(b"\n") == 2)
    assert written.getvalue().decode("ascii").splitlines() == ["AnswerHeader is of version '\\xe9'", "and then \\udce9"]


def test_a_log_of_objects_keeps_every_letter(scribe):
    written = io.StringIO()
    sys.stdout = JsonLineStream(written, "robot", "info")
    scribe.say("AnswerHeader is of version 'é'")
    assert until(written.getvalue)
    assert json.loads(written.getvalue())["message"] == "AnswerHeader is of version 'é'"


@pytest.mark.parametrize("stream", [Refusing(), Gone(), None], ids=["refusing", "gone", "none"])
def test_a_stream_that_fails_in_any_way_costs_lines_only(latch, scribe, stream):
    sys.stdout = stream
    scribe.say("a line")
    scribe.keep(True)
    assert until(latch.is_set)


def test_a_terminal_that_nobody_reads_does_not_hold_up_the_mark(latch, scribe):
    sys.stdout = stuck = Stuck()
    scribe.say("a line")
    assert stuck.reached.wait(5)
    scribe.keep(True)
    marked = until(latch.is_set)
    stuck.read.set()
    scribe.close()  # before the stream goes: `print` of Python 3.11 does not hold it
    assert marked


@pytest.mark.parametrize("stopped", [True, False])
def test_a_mark_that_failed_half_way_is_written_again(latch, scribe, monkeypatch, stopped):
    """The first step, writing or removing it, is done then, and nobody knows it."""
    scribe.keep(not stopped)
    assert until(lambda: latch.is_set() is not stopped)
    with monkeypatch.context() as broken:
        broken.setattr(StopLatch, "_sync_folder", failing := Failing())
        scribe.keep(stopped)
        assert until(lambda: failing.times)
        scribe.keep(not stopped)
        assert until(lambda: latch.is_set() is not stopped)


def test_a_mark_that_fails_while_it_ends_is_told(latch, scribe, monkeypatch):
    sys.stdout = written = io.StringIO()
    slow = threading.Event()

    def keep(_latch, _stopped):
        slow.wait(0.2)
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as broken:
        broken.setattr(StopLatch, "keep", keep)
        scribe.keep(True)
        scribe.close()
    assert "the STOP mark is not kept over a restart: Input/output error" in written.getvalue()
    slow.set()


class Failing:
    """A folder that cannot be written through."""

    times = 0

    def __call__(self):
        self.times += 1
        raise OSError(errno.EIO, "Input/output error")
