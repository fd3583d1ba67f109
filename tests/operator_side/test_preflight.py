"""The place of a result is checked before the work; each problem is one line."""

import os
from pathlib import Path

import pytest

from sightline.operator_side.preflight import check_out_file, write_whole
from sightline.protocol.errors import ConfigError


def test_a_file_that_can_be_written_passes(tmp_path):
    (tmp_path / "old.toml").touch()
    check_out_file(tmp_path / "old.toml")
    check_out_file(tmp_path / "new.toml")


@pytest.mark.parametrize(("name", "words"), [
    ("none/x.toml", "no folder"), ("", "is a folder"), ("locked/x.toml", "cannot write"),
    ("locked/inner/x.toml", "cannot write"), ("x" * 246 + ".mp4", "240 bytes; choose a shorter"),
    ("\u00e9" * 121, "240 bytes; choose a shorter"),
])  # fmt: skip
def test_unwritable_file_is_reported(tmp_path, monkeypatch, name, words):
    locked = tmp_path / "locked"
    locked.mkdir()
    kind = type(tmp_path)
    is_dir = kind.is_dir

    def refused(path):  # root may read everywhere; other users get this
        if locked in path.parents:
            raise PermissionError
        return is_dir(path)

    monkeypatch.setattr(kind, "is_dir", refused)
    monkeypatch.setattr("os.access", lambda path, mode: path != locked)
    with pytest.raises(ConfigError, match=words):
        check_out_file(tmp_path / name)


def test_written_file_keeps_its_mode_and_a_link_to_it(tmp_path):
    file, link = tmp_path / "real.toml", tmp_path / "link.toml"
    link.symlink_to("real.toml")
    write_whole(link, "new\r\n")
    file.chmod(0o640)
    write_whole(link, "newer\r\n")
    assert link.is_symlink() and file.read_bytes() == b"newer\r\n" and file.stat().st_mode & 0o777 == 0o640
    assert sorted(tmp_path.iterdir()) == [link, file]


def test_device_is_written_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)) as reader:
        write_whole(pipe, "text")
        assert reader.read() == "text" and pipe.is_fifo()
    with pytest.raises(ConfigError, match="cannot write /dev/full: No space left on device; choose another file"):
        write_whole(Path("/dev/full"), "text")
    assert Path("/dev/full").is_char_device()
