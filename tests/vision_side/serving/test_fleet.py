"""One vision for several robots: a pipeline each, fair turns, newest frames only; over real Zenoh sessions."""

import threading
import time
from contextlib import ExitStack
from itertools import pairwise

import pytest

from sightline.protocol.channels import ACK, FRAME, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import AnswerHeader, FrameHeader, Stamp, State, Status
from sightline.protocol.transports.link import LatestSlot
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.protocol.transports.zenoh import link as zenoh_link
from sightline.protocol.transports.zenoh.link import open_fleet, open_zenoh
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.serving.fleet import Fleet
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import JPEG


class Robot:
    """A robot that publishes its status, sends frames at the pace of the test, and records the answered frames."""

    def __init__(self, name, endpoint):
        self.link = open_zenoh(name, connect=[endpoint], role="robot")
        self.answered = []
        self.sent = 0
        self._session = f"{abs(hash(name)) % 2**32:08x}"
        for channel in (TWIST, ACK):
            self.link.subscribe(channel, self._answer)

    def _answer(self, message):
        self.answered.append(decode(AnswerHeader, message.header).echo.seq)

    def say(self):
        stamp = Stamp(session=self._session, seq=self.sent, t_us=1000 + self.sent)
        self.link.publish(STATUS, encode(stamp), encode(Status(state=State.HOLD, reason="test")))

    def frame(self):
        header = FrameHeader(session=self._session, seq=self.sent, t_us=1000 + self.sent)
        self.link.publish(FRAME, encode(header), JPEG)
        self.sent += 1


@pytest.fixture
def fleet():
    """A vision service for `r*` that listens, its endpoint, and all lines that it printed."""
    endpoint, said, ending = free_endpoint(), [], threading.Event()
    config = VisionConfig(robot="r*", listen=(endpoint,), connect=())
    with open_fleet("r*", listen=[endpoint], role="vision") as site:
        running = Fleet(config, site, said.append)
        thread = threading.Thread(target=running.serve, args=(ending,), daemon=True)
        thread.start()
        yield running, endpoint, said
        ending.set()
        thread.join(5)
        assert not thread.is_alive()


def test_every_robot_that_fits_is_answered_and_no_other(fleet):
    _, endpoint, said = fleet
    with ExitStack() as ending:
        robots = {name: Robot(name, endpoint) for name in ("r1", "r2", "rex", "x1")}
        for robot in robots.values():
            ending.enter_context(robot.link)

        def all_answered():
            for robot in robots.values():
                robot.say()
                robot.frame()
            time.sleep(0.03)
            return all(len(robots[name].answered) >= 5 for name in ("r1", "r2", "rex"))

        assert until(all_answered, 10)
        assert robots["x1"].answered == []
        for robot in robots.values():
            assert robot.answered == sorted(set(robot.answered)), "newest only, each once"
    assert any(line.startswith("vision: rex: frames from robot rex") for line in said)


def test_a_robot_that_floods_takes_no_turn_from_another(fleet):
    running, endpoint, _ = fleet
    with Robot("r1", endpoint).link, ExitStack() as ending:
        loud, quiet = Robot("rloud", endpoint), Robot("rquiet", endpoint)
        for robot in (loud, quiet):
            ending.enter_context(robot.link)
        assert until(lambda: [loud.say(), quiet.say(), time.sleep(0.02)] and len(running.services) >= 2, 10)
        assert until(lambda: quiet.link.has_listener(FRAME) and loud.link.has_listener(FRAME), 5)
        for _ in range(60):
            quiet.frame()
            assert until(lambda: [loud.frame() for _ in range(5)] and quiet.answered[-1:] == [quiet.sent - 1])
        assert len(loud.answered) < loud.sent


class _Memory(MemoryNetwork):
    """A site of two robots without real time."""

    def robots(self):
        return ["rloud", "rquiet"]

    def on_new_robot(self, callback):
        pass

    def link(self, robot, role="vision"):
        return super().link(robot, role=role)


