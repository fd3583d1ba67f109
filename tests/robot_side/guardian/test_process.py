"""A real guardian and its driver processes, on a log drive that one process at a time can own."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sightline.operator_side.client.requests import Operator
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import Verb
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.guardian.start import zero_of
from sightline.robot_side.hardware.log_drive import LogDrive
from tests.fixtures.links import START_S, until
from tests.fixtures.robot_process import RobotProcess, Vision, driving, stop_after

MEMORY_KB = 15_000
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


class LoopingDrive(LogDrive):
    """Its hundredth motion never returns; the next driver process finds the mark and does not do it again."""

    turned = 0

    def set(self, left_rad_s, right_rad_s):
        super().set(left_rad_s, right_rad_s)
        self.turned += left_rad_s > 10
        mark = Path(os.environ["LOOPED"])
        if self.turned == 20 and not mark.exists():
            mark.touch()
            while True:
                pass


class ZerolessDrive(LogDrive):
    """A plug-in that was written before `zero` existed."""

    zero = None


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGSEGV])
def test_dead_or_stopped_driver_leaves_the_wheels_at_zero_and_a_new_one_starts(tmp_path, number):
    with RobotProcess(tmp_path, safety={"auto_arm": False}) as robot, Vision(robot.endpoint) as vision:
        robot.wait_until_on()
        arm(robot.endpoint)
        assert driving(robot)
        driver, since_us = robot.driver_pid(), time.monotonic_ns() // 1000
        os.kill(driver, number)
        robot.wait_until_on("a new driver process starts")
        stop_s, stop_m = stop_after(robot.motor_rows(), since_us)
        assert stop_s <= BOUND_S and stop_m <= BOUND_M
        assert until(lambda: robot.output().count("robot r1: on") == 2, START_S), robot.output()
        assert vision.status().state == "DISARMED"
        assert robot.driver_pid() != driver
        assert robot.speed() == 0.0


def test_endless_loop_in_the_driver_is_ended(tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPED", str(tmp_path / "looped"))
    kind = f"{__name__}:LoopingDrive"
    drive = {"kind": kind, "options": {"path": str(tmp_path / "drive.csv")}}
    with RobotProcess(tmp_path, drive=drive) as robot, Vision(robot.endpoint):
        assert until((tmp_path / "looped").exists, START_S)
        since_us = time.monotonic_ns() // 1000
        robot.wait_until_on("a new driver process starts")
        assert stop_after(robot.motor_rows(), since_us)[0] <= BOUND_S


def test_driver_ramps_to_zero_and_ends_without_its_guardian(tmp_path):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint):
        assert driving(robot)
        driver, network, since_us = robot.driver_pid(), robot.network_pid(), time.monotonic_ns() // 1000
        robot.process.kill()
        robot.process.wait(5)
        gone = [Path(f"/proc/{pid}/cmdline") for pid in (driver, network)]
        assert until(lambda: not any(path.exists() and path.read_bytes() for path in gone), 5)
        stop_s, stop_m = stop_after(robot.motor_rows(), since_us)
        assert stop_s <= BOUND_S and stop_m <= BOUND_M
        assert any(0 < left < 10 for t_us, left, _ in robot.motor_rows() if t_us > since_us), "a ramp, not a jump"


def test_guardian_is_small_and_imports_no_package_of_ours_that_is_not_needed(tmp_path):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        assert rss_kb(robot.process.pid) <= MEMORY_KB
        maps = Path(f"/proc/{robot.process.pid}/maps").read_text()
        assert "pydantic" not in maps and "zenoh" not in maps


def test_sixth_death_within_a_minute_ends_the_robot(tmp_path):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        for count in range(6):
            assert until(lambda n=count: robot.output().count("a new driver process starts") == n, START_S)
            os.kill(robot.driver_pid(), signal.SIGKILL)
        assert robot.process.wait(START_S) == 3
        assert "5 restarts within 60 s; the motors stay at zero" in robot.output()
        assert robot.motor_rows()[-1][1:] == (0.0, 0.0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_end_before_the_first_heartbeat_is_quick_and_quiet(tmp_path, number):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        os.kill(robot.driver_pid(), signal.SIGKILL)
        robot.wait_until_on("a new driver process starts")
        robot.process.send_signal(number)
        assert robot.process.wait(3) == 128 + number
        assert "Traceback" not in robot.output()


def test_drive_without_zero_is_one_line_at_start(tmp_path):
    kind = f"{__name__}:ZerolessDrive"
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
    assert zero_of(RobotConfig(drive=PluginChoice(kind=kind, options=options))) == expected


def test_zero_of_an_unknown_drive_is_a_configuration_error():
    with pytest.raises(ConfigError, match="no drive called 'lgo'"):
        zero_of(RobotConfig(drive=PluginChoice(kind="lgo")))


def test_shipped_zero_needs_no_pydantic():
    modules = ["sightline.robot_side.hardware.log_zero", "sightline.sim.zero", "sightline.robot_side.guardian.process"]
    code = f"import sys, {', '.join(modules)}; print([m for m in ('pydantic', 'typer', 'zenoh') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
