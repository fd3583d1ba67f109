"""Test JavaScript and Python peers together, each in a process: robot, vision service, operator and viewer."""

import json
import shutil
import subprocess
import time
from typing import Any

import cv2
import numpy as np
import pytest
from websockets.sync.client import connect

from sightline.evaluation.processes import SIGHTLINE
from tests.fixtures.javascript import ROOT, JsProcess, JsRobot, JsVision, hello, json_payload
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_port
from tests.fixtures.robot_process import RobotProcess, driving


def sightline(*arguments: str, ok: bool = True) -> str:
    """Run the command and return its output."""
    run = subprocess.run([*SIGHTLINE, *arguments], check=False, capture_output=True, text=True, timeout=30)
    assert (run.returncode == 0) == ok, run.stdout + run.stderr
    return run.stdout if ok else run.stdout + run.stderr


def status(robot: JsRobot) -> dict[str, object]:
    return dict(json.loads(sightline("status", "js1", "--connect", robot.endpoint, "--json")))


def applied(robot: JsRobot) -> list[float]:
    return list(status(robot)["applied"])  # type: ignore[call-overload]


@pytest.fixture
def our_vision(tmp_path):
    """Yield a function that starts `sightline vision` for a JavaScript robot."""
    running = []

    def start(robot: JsRobot) -> subprocess.Popen[bytes]:
        command = [*SIGHTLINE, "vision", "--connect", robot.endpoint, "--robot", "js1"]
        log = (tmp_path / "our_vision.log").open("wb")
        running.append(subprocess.Popen(command, stdout=log, stderr=log))
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.wait(5)


@pytest.mark.slow
def test_our_vision_and_operator_drive_and_stop_the_javascript_robot(tmp_path, our_vision):
    with JsRobot(tmp_path) as robot:
        our_vision(robot)
        assert until(lambda: status(robot)["refused"].get("DISARMED"), START_S), "vision sends commands"
        armed = sightline("arm", "js1", "--connect", robot.endpoint)
        assert "armed" in armed
        assert robot.says(r"ACTIVE \(driving\)")
        report: dict[str, Any] = {}

        def drives() -> bool:
            report.update(status(robot))
            return report["state"] == "ACTIVE" and report["holder"]["source"] == "vision" and any(report["applied"])

        assert until(drives, START_S), report
        assert set(report["refused"]) <= {"DISARMED", "CLAMPED", "NOT_ALLOWED"}  # armed as soon as it was allowed
        assert report["stream"]["credit_timeouts"] < report["stream"]["sent"] / 4
        assert "STOPPED" in sightline("stop", "js1", "--connect", robot.endpoint)
        assert until(lambda: not any(applied(robot)), 5)
        assert "STOPPED" in sightline("arm", "js1", "--connect", robot.endpoint, ok=False)
        sightline("reset", "js1", "--connect", robot.endpoint)
        assert robot.says(r"DISARMED \(reset by operator")
        assert robot.end() == 0


@pytest.mark.slow
def test_the_stop_latch_of_the_javascript_robot_survives_kill_and_restart(tmp_path):
    with JsRobot(tmp_path, "--auto-arm") as robot:
        sightline("stop", "js1", "--connect", robot.endpoint)
        robot.kill()
    with JsRobot(tmp_path, "--auto-arm") as robot, JsVision(tmp_path, robot.endpoint, "js1") as vision:
        assert robot.says("STOP was set before the restart")
        assert vision.says("frames from robot js1")
        assert until(lambda: status(robot)["refused"].get("STOPPED", 0) > 5, 10)
        assert status(robot)["state"] == "STOPPED"

@pytest.mark.parametrize("replaced", [False, True], ids=["removed", "a file"])
def test_stop_is_stored_or_the_robot_reports_that_it_is_not(tmp_path, replaced):
    header = {"channel": "request", "source": "operator", "v": 1, "session": "99999999", "seq": 0}
    block = json.dumps(header, separators=(",", ":")).encode()
    with JsRobot(tmp_path) as robot, connect(robot.endpoint, subprotocols=["sightline.v1"]) as operator:
        operator.send(hello("js1", wants=["reply"]))
        operator.recv(5)
        shutil.rmtree(tmp_path / "state")
        if replaced:
            (tmp_path / "state").write_text("")
        operator.send(len(block).to_bytes(2) + block + b'{"id":1,"verb":"stop"}')
        assert json_payload(operator.recv(5))["state"] == "STOPPED"
        assert (tmp_path / "state" / "js1.stopped").exists() != replaced
        assert ("STOPPED is not stored for a restart" in robot.output()) == replaced
        assert "error" not in robot.output()


