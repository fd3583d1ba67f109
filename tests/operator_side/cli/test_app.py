"""The command line: help, one line and an exit code for each error, and no heavy import before it is needed."""

import ast
import ctypes
import errno
import importlib.metadata
import io
import json
import math
import os
import re
import subprocess
import sys
import tomllib
from contextlib import nullcontext, suppress
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer

from sightline.evaluation.checks import at_most
from sightline.operator_side.cli import app as cli
from sightline.operator_side.cli import commands as table
from sightline.operator_side.cli import operate
from sightline.operator_side.cli.options import CHECK_FAILED, plugin_prints, print_result
from sightline.operator_side.preflight import needs
from sightline.protocol.errors import CheckError, ConfigError, HardwareError, LinkError, SightlineError
from tests.fixtures.commands import run
from tests.fixtures.ports import free_endpoint


def commands(group=None, path=()):
    group = group or typer.main.get_command(table.app)
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command


PROJECT = Path(__file__).parents[3] / "pyproject.toml"
COMMANDS = dict(commands())
COMMANDS_AND_GROUPS = typer.main.get_command(table.app).commands


def test_the_commands_of_this_version_exist():
    expected = {
        "sim",
        "robot",
        "vision",
        "demo",
        "robots",
        "status",
        "arm",
        "disarm",
        "stop",
        "reset",
        "faults",
        "watch",
        "capture",
        "pick-color",
        "train",
    }
    assert expected <= {path[0] for path in COMMANDS if len(path) == 1}
    groups = {
        "calibrate": ("camera",),
        "config": ("check", "show", "schema"),
        "detector": ("list", "check"),
        "score": ("detectors",),
        "bench": ("codec", "pipeline", "demo"),
    }
    assert {(group, name) for group, names in groups.items() for name in names} <= set(COMMANDS)


GROUPS = sorted({path[:1] for path in COMMANDS if len(path) > 1})


@pytest.mark.parametrize("path", [*COMMANDS, *GROUPS], ids=" ".join)
def test_help_has_a_summary_at_most_two_sentences_and_an_example(capsys, monkeypatch, path):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, err = run(capsys, *path, "--help")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].startswith(f"Usage: sightline {' '.join(path)}") and "[[" not in lines[0]
    assert max(map(len, lines)) <= 80 and "..." not in out.partition("Commands:")[2]
    description = out.split("\n\n")[1]
    assert "\n" not in description, "the summary is one line"
    assert_is_summary(description.strip())
    body = " ".join(out.partition("Arguments:")[0].partition("Options:")[0].split("\n\n", 2)[2].split())
    assert len(re.findall(r"[.!?](?= [A-Z`-]|$)", body)) <= 2, body
    if path in COMMANDS:
        assert out.rstrip().splitlines()[-1].startswith(f"  Example: sightline {' '.join(path)}"), "one line, the last"
        for parameter in COMMANDS[path].params:
            assert getattr(parameter, "hidden", False) or parameter.help, parameter.name


def assert_is_summary(text):
    assert 10 <= len(text) <= 60, text
    assert text[0].isupper() and not text.endswith("."), text


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_no_two_options_of_a_command_have_the_same_help(path):
    helps = [option.help for option in COMMANDS[path].params if getattr(option, "help", None)]
    assert sorted(set(helps)) == sorted(helps)