def test_each_turn_answers_one_frame_of_every_robot():
    site = _Memory(seed=1)
    fleet = Fleet(VisionConfig(robot="r*"), site, lambda line: None)
    while len(fleet.services) < 2:  # on a busy machine a turn adds one
        fleet.turn()
    robots = {name: site.link(name, "robot") for name in site.robots()}
    for turn in range(1, 20):
        for name, count in (("rloud", 5), ("rquiet", 1)):
            for number in range(count):
                seq = turn * 10 + number
                header = FrameHeader(session="0000abcd", seq=seq, t_us=seq)
                robots[name].publish(FRAME, encode(header), JPEG)
                site.advance(site.now_us + 1)
        fleet.turn()
        assert [fleet.services[name].answered for name in site.robots()] == [turn, turn]


class _NoRobots:
    """A site without robots until `arrive`."""

    def __init__(self):
        self._names = []

    def robots(self):
        return self._names

    def on_new_robot(self, callback):
        pass

    def link(self, robot):
        return _Silent(robot)


class _Silent:
    def __init__(self, robot):
        self.robot = robot

    def subscribe(self, channel, callback):
        pass

    def latest(self, channel):
        return LatestSlot()

    def publish(self, *message):
        pass

    def close(self):
        pass


def test_a_robot_may_come_later():
    site = _NoRobots()
    fleet = Fleet(VisionConfig(robot="r*"), site, lambda line: None)
    fleet.turn()
    assert fleet.services == {}
    site.robots().append("r7")
    fleet.turn()
    assert list(fleet.services) == ["r7"]


def test_a_crowd_that_comes_keeps_no_robot_waiting(monkeypatch):
    """Each turn adds some, and the next turn follows at once."""
    site = _NoRobots()
    fleet = Fleet(VisionConfig(robot="r*"), site, lambda line: None)
    site.robots().append("r0")
    fleet.turn()
    turns = []
    monkeypatch.setattr(fleet.services["r0"], "turn", lambda wait_s: turns.append(len(fleet.services)))
    monkeypatch.setattr(_Silent, "subscribe", lambda *_: time.sleep(0.004))
    site.robots().extend(f"r{number}" for number in range(1, 31))
    while len(fleet.services) < 31:
        fleet.turn()
        assert len(fleet.services) == 31 or fleet._bell.is_set()
    added = [after - before for before, after in zip([1, *turns], turns, strict=False)]
    assert max(added) <= 5, "r0 had its turn after a few others"
    assert min(added) >= 1


def test_a_crowd_that_leaves_keeps_no_robot_waiting(monkeypatch):
    site = _NoRobots()
    fleet = Fleet(VisionConfig(robot="r*"), site, lambda line: None)
    site.robots().extend(f"r{number}" for number in range(31))
    while len(fleet.services) < 31:
        fleet.turn()
    turns = [31]
    monkeypatch.setattr(fleet.services["r0"], "turn", lambda wait_s: turns.append(len(fleet.services)))
    monkeypatch.setattr(_Silent, "close", lambda _link: time.sleep(0.004))
    del site.robots()[1:]
    while len(fleet.services) > 1:
        fleet._bell.clear()
        fleet.turn()
        assert len(fleet.services) == 1 or fleet._bell.is_set()
    dropped = [before - after for before, after in pairwise(turns)]
    assert 1 <= min(dropped) <= max(dropped) <= 5, "r0 had its turn after a few others"


def test_several_robots_need_zenoh():
    with pytest.raises(ConfigError, match="need Zenoh"):
        open_fleet("r*", connect=["ws://127.0.0.1:9090"])


def test_a_silent_robot_is_forgotten_and_found_again(fleet, monkeypatch):
    monkeypatch.setattr(zenoh_link, "LEFT_AFTER_S", 0.5)
    running, endpoint, said = fleet
    with ExitStack() as ending:
        robots = {name: Robot(name, endpoint) for name in ("r1", "r2")}
        for robot in robots.values():
            ending.enter_context(robot.link)

        def all_say(*names):
            for name in names:
                robots[name].say()
            time.sleep(0.02)
            return set(running.services)

        assert until(lambda: all_say("r1", "r2") == {"r1", "r2"}, 10)
        assert until(lambda: all_say("r1") == {"r1"}, 5) and "vision: r2: left" in said
        assert until(lambda: all_say("r1", "r2") == {"r1", "r2"}, 10)
        assert until(lambda: [robots["r2"].frame(), all_say("r1", "r2")] and robots["r2"].answered, 5)
