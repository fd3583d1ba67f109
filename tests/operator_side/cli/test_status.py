"""`sightline status` in a terminal and in a pipe: short, in full, and live."""

import json
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest

from sightline.operator_side.cli.operate import _status_block
from sightline.protocol.channels import REPORT, STATUS
from sightline.protocol.codec import encode
from sightline.protocol.messages import DetectionsHeader, Echo, MissionReport, Stamp, State, Status, StreamStatus
from sightline.protocol.transports.open import open_link
from tests.fixtures.commands import run
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.terminal import Terminal


@pytest.fixture
def endpoint():
    """The address of a robot that publishes its status at 20 Hz."""
    with open_link("r1", listen=[address := free_endpoint()]) as robot, repeated(robot, STATUS, Status(
        state=State.STOPPED, reason="test", stream=StreamStatus(fps=30.0)
    ), 0.05):
        yield address


@contextmanager
def repeated(link, channel, payload, period_s):
    """Publish a payload again and again."""
    ending = threading.Event()

    def publish():
        seq = 0
        while not ending.wait(period_s):
            seq += 1
            stamp = Stamp(session="0000abcd", seq=seq, t_us=seq)
            echo = Echo(channel="frame", session=stamp.session, seq=seq, t_us=seq)
            of_vision = DetectionsHeader(source="vision", session="0000abcd", seq=seq, echo=echo)
            header, source = (of_vision, "vision") if channel is REPORT else (stamp, "")
            link.publish(channel, encode(header), encode(payload), source)

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    yield
    ending.set()
    thread.join()


def test_status_is_short_and_verbose_shows_every_field(capsys, endpoint):
    code, short, err = run(capsys, "status", "--connect", endpoint)
    assert (code, err) == (0, "") and len(short.splitlines()) <= 7
    assert "state     STOPPED: test\n" in short and "next      sightline reset r1\n" in short
    code, full, _ = run(capsys, "status", "--verbose", "--connect", endpoint)
    assert "network restarts" in full and len(full.splitlines()) > len(short.splitlines())


def test_status_shows_the_mission_of_a_stopped_robot_at_each_call(capsys, endpoint):
    report = MissionReport(mission="follow", phase="tracking", detector="onnx")
    with open_link("r1", connect=[endpoint], role="vision") as vision, repeated(vision, REPORT, report, 0.5):
        for _ in range(3):
            code, told, _ = run(capsys, "status", "--json", "--connect", endpoint)
            assert code == 0 and json.loads(told)["mission"]["mission"] == "follow"


@pytest.mark.parametrize("verbose", [False, True])
def test_status_shows_the_faults_of_robot_and_vision_service(verbose):
    stream = StreamStatus(camera_fault="camera sim gives no image")
    state = Status(state=State.HOLD, reason="no command", faults={"callback": 1, "drive": 2}, stream=stream)
    lines = _status_block("r1", state, MissionReport(mission="follow", phase="x", faults={"detector": 3}), verbose)
    assert "camera    camera sim gives no image" in lines
    assert "faults    drive 2, callback 1; the robot's log has the details" in lines
    assert "faults    detector 3; the log of the vision service has the tracebacks" in lines
    state = Status(state=State.HOLD, reason="")
    lines = _status_block("r1", state, MissionReport(mission="follow", phase="x"), verbose)
    assert not any(line.startswith(("faults", "camera  ")) for line in lines)


@pytest.mark.parametrize(("no_color", "colored"), [("", True), ("1", False)])
def test_watch_redraws_in_place_with_colors_unless_no_color(endpoint, monkeypatch, no_color, colored):
    monkeypatch.setenv("NO_COLOR", no_color)
    monkeypatch.setenv("TERM", "xterm")
    terminal = Terminal("status", "--watch", "--connect", endpoint)
    try:
        assert until(lambda: terminal.text().count("robot     r1") >= 3, 15), terminal.text()
        assert "\x1b[1A" in terminal.text(), "up, to draw over the last block"
        assert ("\x1b[31mSTOPPED" in terminal.text()) is colored
        terminal.types("\x03")
        assert terminal.process.wait(5) == 130
        assert until(lambda: terminal.text().endswith("\x1b[?25h"), 5), "the cursor is visible again"
    finally:
        terminal.close()


@pytest.mark.parametrize("arguments", [(), ("--json",)])
def test_watch_in_a_pipe_prints_plain_lines(endpoint, arguments):
    command = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app", "status", "--watch", *arguments]
    with subprocess.Popen([*command, "--connect", endpoint], stdout=subprocess.PIPE, text=True) as process:
        lines = [process.stdout.readline().rstrip() for _ in range(2 if arguments else 8)]
        process.terminate()
    if arguments:
        assert [json.loads(line)["state"] for line in lines] == ["STOPPED", "STOPPED"]
    else:
        assert lines.count("robot     r1") == 2 and "\x1b" not in "".join(lines)
