"""Motors of a robot without a living process are set to zero by what it noted at its start."""

import json
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.guardian import start, zero
from tests.fixtures.dying import DriveFault
from tests.fixtures.links import START_S
from tests.fixtures.robot_process import RobotProcess, Vision

UNIT = Path(__file__).parent.parent.parent.parent / "robot_side" / "systemd" / "sightline-robot.service"
COMMAND = ["/bin/sh", "-c", "exit 7"]
"""The slow command in place of that of the unit."""
LOG = "sightline.robot_side.hardware.log_zero"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Make the folder in which systemd lets a service keep files until it ends."""
    made = tmp_path / "run"
    made.mkdir()
    monkeypatch.setenv("RUNTIME_DIRECTORY", f"{made}:/run/another")
    return made


def note(folder, **named):
    setup = {"path": sys.path, "zero": {"module": LOG, "name": "zero", "config": {}, **named}, "driver": "secret"}
    zero.write_note(setup)
    return folder / "sightline-zero.json"


def command_of_unit(fallback):
    line = next(one for one in UNIT.read_text().splitlines() if one.startswith("ExecStopPost="))
    words = shlex.split(line.partition("=")[2])
    return [sys.executable, *words[1:4], *fallback]


@pytest.mark.waits
def test_wheels_of_a_robot_whose_processes_died_together_stop_by_its_note(tmp_path, folder, monkeypatch):
    DriveFault(monkeypatch, tmp_path, "both")
    drive = {"kind": "tests.fixtures.dying:DyingLogDrive", "options": {"path": str(tmp_path / "drive.csv")}}
    with RobotProcess(tmp_path, drive=drive) as robot, Vision(robot.endpoint):
        assert robot.process.wait(START_S) == -signal.SIGKILL
        assert robot.speed() > 0, "motors keep their last speed"
        begin_s = time.monotonic()
        done = subprocess.run(command_of_unit(COMMAND), capture_output=True, text=True, timeout=START_S, check=False)
        print(f"\nthe unit's command took {time.monotonic() - begin_s:.2f} s")
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
        assert robot.motor_rows()[-1][1:] == (0.0, 0.0)


def test_units_command_ends_with_the_command_that_needs_no_note():
    lines = dict(line.partition("=")[::2] for line in UNIT.read_text().splitlines() if line.startswith("Exec"))
    words = shlex.split(lines["ExecStopPost"])
    assert words[:4] == ["/opt/sightline/bin/python", "-P", "-m", zero.__name__]
    assert words[4:] == [*shlex.split(lines["ExecStart"]), "--zero-motors"]
    assert "\nRuntimeDirectory=%N\n" in UNIT.read_text(), "a folder for the note, which no copy of the unit shares"


def test_a_note_needs_no_package_but_those_of_the_drive(tmp_path, folder):
    log = tmp_path / "drive.csv"
    note(folder, config={"path": str(log)})
    shown = "import sys; from sightline.robot_side.guardian.zero import main; main(sys.argv[1:]); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-P", "-c", shown, *COMMAND], capture_output=True, text=True, timeout=START_S, check=True)
    assert LOG in done.stdout.split(), "it imported what follows"
    assert {"typer", "pydantic", "zenoh", "logging", "subprocess"}.isdisjoint(done.stdout.split())
    assert log.read_text().endswith(",0.0000,0.0000\n")


def raises(_config):
    raise OSError("unplugged")


def leaves(_config):
    raise SystemExit(0)


def interrupts(_config):
    raise KeyboardInterrupt


class Fallback(BaseException):
    """In place of the other command."""


@pytest.mark.parametrize("broken", [
    "", "{", '{"path": []}', "[]", "raises", "leaves", "interrupts", "absent", "gone", "no folder",
])
def test_without_a_note_that_works_the_other_command_runs(folder, monkeypatch, broken):
    def execute(program, arguments):
        raise Fallback(program, arguments)

    monkeypatch.setattr(zero.os, "execv", execute)
    monkeypatch.setattr(sys, "path", sys.path[:])
    file = note(folder, module=__name__, name=broken)
    if broken == "gone":
        file.unlink()
    elif broken == "no folder":
        monkeypatch.delenv("RUNTIME_DIRECTORY")
    elif broken not in ("raises", "leaves", "interrupts", "absent"):
        file.write_text(broken)
    with pytest.raises(Fallback) as fallen:
        zero.main(COMMAND)
    assert fallen.value.args == (COMMAND[0], COMMAND)


class Forked(BaseException):
    """In place of the fork."""


@pytest.mark.parametrize("has_room", [True, False])
def test_a_start_notes_its_drive_before_its_guardian_and_starts_without_room_for_it(
    folder, monkeypatch, caplog, has_room
):
    def fork():
        raise Forked

    monkeypatch.setattr(start.os, "fork", fork)
    monkeypatch.setattr(start.signal, "pthread_sigmask", lambda *_: None)
    if not has_room:
        folder.rmdir()
    with pytest.raises(Forked):
        start.become_guardian(RobotConfig(drive=PluginChoice(kind="log", options={"path": "/x"})), restarts=False)
    assert has_room != ("no note of its drive" in caplog.text)
    if has_room:
        noted = json.loads((folder / "sightline-zero.json").read_text())
        assert noted == {"path": [one for one in sys.path if isinstance(one, str)],
                         "zero": {"module": LOG, "name": "zero", "config": {"path": "/x"}}}


def test_a_robot_without_systemd_notes_nothing(tmp_path, monkeypatch):
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.chdir(tmp_path)
    zero.write_note({"path": [], "zero": {}})
    assert not list(tmp_path.iterdir())
