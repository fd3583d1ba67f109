"""`sightline install`: units that systemd's own parser takes, with this machine's paths; nothing written unasked."""

import configparser
import errno
import os
import pwd
import re
import tempfile
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.main import get_command

from sightline.operator_side.cli import app as cli
from sightline.operator_side.cli.commands import app
from sightline.operator_side.setup import install
from sightline.operator_side.setup.install import check_user
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
    at_once = f"{PROGRAM.with_name('python')} -P -m sightline.robot_side.guardian.zero"
    assert unit["Service"]["ExecStopPost"] == f"{at_once} {PROGRAM} robot --config {CONFIG} --zero-motors"
    assert unit["Service"]["Type"] == "notify"


@pytest.mark.parametrize(("service", "config", "user"), [
    ("sim", CONFIG, "pi"), ("robot", Path("/a b.toml"), "pi"), ("robot", CONFIG, ""), ("robot", CONFIG, "p%i"),
    ("vision", Path("/x\nUser=root"), "pi"),
    ("robot", Path("/home/${HOME}/robot.toml"), "pi"), ("robot", CONFIG, "$USER"),
])  # fmt: skip
def test_value_that_changes_the_unit_is_rejected(service, config, user, tmp_path):
    with pytest.raises(ConfigError):
        install.plan(service, PROGRAM, config, user, tmp_path)


@pytest.mark.parametrize(("present", "line"), [
    (("video", "gpio"), "video gpio"), (("video", "root"), "video"), ((), "")])
def test_unit_names_only_groups_of_this_machine(present, line, monkeypatch, tmp_path):
    monkeypatch.setattr(install.grp, "getgrall", lambda: [SimpleNamespace(gr_name=name) for name in present])
    unit = _parsed(install.plan("robot", PROGRAM, CONFIG, "pi", tmp_path).text)
    assert unit["Service"]["SupplementaryGroups"] == line


def test_folder_of_the_configuration_holds_the_stop_latch(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(install, "UNIT_DIR", tmp_path)
    shown = []
    for line in ("", 'state_dir = "/data/state"\n'):
        (tmp_path / "robot.toml").write_text(line)
        assert cli.run(["install", "robot", "--config", str(tmp_path / "robot.toml"), "--user", "pi"]) == 0
        shown.append(_parsed(capsys.readouterr().out)["Service"])
    assert shown[0]["Environment"] == "SIGHTLINE_ROBOT__STATE_DIR=/var/lib/sightline"
    assert "Environment" not in shown[1] and shown[1]["ReadWritePaths"] == "/data/state"


@pytest.mark.parametrize("folder", ["~/state", "state", "/a b", "/a%i"])
def test_folder_of_the_stop_latch_that_systemd_cannot_use_is_rejected(folder, tmp_path):
    with pytest.raises(ConfigError, match="write a whole path"):
        install.with_state_in(install.plan("robot", PROGRAM, CONFIG, "pi", tmp_path), Path(folder))


@pytest.mark.parametrize(("host", "name"), [
    ("pi", " --name %l-%i"), ("h" * 29 + ".local", " --name %l-%i"), ("h" * 30, "")])
def test_instances_on_a_host_with_a_long_name_make_their_names(host, name, monkeypatch, tmp_path):
    monkeypatch.setattr(install.os, "uname", lambda: SimpleNamespace(nodename=host))
    unit = _parsed(install.plan("vision", PROGRAM, CONFIG, "pi", tmp_path, instances=2).text)
    assert unit["Service"]["ExecStart"] == f"{PROGRAM} vision --config {CONFIG} --share{name}"


def test_a_full_disk_leaves_the_unit_as_it_was(monkeypatch, tmp_path):
    def fill(path, text):
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    planned = install.plan("vision", PROGRAM, CONFIG, "pi", tmp_path)
    planned.path.write_text("before")
    monkeypatch.setattr(Path, "write_text", fill)
    with pytest.raises(ConfigError, match="No space left on device"):
        install.write(planned)
    assert planned.path.read_text() == "before" and list(tmp_path.iterdir()) == [planned.path]


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


@pytest.mark.parametrize(("folder", "written"), [("", ""), ("../units/", ""), ("link/../", ""), ("link/", "link")])
def test_relative_file_is_written_as_absolute_path(capsys, monkeypatch, tmp_path, folder, written):
    (home := tmp_path / "units").mkdir()
    monkeypatch.chdir(home)
    Path("car.toml").write_text(CAR)
    Path("other").mkdir()
    Path("link").symlink_to("other" if ".." in folder else ".")
    assert cli.run(["install", "robot", "--config", f"{folder}car.toml", "--user", "pi"]) == 0
    unit, there = capsys.readouterr().out, home / written
    assert unit.count(f"robot --config {there / 'car.toml'}") == 3 == unit.count("--config")
    assert f"WorkingDirectory=-{there}\n" in unit, "systemd ignores one with '..', and finds no drive of one's own"


def test_a_service_that_could_not_begin_is_not_installed(capsys, tmp_path):
    broken = tmp_path / "vision.toml"
    broken.write_text("nonsense = 1")
    assert cli.run(["install", "vision", "--config", str(broken), "--user", "pi", "--yes"]) == 2
    assert "nonsense" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["sightline-vision.service", "gpio-low.conf"])
