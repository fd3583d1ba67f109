"""Several robots and one vision service with a remote detector: no robot waits for the answer to another."""

import threading
import time
from contextlib import ExitStack

import pytest

from sightline.protocol.channels import ACK, FRAME, STATUS, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError, WireError
from sightline.protocol.messages import FrameHeader, Stamp, State, Status
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.protocol.transports.zenoh.link import open_fleet, open_zenoh
from sightline.vision_side.config import DetectorConfig, HsvConfig, VisionConfig
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.plugin_calls import close_detector
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.serving import fleet as fleet_module
from sightline.vision_side.serving.detector_service import DetectorService, ServingOptions
from sightline.vision_side.serving.fleet import Fleet
from sightline.vision_side.serving.service import Service
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.vision.remote import BALL_JPEG, MODEL, Server, box, http_reply, said

DEADLINE_S = 0.5
ROBOTS = {"ra1": "00000001", "rb": "00000002", "ra2": "00000003", "ra3": "00000004"}
"""Each one's session."""
MUTE = "rb"
"""The robot whose frames get no answer."""


class Robot:
    """Sends a ball's picture, and counts the twists and the acknowledgements that it gets."""

    def __init__(self, name, endpoint):
        self.session, self.link = ROBOTS[name], open_zenoh(name, connect=[endpoint], role="robot")
        self.sent, self.heard = 0, {TWIST: 0, ACK: 0}
        for channel in (TWIST, ACK):
            self.link.subscribe(channel, lambda _, channel=channel: self._count(channel))

    def _count(self, channel):
        self.heard[channel] += 1

    def show(self):
        self.sent += 1
        stamp = {"session": self.session, "seq": self.sent, "t_us": self.sent * 40_000}
        self.link.publish(STATUS, encode(Stamp(**stamp)), encode(Status(state=State.HOLD, reason="test")))
        self.link.publish(FRAME, encode(FrameHeader(**stamp)), BALL_JPEG)


def _all_show(robots, seconds=0.0):
    """Once, or for so long; the share of each robot's frames that it was sent a twist for."""
    before = {name: (robot.sent, robot.heard[TWIST]) for name, robot in robots.items()}
    for _ in range(max(1, round(seconds / 0.04))):
        for robot in robots.values():
            robot.show()
        time.sleep(0.04)
    return {name: (robots[name].heard[TWIST] - steered) / (robots[name].sent - sent)
            for name, (sent, steered) in before.items()}


def _by_http(ending, endpoint):
    """Start a server, and return its address for the vision service."""
    over = threading.Event()
    ending.callback(over.set)

    def answer(request):
        if f"x-sightline-session: {ROBOTS[MUTE]}" not in request[0].lower():
            return http_reply(said(box()))
        over.wait(10)
        return None

    server = ending.enter_context(Server(answer))
    return f"http+jpeg://127.0.0.1:{server.port}/"


def _by_zenoh(ending, endpoint):
    """A detector service for the others."""
    site = ending.enter_context(open_fleet("ra*", connect=[endpoint], role="detector"))
    service = DetectorService(site, Hsv(Hsv.Config(hsv=HsvConfig())), ServingOptions("hsv"), lambda line: None)
    _served(ending, service)
    return "zenoh"


def _served(ending, service):
    """Until the end."""
    over = threading.Event()
    thread = threading.Thread(target=service.serve, args=(over,), daemon=True)
    thread.start()
    ending.callback(thread.join, 5)
    ending.callback(over.set)


@pytest.fixture
def shown():
    """The robots after 3 s with a vision service and the given detector, and each robot's share of twists."""
    with ExitStack() as ending:

        def show(eyes, fallback):
            endpoint = free_endpoint()
            site = ending.enter_context(open_fleet("r*", listen=[endpoint], role="vision"))
            detector = DetectorConfig(kind=eyes(ending, endpoint), fallback=fallback, deadline_s=DEADLINE_S)
            config = VisionConfig(robot="r*", camera=MODEL, detector=detector)
            first = configured_detector(config)
            ending.callback(close_detector, first)
            _served(ending, Fleet(config, site, lambda line: None, first))
            robots = {name: Robot(name, endpoint) for name in ROBOTS}
            for robot in robots.values():
                ending.enter_context(robot.link)
            assert until(lambda: _all_show(robots) and all(sum(one.heard.values()) for one in robots.values()), 10)
            return robots, _all_show(robots, 3.0)

        yield show


@pytest.mark.waits
@pytest.mark.parametrize("eyes", [_by_http, _by_zenoh])
def test_unanswered_robot_does_not_delay_others(shown, eyes):
    robots, shares = shown(eyes, "")
    mute = robots[MUTE].heard
    assert mute[TWIST] == 0 and mute[ACK] >= 3, "a frame without an answer is acknowledged without a twist"
    assert shares.pop(MUTE) == 0 and min(shares.values()) > 0.7, shares


@pytest.mark.waits
@pytest.mark.parametrize("eyes", [_by_http, _by_zenoh])
def test_with_a_fallback_every_robot_is_steered(shown, eyes):
    _, shares = shown(eyes, "hsv")
    assert min(shares.values()) > 0.7, shares


