"""A real guardian and its driver processes, on a log drive that one process at a time can own."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from sightline.evaluation.processes import is_running
from sightline.operator_side.client.requests import Operator
from sightline.operator_side.client.stop import stop_robot
from sightline.protocol.clock import heartbeat_us
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import Verb
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.process import _SHUTDOWN_US
from sightline.robot_side.driver.supervision import schedule_real_time
from sightline.robot_side.guardian.process import hurry
from sightline.robot_side.guardian.start import zero_of
from tests.fixtures.dying import LATE, DriveFault
from tests.fixtures.links import START_S, until
from tests.fixtures.robot_process import RobotProcess, Vision, driving, stop_after

pytestmark = pytest.mark.waits

MEMORY_KB = 15_000
GUARDIAN_OF_A_DEAD_DRIVER = """
import os, signal, socket
from sightline.robot_side.guardian import process

def fail(part):
    if part == "{}":
        raise {}("broken")

prepare, zero = lambda: fail("prepare"), lambda config: fail("zero")
driver = os.fork()
if not driver:
    signal.pause()
os.kill(driver, signal.SIGKILL)
near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
drive = dict(module="__main__", name="zero", config=dict())
process.main(dict(zero=drive, path=[], robot="r1", driver=None, pid=driver, beats=near.detach(), receiver=None))
"""
BOUND_S, BOUND_M = 0.7, 0.25


def rss_kb(pid: int) -> int:
    """Return the resident memory of a process, kB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))


def arm(endpoint: str) -> None:
    """Arm the robot as soon as it has a driver to arm."""
    with open_zenoh("r1", connect=[endpoint], role="operator", timeout_s=START_S) as link:
        operator = Operator(link)
        assert until(lambda: operator.request(Verb.ARM).ok, START_S)


@pytest.fixture
def dying(tmp_path, monkeypatch):
    """Start a robot whose drive has a fault, and wait for it; return the robot and the fault."""
    with ExitStack() as ending:

        def start(name, kind="DyingLogDrive", on_one_processor=False, **changes):
            fault = DriveFault(monkeypatch, tmp_path, name)
            drive = {"kind": f"tests.fixtures.dying:{kind}", "options": {"path": str(tmp_path / "drive.csv")}}
            robot = RobotProcess(tmp_path, drive=drive, **changes)
            robot._entry = ["taskset", "-c", str(min(os.sched_getaffinity(0)))] if on_one_processor else robot._entry
            ending.enter_context(robot)
            vision = ending.enter_context(Vision(robot.endpoint))
            return robot, vision, fault

        yield start


def check_stop(robot, fault):
    stop_s, stop_m = stop_after(robot.motor_rows(), fault.t_us)
    assert stop_s <= BOUND_S and stop_m <= BOUND_M


@pytest.mark.parametrize("name", ["SIGKILL", "SIGSTOP", "SIGSEGV", "exit 0", "exit 1", "refuses"])
def test_dead_or_stopped_driver_leaves_the_wheels_at_zero_and_a_new_one_starts(dying, name):
    robot, vision, fault = dying(name, safety={"auto_arm": False})
    robot.wait_until_on()
    driver = robot.driver_pid()
    arm(robot.endpoint)
    robot.wait_until_on("a new driver process starts")
    check_stop(robot, fault)
    assert until(lambda: robot.output().count("robot r1: on") == 2, START_S), robot.output()
    assert vision.status().state == "DISARMED"
    assert robot.driver_pid() != driver
    assert robot.speed() == 0.0


@pytest.mark.parametrize("name", ["SIGSTOP", "loop"])
def test_one_processor_is_enough_to_stop_the_wheels_of_a_hung_driver(dying, name):
    """With real-time priority the guardian reaped it forever: a thread of the dead process needed the processor."""
    robot, _, fault = dying(name, on_one_processor=True)
    assert until(fault.has_come, START_S)
    assert until(lambda: robot.speed() == 0.0, 3), robot.output()
    robot.wait_until_on("a new driver process starts")


