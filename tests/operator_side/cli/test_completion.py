"""Completion of commands, options and names by the shell: what it offers, and that it imports nothing heavy."""

import json
import os
import re
import subprocess
import sys

import pytest
import typer

from sightline.operator_side.cli import commands as table
from sightline.operator_side.config.context import Context, write_context
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import PluginChoice
from sightline.robot_side.plugins import CAMERAS
from sightline.sim.robot import load_robot
from sightline.vision_side.missions.registry import REGISTRY as MISSIONS
from tests.fixtures.commands import run

HEAVY = {"numpy", "cv2", "pybullet", "zenoh", "websockets", "sightline.vision_side.detect", "sightline.sim.bus"}
_SCRIPT = f"""
import atexit, sys
from sightline.operator_side.cli.app import main
atexit.register(lambda: print(*{HEAVY} & set(sys.modules), file=sys.stderr))
main()
"""


def offered_in_bash(words):
    """Return what bash offers for the last word."""
    last = str(words.count(" "))
    environ = os.environ | {"_SIGHTLINE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": last}
    command = [sys.executable, "-P", "-c", _SCRIPT]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True)
    assert done.stderr == "\n", words
    return done.stdout.split()


def parameters(command=None, path=()):
    """Return each parameter of each command by its path, e.g. "demo --scenario" or "mission NAME"."""
    command = command or typer.main.get_command(table.app)
    for one in command.params:
        yield " ".join((*path, one.metavar if one.param_type_name == "argument" else one.opts[0])), one
    for name, sub in getattr(command, "commands", {}).items():
        yield from parameters(sub, (*path, name))


PARAMETERS = {path: one for path, one in parameters() if one.name != "help"}


def offered(path, typed=""):
    return [item.value for item in PARAMETERS[path].shell_complete(None, typed)]


def paths(ending, *others):
    """Return the paths of parameters that end so, and others."""
    return [*(path for path in PARAMETERS if path.endswith(f" {ending}")), *others]


def test_completion_of_the_shell_offers_commands_and_options():
    assert set(offered_in_bash("sightline st")) == {"status", "stop"}
    assert "--version" in offered_in_bash("sightline --")


@pytest.mark.parametrize(("words", "some"), [
    ("demo --scenario c", "circle"), ("score --scenario ", "eight"), ("vision --detector h", "hsv"),
    ("mission r1 f", "follow"), ("doctor --camera v", "v4l2"), ("sim --robot-model t", "thymio"), ("status r", "r1"),
])
def test_completion_of_a_name_imports_nothing_heavy(words, some):
    assert some in offered_in_bash(f"sightline {words}")


def test_completion_offers_the_listed_scenarios(capsys):
    listed = [one["name"] for one in json.loads(run(capsys, "scenarios", "--json")[1])["scenarios"]]
    for path in paths("--scenario", "scenarios NAME"):
        assert offered(path) == listed, path


def test_completion_offers_the_listed_detectors(capsys):
    listed = [one["name"] for one in json.loads(run(capsys, "detector", "list", "--json")[1])["detectors"]]
    others = ("vision --shadow", "detector --serve", "detector check NAME", "score detectors NAME")
    for path in paths("--detector", *others):
        assert offered(path) == listed, path


def test_completion_offers_the_names_of_missions_cameras_and_robot_models():
    for path in paths("--mission", "mission NAME"):
        assert offered(path) == MISSIONS.names(), path
    for path in paths("--camera"):
        with pytest.raises(ConfigError, match=f"there are {', '.join(offered(path))}"):
            CAMERAS.load(PluginChoice(kind="nothing"))
    for path in paths("--robot-model"):
        assert [load_robot(name).name for name in offered(path)] == offered(path) != []


@pytest.mark.parametrize("path", [*paths("SERVICE"), "install robot|vision"])
def test_completion_offers_the_services_that_the_error_names(capsys, path):
    *command, _ = path.split()
    error = run(capsys, *command, "nothing")[2]
    assert offered(path) and all(service in error for service in offered(path))


@pytest.mark.parametrize("path", paths("ROBOT"))
def test_completion_offers_the_saved_robot_and_none_from_a_damaged_file(monkeypatch, tmp_path, path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    file = tmp_path / "sightline/context.toml"
    assert offered(path) == ["r1"]
    write_context(file, Context("tcp/192.0.2.1:7447", "kitchen"))
    assert (offered(path), offered(path, "k"), offered(path, "r")) == (["kitchen"], ["kitchen"], [])
    file.write_text("connect = ")
    assert offered(path) == []


@pytest.mark.parametrize("path", paths("--scenario"))
@pytest.mark.parametrize("typed", ["circle,e", "./my", "/"])
def test_completion_leaves_lists_and_paths_to_the_shell(path, typed):
    assert offered(path, typed) == []


@pytest.mark.parametrize("home", ["file", "/proc/absent"])
def test_completion_in_a_home_that_cannot_be_written_is_one_line(tmp_path, home):
    (tmp_path / "file").touch()
    command = [sys.executable, "-m", "sightline.operator_side.cli.app", "--install-completion"]
    environ = os.environ | {"HOME": str(tmp_path / home), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = subprocess.run([*command, "bash"], capture_output=True, text=True, env=environ, check=False)
    assert done.returncode == 2
    assert re.fullmatch(rf"error: cannot write {tmp_path / home}.*: .*; set HOME to a folder .*\n", done.stderr)
