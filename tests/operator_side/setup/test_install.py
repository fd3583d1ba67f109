"""`sightline install`: units that systemd's own parser takes, with this machine's paths; nothing written unasked."""

import configparser
from pathlib import Path

import pytest

from sightline.operator_side.cli import app as cli
from sightline.operator_side.setup import install
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import PluginChoice, RobotConfig

PROGRAM, CONFIG = Path("/home/pi/.venv/bin/sightline"), Path("/home/pi/robot.toml")
CAR = """
[drive]
kind = "gpio"
[drive.options]
left_forward_pin = 5
left_backward_pin = 6
right_forward_pin = 13
right_backward_pin = 19
enable_pins = [26]
"""


def _parsed(text):
    parser = configparser.RawConfigParser(strict=False, interpolation=None)
    parser.optionxform = str
    parser.read_string(text)
    return parser


@pytest.mark.parametrize("service", install.SERVICES)
def test_unit_has_the_paths_of_this_machine(service, tmp_path):
    planned = install.plan(service, PROGRAM, CONFIG, "pi", tmp_path)
    unit = _parsed(planned.text)
    assert unit["Service"]["ExecStart"] == f"{PROGRAM} {service} --config {CONFIG}"
    assert unit["Service"]["User"] == "pi"
    assert unit["Service"]["WorkingDirectory"] == "-/home/pi", "where its relative paths begin; gone or not"
    assert unit["Install"]["WantedBy"] == "multi-user.target"
    assert "/opt/" not in planned.text
    assert planned.path == tmp_path / f"sightline-{service}.service"


def test_unit_zeroes_the_motors_after_every_end(tmp_path):
    unit = _parsed(install.plan("robot", PROGRAM, CONFIG, "pi", tmp_path).text)
    assert unit["Service"]["ExecStopPost"] == f"{PROGRAM} robot --config {CONFIG} --zero-motors"
    assert unit["Service"]["Type"] == "notify"


@pytest.mark.parametrize(("service", "config", "user"), [
    ("sim", CONFIG, "pi"), ("robot", Path("/a b.toml"), "pi"), ("robot", CONFIG, ""), ("robot", CONFIG, "p%i"),
    ("vision", Path("/x\nUser=root"), "pi"),
])  # fmt: skip
def test_value_that_changes_the_unit_is_rejected(service, config, user, tmp_path):
    with pytest.raises(ConfigError):
        install.plan(service, PROGRAM, config, user, tmp_path)


