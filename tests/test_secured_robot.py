"""A real robot over mutual TLS: its own vision drives it, an operator commands it, strangers move nothing."""

import secrets
import subprocess
import sys
import time

import pytest

from operator_side import keys
from protocol.channels import FRAME, TWIST
from protocol.codec import decode, encode
from protocol.errors import LinkError
from protocol.messages import AnswerHeader, Echo, FrameHeader
from protocol.transports.zenoh import open_zenoh
from tests.link_rigs import free_endpoint, until
from tests.robot_process import RobotProcess, Vision, driving

pytestmark = pytest.mark.slow


@pytest.fixture
def robot(tmp_path):
    keys.make(tmp_path / "keys", [])
    endpoint = free_endpoint().replace("tcp/", "tls/")
    with RobotProcess(tmp_path, endpoint=endpoint, secure=str(tmp_path / "keys")) as running:
        assert until(lambda: "robot r1: on" in running.output(), 8)
        yield running


def _sightline(*arguments):
    command = [sys.executable, "-m", "operator_side.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)


def test_vision_drives_and_an_operator_stops_it(robot):
    folder = robot.config["secure"]
    with Vision(robot.endpoint, secure=folder):
        assert driving(robot)
        stopped = _sightline("stop", "r1", "--connect", robot.endpoint, "--secure", folder)
        assert stopped.returncode == 0 and "STOPPED" in stopped.stdout, stopped
        assert until(lambda: robot.speed() == 0.0)


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_who_may_not_steer_moves_nothing_though_it_claims_to_be_vision(robot, role):
    """It sees the frames and answers each of them correctly, under a certificate that is not vision's."""
    with open_zenoh("r1", connect=[robot.endpoint], role=role, secure=robot.config["secure"]) as rogue:
        frames, session, answered = rogue.latest(FRAME), secrets.token_hex(4), 0
        ends_s = time.monotonic() + 2.0
        while time.monotonic() < ends_s:
            message = frames.take(0.2)
            if message is None:
                continue
            frame = decode(FrameHeader, message.header)
            echo = Echo(channel="frame", session=frame.session, seq=frame.seq, t_us=frame.t_us)
            answer = AnswerHeader(source="vision", session=session, seq=answered, echo=echo)
            rogue.publish(TWIST, encode(answer), b"0.4000|0.0000", "vision")
            answered += 1
        assert answered > 5, "it could have driven, had it been heard"
        assert robot.speed() == 0.0


def test_without_keys_nobody_even_watches(robot):
    with pytest.raises(LinkError, match="speaks TLS only"):
        open_zenoh("r1", connect=[robot.endpoint.replace("tls/", "tcp/")], role="vision", timeout_s=1.0)
    asked = _sightline("status", "r1", "--connect", robot.endpoint)
    assert asked.returncode == 4
    assert asked.stderr == f"error: refused at {robot.endpoint}: a tls/ endpoint needs keys; give --secure DIR\n"
