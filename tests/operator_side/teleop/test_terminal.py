"""`sightline teleop` in a real pseudo-terminal, at a real robot over real Zenoh, with fingers that repeat a key."""

import os
import signal
import statistics
import threading
import time

import pytest

from sightline.operator_side.cli import app as cli
from sightline.protocol.messages import State
from sightline.protocol.transports.zenoh.session import open_session
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision
from tests.fixtures.terminal import Terminal

MOVING_S, ZERO_S = 0.120, 0.150
"""The issue's bounds: from a key to a moving wheel; from the end of its repeats, or of its terminal, to zero."""
REPEAT_S, DELAY_S = 0.033, 0.25


class Fingers:
    """Hold a key of a terminal as an X server does: one press, a delay, then repeats; on a thread."""

    def __init__(self, terminal):
        self._terminal, self._lifted = terminal, threading.Event()

    def press(self, key):
        """When it went down, monotonic seconds."""
        self._lifted.clear()
        pressed_s = time.monotonic()
        self._terminal.types(key)
        self._thread = threading.Thread(target=self._repeat, args=(key,), daemon=True)
        self._thread.start()
        return pressed_s

    def _repeat(self, key):
        wait_s = DELAY_S
        while not self._lifted.wait(wait_s):
            self._terminal.types(key)
            wait_s = REPEAT_S

    def lift(self):
        """When the last repeat can have been, monotonic seconds."""
        self._lifted.set()
        self._thread.join()
        return time.monotonic()


class Overheard:
    """Every twist that teleop sends, as it passes the robot's router."""

    def __init__(self, endpoint):
        self._session = open_session((), [endpoint], 10.0)
        self.commands = []
        self._subscriber = self._session.declare_subscriber("sightline/r1/twist/teleop", self._hear)

    def _hear(self, sample):
        self.commands.append((time.monotonic(), bytes(sample.payload)))

    def first_zero_s(self, since_s):
        """When the first zero came that nothing but zeros followed; None if none has."""
        moving = [at_s for at_s, text in self.commands if text != b"0.0000|0.0000"]
        last_s = max(moving, default=0.0)
        return next((at_s for at_s, _ in self.commands if at_s > max(last_s, since_s - REPEAT_S)), None)

    def close(self):
        self._session.close()


class Seat:
    """A robot, a person's terminal at it, and somebody who listens."""

    def __init__(self, folder):
        self.robot = RobotProcess(folder, safety={"auto_arm": False}).__enter__()
        assert until(lambda: "on tcp/" in self.robot.output(), 10)
        self.overheard = Overheard(self.robot.endpoint)
        self.terminal = Terminal("teleop", "r1", "--connect", self.robot.endpoint)
        self.fingers = Fingers(self.terminal)

    def close(self):
        self.terminal.close()
        self.overheard.close()
        self.robot.__exit__()

    def sit(self):
        """Drive a little, so that the robot is armed and the terminal's repeats are learnt."""
        assert self.terminal.shows("DISARMED"), self.terminal.text()
        self.fingers.press("i")
        assert until(lambda: self.robot.speed() > 4, 5), self.terminal.text()
        time.sleep(0.3)
        self.fingers.lift()
        assert until(lambda: self.robot.speed() == 0, 2)
        time.sleep(0.4)
        return self

    def moved_s(self, since_s):
        """When the motors were first told to turn."""
        rows = [t_us / 1e6 for t_us, left, right in self.robot.motor_rows() if left or right]
        return next((at_s for at_s in rows if at_s >= since_s), None)


@pytest.fixture
def seat(tmp_path):
    opened = Seat(tmp_path)
    yield opened
    opened.close()


@pytest.mark.alone
def test_a_key_moves_the_wheels_soon_and_its_release_is_a_zero_command_soon(seat):
    seat.sit()
    moving_s, zero_s = [], []
    for key in "iujo,":
        pressed_s = seat.fingers.press(key)
        assert until(lambda since_s=pressed_s: seat.moved_s(since_s), 2), seat.terminal.text()
        time.sleep(0.7)
        lifted_s = seat.fingers.lift()
        assert until(lambda since_s=lifted_s: seat.overheard.first_zero_s(since_s), 2)
        moving_s.append(seat.moved_s(pressed_s) - pressed_s)
        zero_s.append(seat.overheard.first_zero_s(lifted_s) - lifted_s)
        assert until(lambda: seat.robot.speed() == 0, 2)
        time.sleep(0.4)
    print(f"\nkey to moving wheel, ms: {[round(s * 1e3) for s in moving_s]}; "
          f"release to zero command, ms: {[round(s * 1e3) for s in zero_s]}")  # fmt: skip
    assert statistics.median(moving_s) <= MOVING_S
    assert statistics.median(zero_s) <= ZERO_S