def test_folder_that_cannot_be_written_is_reported(name, tmp_path):
    planned = install.InstallPlan("robot", tmp_path / "absent" / "folder" / name, "[Service]\n")
    with pytest.raises(ConfigError, match=r"cannot write .*: No such file or directory; run it with sudo"):
        install.write(planned)


@pytest.mark.parametrize(("printed", "shown"), [
    ("Job for x.service failed: the control process exited with an error.\nSee \"systemctl status x.service\".",
     "Job for x.service failed: the control process exited with an error. See \"systemctl status x.service\"."),
    ("Failed to connect to bus: No such file or directory", "Failed to connect to bus: No such file or directory"),
    ("", "failed"),
])  # fmt: skip
def test_failure_of_systemctl_is_one_line_with_its_cause(monkeypatch, tmp_path, printed, shown):
    program = tmp_path / "systemctl"
    program.write_text(f"#!/bin/sh\ncat >&2 <<'E'\n{printed}\nE\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    with pytest.raises(ConfigError) as raised:
        install._systemctl(["restart", "x.service"])
    assert str(raised.value) == f"systemctl restart x.service: {shown}"


# --- several vision services ----------------------------------------------------------------------------------------


@pytest.fixture
def vision(monkeypatch, tmp_path):
    """Return the command, the folder of units, and the calls of systemctl; `enable` and `disable` make their links."""
    file, units, calls = tmp_path / "vision.toml", tmp_path / "units", []
    at_boot = units / "multi-user.target.wants"
    file.write_text('robot = "r*"\n')
    at_boot.mkdir(parents=True)

    def systemctl(arguments):
        calls.append(arguments)
        verb, *names = [word for word in arguments if word != "--now"]
        for name in names if verb in ("enable", "disable") else ():
            (at_boot / name).touch() if verb == "enable" else (at_boot / name).unlink()

    monkeypatch.setattr(install, "UNIT_DIR", units)
    monkeypatch.setattr(install, "_systemctl", systemctl)
    monkeypatch.setattr(install, "check_user", lambda *_: None)
    return ["install", "vision", "--config", str(file), "--user", "pi"], units, calls


@pytest.mark.parametrize(("user", "is_known"), [
    ("root", True), ("0", True), ("no-such-user", False), ("4294967294", False), ("9" * 30, False)])
def test_service_is_installed_only_for_an_account_of_this_machine(vision, capsys, monkeypatch, user, is_known):
    monkeypatch.setattr(install, "check_user", check_user)
    command, units, calls = vision
    command = [*command[:-1], user]
    assert cli.run(command) == 0, "a unit is shown for another machine, too"
    assert cli.run([*command, "--yes"]) == (0 if is_known else 2)
    assert (f"unknown user '{user}'; create the account" in capsys.readouterr().err) is not is_known
    assert bool(calls) is (units / "sightline-vision.service").exists() is is_known


def _instances(*numbers):
    return [f"sightline-vision@{number}.service" for number in numbers]


def test_instances_share_one_template_and_each_has_a_name(vision, capsys):
    command, units, calls = vision
    assert cli.run([*command, "--instances", "3"]) == 0
    shown = capsys.readouterr()
    assert (calls, list(units.glob("*.service"))) == ([], [])
    assert "starts sightline-vision@1.service to sightline-vision@3.service" in shown.err
    assert cli.run([*command, "--instances", "3", "--yes"]) == 0
    [template] = units.glob("*.service")
    assert (template.name, template.read_text()) == ("sightline-vision@.service", shown.out)
    unit = _parsed(shown.out)
    assert unit["Service"]["ExecStart"].endswith(f"{command[3]} --share --name %l-%i")
    assert (unit["Service"]["User"], unit["Service"]["Restart"]) == ("pi", "always")
    assert unit["Install"]["WantedBy"] == "multi-user.target"
    one_by_one = [["restart", name] for name in _instances(1, 2, 3)]
    assert calls == [["daemon-reload"], ["enable", *_instances(1, 2, 3)], *one_by_one]
    assert "systemctl status 'sightline-vision@*'" in capsys.readouterr().out


@pytest.mark.parametrize(("service", "instances"), [("robot", None), ("vision", None), ("vision", 2)])
def test_command_line_accepts_the_commands_of_the_unit(service, instances, tmp_path):
    unit = install.plan(service, PROGRAM, CONFIG, "pi", tmp_path, instances=instances).text
    lines = [line for line in unit.splitlines() if line.startswith("Exec")]
    commands = [line[line.index(str(PROGRAM)):].split() for line in lines]
    assert [command[:2] for command in commands] == [[str(PROGRAM), service]] * len(commands) and commands
    for _, name, *options in commands:
        words = [name, *options]
        get_command(app).commands[name].make_context(name, words[1:]).close()


@pytest.mark.parametrize(("first", "then", "ended", "left"), [
    (["--instances", "3"], ["--instances", "1"], _instances(2, 3), _instances(1)),
    (["--instances", "2"], ["--instances", "4"], [], _instances(1, 2, 3, 4)),
    ([], ["--instances", "2"], ["sightline-vision.service"], _instances(1, 2)),
    (["--instances", "2"], [], _instances(1, 2), ["sightline-vision.service"]),
])  # fmt: skip
def test_other_number_of_instances_ends_what_is_not_part_of_it(first, then, ended, left, vision, capsys):
    command, units, calls = vision
    at_boot = units / "multi-user.target.wants"
    (at_boot / "sightline-vision-of-another-project.service").touch()
    (at_boot / "sightline-robot.service").touch()
    assert cli.run([*command, *first, "--yes"]) == 0
    capsys.readouterr()
    calls.clear()
    assert cli.run([*command, *then, "--yes"]) == 0
    assert [call[2:] for call in calls if call[:2] == ["disable", "--now"]] == ([ended] if ended else [])
    assert [f"ended {name}: it is not one of the units of this command" for name in ended] == [
        line for line in capsys.readouterr().out.splitlines() if line.startswith("ended")
    ]
    others = ["sightline-robot.service", "sightline-vision-of-another-project.service"]
    assert sorted(path.name for path in at_boot.iterdir()) == sorted([*left, *others])


@pytest.mark.parametrize(("service", "number", "why"), [
    ("vision", "0", "greater than or equal to 1"), ("vision", "-2", "greater than or equal to 1"),
    ("vision", "1000", "less than or equal to 64"), ("vision", "three", "valid integer"),
    ("vision", "2.5", "valid integer"), ("robot", "2", "--instances is for vision, and robot runs once on a machine"),
])  # fmt: skip
def test_number_of_instances_that_is_impossible_is_one_line(service, number, why, vision, capsys):
    command, units, calls = vision
    command[1] = service
    assert cli.run([*command, "--instances", number, "--yes"]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("error: ") and said.err.count("\n") == 1 and "--instances" in said.err
    assert why in said.err
    assert (said.out, calls, list(units.glob("*.service"))) == ("", [], [])


def test_plan_rejects_a_number_of_instances_out_of_range(tmp_path):
    for number in (0, -1, install.MAX_INSTANCES + 1):
        with pytest.raises(ConfigError, match=f"invalid --instances {number}: expected 1 to 64"):
            install.plan("vision", PROGRAM, CONFIG, "pi", tmp_path, instances=number)


# --- a robot on a Raspberry Pi's pins -------------------------------------------------------------------------------


@pytest.fixture
def car(monkeypatch, tmp_path):
    """Return the configuration, the folder of units, and the calls of systemctl."""
    file, units, told = tmp_path / "car.toml", tmp_path / "units", []
    file.write_text(CAR)
    units.mkdir()
    monkeypatch.setattr(install, "UNIT_DIR", units)
    monkeypatch.setattr(install, "_systemctl", told.append)
    monkeypatch.setattr(install, "check_user", lambda *_: None)
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


@pytest.mark.parametrize(("group", "kind", "shown"), [
    ("drive", "gpoi", "'gpoi'"), ("drive", "a_plugin_of_a_test:Other", "Other"),
    ("camera", "no_module:Camera", "no_module"), ("drive", "a_plugin_of_a_test:Drive", "")])
def test_service_whose_plugin_does_not_load_is_not_installed(group, kind, shown, car, capsys):
    file, units, told = car
    file.with_name("a_plugin_of_a_test.py").write_text(
        "import pydantic\n\n\nclass Drive:\n    class Config(pydantic.BaseModel):\n        pass\n\n"
        "    def __init__(self, config):\n        raise OSError('a device of the robot')\n\n"
        "    @staticmethod\n    def zero(config):\n        pass\n")
    file.write_text(f'[{group}]\nkind = "{kind}"\n')
    code = cli.run(["install", "robot", "--config", str(file), "--user", "pi", "--yes"])
    printed = capsys.readouterr().err
    assert (code, bool(told), bool(list(units.iterdir()))) == ((2, False, False) if shown else (0, True, True)), printed
    assert shown in printed and printed.count("\n") == (1 if shown else 0)


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


def test_folder_of_the_stop_latch_that_is_absent_is_not_installed(car, capsys, tmp_path):
    """systemd fails to start a unit with ReadWritePaths= of a folder that does not exist."""
    file, units, told = car
    file.write_text(f'state_dir = "{tmp_path}/state"\n{CAR}')
    command = ["install", "robot", "--config", str(file), "--user", "pi", "--yes"]
    assert cli.run(command) == 2 and (list(units.iterdir()), told) == ([], [])
    assert f"does not exist; run: sudo install -d -o pi {tmp_path}/state\n" in capsys.readouterr().err
    (tmp_path / "state").mkdir()
    assert cli.run(command) == 0 and told


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
    assert cli.run(["install", "vision", "--config", str(file), "--user", "pi"]) == 0
    assert f"{file} does not exist yet; create it before --yes" in capsys.readouterr().err


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can try the rights of another account")
@pytest.mark.parametrize(("closed", "problem"), [
    ("", ""), ("bin/sightline", "may not execute {}/bin/sightline; name another account with --user"),
    ("bin/python", "may not execute {}/bin/python;"), ("bin", "may not execute {}/bin/sightline;"),
    ("robot.toml", "may not read {}/robot.toml; name another account with --user, or move it, e.g. to /etc/sightline"),
])
def test_account_that_may_not_use_program_or_configuration_is_rejected(closed, problem):
    with tempfile.TemporaryDirectory() as name:  # the folder of pytest is closed to other accounts
        folder = Path(name)
        (folder / "bin").mkdir()
        program, config = folder / "bin" / "sightline", folder / "robot.toml"
        for path in (program, program.with_name("python"), config):
            path.touch()
            path.chmod(0o755)
        folder.chmod(0o755)
        if closed:
            (folder / closed).chmod(0o700)
        for user in ("nobody", str(pwd.getpwnam("nobody").pw_uid)):
            with pytest.raises(ConfigError, match=re.escape(problem.format(folder))) if closed else nullcontext():
                check_user(user, program, config)
        check_user("root", program, config)
