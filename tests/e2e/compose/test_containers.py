"""The containers of every profile, for real: the robot follows the ball, STOP stops it, it ends with wheels at zero.

Run by `pytest -m compose`; needs an engine. docs/how-to/containers.md and .ci/engine show how to get one.
"""

import base64
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from websockets.sync.client import connect

from tests.e2e.compose.fixture import DEFAULT, HEAVY, IMAGES, PROFILES, SERVICES, Containers, ask, engine_missing
from tests.fixtures.links import until

pytestmark = pytest.mark.compose


@pytest.fixture(scope="module")
def images(request, tmp_path_factory):
    """All images, built once."""
    if "compose" not in request.config.option.markexpr:
        pytest.skip("builds images for minutes; run: make test ARGS='-m compose'")
    if reason := engine_missing():
        pytest.skip(reason)
    for profile in PROFILES:
        new = [name for name in IMAGES.values() if SERVICES[name]["profiles"][0] == profile.name]
        if new:
            Containers(profile, tmp_path_factory.mktemp("build")).compose("build", *new)


@pytest.fixture(scope="module", params=PROFILES, ids=lambda profile: profile.name)
def running(request, images, tmp_path_factory):
    """A profile's containers, up."""
    containers = Containers(request.param, tmp_path_factory.mktemp("compose"))
    try:
        containers.up()
        yield containers
    finally:
        containers.down()


def only(containers, *names):
    if containers.profile.name not in names:
        pytest.skip(f"is for {', '.join(names)}")


def test_every_image_is_made(images):
    for image in IMAGES:
        assert ask("docker", "image", "inspect", image).returncode == 0


def test_every_robot_follows_its_ball(running):
    profile = running.profile
    assert all(running.drives(robot) for robot in profile.robots), running.compose("logs", "--tail", "5")
    time.sleep(6)  # acquired and up to the ball's speed
    sims = [sim for _, sim in profile.robots.values()]
    with ThreadPoolExecutor(len(sims)) as together:
        worlds = list(together.map(running.truth, sims))
    for rows in worlds:
        assert len(rows) == 250
        assert max(abs(bearing_rad) for bearing_rad, _, _ in rows) < profile.max_bearing_rad
        assert all(0.6 < distance_m < 1.0 for _, distance_m, _ in rows)
        # Backwards too: a ball that comes round to a robot that has stood drives it before itself.
        assert sum(abs(linear_mps) > 0.05 for *_, linear_mps in rows) > 200, rows[::50]


def test_every_container_reports_healthy(running):
    asked = {name for name in running.profile.services if "healthcheck" in SERVICES[name]}
    assert until(lambda: running.health() == dict.fromkeys(asked, "healthy"), 40), running.health()
    for service in [name for name in running.profile.services if "status" in name]:
        assert "state" in running.compose("logs", "--no-color", service)


def test_containers_have_no_rights(running):
    for service in running.profile.services:
        if service != "keys":  # it has ended
            told = running.inside(service, "sh", "-c", "id -u; touch /opt/x 2>&1 || true").splitlines()
            assert told[0] == "10001"
            assert "Read-only" in told[1]


def test_robot_image_has_no_heavy_package(running):
    only(running, "plain")
    listed = running.inside("robot", "/opt/sightline/bin/pip", "list", "--format", "json")
    assert not {package["name"].lower() for package in json.loads(listed)} & HEAVY
    search = ("find", "/usr", "/opt", "-name", "cv2", "-o", "-name", "numpy", "-o", "-name", "pybullet*")
    assert running.inside("robot", *search) == ""
    found = running.inside("sim", *search).split()
    assert {"cv2", "numpy", "pybullet_data"} <= {file.rpartition("/")[2] for file in found}, "the search finds them"


def test_each_role_has_only_its_own_keys(running):
    only(running, "secure")
    held = {"secure-router": "router", "secure-robot": "robot", "secure-vision": "vision", "secure-status": "operator"}
    for service, role in held.items():
        files = running.inside(service, "sh", "-c", "cd /keys; find . -type f").split()
        names = {"ca.pem", *(f"{one}.{kind}" for one in (role, "viewer") for kind in ("key", "pem", "token"))}
        names -= {"router.token"}  # a router serves no WebSocket
        names |= set() if role == "vision" else {"stop.secret"}
        assert {file.rpartition("/")[2] for file in files} == names