def test_javascript_robot_stops_when_its_vision_is_killed(tmp_path, our_vision):
    with JsRobot(tmp_path, "--auto-arm") as robot:
        vision = our_vision(robot)
        assert robot.says("ACTIVE", 15)
        with connect(robot.endpoint, subprotocols=["sightline.v1"]) as watcher:
            watcher.send(hello("js1", wants=["status"]))
            watcher.recv()
            assert until(lambda: any(json_payload(watcher.recv())["applied"]), 10)
            vision.kill()
            killed_s = time.monotonic()
            while any(json_payload(watcher.recv())["applied"]):
                assert time.monotonic() - killed_s < 3
        assert time.monotonic() - killed_s < 1.2  # 0.7 s, a status at 10 Hz, and the load of other processes
        # The last frame may already be old when the vision service dies. Then its age stops the robot.
        assert robot.says(r"HOLD \((no accepted command|the frame behind the command is too old)")


def _yellow_ball(folder):
    """Write images of a yellow ball, right of the center, with chroma at half resolution like those of a camera."""
    folder.mkdir()
    for number, x in enumerate((380, 390, 400)):
        picture = np.full((480, 640, 3), (120, 125, 118), np.uint8)
        cv2.circle(picture, (x, 240), 28, (20, 200, 235), -1)
        cv2.imwrite(str(folder / f"{number}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return folder


def test_the_javascript_vision_drives_our_robot(tmp_path):
    pictures = _yellow_ball(tmp_path / "balls")
    endpoint = f"ws://127.0.0.1:{free_port()}"
    camera = {"kind": "folder", "options": {"path": str(pictures)}}
    with (
        RobotProcess(tmp_path, endpoint=endpoint, camera=camera) as robot,
        JsVision(tmp_path, endpoint, "r1") as vision,
    ):
        assert vision.says("target seen"), vision.output() + robot.output()
        assert driving(robot, 2.0), robot.output()
        report = json.loads(sightline("status", "r1", "--connect", endpoint, "--json"))
        assert report["accepted"] > 5 and set(report["refused"]) <= {"DISARMED", "CLAMPED", "STALE"}  # busy machine
        assert report["applied"][0] > 0 > report["applied"][1]  # the ball is on the right
        vision.kill()
        assert until(lambda: robot.speed() == 0, 2)


# The Python robot drops a viewer that is slower than its frames, so that no other test may load the machine.
@pytest.mark.parametrize("whose", [pytest.param("ours", marks=pytest.mark.alone), "theirs"])
def test_the_viewer_watches_steers_and_stops_a_robot(tmp_path, whose):
    """Run the viewer with the WebSocket of Node, like a browser without a screen."""
    endpoint = f"ws://127.0.0.1:{free_port()}"
    camera = {"kind": "folder", "options": {"path": str(_yellow_ball(tmp_path / "balls"))}}
    ours = whose == "ours"
    a_robot = RobotProcess(tmp_path, endpoint=endpoint, camera=camera) if ours else JsRobot(tmp_path, "--auto-arm")
    with a_robot as robot:
        assert ours or isinstance(robot, JsRobot)
        place = (endpoint, "r1") if isinstance(robot, RobotProcess) else (robot.endpoint, "js1")
        script = str(ROOT / "tests" / "javascript_viewer.mjs")
        with JsProcess(tmp_path, script, *place, flags=("--experimental-websocket", "--no-warnings")) as viewer:
            assert until(lambda: viewer.process.poll() is not None, 20), viewer.output() + robot.output()
            assert viewer.process.returncode == 0, viewer.output()
            lines = viewer.output().splitlines()
    assert [line for line in lines if line != "no target" and not line.startswith("link: no")] == [
        "link: connected", "target", "driving", "reply: STOPPED", "stopped; frames: many; skipped: {}",
    ]  # fmt: skip


def test_the_javascript_vision_finds_the_robot_again(tmp_path):
    port = free_port()
    with JsRobot(tmp_path, port=port) as robot, JsVision(tmp_path, robot.endpoint, "js1") as vision:
        assert vision.says("target seen")
        robot.end()
        assert vision.says("link ended: the robot is shutting down")
        with JsRobot(tmp_path, port=port) as again:
            assert until(lambda: vision.output().count("frames from robot js1") == 2, 5)
            assert until(lambda: status(again)["refused"].get("DISARMED", 0) > 5, 5)
        assert vision.end() == 0
