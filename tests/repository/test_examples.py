"""The examples run as they stand."""

import base64
import os
import re
import runpy
import select
import shlex
import subprocess
import sys
import termios
import textwrap
from pathlib import Path

import cv2
import numpy as np

from examples.my_drive import MyDrive
from sightline.operator_side.config.loading import load_service
from sightline.robot_side.plugins import DRIVES
from sightline.robot_side.ports import WheelAngles
from tests.fixtures.commands import service
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision

ROOT = Path(__file__).parent.parent.parent


def test_example_robot_drives(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT / "examples")
    config = load_service("robot", file="my_robot.toml", environ={}).config
    serial = tmp_path / "serial"
    serial.touch()
    drive = {"kind": config.drive.kind, "options": {"port": str(serial)}}
    changes = {"drive": drive, "camera": config.camera.model_dump(), "endpoint": free_endpoint()}
    with RobotProcess(tmp_path, **changes) as robot, Vision(robot.endpoint):
        assert until(lambda: any(float(line.split()[0]) > 5 for line in serial.read_text().splitlines()[:-1]), START_S)
    assert serial.read_text().splitlines()[-1] == "0.000 0.000"


def test_example_drive_keeps_the_contract(monkeypatch):
    monkeypatch.chdir(ROOT / "examples")
    config = load_service("robot", file=str(ROOT / "examples/my_robot.toml"), environ={}).config
    drive = DRIVES.build(config.drive)
    drive.set(10.0, -10.0)
    first = drive.wheels()
    assert isinstance(first, WheelAngles)
    assert until(lambda: drive.wheels().left_rad > first.left_rad + 0.1)
    drive.close()


def test_example_drive_sets_up_its_serial_port():
    controller, port = os.openpty()
    drive = MyDrive(MyDrive.Config(port=os.ttyname(port)))
    assert termios.tcgetattr(port)[4:6] == [termios.B115200] * 2
    os.write(controller, b"ready\n")
    drive.set(1.0, -2.0)
    assert select.select([controller], [], [], 5)[0]
    assert os.read(controller, 100) == b"1.000 -2.000\n"
    drive.close()
    os.close(port)
    os.close(controller)


def test_legacy_client_changes_its_search_with_the_image():
    steer = runpy.run_path(str(ROOT / "examples/compose/older_client.py"))["steer"]
    images = [base64.b64encode(cv2.imencode(".jpg", np.full((48, 64, 3), shade, np.uint8))[1]).decode()
              for shade in (90, 130)]
    first, second = (steer(image) for image in images)
    assert first != second and steer(images[0]) == first
    assert all(re.fullmatch(r"0\.0\|0\.50?\d?", twist) for twist in (first, second))


def test_steps_of_the_own_robot_page_work_from_an_empty_folder(tmp_path):
    page = (ROOT / "docs/how-to/own-robot.md").read_text("utf-8").partition("## Choose what")[0]
    home, folder = tmp_path / "home", tmp_path / "robot"
    home.mkdir()
    folder.mkdir()
    (home / "sightline").symlink_to(ROOT)
    copy, check, run = (shlex.split(one) for one in re.findall(r"```sh\n(.*?)```", page, re.DOTALL))
    words = [word.replace("~", str(home)) for word in copy]
    subprocess.run(words, cwd=folder, check=True)
    changed = "\n".join(textwrap.dedent(one) for one in re.findall(r"```toml\n(.*?)```", page, re.DOTALL))
    env = {**os.environ, "SIGHTLINE_ROBOT__LISTEN": f'["{free_endpoint()}"]',
           "SIGHTLINE_ROBOT__STATE_DIR": str(tmp_path / "state")}  # fmt: skip
    program = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app"]
    with service([*program, *run[1:]], "robot r1: on", tmp_path, 20, cwd=folder, env=env):
        pass
    (folder / "my_robot.toml").write_text(changed)
    done = subprocess.run([*program, *check[1:]], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "valid" in done.stdout, done.stderr