@pytest.mark.parametrize(("how", "why"), [
    ("exit", "SystemExit: 0"), ("raise", "OSError: no device"), ("hang", "TimeoutError: zero() does not return"),
])
def test_zero_that_fails_is_reported_and_the_next_driver_stops_the_wheels(dying, how, why):
    robot, _, fault = dying("SIGKILL", kind="StubbornLogDrive", safety={"auto_arm": False})
    fault.zero_fails(how)
    robot.wait_until_on()
    arm(robot.endpoint)
    robot.wait_until_on(f"motors NOT set to zero: {why}")
    robot.wait_until_on("a new driver process starts")
    assert until(lambda: robot.speed() == 0.0, START_S), "its first tick"
    fault.zero_fails("")
    robot.process.terminate()
    assert robot.process.wait(START_S) == 0 and robot.output().count("NOT set to zero") == 1


@pytest.mark.parametrize("error", ["SystemExit", "KeyboardInterrupt", "GeneratorExit", "OSError"])
@pytest.mark.parametrize(("part", "line", "code"), [
    ("prepare", "the guardian does not start: {}: broken", 1),
    ("zero", "motors NOT set to zero: {}: broken; switch off their supply", 3),
])
def test_whatever_a_drive_raises_in_the_guardian_is_one_line_and_no_success(part, line, code, error):
    command = [sys.executable, "-c", GUARDIAN_OF_A_DEAD_DRIVER.format(part, error)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=START_S, check=False)
    assert line.format(error) in done.stderr and done.returncode == code
    assert "motors are set to zero" not in done.stdout


def test_robot_whose_drive_is_gone_shows_why_and_drives_again_when_it_is_back(dying):
    robot, vision, fault = dying("gone", safety={"auto_arm": False})
    robot.wait_until_on()
    arm(robot.endpoint)
    robot.wait_until_on("a new driver process starts")
    check_stop(robot, fault)
    assert until(lambda: vision.status().state == "FAULT", START_S), robot.output()
    assert "DyingLogDrive' raised OSError: unplugged" in vision.status().reason
    fault.end()
    with open_zenoh("r1", connect=[robot.endpoint], role="operator", timeout_s=START_S) as link:
        operator = Operator(link)
        assert until(lambda: operator.request(Verb.RESET).ok and vision.status().state == "DISARMED", START_S)
    arm(robot.endpoint)
    assert driving(robot)
    assert robot.process.poll() is None


def test_drive_that_takes_no_speeds_while_the_robot_ends_is_set_to_zero_by_the_guardian(dying):
    robot, _, fault = dying("refuses")
    assert until(fault.has_come, START_S)
    robot.process.terminate()
    assert robot.process.wait(START_S) == 3, robot.output()
    assert robot.motor_rows()[-1][1:] == (0.0, 0.0) and "a new driver process starts" not in robot.output()
    assert "the guardian is gone" not in robot.output()


def test_endless_loop_in_the_driver_is_ended_and_the_new_one_waits_for_an_operator(dying):
    robot, vision, fault = dying("loop")
    robot.wait_until_on("a new driver process starts")
    check_stop(robot, fault)
    assert until(lambda: vision.status().refused.get("DISARMED", 0) >= 10, START_S), "five arm a robot by itself"
    assert (vision.status().state, vision.status().auto_arm) == ("DISARMED", False)
    arm(robot.endpoint)
    assert driving(robot)


def test_driver_ramps_to_zero_and_ends_without_its_guardian(dying):
    robot, _, fault = dying("guardian")
    robot.wait_until_on()
    driver = robot.driver_pid()
    network = robot.network_pid()
    assert until(fault.has_come, START_S)
    assert until(lambda: not is_running(driver) and not is_running(network), START_S)
    check_stop(robot, fault)
    assert any(0 < left < 10 for t_us, left, _ in robot.motor_rows() if t_us > fault.t_us), "a ramp, not a jump"


