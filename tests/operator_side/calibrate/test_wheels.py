"""`sightline robot test-wheels` and `sightline calibrate drive`: nothing turns unasked, every end is zero."""

import io
import os
import signal
import sys
import tomllib
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from sightline.evaluation.processes import driver_of
from sightline.operator_side.calibrate import wheels as wheel_test
from sightline.operator_side.cli import app as cli
from sightline.operator_side.cli import calibrate as cli_robot_tools
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.supervision import EXIT_SIGNALS
from tests.fixtures import demanded
from tests.fixtures.links import until
from tests.fixtures.terminal import Terminal

GPIO = PluginChoice(kind="sightline.robot_side.hardware.gpio:GpioDrive", options={"wheel_radius_m": 0.0325})


class DutyDrive:
    """A drive with duties that moves nothing."""

    def set_duty(self, left, right):
        pass


class Operator:
    """Answers by the words of the question; stores all printed lines."""

    def __init__(self, **answers):
        self.answers, self.lines, self.questions = answers, [], []

    def answer(self, question):
        self.questions.append(question)
        known = ("off_the_ground", "is_that_right", "what_turned", "one_of")
        key = next(key for key in known if key.replace("_", " ") in question)
        given = self.answers.get(key, "y")
        return given.pop(0) if isinstance(given, list) else given


@pytest.fixture
def robot(tmp_path, monkeypatch):
    monkeypatch.setattr(wheel_test, "TURN_S", 0.01)
    log = tmp_path / "drive.csv"
    return RobotConfig(drive=PluginChoice(kind="log", options={"path": str(log)})), log


def commanded(log):
    """Return (left, right) of each motor command."""
    return [tuple(float(cell) for cell in line.split(",")[1:]) for line in log.read_text().splitlines()]


def test_each_wheel_turns_alone_in_both_directions_and_stops(robot):
    config, log = robot
    operator = Operator()
    assert wheel_test.try_wheels(config, operator.answer, operator.lines.append)
    speed = 0.25 / 0.035
    turns = [(speed, 0), (-speed, 0), (0, speed), (0, -speed)]
    expected = [pair for turn in turns for pair in (turn, (0, 0))] + [(0, 0)]
    assert commanded(log) == [pytest.approx(pair, abs=1e-4) for pair in expected]
    text = "\n".join(operator.lines)
    assert "left wheel, forward: its top moves away from you" in text and text.endswith("all wheels turn as expected")
    assert operator.questions[0] == "are its wheels off the ground? y/n" and len(operator.questions) == 5


@pytest.mark.parametrize("answer", ["n", "", "no", "maybe", " "])
def test_wheels_do_not_turn_without_confirmation(robot, answer):
    config, log = robot
    operator = Operator(off_the_ground=answer)
    assert not wheel_test.try_wheels(config, operator.answer, operator.lines.append)
    assert not log.exists()
    assert operator.lines[-1] == "nothing moved"


@pytest.mark.parametrize(("options", "turn", "wrong", "expected"), [
    ({}, 0, "w", "set drive.options.left_reversed = true"), ({}, 2, "w", "set drive.options.right_reversed = true"),
    ({"left_reversed": True}, 1, "w", "set drive.options.left_reversed = false"),
    ({"swapped": True}, 0, "w", "set drive.options.right_reversed = true"),
    ({}, 0, "o", "set drive.options.swapped = true"), ({"swapped": True}, 3, "o", "set drive.options.swapped = false"),
    ({}, 0, "b", "two wires of different motors"), ({}, 0, "n", "check the motors' supply"),
])  # fmt: skip
def test_wheel_that_turns_the_wrong_way_names_the_option(options, turn, wrong, expected):
    choice = PluginChoice(kind=GPIO.kind, options={**GPIO.options, **options})
    assert expected in wheel_test._advice(choice, wheel_test.TURNS[turn], wrong)


def test_drive_without_these_options_gets_a_wiring_hint(robot):
    config, _ = robot
    operator = Operator(is_that_right=["n", "y", "n", "y"], what_turned=["?", "o"], one_of="w")
    assert not wheel_test.try_wheels(config, operator.answer, operator.lines.append)
    text = "\n".join(operator.lines)
    assert "left wheel, forward: it turned the wrong way: exchange the two wires of the left motor" in text
    assert "right wheel, forward: the other wheel turned: exchange the motors' plugs" in text