def test_client_without_keys_is_rejected_with_the_cause(running):
    only(running, "secure")
    assert running.sightline("status", "r1").returncode == 0
    plain = f"tcp/127.0.0.1:{running.ports['7447']}"
    refused = ask(sys.executable, "-P", "-m", "sightline.operator_side.cli.app", "status", "r1", "--connect", plain)
    assert refused.returncode == 4
    assert plain in refused.stderr


def test_robot_without_its_detector_holds(running):
    only(running, "remote-detector")
    running.compose("stop", "detector")
    assert until(lambda: running.state("r1") in ("HOLD", "DISARMED"), 10)
    running.compose("start", "detector")
    assert running.drives("r1")


def test_legacy_protocol_works_on_its_port(running):
    only(running, "legacy")
    with connect(f"ws://127.0.0.1:{running.ports['9091']}", compression=None) as client:
        assert base64.b64decode(client.recv(5)).startswith(b"\xff\xd8")


def test_robots_meet_again_after_the_router_was_restarted(running):
    only(running, "plain", "secure")
    running.compose("restart", running.profile.router)
    assert all(running.drives(robot) for robot in running.profile.robots)


def stood_after_kill(running, container, bound_s):
    """Kill a container, start it again, and return the stands longer than `bound_s`: of robots whose simulation was in
    time, and of those whose simulation was late. The images of a late one are too old to drive by."""
    sims = [sim for _, sim in running.profile.robots.values()]
    with running.lateness(sims) as late_us:
        time.sleep(1)  # the start of what notes the lateness takes CPU time
        before = {sim: len(running.motor_rows(sim)) for sim in sims}
        assert ask("docker", "kill", container).returncode == 0
        time.sleep(6)
        stands = [(sim, *stand) for sim in sims for stand in running.stands(sim, before[sim])]
    assert ask("docker", "start", container).returncode == 0
    assert all(running.drives(robot) for robot in running.profile.robots)
    long = [(sim, began_us, ended_us) for sim, began_us, ended_us in stands if ended_us - began_us > bound_s * 1e6]
    late = [stand for stand in long if any(stand[1] - 5e5 < at_us < stand[2] for at_us in late_us[stand[0]])]
    return [stand for stand in long if stand not in late], late


def test_robots_go_on_when_a_vision_service_or_a_router_is_killed(running):
    only(running, "shared")
    visions = running.replicas("vision-shared")
    assert len(visions) == 3
    for container, bound_s in ((visions[0], 0.3), (visions[1], 0.3), (running.container("shared-router-a"), 2.0)):
        for _ in range(5):
            stood, late = stood_after_kill(running, container, bound_s)
            assert not stood, running.compose("logs", "--tail", "20")
            time.sleep(3)
            if not late:
                break
        assert not late, "a simulation was behind the clock at every kill; is the machine busy?"


def test_stop_stops_one_robot_until_reset_and_armed(running):
    (robot, (service, sim)), *others = running.profile.robots.items()
    stopped = running.sightline("stop", robot)
    assert stopped.returncode == 0, stopped.stderr
    assert until(lambda: running.speeds(sim)[-1] == (0.0, 0.0), 2)
    assert "STOPPED" not in [running.state(other) for other, _ in others]
    if running.profile.name == DEFAULT:
        running.compose("restart", service)  # a STOP outlives its container
    assert until(lambda: running.state(robot) == "STOPPED", 20)
    for request in ("reset", "arm"):
        granted = running.sightline(request, robot)
        assert granted.returncode == 0, granted.stderr
    assert running.drives(robot)


def test_a_driving_robot_ends_within_two_seconds_with_zero_sent(running):
    for service, sim in running.profile.robots.values():
        assert until(lambda: max(map(abs, running.speeds(sim)[-1])) > 1.0, 20)  # noqa: B023
        container = running.container(service)
        started_s = time.monotonic()
        assert ask("docker", "stop", "--time", "4", container).returncode == 0
        assert time.monotonic() - started_s < 2.0
        assert running.speeds(sim)[-1] == (0.0, 0.0)
        assert ask("docker", "inspect", "-f", "{{.State.ExitCode}}", container).stdout.strip() == "0"
