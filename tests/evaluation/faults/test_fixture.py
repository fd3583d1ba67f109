"""Which processes of a fault row are measured, and which STOP counts."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from sightline.evaluation.faults.evidence import MotorRow
from sightline.evaluation.faults.fixture import RobotFixture, Setup, memory_kib, moving_stop
from sightline.evaluation.processes import Processes
from sightline.robot_side.kinematics import DiffDriveConfig
from sightline.robot_side.safety.limits import TICK_US
from tests.fixtures.links import START_S, until

_GUARDIAN = """
from sightline.robot_side.guardian import stop_receiver
receiver = stop_receiver.start("r1", [], [], "")
receiver.keep_alive(0)
print(1, flush=True)
input()
receiver.close()
"""


@pytest.mark.parametrize(("setup", "measured"), [
    (Setup(), {"sim", "robot"}), (Setup("vision"), {"sim", "robot", "peer"}),
    (Setup(routed=True), {"sim", "robot", "router"}), (Setup("vision", "websockets", legacy=""), {"sim", "vision"}),
])
def test_every_process_of_sightline_is_measured(tmp_path, setup, measured):
    assert set(RobotFixture(tmp_path / "row", setup)._measured) == measured


def test_memory_of_stop_receiver_is_measured(tmp_path):
    processes = Processes(tmp_path)
    command = [sys.executable, "-P", "-c", _GUARDIAN]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as guardian:
        assert guardian.stdout.readline()
        processes._running["robot"] = SimpleNamespace(pid=guardian.pid)
        assert until(lambda: memory_kib(processes, ["robot"]).get(("robot", "stop")), START_S)
        measured = memory_kib(processes, ["robot"])
        guardian.stdin.write(b"\n")
    assert set(measured) == {("robot", "itself"), ("robot", "stop")} and min(measured.values()) > 0


def motors(mps_before, mps_after):
    """A motor log: a second before STOP at 1 s, a second after it, the wheels at their set speed."""
    rows, angle_rad = [], 0.0
    for t_us in range(0, 2_000_000, TICK_US):
        rad_s = (mps_before if t_us < 1_000_000 else mps_after) / DiffDriveConfig().wheel_radius_m
        rows.append(MotorRow(t_us, rad_s, rad_s, angle_rad, angle_rad))
        angle_rad += rad_s * TICK_US / 1e6
    return rows


@pytest.mark.parametrize(("before", "after", "ok"), [(0.5, 0.0, True), (0.0, 0.0, False), (0.5, 0.5, False)])
def test_stop_of_a_standing_robot_passes_no_check(before, after, ok):
    assert all(check.ok for check in moving_stop(motors(before, after), 990_000, Setup().kept_mps)) is ok
