"""The place of a result is checked before the work; each problem is one line."""

import pytest

from sightline.operator_side.preflight import check_out_file
from sightline.protocol.errors import ConfigError


def test_a_file_that_can_be_written_passes(tmp_path):
    (tmp_path / "old.toml").touch()
    check_out_file(tmp_path / "old.toml")
    check_out_file(tmp_path / "new.toml")


@pytest.mark.parametrize(("name", "words"), [
    ("none/x.toml", "no folder"), ("", "is a folder"), ("locked/x.toml", "cannot write"),
    ("locked/inner/x.toml", "cannot write"),
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
