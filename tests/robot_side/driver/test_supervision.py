"""The service manager's side: the unit file, the notifications, the motors zeroed by themselves."""

import configparser
import inspect
import os
import signal
import socket
import time
from itertools import pairwise
from pathlib import Path

import pytest

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.transports.open import open_link
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.process import zero_motors
from sightline.robot_side.driver.supervision import DRIVER_PRIORITY, GUARDIAN_PRIORITY, SystemdNotifier
from sightline.robot_side.guardian.core import ENDS_WITHIN_US
from sightline.robot_side.hardware.log_drive import LogDrive
from tests.fixtures.links import START_S, until
from tests.fixtures.robot_process import RobotProcess

BOUND_S = 0.7
UNIT = Path(__file__).parent.parent.parent.parent / "robot_side" / "systemd" / "sightline-robot.service"


def unit_file():
    unit = configparser.ConfigParser(interpolation=None, strict=True)
    unit.optionxform = str
    unit.read(UNIT)
    return unit


def test_the_unit_watches_restarts_and_zeroes():
    service = unit_file()["Service"]
    assert service["Type"] == "notify" and service["NotifyAccess"] == "main"
    assert 0 < float(service["WatchdogSec"]) <= 2 and service["Restart"] == "on-failure"
    assert service["ExecStopPost"].endswith(f" {service['ExecStart']} --zero-motors")
    assert float(service["TimeoutStopSec"]) > ENDS_WITHIN_US / 1e6, "the guardian waits so long for the driver process"
    assert int(service["LimitRTPRIO"]) >= GUARDIAN_PRIORITY > DRIVER_PRIORITY


def test_systemd_leaves_a_live_driver_time_to_ramp_and_zeroes_only_after_all_processes_ended():
    """With KillMode=mixed, systemd 252 kills the driver process 10 ms after a guardian that was killed, and calls
    --zero-motors while a hung driver process still has the motors."""
    service = unit_file()["Service"]
    assert service["KillMode"] == "control-group"
    assert service["WatchdogSignal"] == "SIGTERM", "SIGABRT would kill a driver process that can still ramp to zero"
    assert BOUND_S <= float(service["TimeoutAbortSec"]) <= 1, "then systemd kills those that hang"


def test_a_robot_that_waits_for_its_router_tries_for_ever_and_one_that_fails_at_once_stays_stopped():
    unit = unit_file()
    between_starts_s = int(unit["Unit"]["StartLimitIntervalSec"]) / int(unit["Unit"]["StartLimitBurst"])
    pause_s = float(unit["Service"]["RestartSec"])
    waits_s = inspect.signature(open_link).parameters["timeout_s"].default
    assert pause_s < between_starts_s < pause_s + waits_s


def test_the_guardian_feeds_the_watchdog_only_while_heartbeats_arrive(tmp_path, monkeypatch):
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(START_S)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        monkeypatch.setenv("WATCHDOG_USEC", "1000000")
        with RobotProcess(tmp_path) as robot:
            assert manager.recv(256) == b"WATCHDOG_USEC=1000000"
            assert manager.recv(256) == manager.recv(256) == b"READY=1\nWATCHDOG=1"
            os.kill(robot.driver_pid(), signal.SIGKILL)
            assert until(lambda: manager.recv(256) == b"WATCHDOG_USEC=30000000"), "time to start a new driver process"
            assert manager.recv(256) == b"WATCHDOG_USEC=1000000", "not fed until its first heartbeat"
            robot.process.terminate()
            assert until(lambda: b"STOPPING=1" in manager.recv(256))
            assert robot.process.wait(5) == 0


SLOW_START = """
import subprocess, time
from sightline.robot_side.hardware.log_drive import LogDrive
class SlowPopen(subprocess.Popen):
    def __init__(self, *arguments, **options):
        time.sleep(1)
        super().__init__(*arguments, **options)
subprocess.Popen = SlowPopen
class SlowStartDrive(LogDrive):
    pass
"""


def test_the_watchdog_is_fed_while_a_busy_machine_starts_the_network_process(tmp_path, monkeypatch):
    """The guardian limits that time. Without it systemd would end a healthy robot after a second."""
    (tmp_path / "slow_start.py").write_text(SLOW_START)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    address = str(tmp_path / "notify")
    drive = {"kind": "slow_start:SlowStartDrive", "options": {"path": str(tmp_path / "drive.csv")}}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(START_S)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        with RobotProcess(tmp_path, drive=drive) as robot:
            fed_s = []
            while "robot r1: on" not in robot.output():
                assert manager.recv(256) == b"READY=1\nWATCHDOG=1"
                fed_s.append(time.monotonic())
            assert max(after - before for before, after in pairwise(fed_s)) < 0.6, robot.output()


def test_supervision_without_a_manager_sends_nothing(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    manager = SystemdNotifier()
    manager.notify("READY=1")
    assert not manager.is_active


def test_motors_are_zeroed_without_gate_or_network(tmp_path):
    log = tmp_path / "drive.csv"
    config = RobotConfig(drive=PluginChoice(kind="log", options={"path": log}))
    assert zero_motors(config) == 0
    assert log.read_text().strip().endswith(",0.0000,0.0000")


def test_motors_of_a_drive_without_zero_are_a_configuration_error():
    with pytest.raises(ConfigError, match="has no static method zero"):
        zero_motors(RobotConfig(drive=PluginChoice(kind="tests.fixtures.dying:ZerolessDrive")))


class GoneDrive(LogDrive):
    """A drive whose port is gone."""

    @staticmethod
    def zero(config):
        raise FileNotFoundError(2, "No such file or directory", "/dev/ttyUSB0")


class LeavingDrive(LogDrive):
    """A drive of a library that ends the program."""

    @staticmethod
    def zero(config):
        raise SystemExit("no controller")


@pytest.mark.parametrize(("drive", "text"), [
    (GoneDrive, "FileNotFoundError: [Errno 2] No such file or directory: '/dev/ttyUSB0'"),
    (LeavingDrive, "SystemExit: no controller"),
])  # fmt: skip
def test_zero_that_raises_is_a_hardware_error_with_its_traceback_in_the_log(caplog, drive, text):
    kind = f"{__name__}:{drive.__name__}"
    with pytest.raises(HardwareError) as raised:
        zero_motors(RobotConfig(drive=PluginChoice(kind=kind)))
    assert str(raised.value) == f"motors NOT set to zero: drive '{kind}' raised {text}; switch off their supply"
    assert any(record.exc_info for record in caplog.records)


def test_driver_scheduling_is_not_inherited(tmp_path):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on("on tcp/")
        assert os.sched_getscheduler(robot.network_pid()) == os.SCHED_OTHER
        driver = robot.driver_pid()
        permitted = os.sched_getscheduler(driver) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        assert permitted != ("real-time scheduling is not permitted" in robot.output())
        if permitted:
            assert os.sched_getparam(robot.process.pid).sched_priority > os.sched_getparam(driver).sched_priority
        assert "fit the hardware cutoff of docs/how-to/hardware-cutoff.md, and run it under systemd" in robot.output()
