"""Which processes of a fault row are measured."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from sightline.evaluation.faults.fixture import RobotFixture, Setup, memory_kib
from sightline.evaluation.processes import Processes

_WAITS = [sys.executable, "-I", "-S", "-c", "print(1, flush=True); input()"]
_GUARDIAN = "import subprocess, sys; subprocess.Popen(sys.argv[1:])"


@pytest.mark.parametrize(("setup", "measured"), [
    (Setup(), {"sim", "robot"}), (Setup("vision"), {"sim", "robot", "peer"}),
    (Setup(routed=True), {"sim", "robot", "router"}), (Setup("vision", "websockets", legacy=""), {"sim", "vision"}),
])
def test_every_process_of_sightline_is_measured(tmp_path, setup, measured):
    assert set(RobotFixture(tmp_path / "row", setup)._judged) == measured


def test_memory_of_stop_receiver_is_measured(tmp_path):
    processes = Processes(tmp_path)
    command = [*_WAITS[:3], "-c", f"{_GUARDIAN}; input()", *_WAITS, "robot_side.guardian.stop_receiver"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as guardian:
        assert guardian.stdout.readline()
        processes._running["robot"] = SimpleNamespace(pid=guardian.pid)
        measured = memory_kib(processes, ["robot"])
        guardian.stdin.close()
    assert set(measured) == {("robot", "itself"), ("robot", "stop")} and min(measured.values()) > 0
