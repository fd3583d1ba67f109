"""`sightline teleop` in a real pseudo-terminal, with a real robot over real Zenoh and fingers that repeat a key."""

import itertools
import os
import pty
import signal
import statistics
import threading
import time
from contextlib import ExitStack, closing, contextmanager

import pytest

from sightline.operator_side.cli import app as cli
from sightline.operator_side.client.stop import StopSender
from sightline.operator_side.teleop import terminal
from sightline.operator_side.teleop.control import Speeds, Teleop
from sightline.operator_side.teleop.terminal import Cockpit
from sightline.protocol.channels import REQUEST
from sightline.protocol.codec import decode
from sightline.protocol.errors import LinkError
from sightline.protocol.messages import Request, State, Verb
from sightline.protocol.transports.memory import MemoryNetwork
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
        """Return the time of the press, monotonic seconds."""
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
        """Return the latest time of the last repeat, monotonic seconds."""
        self._lifted.set()
        self._thread.join()
        return time.monotonic()


class Recorder:
    """Records every twist that teleop sends, as it passes the robot's router."""

    def __init__(self, endpoint):
        self._session = open_session((), [endpoint], 10.0)
        self.commands = []
        self._subscriber = self._session.declare_subscriber("sightline/r1/twist/teleop", self._store)

    def _store(self, sample):
        self.commands.append((time.monotonic(), bytes(sample.payload)))

    def first_zero_s(self, since_s):
        """Return the time of the first zero that only zeros follow; None without one."""
        moving = [at_s for at_s, text in self.commands if text != b"0.0000|0.0000"]
        last_s = max(moving, default=0.0)
        return next((at_s for at_s, _ in self.commands if at_s > max(last_s, since_s - REPEAT_S)), None)

    def close(self):
        self._session.close()


class Seat:
    """A robot, an operator's terminal, and a recorder."""

    def __init__(self, folder, ending):
        """`ending` closes what is open, also where a later part does not open."""
        self.robot = ending.enter_context(RobotProcess(folder, safety={"auto_arm": False}))
        self.robot.wait_until_on("on tcp/")
        self.recorder = ending.enter_context(closing(Recorder(self.robot.endpoint)))
        self.terminal = ending.enter_context(closing(Terminal("teleop", "r1", "--connect", self.robot.endpoint)))
        self.fingers = Fingers(self.terminal)

    def sit(self):
        """Drive a little, so that the robot is armed and the terminal's repeats are learned."""
        assert self.terminal.shows("DISARMED"), self.terminal.text()
        self.fingers.press("w")
        assert until(lambda: self.robot.speed() > 4, 5), self.terminal.text()
        time.sleep(0.3)
        self.fingers.lift()
        assert until(lambda: self.robot.speed() == 0, 2)
        time.sleep(0.4)
        return self

    def moved_s(self, since_s):
        """Return the time of the first motor command."""
        rows = [t_us / 1e6 for t_us, left, right in self.robot.motor_rows() if left or right]
        return next((at_s for at_s in rows if at_s >= since_s), None)

    def falls_s(self):
        """Return the time of the first motor command after which the wheels only slow down, to zero."""
        rows = [(t_us / 1e6, max(abs(left), abs(right))) for t_us, left, right in self.robot.motor_rows()]
        faster = [at for at in range(1, len(rows)) if rows[at][1] >= rows[at - 1][1] and rows[at][1] > 0]
        return rows[faster[-1] + 1][0]


@pytest.fixture
def seat(tmp_path):
    with ExitStack() as ending:
        yield Seat(tmp_path, ending)


@pytest.mark.alone
def test_a_key_moves_the_wheels_soon_and_its_release_is_a_zero_command_soon(seat):
    seat.sit()
    moving_s, zero_s = [], []
    for key in ("w", "a", "d", "s", "\x1b[A"):
        pressed_s = seat.fingers.press(key)
        assert until(lambda since_s=pressed_s: seat.moved_s(since_s), 2), seat.terminal.text()
        time.sleep(0.7)
        lifted_s = seat.fingers.lift()
        assert until(lambda since_s=lifted_s: seat.recorder.first_zero_s(since_s), 2)
        moving_s.append(seat.moved_s(pressed_s) - pressed_s)
        zero_s.append(seat.recorder.first_zero_s(lifted_s) - lifted_s)
        assert until(lambda: seat.robot.speed() == 0, 2)
        time.sleep(0.4)
    print(f"\nkey to moving wheel, ms: {[round(s * 1e3) for s in moving_s]}; "
          f"release to zero command, ms: {[round(s * 1e3) for s in zero_s]}")  # fmt: skip
    assert statistics.median(moving_s) <= MOVING_S
    assert statistics.median(zero_s) <= ZERO_S


