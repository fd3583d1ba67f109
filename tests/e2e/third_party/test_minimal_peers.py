"""Peers that do not import Sightline, each in a process of its own, against ours: they drive, and stop when alone."""

import re
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from sightline.operator_side.client.requests import Operator
from sightline.protocol.clock import monotonic_us
from sightline.protocol.messages import State
from sightline.protocol.transports.open import open_link
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_port
from tests.fixtures.robot_process import RobotProcess, stop_after

pytestmark = pytest.mark.waits

ROOT = Path(__file__).parent.parent.parent.parent
PICTURES = str(ROOT / "examples/pictures")
PAGE = (ROOT / "docs/tutorials/implement-a-peer.md").read_text("utf-8")
SCHEMES = {"ws": "ws://127.0.0.1:{}", "zenoh": "tcp/127.0.0.1:{}"}
STILL = (0.0, 0.0)


def program_of_the_page():
    """The page's blocks of code, one after the other."""
    return "\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))


class Process:
    """A program that prints lines; ended at the end."""

    def __init__(self, *command: str) -> None:
        self.lines: list[str] = []
        self.times_s: list[float] = []
        self._process = subprocess.Popen(
            [sys.executable, *command], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._process.stdout:
            self.times_s.append(time.monotonic())
            self.lines.append(line.strip())

    def wheels(self) -> tuple[float, float] | None:
        """Return the last motion of the wheels that the program printed, or None."""
        last = next((line for line in reversed(self.lines) if line.startswith("wheels ")), None)
        return last and tuple(map(float, last.split()[1:]))

    def moved_s(self) -> float:
        """Return when the program printed the last motion of the wheels."""
        return [at_s for at_s, line in zip(self.times_s, self.lines, strict=False) if line.startswith("wheels ")][-1]

    def end(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._reader.join()
        self._process.stdout.close()

    def __enter__(self) -> "Process":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


def vision(endpoint: str) -> Process:
    """Start `sightline vision` as an operator does."""
    return Process("-P", "-m", "sightline.operator_side.cli.app", "vision", "--connect", endpoint)


def check_driven(robot: Process, endpoint: str) -> None:
    """Our vision drives `robot`, which stands still soon after vision is killed."""
    with vision(endpoint) as eyes:
        assert until(lambda: robot.wheels() not in (None, STILL), START_S), (robot.lines[-5:], eyes.lines)
        assert any("frames from robot r1" in line for line in eyes.lines)
        linear, angular = robot.wheels()
        assert abs(linear) <= 0.3 and abs(angular) <= 1.5
        eyes.end()
        ended_s = time.monotonic()
        assert until(lambda: robot.wheels() == STILL, 3)
        assert robot.moved_s() - ended_s <= 0.7, "0.7 s after its driver was killed it still moves"


def test_vision_drives_the_robot_of_the_page(tmp_path):
    code = program_of_the_page()
    assert sum(bool(line.strip()) for line in code.splitlines()) < 70 and "sightline.v1" in code
    (tmp_path / "robot.py").write_text(code, "utf-8")
    port = str(free_port())
    with Process(str(tmp_path / "robot.py"), port, PICTURES) as robot:
        assert until(lambda: robot.wheels() == STILL, START_S), robot.lines
        check_driven(robot, f"ws://127.0.0.1:{port}")


@pytest.mark.parametrize("kind", SCHEMES)
def test_vision_drives_and_operator_stops_the_minimal_robot(kind):
    port = str(free_port())
    endpoint = SCHEMES[kind].format(port)
    with Process("examples/minimal_robot.py", kind, port, PICTURES) as robot:
        check_driven(robot, endpoint)
        with open_link("r1", connect=[endpoint], role="operator", timeout_s=10) as link:
            assert Operator(link).stop(lambda: None).state is State.STOPPED
        with vision(endpoint) as eyes:
            assert until(lambda: any("target seen" in line for line in eyes.lines), START_S), eyes.lines
            assert robot.wheels() == STILL, "STOP is a latch"


JUNK = {"deep": "[" * 2_000, "list": "[]", "empty": "{}", "twist": "0.1|0", "bytes": b"\x00\x00"}


@pytest.mark.parametrize("junk", JUNK.values(), ids=JUNK)
def test_junk_does_not_block_clients_of_the_minimal_robot(junk):
    port = str(free_port())
    url = SCHEMES["ws"].format(port)
    with Process("examples/minimal_robot.py", "ws", port, PICTURES) as robot:
        assert until(lambda: answers(url), START_S), robot.lines
        assert until(lambda: _accepts(url, junk), 5), robot.lines
        assert until(lambda: answers(url), 5), robot.lines


def _accepts(url: str, message: str | bytes) -> bool:
    """Return whether the robot read the message; not while it still serves the client before."""
    with connect(url, subprotocols=["sightline.v1"], compression=None) as connection:
        try:
            connection.send(message)
            connection.recv(5)
        except ConnectionClosed as closed:
            return "one client at a time" not in str(closed)
        return True


def answers(url: str) -> bool:
    """Return whether the robot answers a valid hello."""
    with suppress(OSError, ConnectionClosed, TimeoutError), connect(url, subprotocols=["sightline.v1"]) as connection:
        connection.send('{"robot": "r1", "session": "0000beef"}')
        return "r1" in str(connection.recv(2))
    return False


@pytest.mark.parametrize("kind", SCHEMES)
def test_the_minimal_vision_drives_our_robot(tmp_path, kind):
    endpoint = SCHEMES[kind].format(free_port())
    with RobotProcess(tmp_path, endpoint=endpoint) as robot:
        robot.wait_until_on(f"robot r1: on {endpoint}")
        with Process("examples/minimal_vision.py", endpoint) as eyes:
            assert until(lambda: robot.speed() > 0.3, START_S), (robot.output(), eyes.lines)
        ended_us = monotonic_us()
        assert until(lambda: robot.speed() == 0.0, 3)
        assert stop_after(robot.motor_rows(), ended_us)[0] <= 0.7


@pytest.mark.parametrize("name", ["minimal_robot", "minimal_vision"])
def test_minimal_peers_do_not_import_sightline(name):
    text = (ROOT / f"examples/{name}.py").read_text("utf-8")
    for code in (text, program_of_the_page()):
        assert not re.search(r"^\s*(from|import) (protocol|\w+_side|sim)\b", code, re.MULTILINE)
