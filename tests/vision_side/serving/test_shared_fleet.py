"""Vision services that share robots over real Zenoh sessions; the robots have their real gate."""

import json
import resource
import subprocess
import sys
import threading
from contextlib import ExitStack, closing, contextmanager

import pytest

from sightline.benchmarks.loop.pictures import write_pictures
from sightline.benchmarks.network import gated_robots
from sightline.benchmarks.network.gated_robots import GatedRobot
from sightline.benchmarks.network.robots import Settings, play
from sightline.evaluation.processes import SIGHTLINE
from sightline.protocol.channels import FRAME
from sightline.protocol.clock import monotonic_us
from sightline.protocol.transports.zenoh.link import ZenohFleet, open_fleet, open_zenoh
from sightline.protocol.transports.zenoh.presence import PresenceAnnouncer
from sightline.protocol.transports.zenoh.session import open_session
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.vision_side.config import DetectorConfig, ShareConfig, VisionConfig
from sightline.vision_side.serving import fleet as fleet_module
from sightline.vision_side.serving import sharing
from sightline.vision_side.serving.assignment import assign
from sightline.vision_side.serving.fleet import SharedFleet
from sightline.vision_side.serving.service import Service
from tests.fixtures.commands import service as running
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint

pytestmark = pytest.mark.waits


class Vision:
    """A service that shares, in a thread of this process."""

    def __init__(self, name, endpoint, **settings):
        self.name, self.lines = name, []
        self.link = open_fleet("r*", connect=[endpoint], role="vision", by_status=False)
        config = VisionConfig(robot="r*", connect=(endpoint,), share=ShareConfig(enabled=True, name=name), **settings)
        self.fleet, self._ending = SharedFleet(config, self.link, self.lines.append), threading.Event()
        self._thread = threading.Thread(target=self.fleet.serve, args=(self._ending,), daemon=True)
        self._thread.start()

    @property
    def driving(self):
        return {robot for robot, service in self.fleet.services.copy().items() if not service.is_standby}

    def end(self):
        self._ending.set()
        self._thread.join(5)
        assert not self._thread.is_alive()
        self.link.close()

    def die(self):
        """Lose all tokens at once, as a killed process does."""
        self.link.close()
        self._ending.set()