def test_program_help_lists_every_command_uncut(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, err = run(capsys, "--help")
    assert (code, err) == (0, "")
    for heading in ("Run", "Drive", "Observe", "Set up", "Evaluate", "Develop"):
        assert f"\n{heading}:\n" in out
    for name, entry in table.COMMANDS.items():
        assert_is_summary(entry.summary)
        assert re.search(rf"^  {name} +{re.escape(entry.summary)}$", out, re.MULTILINE), name
    assert max(map(len, out.splitlines())) <= 80 and "..." not in out.partition("Options:")[2]


@pytest.mark.parametrize("name", table.COMMANDS)
def test_summary_in_the_program_help_is_that_of_the_command(name):
    summary = table.COMMANDS[name].summary
    assert COMMANDS_AND_GROUPS[name].help.split("\n")[0].strip() == summary


def test_exit_codes_in_the_program_help_are_those_of_the_errors(capsys):
    _, out, _ = run(capsys, "--help")
    errors = (SightlineError, ConfigError, HardwareError, LinkError, CheckError)
    for code in (0, *(error.exit_code for error in errors), CHECK_FAILED):
        assert re.search(rf"^  {code} +{table.EXIT_CODES[code]}", out, re.MULTILINE), code


def test_version_is_that_of_the_distribution(capsys):
    assert run(capsys, "--version") == (0, f"sightline {importlib.metadata.version('sightline-robot')}\n", "")


@pytest.mark.parametrize("group", [(), *GROUPS], ids=" ".join)
def test_group_without_a_subcommand_lists_its_subcommands(capsys, group):
    if group == ("score",):  # which also runs by itself
        group = ("score", "--help")
    code, out, err = run(capsys, *group)
    assert (code, err) == (0, "")
    assert f"Usage: sightline {' '.join(group[:1])}".rstrip() in out
    names = [path[1] for path in COMMANDS if path[:1] == group[:1] and len(path) > 1] if group else table.COMMANDS
    for name in names:
        assert re.search(rf"^  {name} ", out, re.MULTILINE), name


_INTERRUPTED = """
import signal, sys
from importlib import import_module
def interrupt(event, arguments):
    if event == "import" and arguments[0] == moment:
        signal.raise_signal(signal.SIGINT)
module, name, moment, *sys.argv[1:] = sys.argv[1:]
sys.addaudithook(interrupt)
sys.exit(getattr(import_module(module), name)())
"""


@pytest.mark.parametrize("moment", ["sightline.operator_side.cli.app", "sightline.protocol.errors", "typer"])
def test_interrupt_while_the_command_is_imported_prints_no_traceback(moment):
    scripts = tomllib.loads(PROJECT.read_text("utf-8"))["project"]["scripts"]
    command = [sys.executable, "-P", "-c", _INTERRUPTED, *scripts["sightline"].split(":"), moment, "status"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (cli.INTERRUPTED, "", "")


_INTERRUPTED_TWICE = """
import atexit, signal, sys
sys.modules["zenoh"] = sys
from sightline.operator_side.cli import app
def interrupted(_arguments):
    print("shown")
    try:
        signal.raise_signal(signal.SIGINT)
    finally:
        signal.raise_signal(signal.SIGINT)
setattr(app, sys.argv[1], interrupted)
atexit.register(print, "the interpreter ends, and threads of Zenoh abort it")
app.main()
"""


@pytest.mark.parametrize("within", ["_typed", "run"])
def test_two_interrupts_at_once_end_a_command_as_one_does(within):
    command = [sys.executable, "-P", "-c", _INTERRUPTED_TWICE, within]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (cli.INTERRUPTED, "shown\n", "")


_CLOSED = """
import os, subprocess, sys
from sightline.operator_side.cli import app
def shown(_arguments):
    print(sys.stdin.read(), file=sys.stderr)
    print("lost", flush=True)
    child = "import os; print(*(os.fstat(number).st_rdev == os.stat(os.devnull).st_rdev for number in (0, 2)))"
    are_null = subprocess.run([sys.executable, "-c", child], stdout=subprocess.PIPE, check=True).stdout
    with open(sys.argv[1], "wb") as file:
        file.write(are_null)
app.run = shown
app.main()
"""


def test_command_whose_standard_streams_are_closed_has_the_null_device_and_so_have_its_processes(tmp_path):
    """A robot did not start, and a socket with the number of a stream would take what is printed."""
    command = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", sys.executable, "-P", "-c", _CLOSED, str(tmp_path / "null")]
    assert subprocess.run(command, timeout=30, check=False).returncode == 0
    assert (tmp_path / "null").read_text() == "True True\n"


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["dmeo"], 2, "did you mean 'demo'"),
        (["config", "chekc"], 2, "unknown command 'chekc'; did you mean 'check'?; see sightline config --help"),
        (["bench", "pipline"], 2, "unknown command 'pipline'; did you mean 'pipeline'?; see sightline bench --help"),
        (["bench", "vision"], 2, "unknown command 'vision' in sightline bench; did you mean 'sightline vision'?"),
        (["config", "check"], 2, "SERVICE"),
        (["arm", "r1", "--connect"], 2, "see sightline arm --help"),
        (["config", "show", "robot", "--profile"], 2, "see sightline config show --help"),
        (["config", "check", "robto"], 2, "did you mean 'robot'"),
        *((["config", "check", "robot", "--set", value], 2, why) for value, why in (
            ("listen=[]", "no endpoint; pass one to listen on"),
            ("listen=tcp/127.0.0.1:1,tcp/127.0.0.1:1", "tcp/127.0.0.1:1 is listed twice"),
            ("listen=tls/127.0.0.1:1", "tls/127.0.0.1:1: a tls/ endpoint needs keys"),
            ("connect=quic/127.0.0.1:1", "quic/127.0.0.1:1: a quic/ endpoint needs keys"),
            ("listen=tcp/0.0.0.0:7448", "its STOP port would be 7449/udp"),
            ("state_dir=~no-user/x", "no home folder for '~no-user' in ~no-user/x"),
        )),
        (["config", "check", "robot", "--set", "drive.kind=gpio", "--set", "drive.options.table_file=no.toml"], 2,
         "no.toml: cannot be read: No such file or directory; write one with `sightline calibrate drive`"),
        (["config", "check", "robot", "no such file.toml"], 2,
         "no such file.toml: No such file or directory; name a TOML file that you may read"),
        (["config", "check", "vision", "--set", "targt.radius_m=1"], 2, "did you mean 'target.radius_m'"),
        (["config", "check", "vision", "--set", "mission.kind=folow"], 2, "did you mean 'follow'"),
        (["config", "check", "vision", "--set", "missions.goto.spede=1"], 2, "'spede'"),
        (["config", "check", "vision", "--set", "detector.kind=hvs"], 2, "did you mean 'hsv'"),
        (["config", "check", "vision", "--set", "detector.options.colr=1"], 2, "'colr'"),
        (["config", "check", "vision", "--set", "detector.fallback=onnx:no.onnx"], 2, "no.onnx"),
        (["config", "check", "vision", "--set", "detector.shadow=adaptve"], 2, "did you mean 'adaptive'"),
        (["config", "check", "vision", "--set", "detector.kind=hsv", "--set", "detector.device=cuda"], 2, "no device"),
        (["config", "check", "vision", "--set", "detector.kind=boxes", "--set", "detector.tracked=true"], 2, "tracked"),
        *((arguments.split(), 2, f"Invalid value for '{option}': {what}; see sightline {command} --help")
          for arguments, option, what, command in (
            ("sim --seed x", "--seed", "expected a valid integer", "sim"),
            ("demo --latency-ms 1,5", "--latency-ms", "expected a valid number", "demo"),
            ("watch --port -1", "--port", "expected greater than or equal to 0", "watch"),
            ("keys add keys robot --days 0", "--days", "expected greater than or equal to 1", "keys add"),
            ("train --device foo", "--device", "'foo' is not one of 'cpu', 'cuda'", "train"),
        )),
        (["robot", "--robot", "a/b"], 2, "'a/b'"),
        (["robot", "--robot", "*"], 2, "'*'"),
        (["calibrate", "camera", "--robot", "r1", "--secure", "no-such-folder"], 2, "no-such-folder"),
        (["robot", "--listen", "7447"], 2, "tcp/127.0.0.1:7447"),
        (["robot", "--listn", "x"], 2, "--listen"),
        (["robot", "--set", "safety.max_linear_mps=nan"], 2, "nan"),
        (["robot", "--set", "drive.kind=lgo"], 2, "did you mean 'log'"),
        (["robot", "--set", "drive.kind=:"], 2, "':'"),
        (["robot", "--set", "drive.kind=.a:X"], 2, "'.a:X'"),
        (["router", "--listen", "ws://0.0.0.0:9090"], 2, "takes no WebSocket endpoint (ws://0.0.0.0:9090); let the"),
        (["watch", "r1", "nope"], 2, "expected frame, "),
        (["watch", "r1", "status", "--text"], 2, "--text has no effect on channel 'status'; remove one of the two"),
        (["watch", "r1", "target", "--show", "frame"], 2, "--show has no effect on channel 'target'"),
        (["watch", "r1", "status", "--port", "8080"], 2, "--port has no effect on channel 'status'"),
        (["doctor", "--camera-set", "device=/dev/video2"], 2, "--camera-set needs --camera; name a camera"),
        (["calibrate", "camera", "--images", ".", "--camera-set", "device=x"], 2, "--camera-set needs --camera"),
        (["vision", "--robot", "r1/"], 2, "'r1/'"),
        (["vision", "--set", "hsv.min_radius_px=-1"], 2, "-1"),
        (["sim", "--scenario", "cirle"], 2, "'circle'"),
        (["sim", "--robot-model", "rasberry"], 2, "'raspberry'"),
        (["sim", "--seed", "-1"], 2, "--seed"),
        (["demo", "--scenario", "egiht"], 2, "'eight'"),
        (["demo", "--loss", "1.5"], 2, "--loss 1.5: expected a share from 0 to below 1, e.g. 0.1"),
        (["demo", "--transport", "foo"], 2, "error: unknown --transport 'foo'; expected zenoh, websocket, legacy"),
        (["demo", "--transport", "websockt"], 2, "error: unknown --transport 'websockt'; did you mean 'websocket'?"),
        (["demo", "--seconds", "-3"], 2, "--seconds -3.0: expected 0 to 3600"),
        (["status", "r1", "--connect", "tcp://robot:7447"], 2, "write tcp/robot:7447"),
        (["vision", "--connect", "tls/127.0.0.1:1"], 2, "a tls/ endpoint needs keys; pass --secure"),
        (["goto", "1.5", "1.5"], 2, "the robot is missing: write sightline goto ROBOT 1.5 1.5"),
        (["goto", "r1", "1,5", "1"], 2, "invalid number '1,5'; write 1.5"),
        (["goto", "r1", "--file", "none.txt"], 2,
         "cannot read none.txt: No such file or directory; name a file with one waypoint X Y per line"),
        (["mission", "r1", "--label", "person"], 2,
         "--label needs a mission to start; name it, e.g. sightline mission r1 follow --label person"),
        (["mission", "r1", "--set", "a=1"], 2, "--set needs a mission to start; name it, e.g. sightline mission r1 "),
        *((["mission", "r1", name, "--label", "a", "--set", f"{key}=b"], 2,
           f"--label and --set {key} exclude each other; remove one")
          for name, key in (("follow", "target.label"), ("legs", "label"))),
        (["detector", "check", "boxs"], 2, "did you mean 'boxes'?"),
        (["detector", "check", "hsv", "--set", "a"], 2, "expected KEY=VALUE, e.g. --set min_score=0.5"),
        (["detector", "check", "onnx:"], 2, "has nothing after its colon; write onnx"),
        *((["detector", "check", f"{name}:"], 2, f"has nothing after its colon; write e.g. {name}:{example}")
          for name, example in (("torch", "model.torchscript"), ("ultralytics", "yolo11n.pt"), ("transformers", "F"))),
        (["detector", "check", "LICENSE"], 2, "is a file: write onnx:LICENSE, or torch:LICENSE for a model of PyTorch"),
        (["detector", "check", __file__], 2, "is a file of Python: write test_app:NAME for its class NAME"),
        (["detector", "check", f"{__name__}.py:run"], 2, f"; write {__name__}:run"),
        (["vision", "--detector", ""], 2, "error: --detector = ''"),
        (["vision", "--mission", ""], 2, "error: --mission = ''"),
        (["detector", "check", f"onnx:{__file__}"], 2, "it is not an ONNX file"),
        (["detector", "check", f"{__name__}:rum"], 2, f"has no rum; did you mean {__name__}:run?"),
        (["score", "--scenario", "cirle"], 2, "'circle'"),
        (["score", "--seeds", "a,b"], 2, "--seeds 1,2,3"),
        (["score", "--latency-ms", "-5"], 2, "0 to 10000"),
        (["score", "--mission", "folow"], 2, "did you mean 'follow'"),
        (["score", "--mission", "band"], 2, "scenario thymio: mission 'band': unknown option 'waypoints'"),
        (["score", "--detector", "hvs"], 2, "'hsv'"),
        (["status", "--connect", "here"], 2, "tcp/127.0.0.1:7447"),
        (["arm", "a b"], 2, "'a b'"),
        *(([command, "tcp/127.0.0.1:9"], 2, "(no '/' or '*'), e.g. r1; pass an address with --connect")
          for command in ("arm", "stop", "status", "mission", "watch")),
        (["arm", ""], 2, "invalid robot id ''"),
        (["arm", "", "--connect", "tcp/127.0.0.1:9"], 2, "invalid robot id ''"),
        *((words, 2, "no home folder for '~no-user' in ~no-user/x; write the whole path") for words in (
            ["status", "--secure", "~no-user/x"],
            ["config", "check", "robot", "~no-user/x"],
            ["keys", "show", "~no-user/x"],
            ["goto", "r1", "--file", "~no-user/x"],
            ["scenarios", "circle", "--out", "~no-user/x"],
            ["detector", "check", "onnx:~no-user/x"],
        )),
        (["robots", "--connect", "tcp/127.0.0.1:1", "--seconds", "0.3"], 4, "no answer from tcp/127.0.0.1:1"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_and_its_exit_code(capsys, arguments, code, expected):
    got, out, err = run(capsys, *arguments)
    assert (got, out) == (code, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1, err
    assert expected in err


def test_a_robot_may_be_given_by_its_address(capsys, monkeypatch):
    """A legacy robot has an address and no id: `vision --robot ws-legacy://HOST:9091`."""
    seen = []
    monkeypatch.setattr("sightline.vision_side.serving.process.run", lambda config: seen.append(config) or 0)
    assert run(capsys, "vision", "--robot", "ws-legacy://127.0.0.1:9091")[0] == 0
    assert run(capsys, "vision", "--robot", "r7", "--connect", "ws://127.0.0.1:9090")[0] == 0
    assert [(config.robot, config.connect) for config in seen] == [
        ("r1", ("ws-legacy://127.0.0.1:9091",)), ("r7", ("ws://127.0.0.1:9090",)),
    ]  # fmt: skip


@pytest.mark.parametrize("has_logs", [True, False])
def test_interrupted_faults_name_the_folder_of_their_logs(capsys, monkeypatch, tmp_path, has_logs):
    def interrupted(_rows, _repeat, folder, *_given):
        if has_logs:
            (folder / "vision.kill-1-1").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("sightline.evaluation.faults.runner.run_cases", interrupted)
    code, _, err = run(capsys, "faults", "--only", "vision.kill")
    left = [str(folder) for folder in tmp_path.iterdir()]
    assert code == 130 and len(left) == has_logs and all(folder in err for folder in left)
    assert ("logs of failed and interrupted rows are in" in err) is has_logs


def test_empty_file_that_a_command_reads_is_not_an_interrupt(capsys, monkeypatch):
    def read(_pickled):
        raise EOFError("Ran out of input")

    monkeypatch.setattr("sightline.evaluation.faults.runner.run_cases", lambda *_given: read(b""))
    code, _, err = run(capsys, "faults", "--only", "vision.kill")
    assert code == cli.UNEXPECTED and err.splitlines()[-1].startswith("error: unexpected EOFError: Ran out of input;")
    monkeypatch.setattr("sightline.evaluation.faults.runner.run_cases", lambda *_given: typer.confirm("go on"))
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert run(capsys, "faults", "--only", "vision.kill")[0] == cli.INTERRUPTED


@pytest.mark.parametrize(("mission", "option"), [("follow", "target.label"), ("legs", "label")])
def test_label_of_a_mission_is_its_option(capsys, monkeypatch, mission, option):
    requests = []

    class Missions:
        def request(self, name, *, options):
            requests.append((name, options))
            raise LinkError("the test ends here")

    monkeypatch.setattr(operate, "_missions", lambda _target: nullcontext(Missions()))
    run(capsys, "mission", "r1", mission, "--label", "person", "--set", "steer.bearing_kp=2", "--connect",
        "tcp/127.0.0.1:9")
    assert requests == [(mission, {"steer.bearing_kp": 2, option: "person"})]


def test_misspelled_environment_name_stops_any_service(capsys, monkeypatch):
    monkeypatch.setenv("SIGHTLINE_ROBOT__SAFETY__MAX_LINER_MPS", "0.1")
    for service in ("robot", "vision", "sim"):
        code, _, err = run(capsys, service)
        assert code == 2
        assert "SIGHTLINE_ROBOT__SAFETY__MAX_LINEAR_MPS" in err


def test_unexpected_error_is_one_line_and_a_traceback_only_on_request(capsys, monkeypatch):
    def broken(*_arguments: object, **_options: object) -> None:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr("sightline.operator_side.cli.services.load_service", broken)
    code, out, err = run(capsys, "config", "check", "robot")
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert "SIGHTLINE_DEBUG=1" in err
    monkeypatch.setenv("SIGHTLINE_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        cli.run(["config", "check", "robot"])


def test_error_that_ends_a_service_leaves_its_traceback_in_the_log(capsys, caplog, monkeypatch):
    def broken(*_arguments: object, **_options: object) -> None:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr("sightline.operator_side.cli.services.load_service", broken)
    assert run(capsys, "robot")[0] == 1
    (record,) = caplog.records
    assert (record.levelname, record.message) == ("ERROR", "program raised ZeroDivisionError: two lines")
    assert record.exc_info[2].tb_next


@pytest.mark.parametrize("arguments", [["--version"], ["keys", "show", "keys"]])  # by typer.echo, and by print
@pytest.mark.parametrize("is_full", [True, False])
def test_output_that_cannot_be_written_is_not_an_unexpected_error(capsys, monkeypatch, arguments, is_full):
    monkeypatch.setattr("sightline.operator_side.setup.keys.look", lambda _folder: [])
    monkeypatch.setattr("sightline.operator_side.cli.admin.print_table", lambda _rows: print("no keys"))
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed, Path("/dev/full").open("w") as full:
        monkeypatch.setattr("sys.stdout", full if is_full else closed)
        assert cli.run(arguments) == (2 if is_full else 141)
    line = "error: cannot write the output: No space left on device; free the disk\n"
    assert capsys.readouterr().err == (line if is_full else "")


@pytest.mark.parametrize("arguments", [
    ["use", "tcp/127.0.0.1:1", "--secure", "keys"], ["install", "robot", "--config", "r.toml"],
])
def test_current_folder_that_is_gone_is_one_line(capsys, monkeypatch, tmp_path, arguments):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert run(capsys, *arguments) == (2, "", "error: the current folder no longer exists; change to another\n")


@pytest.mark.parametrize("arguments", [["demo", "--out", "run"], ["faults", "--only", "vision.kill"]])
def test_full_temporary_folders_are_one_line(capsys, monkeypatch, tmp_path, arguments):
    def fail(folders):
        raise FileNotFoundError(errno.ENOENT, f"No usable temporary directory found in {folders}")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr("tempfile._get_default_tempdir", lambda: fail(["/tmp"]))
    code, _, err = run(capsys, *arguments)
    assert (code, err.splitlines()[-1]) == (2, (
        "error: no temporary folder can be written: the disk is full or read-only; free some space, or set TMPDIR to "
        "a folder that you may write"))


@pytest.mark.parametrize("as_json", [True, False])
@pytest.mark.parametrize("fails", [True, False])
def test_what_the_c_code_of_a_plug_in_prints_is_not_in_the_json(capfd, as_json, fails):
    libc = ctypes.CDLL(None)
    with suppress(ZeroDivisionError), plugin_prints(as_json):
        print("python")
        libc.puts(b"C")
        os.write(1, b"system\n")
        assert not fails or 1 / 0
    print("{}", flush=True)
    libc.fflush(None)
    out, err = capfd.readouterr()
    meant, other = (err, out) if as_json else (out, err)
    assert {"python", "C", "system"} <= set(meant.split()) and other == ("{}\n" if as_json else "")


def test_what_a_plug_in_prints_to_a_stdout_that_it_imported_by_name_is_not_in_the_json():
    script = ("from sys import stdout; from sightline.operator_side.cli.options import plugin_prints\n"
              "with plugin_prints(True): stdout.write('plug-in')\n"
              "print('{}')")
    environ = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environ, check=True)
    assert (done.stdout, done.stderr) == ("{}\n", "plug-in")


@pytest.mark.parametrize(("arguments", "used"), [
    (["doctor"], ["operator_side.cli.admin._findings"]),
    (["score", "--scenario", "static"], ["evaluation.score.runs.run_cases"]),
    (["score", "--scenario", "static", "--sabotage", "wheels-dead"], ["evaluation.score.runs.run_all_sabotaged"]),
    (["demo"], ["evaluation.demo.run.run_demo", "evaluation.demo.report.report", "evaluation.demo.report.write_files"]),
])  # fmt: skip
def test_json_of_a_command_that_runs_a_plug_in_has_its_prints_on_stderr(capsys, monkeypatch, arguments, used):
    def prints(*_given):
        print("plug-in")
        return [] if arguments == ["doctor"] else SimpleNamespace(to_dict=lambda: {"ok": True}, lines=list)

    for name in used:
        monkeypatch.setattr(f"sightline.{name}", prints)
    for text in ("demo.report.summary", "score.runs.score_text"):
        monkeypatch.setattr(f"sightline.evaluation.{text}", lambda _result: "")
    code, out, err = run(capsys, *arguments, "--json")
    assert code == 0 and json.loads(out)["ok"] and err.count("plug-in") == len(used)


@pytest.mark.parametrize("number", [math.inf, -math.inf, math.nan])
def test_result_with_a_number_that_json_lacks_is_valid_json(capsys, number):
    checks = [asdict(at_most("age", number, "ms", math.inf))]
    print_result({"ok": True, "checks": checks, "ages_ms": (1.5, number)}, (), as_json=True)
    result = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert result["checks"][0]["bound"] is None and result["ages_ms"] == [1.5, None]


@pytest.mark.parametrize(("service", "given", "why"), [
    *((service, given, why) for service in ("robot", "vision") for given, why in (
        ('secure = "/no keys"',
         "ca.pem is missing in /no keys"),
        ('secure = "KEYS"\nlisten = ["tcp/127.0.0.1:1"]', "tcp/127.0.0.1:1 has no TLS"),
        ('listen = ["ws://0.0.0.0:9090"]', "accepts network clients without a token; pass --secure"),
        ('listen = ["wss://0.0.0.0:9090"]\nconnect = []\nsecure = "KEYS"', None),
        ('listen = []\nconnect = ["wss://robot:9090"]\nsecure = "/no keys"',
         "ca.pem is missing in /no keys; copy it from the folder of `sightline keys init`"),
        ('listen = ["tls/0.0.0.0:7447"]\nconnect = []\nsecure = "KEYS"', None),
    )),
    ("robot", 'listen = ["ws-legacy://0.0.0.0:9091"]', "list their addresses, legacy.allow_from"),
    ("robot", 'listen = ["ws-legacy://0.0.0.0:9091"]\nlegacy.allow_from = ["10.0.0.0/8"]', None),
    *(("robot", f'camera.kind = "v4l2"\ncamera.options.{lens}', why) for lens, why in (
        ('model_file = "/gone.toml"', "/gone.toml: cannot be read"),
        ('model_file = "KEYS/ca.pem"', "ca.pem: invalid TOML"),
        ("model.fx_px = 1.0", "camera option model: key 'width_px' is missing"),
    )),
])
def test_check_finds_keys_endpoints_and_lens_files_that_end_the_service(capsys, tmp_path, service, given, why):
    keys, path = str(tmp_path / "keys"), tmp_path / "own.toml"
    run(capsys, "keys", "init", keys)
    path.write_text(given.replace("KEYS", keys))
    code, _, err = run(capsys, "config", "check", service, str(path))
    assert (code, err.count("\n")) == ((0, 0) if why is None else (2, 1)) and (why or "") in err


def test_config_commands_print_output_for_scripts(capsys, tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text('robot = "r9"\n')
    code, out, _ = run(capsys, "config", "check", "robot", str(path))
    assert (code, str(path) in out) == (0, True)
    for fine in ("listen=ws://127.0.0.1:1", "connect=ws://127.0.0.1:1", "connect=tcp/127.0.0.1:1"):
        assert run(capsys, "config", "check", "robot", "--set", fine)[::2] == (0, "")
    for fine in ("detector.kind=boxes", "missions.goto.sight_m=0.2", "missions.goto-baseline.max_linear_mps=0.05"):
        assert run(capsys, "config", "check", "vision", "--set", fine)[::2] == (0, "")
    code, out, _ = run(capsys, "config", "show", "robot", str(path), "--origin")
    assert code == 0
    assert tomllib.loads(out)["robot"] == "r9"
    assert next(line for line in out.splitlines() if line.startswith("robot =")).endswith(f"# {path}")
    code, out, _ = run(capsys, "config", "show", "robot", str(path), "--json", "--origin")
    assert json.loads(out)["origins"]["robot"] == str(path)
    code, out, _ = run(capsys, "config", "schema", "vision")
    assert "target" in json.loads(out)["properties"]


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["config", "show", "robot"], ["arm", "a/b"]])
def test_nothing_heavy_is_imported_before_it_is_needed(arguments):
    script = (
        "import sys; from sightline.operator_side.cli import app as cli; cli.run(sys.argv[1:]);"
        "heavy = {'numpy', 'cv2', 'pybullet', 'matplotlib', 'av', 'mcap', 'zenoh'} & set(sys.modules);"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    result = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=False, env=dict(os.environ)
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(("command", "needs"), [
    ("robot", {"robot_side"}), ("vision", {"vision_side"}), ("sim", {"sim", "robot_side"}), ("metrics", set())])
def test_a_service_starts_without_the_configuration_of_the_others(command, needs):
    script = (
        "import sys; from sightline.operator_side.cli import app as cli; code = cli.run(sys.argv[1:]);"
        "configs = ('robot_side.config', 'robot_side.ports', 'vision_side.config', 'sim.scenario');"
        "print(code, *{name.split('.')[0] for name in configs if f'sightline.{name}' in sys.modules})"
    )
    wrong = ["--port", "0", "a/b"] if command == "metrics" else ["--set", "no_such_key=1"]
    result = subprocess.run([sys.executable, "-P", "-c", script, command, *wrong], capture_output=True, text=True,
                            check=True)
    code, *imported = result.stdout.split()
    assert (code, set(imported)) == ("2", needs), result.stderr


@pytest.mark.waits
@pytest.mark.parametrize(("command", "group", "libraries"), [
    ("stop", "app", ""), ("status", "app commands operate options", "typer"),
    ("teleop", "app commands operate options", "typer"),
], ids=["stop", "status", "teleop"])
def test_operator_commands_import_their_own_group_and_no_image_library(command, group, libraries):
    script = (
        "import sys; from sightline.operator_side.cli import app as cli; cli.run(sys.argv[1:]);"
        "group = 'sightline.operator_side.cli.';"
        "print(*sorted(name[len(group):] for name in sys.modules if name.startswith(group)));"
        "print(*{'numpy', 'cv2', 'pybullet', 'matplotlib', 'typer'} & set(sys.modules))"
    )
    endpoint = ["--connect", "tcp/127.0.0.1:1"]
    result = subprocess.run([sys.executable, "-P", "-c", script, command, *endpoint], capture_output=True, text=True,
                            check=True, stdin=subprocess.DEVNULL)
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert result.stdout.splitlines() == [group, libraries]


@pytest.fixture
def shadowed(tmp_path, monkeypatch):
    """A folder on PYTHONPATH whose files have the names of our packages."""
    for name in ("sim", "protocol", "robot_side", "vision_side", "evaluation", "sightline_robot"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a file of the current folder was imported')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", ".")


@pytest.mark.usefixtures("shadowed")
def test_commands_ignore_files_of_the_same_names_in_the_folder():
    """One process, started as the console script is: without -P, and with the current folder on its path."""
    script = """if True:
        import importlib, json, pkgutil, sys
        import sightline
        from sightline.operator_side.cli import app as cli
        assert "" in sys.path
        for path in json.loads(sys.argv[1]):
            assert cli.run([*path, "--help"]) == 0, path
        for module in pkgutil.walk_packages(sightline.__path__, "sightline."):
            try:
                importlib.import_module(module.name)
            except ModuleNotFoundError as error:
                assert not error.name.startswith("sightline"), error
    """
    done = subprocess.run([sys.executable, "-c", script, json.dumps(list(COMMANDS))], capture_output=True, text=True,
                          check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage: sightline ") == len(COMMANDS)


@pytest.mark.slow
@pytest.mark.usefixtures("shadowed")
@pytest.mark.parametrize("arguments", [
    ("demo", "--seconds", "2", "--out", "run"),
    ("score", "--scenario", "circle", "--seeds", "1,2", "--seconds", "5", "--jobs", "2"),
], ids=lambda value: value[0])
def test_child_processes_import_no_file_of_the_current_folder(arguments):
    command = [str(Path(sys.executable).with_name("sightline")), *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=180)
    assert done.returncode in (0, 5), done.stderr  # so short a run may miss a bound
    assert json.loads(done.stdout)["checks"]


def test_every_python_that_the_product_starts_ignores_the_current_folder():
    root, starts = Path(cli.__file__).resolve().parents[2], 0
    for package in (root / ".import/sightline").iterdir():
        for path in (root / package.name).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.List) and any(ast.unparse(one) == "sys.executable" for one in node.elts):
                    starts += 1
                    given = {one.value for one in node.elts if isinstance(one, ast.Constant)}
                    assert given & {"-P", "-I"}, path
    assert starts >= 6


@pytest.mark.parametrize(
    ("package", "version", "expected"),
    [
        ("av.video", (3, 11), "av is not installed: pip install --editable '.[sim]'"),
        ("pybullet", (3, 11), "pip install --editable '.[sim]'"),
        ("pybullet", (3, 13), "Python 3.13: use Python 3.11, or `docker compose up`"),
    ],
)
def test_a_missing_package_names_the_command_that_installs_it(package, version, expected):
    with pytest.raises(ConfigError) as error, needs("sim", version):
        raise ModuleNotFoundError(name=package)
    assert expected in str(error.value)


def test_missing_module_of_sightline_is_an_unexpected_error():
    with pytest.raises(ModuleNotFoundError), needs("sim"):
        raise ModuleNotFoundError(name="sightline.sim.nothing")


@pytest.mark.slow
def test_command_that_waits_for_a_link_prints_its_address_without_json():
    address = free_endpoint()
    program = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app"]
    commands = {
        name: subprocess.Popen([*program, *words, "--connect", address], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                               text=True)
        for name, words in (("plain", ["status"]), ("json", ["status", "--json"]), ("service", ["vision"]))
    }  # fmt: skip
    said = {name: process.communicate(timeout=30) for name, process in commands.items()}
    waits = f"connecting to {address} ..."
    no_answer = f"error: no answer from {address} after 5 s; start the robot or router, or check the address\n"
    assert said["plain"] == ("", f"{waits}\n{no_answer}")
    assert said["json"] == ("", no_answer)
    assert said["service"][0].endswith(f" info {waits}\n") and said["service"][1] == no_answer