@pytest.mark.alone
@pytest.mark.parametrize("how", ["the terminal is closed", "SIGHUP", "SIGTERM", "Ctrl-C", "Ctrl-Z", "Ctrl-D", "q"])
def test_any_end_stops_the_wheels_soon_and_releases_the_robot(seat, how):
    seat.sit()
    seat.fingers.press("w")
    time.sleep(0.8)
    seat.fingers.lift()
    ended_s = time.monotonic()
    if how == "the terminal is closed":
        os.close(seat.terminal.master)
        seat.terminal.master = os.open(os.devnull, os.O_RDWR)
    elif how.startswith("SIG"):
        seat.terminal.process.send_signal(getattr(signal, how))
    else:
        seat.terminal.types({"Ctrl-C": "\x03", "Ctrl-Z": "\x1a", "Ctrl-D": "\x04", "q": "q"}[how])
    assert seat.terminal.process.wait(5) == 0, seat.terminal.text()
    assert until(lambda: seat.robot.speed() == 0, 2)
    assert until(lambda: "released control" in seat.robot.output(), 2), "immediately, not at the end of its lease"
    fall_s = seat.falls_s() - ended_s
    print(f"\n{how}: the wheels fall after {fall_s * 1e3:.0f} ms")
    assert 0 < fall_s <= ZERO_S


@pytest.mark.slow
def test_enter_stops_the_robot_by_a_datagram_and_latches(seat):
    seat.sit()
    seat.fingers.press("w")
    assert until(lambda: seat.robot.speed() > 4, 2)
    seat.terminal.types("\n")
    assert until(lambda: "STOPPED (STOP by" in seat.robot.output(), 2), seat.robot.output()
    seat.fingers.lift()
    assert until(lambda: seat.robot.speed() == 0, 2)
    seat.fingers.press("w")
    time.sleep(0.5)
    seat.fingers.lift()
    assert seat.robot.speed() == 0, "no key starts it"


@pytest.mark.slow
def test_killed_teleop_stops_the_robot(seat):
    seat.sit()
    seat.fingers.press("w")
    assert until(lambda: seat.robot.speed() > 4, 2)
    seat.terminal.process.kill()
    since_s = time.monotonic()
    assert until(lambda: seat.robot.speed() == 0, 2)
    assert time.monotonic() - since_s <= 0.8
    seat.fingers.lift()
    assert until(lambda: "the operator who drove was lost" in seat.robot.output(), 3)


@pytest.mark.slow
def test_tab_and_keys_switch_between_vision_and_manual(seat):
    seat.sit()
    with Vision(seat.robot.endpoint, twist=b"0.1000|0.0000") as vision:
        seat.terminal.types("\t")
        assert until(lambda: vision.status().state is State.ACTIVE and vision.status().holder.source == "vision", 6)
        assert seat.terminal.shows("vision drives"), seat.terminal.text()
        seat.fingers.press("a")
        assert until(lambda: vision.status().holder.source == "teleop", 2)
        seat.fingers.lift()
        assert until(lambda: vision.status().applied == (0.0, 0.0), 2)
        assert seat.terminal.shows("you drive")
        seat.terminal.types("\x03")
        assert seat.terminal.process.wait(5) == 0
        assert until(lambda: vision.status().state is State.DISARMED, 3), "never back to autonomy by itself"


@pytest.mark.slow
def test_teleop_drives_and_stops_over_websocket(tmp_path):
    endpoint = free_endpoint("ws://")
    with RobotProcess(tmp_path, endpoint=endpoint, safety={"auto_arm": False}) as robot:
        robot.wait_until_on("on ws://")
        terminal = Terminal("teleop", "r1", "--connect", endpoint)
        try:
            assert terminal.shows("DISARMED"), terminal.text()
            fingers = Fingers(terminal)
            fingers.press("w")
            assert until(lambda: robot.speed() > 4, 5), terminal.text()
            fingers.lift()
            assert until(lambda: robot.speed() == 0, 2)
            terminal.types("\x03")
            assert terminal.process.wait(5) == 0
            assert until(lambda: "released control" in robot.output(), 2)
        finally:
            terminal.close()


@pytest.mark.slow
def test_terminal_shows_keys_and_robot(seat):
    seat.sit()
    assert seat.terminal.shows("you drive") and seat.terminal.shows("ACTIVE: driving")
    assert "hold a key to drive" in seat.terminal.text()
    seat.terminal.types("\x03")
    assert seat.terminal.process.wait(5) == 0
    assert "Traceback" not in seat.terminal.text()


@contextmanager
def pty_of(monkeypatch):
    """Yield the outer end of a pseudo-terminal that is this process's stdin and stdout."""
    master, slave = pty.openpty()
    with os.fdopen(master, "r+b", 0) as fingers, os.fdopen(slave, "r+b", 0) as screen:
        monkeypatch.setattr("sys.stdin", screen)
        monkeypatch.setattr("sys.stdout", screen)
        yield fingers


def types_at_help(fingers, keys):
    """Type `keys` as soon as the terminal shows the help, on a thread."""
    def types():
        while b"drive" not in fingers.read(4096):
            pass
        fingers.write(keys)

    threading.Thread(target=types, daemon=True).start()