@contextmanager
def router_at(endpoint):
    """A router in a process of its own. A test may kill it: one that ends in order first ends the tokens."""
    code = f"from {open_session.__module__} import *; one = open_session([{endpoint!r}], (), 5.0); print(1); input()"
    with subprocess.Popen([sys.executable, "-Pc", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.read(1)
        yield process
        process.kill()


@pytest.fixture
def router(request):
    """The endpoint of a router in this process, or with the parameter True in one of its own, and that process."""
    endpoint = free_endpoint()
    if getattr(request, "param", False):
        with router_at(endpoint) as process:
            yield endpoint, process
    else:
        with closing(open_session([endpoint], (), 5.0)):
            yield endpoint, None


@pytest.fixture
def site(tmp_path, router):
    """Four robots and two services at a router."""
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    write_pictures(pictures, 160, 120)
    (endpoint, process), ending = router, threading.Event()
    settings = Settings(endpoint=endpoint, robots=4, fps=15, pictures=pictures, notes=tmp_path / "notes", seed=1)
    with ExitStack() as open_links:
        visions = [Vision(name, endpoint) for name in ("a", "b")]
        links = [open_links.enter_context(open_zenoh(f"r{number}", connect=[endpoint], role="robot"))
                 for number in range(1, 5)]
        robots = [GatedRobot(link.robot, link, settings, monotonic_us()) for link in links]
        playing = threading.Thread(target=play, args=(robots, ending), daemon=True)
        playing.start()
        assert until(lambda: all(len(robot.accepted) > 10 for robot in robots), 10)
        assert until(lambda: visions[0].driving | visions[1].driving == {robot.name for robot in robots})
        yield robots, visions, endpoint, process
        for vision in visions:
            if vision._thread.is_alive():
                vision.end()
        ending.set()
        playing.join(5)


def drives_on(robots, since_us):
    """Return True when each robot has accepted five commands since then."""
    return until(lambda: all(sum(at_us > since_us for at_us, _, _ in robot.accepted) >= 5 for robot in robots), 5)


def stood(robots, since_us):
    """Return the times without motion that began since then."""
    return [hold for robot in robots for hold in robot.holds if hold[0] > since_us]


def withdrawn(robots, since_us):
    """Return the times without motion that began since then although the last accepted command was still in force."""
    limits = SafetyConfig()
    return [(robot.name, hold) for robot in robots for hold in robot.holds if hold[0] > since_us and any(
        hold[0] - at_us < limits.silence_ms * 1000 and hold[0] - capture_us < limits.max_age_us
        for at_us, _, capture_us in robot.accepted if at_us <= hold[0])]


def test_services_share_the_robots_and_each_frame_goes_to_one(site):
    robots, (first, second), *_ = site
    assert not first.driving & second.driving
    since_us = monotonic_us()
    sent = sum(len(robot.record["sent_us"]) for robot in robots)
    assert drives_on(robots, since_us)
    sent = sum(len(robot.record["sent_us"]) for robot in robots) - sent
    answered = sum(service.answered for one in (first, second) for service in one.fleet.services.values())
    accepted = sum(at_us > since_us for robot in robots for at_us, _, _ in robot.accepted)
    assert sent - 2 * len(robots) <= accepted <= sent + len(robots), (accepted, sent)
    assert answered <= sum(len(robot.record["sent_us"]) for robot in robots), "no frame goes to two services"


@pytest.mark.parametrize("how", ["die", "end"])
def test_no_command_is_withdrawn_when_a_service_dies_or_ends(site, how):
    robots, (first, second), *_ = site
    since_us = monotonic_us()
    getattr(first, how)()
    assert until(lambda: second.driving == {robot.name for robot in robots})
    assert drives_on(robots, monotonic_us())
    assert withdrawn(robots, since_us) == []


def test_a_service_that_comes_takes_robots_and_withdraws_no_command(site):
    robots, visions, endpoint, _ = site
    since_us = monotonic_us()
    visions.append(Vision("c", endpoint))
    mine = {robot for robot, (owner, _) in assign([one.name for one in robots], dict.fromkeys("abc", 1.0)).items()
            if owner == "c"}
    assert mine and until(lambda: visions[2].driving == mine)
    assert drives_on(robots, monotonic_us())
    assert sum(len(vision.driving) for vision in visions) == len(robots)
    assert withdrawn(robots, since_us) == []


@pytest.mark.slow
def test_200_robots_at_one_router_are_all_served_and_none_is_forgotten(tmp_path):
    """At 5 fps, each with its session. Two cores are too slow for young commands of all, so answers count."""
    write_pictures(tmp_path, 160, 120)
    endpoint, notes, (soft, hard) = free_endpoint(), tmp_path / "notes", resource.getrlimit(resource.RLIMIT_NOFILE)
    settings = Settings(endpoint=endpoint, robots=200, fps=5, pictures=tmp_path, notes=notes, seed=1)
    router = [*SIGHTLINE, "router", "--listen", endpoint]
    robots = [sys.executable, "-P", "-m", gated_robots.__name__, settings.model_dump_json()]
    with ExitStack() as at_end:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        at_end.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        at_end.enter_context(running(router, " on ", tmp_path, START_S))
        vision = Vision("a", endpoint, detector=DetectorConfig(kind="hsv"))
        at_end.callback(vision.end)
        at_end.enter_context(running(robots, "playing 200 robots", tmp_path, 2 * START_S))
        for least in (5, 10):
            assert until(lambda least=least: sum(
                one.answered >= least for one in vision.fleet.services.copy().values()) == 200, 120)
            assert len(vision.driving) == 200
        assert [line for line in vision.lines if "left" in line or "failed" in line] == []
    assert all(one["answers"] >= 5 for one in json.loads(notes.read_text()).values())


def may_claim_again(visions):
    """Return True when each driver that works may be followed by another: none changes more than once a second."""
    return until(lambda: all(monotonic_us() - max(one.changed_us, one.driver_us) >= sharing.SETTLED_US
                             for vision in visions for one in vision.fleet.sharing.robots.copy().values()))


@pytest.mark.alone
def test_no_robot_stands_when_services_come_end_and_die(site):
    robots, visions, endpoint, _ = site
    names = {robot.name for robot in robots}
    since_us = monotonic_us()
    visions.append(Vision("c", endpoint))
    for change in (lambda: None, visions[0].end, visions[1].die):
        assert may_claim_again(visions)
        change()
        assert until(lambda: sum(len(one.driving) for one in visions if one._thread.is_alive()) == len(names))
        assert drives_on(robots, monotonic_us())
    assert stood(robots, since_us) == []


@pytest.mark.slow
def test_the_next_owner_receives_frames_before_the_former_one_leaves_but_not_for_long(site, monkeypatch):
    robots, visions, endpoint, _ = site
    monkeypatch.setattr(Service, "has_request", property(lambda service: not service.is_standby))
    monkeypatch.setattr(sharing, "SILENT_US", 60_000_000)  # on a busy machine a driver may be silent for a moment
    assert until(lambda: all(one.is_busy for vision in visions for name, one in vision.fleet.sharing.robots.items()
                             if name in vision.driving))
    visions.append(Vision("c", endpoint))
    mine = {robot for robot, (owner, _) in assign([one.name for one in robots], dict.fromkeys("abc", 1.0)).items()
            if owner == "c"}
    services, seen = visions[2].fleet.services, set()
    assert until(lambda: seen.update(n for n, one in services.copy().items() if one._ahead.take()) or seen >= mine)
    assert seen == mine
    assert until(lambda: not any(one._is_subscribed for one in services.values()))
    assert not visions[2].driving, visions[2].lines
    assert all(one.answered == 0 for one in services.values())


@pytest.mark.slow
@pytest.mark.parametrize("router", [True], indirect=True)
def test_services_outlive_the_end_of_their_router_and_drive_at_its_return(site):
    robots, visions, endpoint, process = site
    before = [(vision.fleet.services, vision.driving, dict(vision.fleet.services)) for vision in visions]
    digests = {robot.name: robot.accepted[-1][1] for robot in robots}
    process.kill()
    assert until(lambda: not any(vision.link.connected for vision in visions))
    assert until(lambda: not any(robot.core.gate._lease.token for robot in robots)), "each robot ends the lease"
    with router_at(endpoint):
        since_us = monotonic_us()
        assert drives_on(robots, since_us)
        for services, driving, same in before:  # one whose link is back first may drive all robots for a moment
            assert until(lambda of=services, those=driving: {
                robot for robot, one in of.copy().items() if not one.is_standby} == those)
            assert services == same
        assert all(digests[robot.name] != digest for robot in robots for at_us, digest, _ in robot.accepted
                   if at_us > since_us), "a session whose token ended drives no more"


def test_a_robot_that_rejects_the_session_gets_a_new_one(site):
    robots, *_ = site
    robot = robots[0]
    with robot._lock:
        fenced, since_us = robot.accepted[-1][1], monotonic_us()
        robot.core.gate.end_token(robot.core.gate._lease.token, since_us)
    assert drives_on([robot], since_us)
    assert fenced not in {digest for at_us, digest, _ in robot.accepted if at_us > since_us + 100_000}
    assert len({digest for _, digest, _ in robot.accepted}) >= 2


def test_robots_without_a_token_are_reported_once(router, monkeypatch):
    monkeypatch.setattr(fleet_module, "_TOKENS_COME_S", 0.1)
    monkeypatch.setattr(fleet_module, "_LOOKS_EVERY_S", 0.01)
    (endpoint, _), looks = router, []
    find = ZenohFleet.find_robots
    monkeypatch.setattr(ZenohFleet, "find_robots", lambda link: looks.append(find(link)) or looks[-1])
    with ExitStack() as ending:
        ending.enter_context(open_zenoh("r1", connect=[endpoint], role="robot"))
        ending.callback((session := open_session([], [endpoint], 5.0)).close)
        for role, robot in (("robot", "r9"), ("robot", "x1"), ("operator", "r8")):
            PresenceAnnouncer(role, robot, f"{len(looks):07x}{robot[1]}").answer_in(session)
        vision = Vision("a", endpoint)
        ending.callback(vision.end)
        assert until(lambda: sum({"r1", "r9", "x1"} <= one for one in looks) >= 4)
    assert [line for line in vision.lines if "token" in line] == [
        "vision: r9: not shared (no token); update it or pass --robot r9"]


def test_the_standby_has_the_camera_and_no_frames(site):
    robots, visions, *_ = site
    for vision in visions:
        standby = {name: one for name, one in vision.fleet.services.copy().items() if one.is_standby}
        assert standby, "each of two services stands by for the robots of the other"
        assert until(lambda one=standby: all(service._camera is not None for service in one.values()))
        assert all(service.answered == 0 for service in standby.values() if service.sender.twists == 0)
    assert all(robot._link.has_listener(FRAME) for robot in robots)
