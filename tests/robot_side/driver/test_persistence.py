"""The STOP mark is on the disk itself, not only in the kernel's memory, when it counts as kept."""

import errno
import os
import stat

import pytest

from sightline.robot_side.driver.persistence import StopLatch


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