def test_keys_typed_before_the_help_is_shown_do_nothing(monkeypatch):
    network, teleop = MemoryNetwork(), Teleop("0000000a", Speeds(0.2, 1.0))
    taken = []
    monkeypatch.setattr(teleop, "on_keys", lambda keys, now_us: taken.append(keys))
    with pty_of(monkeypatch) as fingers:
        fingers.write(b"w\n\n")
        types_at_help(fingers, b"\x04")
        Cockpit(network.link("r1", role="teleop"), teleop, lambda: None).run()
    assert taken == ["\x04"]


def test_terminal_without_a_name_is_written_to(monkeypatch):
    """Within a container its file may be out of reach."""
    monkeypatch.setattr(terminal.os, "ttyname", lambda _number: "/nowhere/pts")
    with pty_of(monkeypatch) as fingers:
        types_at_help(fingers, b"\x04")
        Cockpit(MemoryNetwork().link("r1", role="teleop"), Teleop("0000000a", Speeds(0.2, 1.0)), lambda: None).run()


def test_full_terminal_delays_no_key(monkeypatch):
    """Try many widths: where the last bytes end decides whether a terminal that is not read calls itself writable."""
    network, teleop = MemoryNetwork(), Teleop("0000000a", Speeds(0.2, 1.0))
    monkeypatch.setattr(terminal, "_SHOW_US", 0)
    monkeypatch.setattr(terminal, "_TICK_S", 0)
    for width in range(40, 60):
        monkeypatch.setattr(terminal.shutil, "get_terminal_size", lambda width=width: os.terminal_size((width, 24)))
        with pty_of(monkeypatch) as fingers:
            turns = itertools.count()

            def messages(_now_us, turns=turns, fingers=fingers):
                if next(turns) == 1000:
                    fingers.write(b"\x04")
                return ()

            monkeypatch.setattr(teleop, "messages", messages)
            Cockpit(network.link("r1", role="teleop"), teleop, lambda: None).run()


@pytest.mark.parametrize("secret_file", ["", "missing.secret"])
def test_quitting_without_proof_of_stop_repeats_it_and_is_an_error(monkeypatch, tmp_path, secret_file):
    """Also where no datagram can be sent, since the STOP secret was removed after the start."""
    secret_file = secret_file and str(tmp_path / secret_file)
    monkeypatch.setattr(terminal, "_PROVE_STOP_S", 0.1)
    monkeypatch.setattr(terminal, "_LEAVE_PERIOD_S", 0.005)
    network, teleop = MemoryNetwork(), Teleop("0000000a", Speeds(0.2, 1.0))
    link, robot, requests = network.link("r1", role="teleop"), network.link("r1"), []
    robot.subscribe(REQUEST, requests.append)
    with pty_of(monkeypatch) as fingers:
        types_at_help(fingers, b"\nq")
        with pytest.raises(LinkError, match="robot 'r1' did not confirm STOP; cut its power by hand"):
            Cockpit(link, teleop, lambda: StopSender("r1", ["tcp/127.0.0.1:1"], secret_file)).run()
    network.advance(1)
    assert {decode(Request, message.payload).verb for message in requests} == {Verb.STOP}
    assert len(requests) >= 3
    assert teleop.note == "STOP is not confirmed, repeating" or (secret_file and secret_file in teleop.note)


@pytest.mark.parametrize("closed", ["stdin", "stdout", ""])
def test_teleop_without_a_terminal_is_one_line(capsys, monkeypatch, closed):
    if closed:
        monkeypatch.setattr(f"sys.{closed}", None)
    assert cli.run(["teleop", "r1", "--connect", "tcp/127.0.0.1:1"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == (
        "error: teleop needs a terminal to read keys; over ssh use `ssh -t`\n"
    )


@pytest.mark.waits
@pytest.mark.parametrize(("arguments", "code", "expected"), [
    (("teleop", "r1", "--connect", "tcp/127.0.0.1:1"), 4, "no answer from tcp/127.0.0.1:1"),
    (("teleop", "a/b"), 2, "'a/b'"), (("teleop", "--linear", "9"), 2, "--linear"),
    (("teleop", "--gamepad", "/dev/null"), (2, 3), "gamepad"),
    (("teleop", "r1", "--connect", "tls/127.0.0.1:1", "--secure", "~no-user/x"), 2, "no home folder for '~no-user'"),
])  # fmt: skip
def test_mistake_in_a_terminal_is_one_line(arguments, code, expected):
    terminal = Terminal(*arguments)
    try:
        exit_code = terminal.process.wait(20)
        assert exit_code in (code if isinstance(code, tuple) else (code,))
        *before, error = terminal.text().splitlines()
        assert error.startswith("error: ") and expected in error
        assert all(line.startswith(("robot r1 at ", "connecting to tcp/127.0.0.1:1 ...")) for line in before)
        assert len({line.partition(" ")[0] for line in before}) == len(before), "each at most once"
    finally:
        terminal.close()