def test_install_without_yes_writes_nothing(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(install, "UNIT_DIR", tmp_path)
    assert cli.run(["install", "vision", "--config", str(CONFIG), "--user", "pi"]) == 0
    said = capsys.readouterr()
    assert "[Service]" in said.out
    assert "nothing written" in said.err
    assert list(tmp_path.iterdir()) == []


def test_unit_runs_as_the_user_of_sudo(capsys, monkeypatch):
    monkeypatch.setenv("SUDO_USER", "pi")
    assert cli.run(["install", "vision", "--config", str(CONFIG)]) == 0
    assert "User=pi\n" in capsys.readouterr().out


def test_relative_file_is_written_as_absolute_path(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("car.toml").write_text(CAR)
    assert cli.run(["install", "robot", "--config", "car.toml", "--user", "pi"]) == 0
    said = capsys.readouterr().out
    assert said.count(f"robot --config {tmp_path / 'car.toml'}") == 3 and "--config car.toml" not in said


def test_a_service_that_could_not_begin_is_not_installed(capsys, tmp_path):
    broken = tmp_path / "vision.toml"
    broken.write_text("nonsense = 1")
    assert cli.run(["install", "vision", "--config", str(broken), "--user", "pi", "--yes"]) == 2
    assert "nonsense" in capsys.readouterr().err


def test_folder_that_cannot_be_written_is_reported(tmp_path):
    planned = install.plan("vision", PROGRAM, CONFIG, "pi", tmp_path / "absent")
    with pytest.raises(ConfigError, match=r"cannot write .*: No such file or directory; run it with sudo"):
        install.write(planned)


# --- a robot on a Raspberry Pi's pins -------------------------------------------------------------------------------


@pytest.fixture
def car(monkeypatch, tmp_path):
    """Return the configuration, the folder of units, and the calls of systemctl."""
    file, units, told = tmp_path / "car.toml", tmp_path / "units", []
    file.write_text(CAR)
    units.mkdir()
    monkeypatch.setattr(install, "UNIT_DIR", units)
    monkeypatch.setattr(install, "_systemctl", told.append)
    return file, units, told


def stops_with(text):
    return [line.partition("=")[2] for line in text.splitlines() if line.startswith("ExecStopPost=")]


@pytest.mark.parametrize("enable", [(), (17,), (3, 2)])
def test_drop_in_sets_the_pins_low_before_the_units_command(enable, tmp_path):
    options = {"left_forward_pin": 20, "right_backward_pin": 21, "enable_pins": enable}
    robot = RobotConfig(drive=PluginChoice(kind="gpio", options=options))
    planned = install.drop_in(robot, PROGRAM, CONFIG, tmp_path)
    pins = " ".join(map(str, (20, 9, 8, 21, *enable)))
    first = f"-/home/pi/.venv/bin/python -P -m sightline.robot_side.hardware.gpio_low {pins}"
    own = stops_with(install.plan("robot", PROGRAM, CONFIG, "pi", tmp_path).text)
    assert stops_with(planned.text) == ["", first, *own], "emptied, then in this order"
    assert planned.path == tmp_path / "sightline-robot.service.d" / "gpio-low.conf"
    assert "#" not in planned.text and "/opt/" not in planned.text


def test_drive_without_pins_gets_no_drop_in(tmp_path):
    assert install.drop_in(RobotConfig(), PROGRAM, CONFIG, tmp_path) is None


def test_wrong_pins_are_not_installed(car, capsys):
    file, units, told = car
    file.write_text(CAR.replace("= 6", "= 5"))
    for yes in ([], ["--yes"]):
        assert cli.run(["install", "robot", "--config", str(file), "--user", "pi", *yes]) == 2
        assert "pin 5 is named twice" in capsys.readouterr().err
    assert (list(units.iterdir()), told) == ([], [])


def test_both_files_are_written_only_with_yes(car, capsys):
    file, units, told = car
    command = ["install", "robot", "--config", str(file), "--user", "pi"]
    assert cli.run(command) == 0
    shown = capsys.readouterr()
    assert "gpio_low 5 6 13 19 26" in shown.out and "sightline-robot.service.d/gpio-low.conf" in shown.err
    assert (list(units.iterdir()), told) == ([], [])
    assert cli.run([*command, "--yes"]) == 0
    written = [(units / name).read_text() for name in
               ("sightline-robot.service", "sightline-robot.service.d/gpio-low.conf")]
    assert "\n".join(written) == shown.out, "what was shown is what is written"
    assert told == [["daemon-reload"], ["enable", "sightline-robot.service"],
                    ["restart", "sightline-robot.service"]], "one that runs has to go on with the new pins"


def test_drop_in_is_removed_for_another_drive(car, capsys):
    file, units, _told = car
    command = ["install", "robot", "--config", str(file), "--user", "pi", "--yes"]
    assert cli.run(command) == 0
    file.write_text('drive = { kind = "log" }\n')
    assert cli.run(command) == 0
    assert not (units / "sightline-robot.service.d/gpio-low.conf").exists()
    assert "the drive of this robot is not gpio" in capsys.readouterr().out


def test_missing_configuration_is_reported(car, capsys):
    file, _units, _told = car
    file.unlink()
    assert cli.run(["install", "robot", "--config", str(file), "--user", "pi"]) == 0
    assert "does not exist yet; with a gpio drive" in capsys.readouterr().err
