"""A real robot over mutual TLS: its vision drives it, an operator commands it, unauthorized clients move nothing."""

import secrets
import time
from pathlib import Path

import pytest

from sightline.benchmarks.loop.pictures import write_pictures
from sightline.evaluation.processes import SIGHTLINE
from sightline.operator_side.setup import keys
from sightline.protocol.channels import FRAME, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import LinkError
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader, LeaseHolder, State, Status
from sightline.protocol.proof import ProofChain
from sightline.protocol.transports.tokens import DriverToken
from sightline.protocol.transports.zenoh.link import open_fleet, open_zenoh
from tests.fixtures.commands import run, service, sightline
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision, driving

pytestmark = pytest.mark.waits


@pytest.fixture
def robot(tmp_path):
    keys.make(tmp_path / "keys", [])
    endpoint = free_endpoint("tls/")
    with RobotProcess(tmp_path, endpoint=endpoint, secure=str(tmp_path / "keys")) as running:
        running.wait_until_on()
        yield running


def test_vision_drives_an_operator_stops_it_and_a_viewer_sees_that(robot, tmp_path, capsys):
    folder = robot.config["secure"]
    with Vision(robot.endpoint, secure=folder):
        assert driving(robot)
        stopped = run(capsys, "stop", "r1", "--connect", robot.endpoint, "--secure", folder)
        assert stopped[0] == 0 and "STOPPED" in stopped[1], stopped
        assert until(lambda: robot.speed() == 0.0)
    (tmp_path / "viewer").mkdir()
    for name in ("ca.pem", "viewer.pem", "viewer.key"):
        (tmp_path / "viewer" / name).write_bytes(Path(folder, name).read_bytes())
    looked = run(capsys, "status", "r1", "--connect", robot.endpoint, "--secure", str(tmp_path / "viewer"))
    assert "STOPPED" in looked[1], "to look, a viewer's keys are enough"


def test_second_connection_of_the_same_role_does_not_drive_by_a_copied_identity(robot):
    """It has read the driver's session, and answers each frame at once with a higher number."""
    folder = robot.config["secure"]
    with Vision(robot.endpoint, secure=folder) as vision, \
         open_zenoh("r1", connect=[robot.endpoint], role="vision", secure=folder) as rogue:
        assert driving(robot)
        frames, seq, ends_s = rogue.latest(FRAME), 10_000, time.monotonic() + 1.0
        proof, sent = ProofChain(secrets.token_bytes), 0
        while time.monotonic() < ends_s:
            message = frames.take(0.2)
            if message is None:
                continue
            seq, sent = seq + 1, sent + 1
            echo = Echo.of(decode(FrameHeader, message.header))
            answer = AnswerHeader(source="vision", session=vision.session, seq=seq, echo=echo, proof=proof.next().proof)
            rogue.publish(TWIST, encode(answer), b"-0.4000|0.0000", "vision")
        status = vision.status()
        assert sent > 5 and status.refused["NOT_PROVEN"] >= 0.5 * sent
        assert status.holder == LeaseHolder.of("vision", vision.session)
        assert all(left >= 0.0 for _, left, _ in robot.motor_rows()), "no motor log line is caused by the copy"
        assert driving(robot)


@pytest.fixture
def shared_robot(tmp_path):
    """A robot that a `vision --share` drives through a router, that router's endpoint, and the keys."""
    folder, endpoint, pictures = str(tmp_path / "keys"), free_endpoint("tls/"), tmp_path / "ball"
    keys.make(tmp_path / "keys", [])
    pictures.mkdir()
    write_pictures(pictures, 160, 120)
    camera = {"kind": "folder", "options": {"path": str(pictures)}}
    where = ["--secure", folder]
    with service([*SIGHTLINE, "router", "--listen", endpoint, *where], " on ", tmp_path, START_S), \
         RobotProcess(tmp_path, listen=[], connect=[endpoint], secure=folder, camera=camera) as robot, \
         service([*SIGHTLINE, "vision", "--share", "--connect", endpoint, *where], "drives it", tmp_path, START_S):
        yield robot, endpoint, folder


