"""Missions over real links: `sightline goto`, `mission` and `status` reach a real vision through a real robot."""

import array
import json
import math
import threading
import time

import numpy as np
import pytest

from sightline.protocol.config import Config as Settings
from sightline.protocol.transports.open import open_link
from sightline.robot_side.ports import Ranges
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.serving.process import serve
from tests.fixtures.commands import sightline
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess
from tests.fixtures.vision.vision import jpeg_of

QUIET = VisionConfig.model_validate({"search": {"enabled": False}})
"""Its pictures are grey: without a search the robot stands."""


class FarSensor:
    """A range sensor in a wide empty hall."""

    Config = Settings

    def __init__(self, config):
        self._due_s = 0.0

    def read(self):
        now_s = time.monotonic()
        if now_s < self._due_s:
            return None
        self._due_s = now_s + 0.1
        return Ranges(round(now_s * 1e6), -1.5, 0.1, 0.02, 3.0, array.array("f", [math.inf] * 31))

    def close(self):
        pass


def grey_camera(folder):
    """Pictures that decode, and hold nothing."""
    path = folder / "grey"
    path.mkdir()
    (path / "0.jpg").write_bytes(jpeg_of(np.full((48, 64, 3), 140, np.uint8)))
    return {"kind": "folder", "options": {"path": str(path)}}


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["zenoh", "websocket"])
def test_operator_sends_a_robot_to_a_goal_and_cancels(tmp_path, transport):
    zenoh, web = free_endpoint(), free_endpoint("ws://")
    of_vision = zenoh if transport == "zenoh" else web
    ending, said = threading.Event(), []
    with (
        RobotProcess(tmp_path, endpoint=zenoh, listen=[zenoh, web], camera=grey_camera(tmp_path),
                     range_sensor={"kind": f"{__name__}:FarSensor"}) as robot,
        open_link("r1", connect=[of_vision], role="vision", timeout_s=20) as link,
    ):
        serving = threading.Thread(target=serve, args=(QUIET, link, ending, said.append), daemon=True)
        serving.start()
        try:
            _course(robot, ["--connect", of_vision], said)
            other = web if transport == "zenoh" else zenoh
            told = sightline("mission", "r1", "--connect", other)
            assert "r1: follow: " in told.stdout, "across the transports of one robot too"
        finally:
            ending.set()
            serving.join()


def _course(robot, connect, said):
    assert until(lambda: any("frames from robot r1" in line for line in said), START_S)
    told = sightline("mission", "r1", *connect)
    assert told.returncode == 0 and "r1: follow: lost" in told.stdout
    assert "detector: onnx:sightline.onnx, on cpu, model" in told.stdout
    assert robot.speed() == 0.0
    # The goal is so far away that the robot still drives at every request below.
    sent = sightline("goto", "r1", "30", "-10", *connect)
    assert sent.returncode == 0 and sent.stderr == f"robot r1 at {connect[1]} (from --connect)\n", sent
    assert until(lambda: robot.speed() > 1.0, START_S), "it drives"
    state = json.loads(sightline("status", "r1", "--json", *connect).stdout)
    assert state["mission"]["mission"] == "goto" and not state["mission"]["done"]
    rejected = sightline("mission", "r1", "folow", *connect)
    assert rejected.returncode == 5 and "no mission called 'folow'; did you mean 'follow'?" in rejected.stderr
    assert robot.speed() > 0.5, "a rejected request changes nothing"
    back = sightline("mission", "r1", "follow", "--json", *connect)
    assert back.returncode == 0 and json.loads(back.stdout)["ok"] is True
    assert until(lambda: robot.speed() == 0.0, 3), "nothing to follow: it stands"
    assert "mission   follow: lost" in sightline("status", "r1", *connect).stdout


@pytest.mark.slow
def test_requests_without_a_vision_service_do_not_wait(tmp_path):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        told = sightline("goto", "r1", "1", "1", "--connect", robot.endpoint)
        assert (told.returncode, told.stdout) == (4, "")
        where, error = told.stderr.splitlines()
        assert where == f"robot r1 at {robot.endpoint} (from --connect)"
        assert error == "error: no report from a vision service of robot 'r1' after 3 s; run `sightline vision`"
