"""The robot service as real processes, validated from its motors' own log."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from sightline.operator_side.client.stop import stop_robot
from sightline.protocol.clock import monotonic_us
from sightline.protocol.messages import LeaseHolder, State
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import port_of
from tests.fixtures.robot_process import RobotProcess, Vision, driving, stop_after

pytestmark = pytest.mark.waits

BOUND_S, BOUND_M = 0.7, 0.25
# Ctrl-C, Ctrl-\, Ctrl-Z, a terminal that closes, and systemd: each signals every process.
KEYS = [signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP, signal.SIGHUP, signal.SIGTERM]


def test_robot_drives_on_fresh_answers_and_stops_when_they_end(tmp_path):
    with RobotProcess(tmp_path) as robot:
        with Vision(robot.endpoint) as vision:
            assert driving(robot)
            wanted = (State.ACTIVE, LeaseHolder.of("vision", vision.session), pytest.approx(0.4))
            assert until(lambda: (got := vision.status()) and (got.state, got.holder, got.applied[0]) == wanted)
            assert until(lambda: vision.status().stream.fps >= 25)
            frames = vision.headers
        since = monotonic_us()
        assert until(lambda: robot.speed() == 0.0, 3)
        seconds, metres = stop_after(robot.motor_rows(), since)
        assert seconds <= BOUND_S and metres <= BOUND_M
        assert [header.seq for header in frames] == sorted({header.seq for header in frames})
        assert frames[-1].pose[0] > 0.05
        assert min(header.latency_us for header in frames if header.latency_us) < 100_000


@pytest.mark.waits
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_wheels_stop_when_the_network_process_dies_or_hangs(tmp_path, number):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint):
        assert driving(robot)
        since = monotonic_us()
        robot.kill_network(number)
        assert until(lambda: any(t >= since and left == right == 0.0 for t, left, right in robot.motor_rows()), 3)
        seconds, metres = stop_after(robot.motor_rows(), since)
        assert seconds <= BOUND_S and metres <= BOUND_M
        assert driving(robot), "it is started again, and the robot drives without help"


@pytest.mark.parametrize("number", KEYS)
def test_a_key_at_the_terminal_does_not_reach_the_network_process(tmp_path, number):
    """The terminal signals every process of the group; the driver process ends its child, after wheels at zero."""
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint):
        assert driving(robot)
        network, since = robot.network_pid(), monotonic_us()
        robot.kill_network(number)
        assert until(lambda: robot.motor_rows()[-1][0] >= since + 800_000), "the driver goes on"
        assert robot.network_pid() == network
        assert Path(f"/proc/{network}/stat").read_text().rpartition(")")[2].split()[0] != "T"
        assert driving(robot)


@pytest.mark.parametrize("number", [signal.SIGTTIN, signal.SIGTTOU])
def test_background_robot_is_not_stopped_by_its_terminal(tmp_path, number):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint) as vision:
        assert driving(robot)
        for pid in (robot.process.pid, robot.driver_pid(), robot.network_pid()):
            os.kill(pid, number)
        since = monotonic_us() + 200_000
        assert until(lambda: any(t >= since and left >= 10.0 for t, left, _ in robot.motor_rows()))
        assert until(lambda: vision.status().state is State.ACTIVE)


@pytest.mark.parametrize(("number", "is_for_all"), [
    (signal.SIGTERM, False), (signal.SIGHUP, False), *((key, True) for key in KEYS),
])
def test_shutdown_follows_zero_and_leaves_no_process(tmp_path, number, is_for_all):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint):
        assert driving(robot)
        driver, network, since = robot.driver_pid(), robot.network_pid(), monotonic_us()
        for pid in (robot.process.pid, driver, network) if is_for_all else (robot.process.pid,):
            os.kill(pid, number)
        assert robot.process.wait(3) == 0
        assert robot.speed() == 0.0
        seconds, metres = stop_after(robot.motor_rows(), since)
        assert seconds <= BOUND_S and metres <= BOUND_M
        assert "network process ended" not in robot.output(), "the driver ends it, after wheels at zero"
        for pid in (driver, network):
            with pytest.raises(ProcessLookupError):
                os.kill(pid, 0)
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port_of(robot.endpoint)))


def test_the_stop_latch_survives_a_restart(tmp_path):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint):
        assert driving(robot)
        assert stop_robot("r1", [robot.endpoint], "", "", lambda: None)
    since_us = monotonic_us()
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint) as vision:
        assert until(lambda: vision.status().refused.get("STOPPED", 0) > 5)
        assert vision.status().state is State.STOPPED
        assert not any(left or right for t_us, left, right in robot.motor_rows() if t_us > since_us)


def test_rejected_twists_have_a_reason_and_move_nothing(tmp_path):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint, twist=b"nan|0") as vision:
        assert until(lambda: vision.status().refused.get("NOT_FINITE", 0) > 5)
        status = vision.status()
        assert status.last_refusal.reason == "NOT_FINITE" and status.last_refusal.source == "vision"
        assert status.state is State.DISARMED and robot.speed() == 0.0


def test_a_port_in_use_names_its_owner(tmp_path):
    with RobotProcess(tmp_path) as first:
        first.wait_until_on("on tcp/")
        (tmp_path / "second").mkdir()
        with RobotProcess(tmp_path / "second", endpoint=first.endpoint) as second:
            assert second.process.wait(START_S) == 4
            (line,) = second.output().splitlines()
            assert line.startswith(f"error: cannot listen on {first.endpoint}: port ")
            assert str(first.network_pid()) in line


@pytest.mark.parametrize(
    ("change", "code", "says"),
    [
        ({"camera": {"kind": "folder", "options": {"path": "/nowhere"}}}, 3, "no .jpg images in /nowhere"),
        ({"camera": {"kind": "webcam"}}, 2, "no camera called 'webcam'"),
        ({"camera": {"kind": "folders"}}, 2, "did you mean 'folder'?"),
        ({"drive": {"kind": "log", "options": {"pth": "x"}}}, 2, "pth"),
        ({"drive": {"kind": "sim", "options": {"socket_dir": "/nowhere"}}}, 3, "sightline sim"),
        ({"listen": ["tcp:7447"]}, 2, "tcp:7447"),
        ({"state_dir": "/proc/nowhere"}, 2, "state_dir"),
        ({"drive": {"kind": "json:Nothing"}}, 2, "Nothing"),
    ],
)
def test_bad_input_is_one_line_and_the_right_exit_code(tmp_path, change, code, says):
    with RobotProcess(tmp_path, **change) as robot:
        assert robot.process.wait(START_S) == code
        output = robot.output()
        assert says in output and "Traceback" not in output
        assert len([line for line in output.splitlines() if line.startswith("error:")]) == 1


def test_driving_needs_no_heavy_package(tmp_path):
    """The modules that the driver and network processes import, watched in a real interpreter."""
    code = (
        "import sightline.robot_side.driver.process, sightline.robot_side.network.process, sightline.sim.bus; "
        "import json, sys; print(json.dumps(sorted(sys.modules)))"
    )
    loaded = json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert not {"numpy", "cv2", "pybullet", "simplejpeg", "typer", "rich"} & set(loaded)