class Quiet:
    """A site with robots that send nothing."""

    def __init__(self, count):
        self._robots = [f"r{number}" for number in range(count)]

    def robots(self):
        return self._robots

    def on_new_robot(self, callback):
        pass

    def link(self, robot):
        return MemoryNetwork().link(robot, role="vision")


def broken_turns(monkeypatch, robot):
    """Let each turn of one robot's service raise while the returned event is set."""
    turn, is_broken = Service.turn, threading.Event()

    def fail(service, wait_s):
        if is_broken.is_set() and service.counts().robot == robot:
            raise RuntimeError("out of luck")
        turn(service, wait_s)

    monkeypatch.setattr(Service, "turn", fail)
    is_broken.set()
    return is_broken


@pytest.mark.parametrize("kind", ["zenoh", "hsv"])
def test_an_error_in_one_robots_service_ends_it_alone_and_a_new_one_starts(monkeypatch, kind, caplog):
    monkeypatch.setattr(fleet_module, "_FIRST_PAUSE_S", 0.02)
    is_broken, said, over = broken_turns(monkeypatch, "r1"), [], threading.Event()
    fleet = Fleet(VisionConfig(robot="r*", detector=DetectorConfig(kind=kind)), Quiet(2), said.append)
    thread = threading.Thread(target=fleet.serve, args=(over,), daemon=True)
    thread.start()

    def restarts():
        return {one.robot: one.restarts for one in fleet.counts()}

    assert until(lambda: fleet._restarts["r1"] >= 2)
    other = fleet.services["r0"]
    is_broken.clear()
    assert until(lambda: restarts().get("r1", 0) >= 2) and restarts()["r0"] == 0
    over.set()
    thread.join(5)
    assert not thread.is_alive() and fleet.services["r0"] is other
    assert "vision: r1: its service failed; a new one starts in 0 s" in said
    assert caplog.text.count("RuntimeError: out of luck") == 2, "the line and its traceback, once"


def test_a_detector_that_does_not_open_for_one_more_robot_costs_that_robot_alone(monkeypatch):
    opened = []

    def opens(config):
        if config.robot == "r1":
            raise ConfigError("no memory left on this GPU")
        opened.append(config.robot)
        return Hanging(config)

    monkeypatch.setattr(fleet_module, "configured_detector", opens)
    said = []
    fleet = Fleet(VisionConfig(robot="r*", detector=DetectorConfig(kind="zenoh")), Quiet(3), said.append)
    while len(fleet.services) < 2:  # on a busy machine a turn adds one
        fleet.turn()
    assert set(fleet.services) == {"r0", "r2"} and opened == ["r*", "r2"]
    assert said == ["vision: r1: its service failed; a new one starts in 1 s"]
    fleet._end()


@pytest.mark.parametrize("error", [RuntimeError("a"), WireError("MALFORMED", "b"), OSError("c")])
def test_a_service_that_fails_for_days_is_started_again_each_half_minute(monkeypatch, error):
    def fail(_service, _wait_s):
        raise error

    monkeypatch.setattr(Service, "turn", fail)
    said = []
    fleet = Fleet(VisionConfig(robot="r*"), Quiet(1), said.append)
    fleet._restarts["r0"] = 5_000
    fleet.turn()
    assert said == ["vision: r0: its service failed; a new one starts in 30 s"] and fleet.services == {}
    fleet.turn()
    assert fleet.services == {}, "not before"


def test_an_invalid_configuration_ends_the_vision_service(monkeypatch):
    def refuse(*_given):
        raise ConfigError("no such label")

    monkeypatch.setattr(fleet_module, "open_service", refuse)
    fleet = Fleet(VisionConfig(robot="r*"), Quiet(1), lambda line: None)
    with pytest.raises(ConfigError, match="no such label"):
        fleet.turn()


def test_a_robot_that_left_is_dropped_and_served_again_when_it_comes_back():
    site, said = Quiet(2), []
    fleet = Fleet(VisionConfig(robot="r*"), site, said.append)
    while len(fleet.services) < 2:  # on a busy machine a turn adds one
        fleet.turn()
    first = fleet.services["r1"]
    site.robots().remove("r1")
    fleet.turn()
    assert list(fleet.services) == ["r0"] and said[-1] == "vision: r1: left"
    site.robots().append("r1")
    fleet.turn()
    assert fleet.services["r1"] is not first


class Hanging:
    """A remote detector that closes slowly."""

    Config = Config
    waits = True

    def __init__(self, config):
        pass

    def detect(self, frames, deadline_us):
        return [None for _ in frames]

    def close(self):
        time.sleep(1.0)


def test_detectors_that_hang_at_the_end_hang_in_parallel():
    kind, over = f"{__name__}:Hanging", threading.Event()
    fleet = Fleet(VisionConfig(robot="r*", detector=DetectorConfig(kind=kind)), Quiet(8), lambda line: None)
    thread = threading.Thread(target=fleet.serve, args=(over,), daemon=True)
    thread.start()
    assert until(lambda: len(fleet.services) == 8)
    over.set()
    thread.join(3)
    assert not thread.is_alive(), "seven of them, one after the other, take 7 s"