@pytest.mark.slow
@pytest.mark.parametrize("how", ["the terminal is closed", "SIGHUP", "SIGTERM", "Ctrl-C", "Ctrl-D"])
def test_however_it_ends_zero_is_commanded_soon_and_the_robot_is_let_go(seat, how):
    seat.sit()
    seat.fingers.press("i")
    time.sleep(0.8)
    seat.fingers.lift()
    ended_s = time.monotonic()
    if how == "the terminal is closed":
        os.close(seat.terminal.master)
        seat.terminal.master = os.open(os.devnull, os.O_RDWR)
    elif how.startswith("SIG"):
        seat.terminal.process.send_signal(getattr(signal, how))
    else:
        seat.terminal.types({"Ctrl-C": "\x03", "Ctrl-D": "\x04"}[how])
    assert seat.terminal.process.wait(5) == 0, seat.terminal.text()
    heard = until(lambda: seat.overheard.first_zero_s(ended_s), 2)  # who listens may run later than who has ended
    assert heard, (ended_s, seat.overheard.commands[-9:], seat.terminal.text(), seat.robot.output())
    zero_s = seat.overheard.first_zero_s(ended_s)
    print(f"\n{how}: zero command after {(zero_s - ended_s) * 1e3:.0f} ms")
    assert zero_s - ended_s <= ZERO_S
    assert until(lambda: seat.robot.speed() == 0, 2)
    assert until(lambda: "let go" in seat.robot.output(), 2), "at once, not when its lease is over"


@pytest.mark.slow
def test_a_person_killed_at_the_keyboard_stops_the_robot(seat):
    seat.sit()
    seat.fingers.press("i")
    assert until(lambda: seat.robot.speed() > 4, 2)
    seat.terminal.process.kill()
    since_s = time.monotonic()
    assert until(lambda: seat.robot.speed() == 0, 2)
    assert time.monotonic() - since_s <= 0.8
    seat.fingers.lift()
    assert until(lambda: "the operator who drove was lost" in seat.robot.output(), 3)


@pytest.mark.slow
def test_vision_and_a_person_hand_over_to_one_another(seat):
    seat.sit()
    with Vision(seat.robot.endpoint, twist=b"0.1000|0.0000") as vision:
        seat.terminal.types("a")
        assert until(lambda: vision.status().state is State.ACTIVE and vision.status().holder.source == "vision", 6)
        assert seat.terminal.shows("vision drives"), seat.terminal.text()
        seat.fingers.press("j")
        assert until(lambda: vision.status().holder.source == "teleop", 2)
        seat.fingers.lift()
        assert until(lambda: vision.status().applied == (0.0, 0.0), 2)
        assert seat.terminal.shows("you drive")
        seat.terminal.types("\x03")
        assert seat.terminal.process.wait(5) == 0
        assert until(lambda: vision.status().state is State.DISARMED, 3), "never back to autonomy by itself"


@pytest.mark.slow
def test_over_websocket_it_drives_and_stops_too(tmp_path):
    endpoint = free_endpoint("ws://")
    with RobotProcess(tmp_path, endpoint=endpoint, safety={"auto_arm": False}) as robot:
        robot.wait_until_on("on ws://")
        terminal = Terminal("teleop", "r1", "--connect", endpoint)
        try:
            assert terminal.shows("DISARMED"), terminal.text()
            fingers = Fingers(terminal)
            fingers.press("i")
            assert until(lambda: robot.speed() > 4, 5), terminal.text()
            fingers.lift()
            assert until(lambda: robot.speed() == 0, 2)
            terminal.types("\x03")
            assert terminal.process.wait(5) == 0
            assert until(lambda: "let go" in robot.output(), 2)
        finally:
            terminal.close()


@pytest.mark.slow
def test_the_terminal_is_as_it_was_and_shows_the_robot(seat):
    seat.sit()
    assert seat.terminal.shows("you drive") and seat.terminal.shows("ACTIVE: driving")
    assert "hold a key to drive" in seat.terminal.text()
    seat.terminal.types("\x03")
    assert seat.terminal.process.wait(5) == 0
    assert "Traceback" not in seat.terminal.text()


def test_without_a_terminal_it_is_one_line(capsys):
    assert cli.run(["teleop", "r1", "--connect", "tcp/127.0.0.1:1"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == (
        "error: teleop reads keys from a terminal and there is none; over ssh use `ssh -t`\n"
    )


@pytest.mark.parametrize(("arguments", "code", "says"), [
    (("teleop", "r1", "--connect", "tcp/127.0.0.1:1"), 4, "nobody answers at tcp/127.0.0.1:1"),
    (("teleop", "a/b"), 2, "'a/b'"), (("teleop", "--linear", "9"), 2, "--linear"),
    (("teleop", "--gamepad", "/dev/null"), (2, 3), "gamepad"),
])  # fmt: skip
def test_in_a_terminal_a_mistake_is_one_line_too(arguments, code, says):
    terminal = Terminal(*arguments)
    try:
        exit_code = terminal.process.wait(20)
        assert exit_code in (code if isinstance(code, tuple) else (code,))
        assert terminal.text().count("\n") == 1 and says in terminal.text()
    finally:
        terminal.close()
