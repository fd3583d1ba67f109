"""`sightline install`: units that systemd's own parser takes, with this machine's paths; nothing written unasked."""

import configparser
from pathlib import Path

import pytest

from operator_side import cli, install
from protocol.errors import ConfigError

PROGRAM, CONFIG = Path("/home/pi/.venv/bin/sightline"), Path("/home/pi/robot.toml")


def _parsed(text):
    parser = configparser.RawConfigParser(strict=False, interpolation=None)
    parser.optionxform = str
    parser.read_string(text)
    return parser


@pytest.mark.parametrize("service", install.SERVICES)
def test_a_unit_has_this_machines_paths_and_nothing_of_the_template(service, tmp_path):
    planned = install.plan(service, PROGRAM, CONFIG, "pi", tmp_path)
    unit = _parsed(planned.text)
    assert unit["Service"]["ExecStart"] == f"{PROGRAM} {service} --config {CONFIG}"
    assert unit["Service"]["User"] == "pi"
    assert unit["Install"]["WantedBy"] == "multi-user.target"
    assert "/opt/" not in planned.text
    assert planned.path == tmp_path / f"sightline-{service}.service"


def test_a_robots_motors_are_zeroed_however_its_driver_ends(tmp_path):
    unit = _parsed(install.plan("robot", PROGRAM, CONFIG, "pi", tmp_path).text)
    assert unit["Service"]["ExecStopPost"] == f"{PROGRAM} robot --config {CONFIG} --zero-motors"
    assert unit["Service"]["Type"] == "notify"


@pytest.mark.parametrize(("service", "config", "user"), [
    ("sim", CONFIG, "pi"), ("robot", Path("/a b.toml"), "pi"), ("robot", CONFIG, ""), ("robot", CONFIG, "p%i"),
    ("vision", Path("/x\nUser=root"), "pi"),
])  # fmt: skip
def test_what_would_make_another_unit_is_refused(service, config, user, tmp_path):
    with pytest.raises(ConfigError):
        install.plan(service, PROGRAM, config, user, tmp_path)


def test_it_shows_first_and_writes_nothing(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(install, "UNIT_DIR", tmp_path)
    assert cli.run(["install", "vision", "--config", str(CONFIG), "--user", "pi"]) == 0
    said = capsys.readouterr()
    assert "[Service]" in said.out
    assert "nothing is written" in said.err
    assert list(tmp_path.iterdir()) == []


def test_a_service_that_could_not_begin_is_not_installed(capsys, tmp_path):
    broken = tmp_path / "vision.toml"
    broken.write_text("nonsense = 1")
    assert cli.run(["install", "vision", "--config", str(broken), "--user", "pi", "--yes"]) == 2
    assert "nonsense" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    planned = install.plan("vision", PROGRAM, CONFIG, "pi", tmp_path / "absent")
    with pytest.raises(ConfigError, match=r"cannot write .*: No such file or directory; try with sudo"):
        install.write(planned)
