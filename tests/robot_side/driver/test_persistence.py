"""The STOP mark is on the disk itself, not only in the kernel's memory, when it counts as kept."""

import errno
import fcntl
import os
import stat
import threading

import pytest

from sightline.protocol.errors import ConfigError
from sightline.robot_side.driver.persistence import LatchWriter, StopLatch, state_locked
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess


@pytest.fixture
def synced(monkeypatch):
    """The synced objects in order: "file" or "folder"."""
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
    latch.write(stopped=True)
    assert synced == ["file", "folder"]
    assert latch.is_set()
    assert StopLatch(tmp_path / "state", "r1").is_set()


def test_a_mark_that_is_removed_stays_removed(tmp_path, synced):
    latch = StopLatch(tmp_path / "state", "r1")
    latch.write(stopped=True)
    synced.clear()
    latch.write(stopped=False)
    assert synced == ["folder"]
    assert not latch.is_set()
    latch.write(stopped=False)
    assert not latch.is_set()


def test_failed_disk_write_leaves_the_latch_unset(tmp_path, monkeypatch):
    latch = StopLatch(tmp_path, "r1")

    def fails(_descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fails)
    for stopped in (True, False):
        with pytest.raises(OSError, match="Input/output error"):
            latch.write(stopped)


def test_folder_without_sync_still_stores_the_mark(tmp_path, monkeypatch):
    latch, fsync = StopLatch(tmp_path, "r1"), os.fsync

    def only_files(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", only_files)
    latch.write(stopped=True)
    assert latch.is_set()


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES])
def test_a_mark_that_cannot_be_read_is_an_error_and_not_a_robot_without_stop(tmp_path, monkeypatch, number):
    latch = StopLatch(tmp_path, "r1")

    def fails(*_arguments, **_options):
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as broken:
        broken.setattr(os, "stat", fails)
        broken.setattr(os, "lstat", fails)
        with pytest.raises(ConfigError) as error:
            latch.is_set()
    assert str(error.value).startswith(f"cannot read the STOP mark {tmp_path}/r1.stopped: {os.strerror(number)}; ")


def test_second_robot_with_the_same_mark_is_warned_and_no_other(tmp_path, caplog):
    (tmp_path / "other").mkdir()
    with state_locked(tmp_path, "r1"), state_locked(tmp_path, "r2"), state_locked(tmp_path / "other", "r1"):
        assert caplog.messages == []
        with state_locked(tmp_path, "r1"):
            assert caplog.messages == [
                f"another robot with the id r1 uses state_dir {tmp_path}, so a reset of one removes the STOP mark of "
                "the other; give each its own --robot ID or --set state_dir=DIR"
            ]
    caplog.clear()
    with state_locked(tmp_path, "r1"):
        assert caplog.messages == []


def test_robot_warns_of_another_one_with_its_mark(tmp_path):
    (tmp_path / "state").mkdir()
    with state_locked(tmp_path / "state", "r1"), RobotProcess(tmp_path, guarded=False) as robot:
        robot.wait_until_on(f"another robot with the id r1 uses state_dir {tmp_path / 'state'}")


@pytest.mark.parametrize("step", ["open", "flock"])
def test_robot_starts_with_a_folder_that_cannot_lock(tmp_path, caplog, monkeypatch, step):
    def fails(*_arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr({"open": os, "flock": fcntl}[step], step, fails)
    with state_locked(tmp_path, "r1"):
        assert not any(record.levelname == "WARNING" for record in caplog.records)


# A terminal that is not read, and a write that fails, do not end the writing of the STOP mark.


@pytest.fixture
def latch(tmp_path):
    return StopLatch(tmp_path, "r1")


@pytest.fixture
def latch_writer(latch):
    latch_writer = LatchWriter(latch)
    yield latch_writer
    latch_writer.close()


@pytest.mark.parametrize("stopped", [True, False])
def test_a_mark_that_failed_half_way_is_written_again(latch, latch_writer, monkeypatch, stopped):
    """The first step, a write or a removal, is done then, without a notice."""
    latch_writer.want(not stopped)
    assert until(lambda: latch.is_set() is not stopped)
    with monkeypatch.context() as broken:
        broken.setattr(StopLatch, "_sync_folder", failing := Failing())
        latch_writer.want(stopped)
        assert until(lambda: failing.times)
        latch_writer.want(not stopped)
        assert until(lambda: latch.is_set() is not stopped)


def test_a_mark_that_fails_while_it_ends_is_logged(latch, latch_writer, monkeypatch, caplog):
    caplog.set_level("INFO", "sightline")
    slow = threading.Event()

    def write(_latch, _stopped):
        slow.wait(0.2)
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as broken:
        broken.setattr(StopLatch, "write", write)
        latch_writer.want(True)
        latch_writer.close()
    assert "the STOP mark is not kept over a restart: Input/output error" in caplog.text
    slow.set()


class Failing:
    """A folder that cannot be written through."""

    times = 0

    def __call__(self):
        self.times += 1
        raise OSError(errno.EIO, "Input/output error")
