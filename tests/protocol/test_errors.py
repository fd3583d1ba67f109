"""The command that an error proposes for a missing extra, and home folders in paths."""

import json
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

from sightline.protocol.errors import ConfigError, home_path, install_command

INSTALLED_FROM = {
    "clone, here": ("file://{here}", "pip install '.[zenoh]'"),
    "clone, elsewhere": ("file:///srv/sightline", "pip install '/srv/sightline[zenoh]'"),
    "wheel file": ("file:///srv/my%20files/sightline_robot-1-py3-none-any.whl",
                   "pip install '/srv/my files/sightline_robot-1-py3-none-any.whl[zenoh]'"),
    "repository": ("https://host/sightline.git", "pip install 'sightline-robot[zenoh] @ git+https://host/sightline.git'"),
    "no record": (None, "pip install '.[zenoh]'"),
}


@pytest.mark.parametrize(("url", "command"), INSTALLED_FROM.values(), ids=INSTALLED_FROM)
def test_install_command_names_what_was_installed(monkeypatch, url, command):
    vcs = {} if not url or url.startswith("file:") else {"vcs_info": {"vcs": "git"}}
    record = url and json.dumps({"url": url.format(here=Path.cwd()), **vcs})
    monkeypatch.setattr(metadata, "distribution", lambda _name: SimpleNamespace(read_text=lambda _file: record))
    assert install_command("zenoh") == command


def test_install_command_keeps_an_editable_clone_editable(monkeypatch):
    record = json.dumps({"url": "file:///srv/sightline", "dir_info": {"editable": True}})
    monkeypatch.setattr(metadata, "distribution", lambda _name: SimpleNamespace(read_text=lambda _file: record))
    assert install_command("zenoh") == "pip install --editable '/srv/sightline[zenoh]'"


def test_install_command_of_an_unknown_distribution_names_the_clone(monkeypatch):
    def distribution(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", distribution)
    assert install_command("zenoh") == "pip install '.[zenoh]'"


def test_home_path_replaces_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    assert [home_path(one) for one in ("~/a", Path("~"), "b/~", "")] == [
        Path("/home/me/a"), Path("/home/me"), Path("b/~"), Path()]  # fmt: skip
    with pytest.raises(ConfigError, match="no home folder for '~nosuchuser' in ~nosuchuser/a; write the whole path"):
        home_path("~nosuchuser/a")