@pytest.mark.alone
def test_robot_with_a_stopped_guardian_still_stops_by_silence_and_by_stop(tmp_path):
    with RobotProcess(tmp_path) as robot:
        with Vision(robot.endpoint):
            assert driving(robot)
            os.kill(robot.process.pid, signal.SIGSTOP)
            since_us = heartbeat_us()
            assert until(lambda: robot.motor_rows()[-1][0] > since_us + 500_000 and robot.speed() > 0.0), (
                "the gate still checks each command")
        since_us = heartbeat_us()
        assert until(lambda: robot.speed() == 0.0, 3)
        seconds, metres = stop_after(robot.motor_rows(), since_us)
        assert seconds <= BOUND_S and metres <= BOUND_M
        assert stop_robot("r1", [robot.endpoint], "", "", lambda: None), "and it is on disk"


def test_nothing_moves_before_the_guardian_watches(tmp_path, monkeypatch):
    """Its `zero` may need a library that takes seconds to import."""
    monkeypatch.setenv(LATE, str(tmp_path / "ready"))
    with RobotProcess(tmp_path, drive={"kind": "tests.fixtures.dying:LateLogDrive",
                                       "options": {"path": str(tmp_path / "drive.csv")}}) as robot:
        with Vision(robot.endpoint):
            assert driving(robot)
        ready_us = int((tmp_path / "ready").read_text())
        assert min(t_us for t_us, left, _ in robot.motor_rows() if left) > ready_us


def test_guardian_is_small_and_the_driver_dumps_no_core(tmp_path):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        assert resource.prlimit(robot.driver_pid(), resource.RLIMIT_CORE)[0] <= 1
        assert rss_kb(robot.process.pid) <= MEMORY_KB
        maps = Path(f"/proc/{robot.process.pid}/maps").read_text()
        assert "pydantic" not in maps and "zenoh" not in maps


def test_killed_receiver_is_logged_with_its_signal(tmp_path):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        os.kill(robot.receiver_pid(), signal.SIGKILL)
        robot.wait_until_on("STOP receiver ended (-9); starting it again")


def test_sixth_death_within_a_minute_ends_the_robot(tmp_path):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        for count in range(6):
            assert until(lambda n=count: robot.output().count("a new driver process starts") == n, START_S)
            os.kill(robot.driver_pid(), signal.SIGKILL)
        assert robot.process.wait(START_S) == 3
        assert "5 restarts within 60 s; the motors are at zero" in robot.output()
        assert robot.motor_rows()[-1][1:] == (0.0, 0.0)


def test_drive_that_still_fails_at_the_end_is_set_to_zero_by_the_guardian(tmp_path):
    kind = "tests.fixtures.dying:FailingLogDrive"
    with RobotProcess(tmp_path, drive={"kind": kind, "options": {"path": str(tmp_path / "drive.csv")}}) as robot:
        robot.wait_until_on()
        assert not robot.motor_rows()
        terminated_us = heartbeat_us()
        robot.process.terminate()
        assert robot.process.wait(START_S) == 3
        assert "the motors are set to zero" in robot.output()
        assert "a new driver process starts" not in robot.output()
        assert [row[1:] for row in robot.motor_rows()] == [(0.0, 0.0)]
        assert robot.motor_rows()[0][0] - terminated_us <= _SHUTDOWN_US + BOUND_S * 1e6, "not after the devices"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_end_before_the_first_heartbeat_is_quick_and_quiet(tmp_path, number):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        os.kill(robot.driver_pid(), signal.SIGKILL)
        robot.wait_until_on("a new driver process starts")
        robot.process.send_signal(number)
        assert robot.process.wait(3) == 128 + number
        assert "Traceback" not in robot.output()


LEAVING = """
import os
from pathlib import Path
from sightline.robot_side.hardware.log_drive import LogDrive
class LeavingDrive(LogDrive):
    def __init__(self, config):
        if (code := Path(config.path).with_suffix(".code")).exists():
            os._exit(int(code.read_text()))
        super().__init__(config)
"""


