"""Requests that are repeated, in virtual time: what a repeat cites, when it leaves, and when the operator gives up."""

import threading
from types import SimpleNamespace

import pytest

from sightline.operator_side.client import requests
from sightline.operator_side.client.requests import Operator
from sightline.protocol.channels import REPLY, REQUEST, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, Echo, Request, RequestHeader, State, Verb
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore

ROBOT, VISION = "0000000a", "0000000b"
TICK_US = 10_000


class VirtualRobot:
    """A robot and the link to it, with one virtual clock: time passes only while the operator waits."""

    robot = "r1"

    def __init__(self):
        config = RobotConfig(drive=PluginChoice(kind="log"), camera=PluginChoice(kind="folder"))
        self.driving = DriverCore(config, ROBOT)
        self.handlers, self.sent = {}, []
        self.now_us = 1_000_000
        self.drives = self.publishes = True
        self.lost_requests = 0
        """So many of the next requests do not arrive."""
        self.on_sent = lambda count: None
        """Runs after each request of the operator, with their count."""
        self._seq = 0

    def subscribe(self, channel, handler):
        self.handlers[channel] = handler

    def publish(self, channel, header, payload, source):
        message = Message(channel, source, header, payload)
        assert channel is REQUEST and source == "operator"
        self.sent.append((self.now_us, decode(RequestHeader, header), decode(Request, payload)))
        if self.lost_requests:
            self.lost_requests -= 1
        else:
            self.driving.on_request(message, self.now_us)
        self.on_sent(len(self.sent))

    def turn(self):
        """Let one tick pass: a command of vision, the gate, what the robot publishes."""
        self.now_us += TICK_US
        if self.drives:
            self._answer()
        self.driving.tick(self.now_us, None, None)
        self.deliver()

    def deliver(self):
        """Deliver what the robot publishes now."""
        for message in self.driving.messages(self.now_us):
            if self.publishes and message.channel in (STATUS, REPLY):
                self.handlers[message.channel](message)

    def _answer(self):
        self._seq += 1
        self.driving.on_issued(self._seq, self.now_us, 0)
        echo = Echo(channel="frame", session=ROBOT, seq=self._seq, t_us=self.now_us)
        header = AnswerHeader(source="vision", session=VISION, seq=self._seq, echo=echo)
        self.driving.on_twist(Message(TWIST, "vision", encode(header), b"0.1|0"), self.now_us)

    def cited(self):
        """List the status that each request cited, as (verb, seq)."""
        return [(request.verb, header.echo and header.echo.seq) for _, header, request in self.sent]


class VirtualCondition(threading.Condition):
    """Waits in the virtual time of a robot."""

    def __init__(self, robot):
        super().__init__()
        self._robot = robot

    def wait_for(self, predicate, timeout=None):
        until_us = self._robot.now_us + round(timeout * 1e6)
        while not predicate() and self._robot.now_us < until_us:
            self._robot.turn()
        return predicate()


@pytest.fixture
def robot(monkeypatch):
    made = VirtualRobot()
    monkeypatch.setattr(requests, "time", SimpleNamespace(monotonic=lambda: made.now_us / 1e6))
    return made


@pytest.fixture
def operator(robot):
    made = Operator(robot)
    made._changed = VirtualCondition(robot)
    for _ in range(20):
        robot.turn()
    return made


def test_disarm_between_two_repeats_of_arm_wins(robot, operator):
    """The repeat cites the status that the operator saw, which precedes the disarm; a newer one would arm."""

    def disarm(count):
        if count == 1:
            robot.driving.gate.disarm("disarmed by another operator")

    robot.lost_requests, robot.on_sent = 1, disarm
    reply = operator.request(Verb.ARM)
    assert len(robot.sent) == 2, "the first was lost"
    assert (reply.ok, reply.detail.partition(":")[0]) == (False, "STALE")
    assert robot.driving.gate.state is State.DISARMED