@pytest.mark.slow
def test_second_connection_that_declares_and_withdraws_the_token_of_the_driver_changes_no_lease(shared_robot):
    robot, endpoint, folder = shared_robot
    statuses, tokens = [], set()
    with open_fleet("*", connect=[endpoint], role="vision", by_status=False, secure=folder) as second, \
         open_zenoh("r1", connect=[endpoint], role="viewer", secure=folder) as viewer:
        second.watch_tokens(lambda token, _: tokens.add(token))
        viewer.subscribe(STATUS, lambda message: statuses.append(decode(Status, message.payload, 4096)))
        assert driving(robot, 1.0), robot.output()
        assert until(lambda: len(statuses) > 3 and statuses[-1].state is State.ACTIVE)
        (token,) = (one for one in tokens if isinstance(one, DriverToken))
        began, rows = len(statuses) - 1, len(robot.motor_rows())
        for _ in range(100):
            second.declare_token(token)()
        declared = len(statuses)
        assert until(lambda: len(statuses) >= declared + 10)
    seen = statuses[began:]
    assert {one.state for one in seen} == {State.ACTIVE}
    assert len({one.holder for one in seen}) == 1 and seen[0].holder.source == "vision"
    assert seen[-1].accepted - seen[0].accepted >= len(seen), "it drives on, at more than 10 commands a second"
    assert all(left or right for _, left, right in robot.motor_rows()[rows:])
    assert [one for one in tokens if isinstance(one, DriverToken)] == [token], "the driver kept its session"


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_client_with_another_role_does_not_steer_as_vision(robot, role):
    """It sees the frames and answers each of them correctly, under a certificate that is not vision's."""
    with open_zenoh("r1", connect=[robot.endpoint], role=role, secure=robot.config["secure"]) as rogue:
        frames, session, answered = rogue.latest(FRAME), secrets.token_hex(4), 0
        ends_s = time.monotonic() + 1.5
        while time.monotonic() < ends_s:
            message = frames.take(0.2)
            if message is None:
                continue
            frame = decode(FrameHeader, message.header)
            echo = Echo.of(frame)
            answer = AnswerHeader(source="vision", session=session, seq=answered, echo=echo)
            rogue.publish(TWIST, encode(answer), b"0.4000|0.0000", "vision")
            answered += 1
        assert answered > 5, "its commands would drive a robot that receives them"
        assert robot.speed() == 0.0, robot.output()


@pytest.mark.slow
def test_secured_robot_rejects_viewers_without_keys(robot):
    with pytest.raises(LinkError, match="accepts only TLS"):
        open_zenoh("r1", connect=[robot.endpoint.replace("tls/", "tcp/")], role="vision", timeout_s=1.0)
    asked = sightline("status", "r1", "--connect", robot.endpoint)
    assert asked.returncode == 2
    assert asked.stderr == f"error: {robot.endpoint}: a tls/ endpoint needs keys; pass --secure DIR\n"


def _with_other_keys(folder, tmp_path):
    keys.make(tmp_path / "other", [])
    return tmp_path / "other"


def _expired(folder, tmp_path):
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    keys.add(tmp_path, "vision", [], days=-0.5)
    return tmp_path


REFUSALS = {
    "plain": (None, r"it accepts only TLS; use tls/\.\.\. and pass --secure DIR"),
    "other authority": (_with_other_keys, "authority; use keys of one `sightline keys init`"),
    "expired": (_expired, r"the certificate of this end has expired \(vision\.pem, 20[-0-9]{8}\); run `sightline keys "
                          "add DIR vision` where ca.key is"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_rejected_peer_receives_the_reason_and_the_robot_continues(robot, name, tmp_path, capsys):
    spoil, pattern = REFUSALS[name]
    (tmp_path / "spoilt").mkdir()
    secure = str(spoil(Path(robot.config["secure"]), tmp_path / "spoilt")) if spoil else ""
    endpoint = robot.endpoint if secure else robot.endpoint.replace("tls/", "tcp/")
    with pytest.raises(LinkError, match=pattern):
        open_zenoh("r1", connect=[endpoint], role="vision", secure=secure, timeout_s=0.3)
    assert run(capsys, "status", "r1", "--connect", robot.endpoint, "--secure", robot.config["secure"])[0] == 0


def test_robot_with_a_certificate_for_another_name_is_rejected(tmp_path, monkeypatch):
    monkeypatch.setattr(keys, "LOOPBACK", ("elsewhere.local",))
    keys.make(tmp_path / "keys", [])
    endpoint = free_endpoint("tls/")
    with RobotProcess(tmp_path, endpoint=endpoint, secure=str(tmp_path / "keys")) as robot:
        robot.wait_until_on()
        with pytest.raises(LinkError, match="names other addresses"):
            open_zenoh("r1", connect=[endpoint], role="vision", secure=str(tmp_path / "keys"), timeout_s=0.3)


def test_rogue_client_on_a_plain_network_is_rejected_and_logged_while_another_drives(tmp_path):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint) as driver:
        robot.wait_until_on()
        assert driving(robot)
        began_s, accepted_of = time.monotonic(), driver.status().holder
        with Vision(robot.endpoint, twist=b"-0.4000|1.0000") as rogue:
            assert until(lambda: "rejected NOT_HOLDER from vision" in robot.output(), 1.0), robot.output()
            assert time.monotonic() - began_s < 3.0
            assert until(lambda: driver.status().refused.get("NOT_HOLDER", 0) > 10)
            assert driver.status().holder == accepted_of
            assert rogue.headers, "its commands would drive a robot that accepts them"
        assert all(left >= 0.0 <= right for _, left, right in robot.motor_rows())
