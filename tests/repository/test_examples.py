"""The examples run as they stand."""

from pathlib import Path

from sightline.operator_side.config.loading import load_service
from sightline.robot_side.plugins import DRIVES
from sightline.robot_side.ports import WheelAngles
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision

ROOT = Path(__file__).parent.parent.parent


def test_example_robot_drives(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    config = load_service("robot", file="examples/my_robot.toml", environ={}).config
    serial = tmp_path / "serial"
    serial.touch()
    drive = {"kind": config.drive.kind, "options": {"port": str(serial)}}
    changes = {"drive": drive, "camera": config.camera.model_dump(), "endpoint": free_endpoint()}
    with RobotProcess(tmp_path, **changes) as robot, Vision(robot.endpoint):
        assert until(lambda: any(float(line.split()[0]) > 5 for line in serial.read_text().splitlines()[:-1]), 8)
    assert serial.read_text().splitlines()[-1] == "0.000 0.000"


def test_example_drive_keeps_the_contract(tmp_path):
    config = load_service("robot", file=str(ROOT / "examples/my_robot.toml"), environ={}).config
    drive = DRIVES.build(config.drive)
    drive.set(10.0, -10.0)
    first = drive.wheels()
    assert isinstance(first, WheelAngles)
    assert until(lambda: drive.wheels().left_rad > first.left_rad + 0.1)
    drive.close()
