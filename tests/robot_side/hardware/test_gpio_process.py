"""A real driver process on mock pins that outlive it, checked by the events of the pins."""

import signal
import subprocess
import sys
import time

import pytest

from tests.fixtures import demanded

demanded.module("gpiozero", "robot-pi")

from tests.fixtures.dying import DriveFault
from tests.fixtures.gpio import BOARD, LEFT, OPTIONS, RIGHT, board_events, board_state
from tests.fixtures.links import START_S, until
from tests.fixtures.robot_process import RobotProcess, Vision

pytestmark = pytest.mark.waits

LOW_WITHIN_US = 50_000
"""From the moment that the gate's zero reaches the drive; the issue's bound."""
FINE = [[0.02, 0.001], [1.0, 1.0]]
"""A table without stiction to speak of: the pins follow the gate down to its very zero."""
DRIVE = {"kind": "tests.fixtures.gpio:BoardDrive", "options": {**OPTIONS, "enable_pins": [17], "table": FINE}}


@pytest.fixture
def board(tmp_path, monkeypatch):
    path = tmp_path / "board.csv"
    monkeypatch.setenv(BOARD, str(path))
    return path


def rolling(board) -> bool:
    """Wait until both wheels are driven forwards."""
    return until(lambda: all(board_state(board).get(number, 0.0) > 0 for number in (LEFT[0], RIGHT[0])), START_S)


def stopped(board) -> bool:
    """Wait until the gate reports zero and no pin of a motor is driven."""

    def still() -> bool:
        told = [value for _, what, value in board_events(board) if what == "gate"]
        return told[-1] == 0 and not any(board_state(board).get(number, 0.0) for number in (*LEFT, *RIGHT))

    return until(still, 3)


def low_after_zero_us(board) -> int:
    """From the first zero that the gate gave after the last motion to the last pin's low."""
    events = board_events(board)
    moving = max(i for i, (_, what, value) in enumerate(events) if what == "gate" and value > 0)
    zero_us = next(t_us for t_us, what, value in events[moving:] if what == "gate" and value == 0)
    return last_low_us(board) - zero_us


def last_low_us(board) -> int:
    """When a pin of a motor was last put low."""
    return max(t_us for t_us, what, value in board_events(board) if what not in ("gate", "17") and value == 0)


def zero_motors() -> float:
    """`ExecStopPost` of the unit, as systemd runs it; the seconds it took."""
    started_s = time.monotonic()
    radius = f"drive.options.wheel_radius_m={OPTIONS['wheel_radius_m']}"
    sets = ["--set", f"drive.kind={DRIVE['kind']}", "--set", radius, "--set", "drive.options.enable_pins=[17]"]
    command = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app", "robot", *sets, "--zero-motors"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return time.monotonic() - started_s


def test_the_pins_are_low_soon_after_the_gates_zero_when_vision_is_gone(tmp_path, board):
    with RobotProcess(tmp_path, drive=DRIVE) as robot:
        with Vision(robot.endpoint):
            assert rolling(board)
        assert stopped(board)
        took_us = low_after_zero_us(board)
        print(f"\nthe last pin is low {took_us / 1000:.2f} ms after the gate's zero")
        assert took_us <= LOW_WITHIN_US
        assert board_state(board)[17] == 1, "the bridge brakes while the robot is on"
    assert board_state(board)[17] == 0
    assert not any(board_state(board).values())


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_network_process_that_dies_or_hangs_leaves_no_pin_high(tmp_path, board, number):
    with RobotProcess(tmp_path, drive=DRIVE) as robot, Vision(robot.endpoint):
        assert rolling(board)
        since_us = time.monotonic_ns() // 1000
        robot.kill_network(number)
        assert stopped(board)
        assert last_low_us(board) - since_us < 1_000_000
        assert low_after_zero_us(board) <= LOW_WITHIN_US


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_every_requested_end_leaves_the_pins_low(tmp_path, board, number):
    with RobotProcess(tmp_path, drive=DRIVE) as robot, Vision(robot.endpoint):
        assert rolling(board)
        robot.process.send_signal(number)
        assert robot.process.wait(5) == 0
        assert not any(board_state(board).values())


DYING = {**DRIVE, "kind": "tests.fixtures.gpio:DyingBoardDrive"}


@pytest.mark.parametrize("name", ["SIGKILL", "SIGSTOP"])
def test_guardian_sets_the_pins_of_a_dead_or_stopped_driver_low_once_it_owns_them(tmp_path, board, monkeypatch, name):
    fault = DriveFault(monkeypatch, tmp_path, name)
    with RobotProcess(tmp_path, drive=DYING) as robot, Vision(robot.endpoint):
        robot.wait_until_on("a new driver process starts")
        low_us = next(t_us for t_us, *event in board_events(board) if t_us > fault.t_us and event == ["17", 0])
        assert low_us - fault.t_us < 700_000
        assert "NOT set to zero" not in robot.output()


def test_pins_keep_their_state_after_both_processes_died_until_the_units_command(tmp_path, board, monkeypatch):
    """Why the unit has an ExecStopPost: nothing that runs in a process outlives it."""
    DriveFault(monkeypatch, tmp_path, "both")
    with RobotProcess(tmp_path, drive=DYING) as robot, Vision(robot.endpoint):
        assert robot.process.wait(START_S) == -signal.SIGKILL
        time.sleep(0.5)
        assert board_state(board)[LEFT[0]] > 0 and board_state(board)[RIGHT[0]] > 0
        zero_motors()
        assert not any(board_state(board).values())


def test_a_driver_whose_drive_breaks_puts_all_pins_low(tmp_path, board):
    """The plug-in raises in the middle of a drive: FAULT, and nothing is driven."""
    broken = {"kind": "tests.fixtures.gpio:BreakingDrive", "options": DRIVE["options"]}
    with RobotProcess(tmp_path, drive=broken) as robot, Vision(robot.endpoint) as vision:
        assert rolling(board)
        assert until(lambda: vision.status().state == "FAULT", 5)
        assert stopped(board)
        assert board_state(board)[17] == 0