@pytest.mark.parametrize(("at_restart", "code"), [(False, 0), (True, 0), (True, 3)])
def test_plugin_that_ends_a_driver_process_during_its_start_is_one_line(tmp_path, monkeypatch, at_restart, code):
    (tmp_path / "leaving.py").write_text(LEAVING)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    options = {"path": str(tmp_path / "drive.csv")}
    if not at_restart:
        (tmp_path / "drive.code").write_text(str(code))
    with RobotProcess(tmp_path, drive={"kind": "leaving:LeavingDrive", "options": options}) as robot:
        if at_restart:
            robot.wait_until_on()
            (tmp_path / "drive.code").write_text(str(code))
            os.kill(robot.driver_pid(), signal.SIGKILL)
        assert robot.process.wait(START_S) == code
        assert f"the driver process ended before its first tick (code {code}), so" in robot.output().splitlines()[-1]


def test_drive_without_zero_is_one_line_at_start(tmp_path):
    kind = "tests.fixtures.dying:ZerolessDrive"
    with RobotProcess(tmp_path, drive={"kind": kind}) as robot:
        assert robot.process.wait(START_S) == 2
        assert robot.output().splitlines() == [
            f"error: drive '{kind}' has no static method zero(config), which stops the wheels after its process has "
            "died; add it as in docs/how-to/add-a-device.md"
        ]


@pytest.mark.parametrize(("kind", "options", "expected"), [
    ("log", {"path": "/tmp/x"}, ("sightline.robot_side.hardware.log_zero", "zero", {"path": "/tmp/x"})),
    ("sim", {"socket_dir": "/tmp/s"}, ("sightline.sim.zero", "zero", {"socket_dir": "/tmp/s"})),
])  # fmt: skip
def test_zero_of_a_drive_is_named_by_its_own_module(kind, options, expected):
    zero, config = zero_of(RobotConfig(drive=PluginChoice(kind=kind, options=options)))
    assert (zero.__module__, zero.__qualname__, config) == expected


def test_zero_of_an_unknown_drive_is_a_configuration_error():
    with pytest.raises(ConfigError, match="no drive called 'lgo'"):
        zero_of(RobotConfig(drive=PluginChoice(kind="lgo")))


def test_late_driver_gets_its_priority_for_all_threads():
    """A killed process ends with its last thread, which beside busy processes would wait for a processor."""
    code = "import threading, time; threading.Thread(target=time.sleep, args=(9,)).start(); print(1, flush=True)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        hurry(process.pid)
        threads = [int(path.name) for path in Path(f"/proc/{process.pid}/task").iterdir()]
        permitted = schedule_real_time(1, threads[0])
        assert len(threads) == 2
        assert [bool(os.sched_getscheduler(thread) & os.SCHED_FIFO) for thread in threads] == [permitted] * 2
        process.kill()


@pytest.mark.parametrize("seconds", [
    pytest.param(20, marks=[pytest.mark.slow, pytest.mark.alone]),
    pytest.param(600, marks=[pytest.mark.long, pytest.mark.alone]),
])  # fmt: skip
def test_busy_processes_without_real_time_cost_no_healthy_driver(tmp_path, seconds):
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(8)]
    try:
        with RobotProcess(tmp_path, real_time=False) as robot, Vision(robot.endpoint):
            assert driving(robot)
            driver = robot.driver_pid()
            assert os.sched_getscheduler(driver) == os.sched_getscheduler(robot.process.pid) == os.SCHED_OTHER
            time.sleep(seconds)
            assert robot.driver_pid() == driver, robot.output()
            assert "driver process" not in robot.output()
    finally:
        for process in busy:
            process.kill()
            process.wait()


def test_shipped_zero_needs_no_pydantic():
    modules = ["sightline.robot_side.hardware.log_zero", "sightline.sim.zero", "sightline.robot_side.guardian.process"]
    code = f"import sys, {', '.join(modules)}; print([m for m in ('pydantic', 'typer', 'zenoh') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []


def test_a_robot_without_hardware_ends_with_one_line_and_its_exit_code(tmp_path):
    command = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app", "robot", "--socket-dir", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    expected = f"nothing simulates a robot in {tmp_path}; start it with `sightline sim`\n"
    assert done.returncode == 3 and done.stdout.endswith(f" info waiting for `sightline sim` in {tmp_path} ...\n")
    assert done.stdout.count("\n") == 1
    assert done.stderr.endswith(expected) and done.stderr.count("\n") == 1