def test_without_questions_the_operator_has_to_compare(robot):
    lines = []
    assert wheel_test.try_wheels(robot[0], None, lines.append)
    assert lines[-1] == "each wheel was turned; compare what you saw with these lines"


def test_drive_that_fails_is_set_to_zero_and_closed(monkeypatch, robot):
    config, log = robot
    monkeypatch.setattr(wheel_test.time, "sleep", lambda _s: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        wheel_test.try_wheels(config, None, lambda _line: None)
    assert commanded(log)[-1] == (0.0, 0.0) and len(commanded(log)) == 3


@pytest.mark.parametrize("number", EXIT_SIGNALS)
def test_any_key_or_terminal_end_sets_zero(monkeypatch, robot, number):
    config, log = robot
    before = signal.getsignal(number)
    monkeypatch.setattr(wheel_test.time, "sleep", lambda _s: signal.raise_signal(number))
    with pytest.raises(KeyboardInterrupt):
        wheel_test.try_wheels(config, None, lambda _line: None)
    assert commanded(log)[-1] == (0.0, 0.0) and signal.getsignal(number) is before


@pytest.mark.parametrize(("arguments", "expected"), [
    (["robot", "test-wheels"], "lift the robot, then add --yes"),
    (["robot", "test-wheel"], "unknown task 'test-wheel'; did you mean 'test-wheels'?"),
    (["robot", "r7"], "--robot r7"),
    (["robot", "my_robot.toml"], "--config my_robot.toml"),
    (["calibrate", "drive", "--set", "drive.kind=log"],
     "no terminal to confirm on; put the robot on the floor, free the way ahead, then add --yes"),
    (["calibrate", "drive", "--duty", "0.4,0.3"], "rising numbers"),
    (["calibrate", "drive", "--duty", "0.4,x"], "--duty"),
    (["calibrate", "drive", "--duty", "0.4,1.4"], "up to 1"),
    (["calibrate", "drive", "--yes", "--set", "drive.kind=log"], "drive 'log' has no duty to calibrate"),
    (["calibrate", "drive", "--yes", "--out", "/nowhere/drive.toml"], "no folder /nowhere"),
])  # fmt: skip
def test_invalid_usage_is_one_line_and_moves_nothing(capsys, monkeypatch, arguments, expected):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.setattr(wheel_test, "turn_for", lambda *_given: pytest.fail("it moved"))
    assert cli.run(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert expected in captured.err


@pytest.mark.parametrize("task", [["test-wheels", "--yes"], ["r1"], []], ids=["test-wheels", "typing error", "none"])
def test_zero_motors_only_sets_the_motors_to_zero(tmp_path, monkeypatch, task):
    monkeypatch.setattr(wheel_test, "turn_for", lambda *_given: pytest.fail("it moved"))
    log = tmp_path / "drive.csv"
    sets = ["--set", "drive.kind=log", "--set", f"drive.options.path={log}"]
    assert cli.run(["robot", *task, "--zero-motors", *sets]) == 0
    assert commanded(log) == [(0.0, 0.0)]


# --- in a terminal ---------------------------------------------------------------------------------------------------


@pytest.fixture
def opened():
    terminals = []

    def run(*arguments):
        terminals.append(Terminal(*arguments))
        return terminals[-1]

    yield run
    for terminal in terminals:
        terminal.close()


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_signal_during_a_turn_sets_zero_first(tmp_path, opened, number):
    log = tmp_path / "drive.csv"
    terminal = opened("robot", "test-wheels", "--set", "drive.kind=log", "--set", f"drive.options.path={log}")
    assert terminal.shows("off the ground? y/n")
    assert not log.exists() or commanded(log) == []
    terminal.types("y\n")
    assert until(lambda: log.exists() and commanded(log) and commanded(log)[-1][0] > 0)
    terminal.process.send_signal(number)
    assert terminal.process.wait(3) == 130
    assert commanded(log)[-1] == (0.0, 0.0)
    assert "not covered" not in terminal.text()


def test_killed_during_a_turn_leaves_zero_and_restarts_nothing(tmp_path, opened):
    log = tmp_path / "drive.csv"
    terminal = opened("robot", "test-wheels", "--set", "drive.kind=log", "--set", f"drive.options.path={log}")
    assert terminal.shows("off the ground? y/n")
    terminal.types("y\n")
    assert until(lambda: log.exists() and commanded(log) and commanded(log)[-1][0] > 0)
    os.kill(driver_of(terminal.process.pid), signal.SIGKILL)
    assert terminal.process.wait(3) == 3
    assert commanded(log)[-1] == (0.0, 0.0)
    assert terminal.shows("not started again: the motors are at zero"), terminal.text()


def test_a_drive_is_calibrated_at_a_terminal(tmp_path, opened, monkeypatch):
    demanded.module("gpiozero", "robot-pi")
    monkeypatch.setenv("CAR_TEST_BOARD", str(tmp_path / "board.csv"))
    out = tmp_path / "drive.toml"
    terminal = opened(
        "calibrate", "drive", "--set", "drive.kind=tests.fixtures.gpio:BoardDrive", "--duty", "0.3,0.4,0.8",
        "--set", "drive.options.wheel_radius_m=0.03", "--seconds", "0.5", "--out", str(out),
    )  # fmt: skip
    for duty, answers in (("0.3", ["0"]), ("0.4", ["much", "0,05"]), ("0.8", ["0.1"])):
        assert terminal.shows(f"duty {duty} for 0.5 s"), terminal.text()
        terminal.types("\n")
        assert terminal.shows(f"duty {duty}: distance in meters"), terminal.text()
        for answer in answers:
            terminal.types(f"{answer}\n")
            assert answer != "much" or terminal.shows("invalid distance 'much'")
    assert terminal.process.wait(10) == 0, terminal.text()
    assert tomllib.loads(out.read_text())["table"] == [[0.4, 0.1], [0.8, 0.2]]
    events = (tmp_path / "board.csv").read_text()
    assert ",10,0.8000" in events and ",8,0.8000" in events


def test_measurements_that_make_no_table_are_not_written(tmp_path, capsys, monkeypatch):
    out = tmp_path / "drive.toml"
    rows = [(0.4, 0.2), (0.6, 0.1)]
    monkeypatch.setattr(cli_robot_tools, "_measure_rows", lambda *given, **_k: given[3].extend(rows))
    assert cli.run(["calibrate", "drive", "--yes", "--out", str(out), "--duty", "0.4,0.6"]) == 2
    said = capsys.readouterr().err
    assert "both must rise" in said and not out.exists()
    assert "[0.4, 0.2]" in said, "what was measured is not lost"


@pytest.mark.parametrize(("answers", "is_printed"), [("0.1\n0\n", True), ("", False)])
def test_table_of_a_calibration_that_ends_early_is_printed(tmp_path, capsys, monkeypatch, answers, is_printed):
    monkeypatch.setattr(sys, "stdin", io.StringIO(answers))
    monkeypatch.setattr(cli_robot_tools, "opened_drive", lambda *_given: nullcontext((DutyDrive(), None)))
    monkeypatch.setattr(cli_robot_tools, "DRIVES", SimpleNamespace(load=lambda _choice: (DutyDrive, None)))
    monkeypatch.setattr(cli_robot_tools, "turn_for", lambda *_given: None)
    out = tmp_path / "drive.toml"
    assert cli.run(["calibrate", "drive", "--yes", "--out", str(out), "--duty", "0.4,0.6,0.8"]) == 130
    said = capsys.readouterr().err
    assert ("not written; the measured table is:" in said) is is_printed and ("[0.400, 0.0500]" in said) is is_printed
    assert not out.exists()


def test_wheels_turn_only_after_a_confirmation():
    wheel_test.check_confirmed(True, False, "x", "wait")
    wheel_test.check_confirmed(False, True, "x", "wait")
    with pytest.raises(ConfigError):
        wheel_test.check_confirmed(False, False, "x", "wait")
