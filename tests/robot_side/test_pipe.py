"""The parts of the network process: the driver's modules, and a camera from the folder in which both start."""

import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from sightline.protocol.clock import monotonic_us
from sightline.robot_side import pipe as ipc
from sightline.robot_side import plugins
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.pipe import DriverEnd
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import JPEG, RobotProcess

ROOT = Path(__file__).parent.parent.parent
STRANGE = "raise SystemExit(7)"
CAMERA = """
from sightline.protocol.config import Config
from sightline.robot_side.hardware.cameras.files import FolderCamera
class MyCamera(FolderCamera):
    pass
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of the robot, with modules of its owner that have the names of modules that a robot needs."""
    for name in ("select", "zenoh", "websockets", "json", "pydantic"):
        (tmp_path / f"{name}.py").write_text(STRANGE)
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "0.jpg").write_bytes(JPEG)
    (tmp_path / "my_camera.py").write_text(CAMERA)
    monkeypatch.chdir(tmp_path)
    # A Path is nothing to Python, which ignores it, but a plug-in may have put one there.
    monkeypatch.setattr(sys, "path", [Path("ignored"), *(one for one in sys.path if one)])
    return tmp_path


@pytest.mark.parametrize("kind", ["folder", "my_camera:MyCamera"])
def test_start_folder_provides_cameras_and_shadows_no_module(folder, kind):
    camera = PluginChoice(kind=kind, options={"path": "pictures"})
    listen = (free_endpoint(), free_endpoint("ws://"))
    config = RobotConfig(camera=camera, listen=listen, state_dir=folder)
    child, packets = DriverEnd(config, "0000beef"), []
    try:
        child.keep_alive(monotonic_us(), 0)
        assert until(lambda: packets.extend(child.packets()) or packets or child._process.poll() is not None, 20)
        assert packets and packets[0][0] == ipc.PacketKind.READY
    finally:
        child.close()


def test_class_of_the_start_folder_comes_after_installed_modules(folder, monkeypatch):
    before = list(sys.path)
    monkeypatch.setattr(sys, "path", list(before))
    choice = PluginChoice(kind="my_camera:MyCamera", options={"path": "pictures"})
    plugins.CAMERAS.load(choice)
    plugins.CAMERAS.load(choice)
    assert sys.path == [*before, str(folder)]


def test_both_processes_run_from_an_uninstalled_checkout(tmp_path, monkeypatch):
    checkout = tmp_path / "checkout"
    for package in ("protocol", "robot_side"):
        shutil.copytree(ROOT / package, checkout / "sightline" / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "sightline" / "__init__.py", checkout / "sightline")
    process = checkout / "sightline" / "robot_side" / "network" / "process.py"
    with process.open("r+") as source:
        text = source.read()
        source.seek(0)
        source.write(text.replace("def main() -> None:", "def main() -> None:\n    print(__file__, flush=True)"))
    environ = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    popen_there = partial(subprocess.Popen, cwd=checkout, env=environ)
    monkeypatch.setattr(subprocess, "Popen", popen_there)
    with RobotProcess(tmp_path) as robot:
        assert until(lambda: str(process) in robot.output(), 20), robot.output()
