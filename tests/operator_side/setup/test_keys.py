"""The STOP secret of `sightline keys`: a file of its own, which an older folder gets by one command."""

import pytest

from sightline.operator_side.setup import keys
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.stop_port import stop_secret_file


def test_a_new_folder_has_a_secret_that_only_its_owner_reads(tmp_path):
    files = keys.make(tmp_path / "keys", [])
    secret = tmp_path / "keys/stop.secret"
    assert secret in files and str(secret) == stop_secret_file(str(tmp_path / "keys"))
    assert secret.stat().st_mode & 0o777 == 0o600 and len(secret.read_text().strip()) >= 32


def test_an_older_folder_gets_one_by_the_command_of_the_error(tmp_path):
    keys.make(tmp_path / "keys", [])
    (tmp_path / "keys/stop.secret").unlink()
    with pytest.raises(ConfigError) as error:
        stop_secret_file(str(tmp_path / "keys"))
    assert f"`sightline keys add {tmp_path}/keys stop`" in str(error.value)
    before = sorted(path.name for path in (tmp_path / "keys").iterdir())
    keys.add(tmp_path / "keys", "stop", [])
    assert sorted(path.name for path in (tmp_path / "keys").iterdir()) == sorted([*before, "stop.secret"])


def test_a_folder_without_keys_gets_no_secret(tmp_path):
    with pytest.raises(ConfigError, match="sightline keys init"):
        keys.add(tmp_path, "stop", [])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("host", ["300.1.1.1", "192.168.1", "robot local", "robot/1"])
def test_an_invalid_host_is_rejected_before_anything_is_written(tmp_path, host):
    with pytest.raises(ConfigError, match=f"invalid host '{host}'"):
        keys.make(tmp_path / "keys", ["robot.local", host])
    assert not (tmp_path / "keys").exists()
