"""A `Teleop` at a real gate in virtual time: the robot's own `DriverCore`, 30 fps, optionally a vision service."""

import random

from sightline.operator_side.teleop.control import LEGACY, Speeds, Teleop
from sightline.protocol.channels import ACK, FRAME, REPLY, REQUEST, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader, Request
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore

ROBOT, OPERATOR, VISION = "0000000a", "0000000b", "0000000c"
STEP_US = 2_000
FRAME_US = 33_000
TICK_US = 20_000


class TeleopRig:
    """Time passes in steps of 2 ms; `delay_us` each way, `loss` of each message."""

    def __init__(self, *, vision=False, delay_us=2_000, loss=0.0, seed=1, stopped=False, layout=LEGACY):
        self._config = RobotConfig(drive=PluginChoice(kind="log"), camera=PluginChoice(kind="folder"))
        self.driving = DriverCore(self._config, ROBOT, stopped=stopped)
        self.teleop = Teleop(OPERATOR, Speeds(0.2, 1.0), layout)
        self.vision, self.delay_us, self.loss = vision, delay_us, loss
        self.now_us = 5_000_000
        self.commands, self.requested, self.acked = [], [], 0
        self.connected = True
        self.last_status = None
        self._random = random.Random(seed)
        self._to_robot, self._to_operator = [], []
        self._frame_due_us = self._tick_due_us = self.now_us
        self._frames = self._answers = 0
        self.held, self._repeats = "", []

    # --- the operator's fingers ----------------------------------------------------------------------------------

    def hold(self, key, repeat_us=33_000, delay_us=500_000):
        """Press a key and hold it: the terminal repeats it after its delay."""
        self.held, self._repeat_us, self._repeat_due_us = key, repeat_us, self.now_us + delay_us
        self.tap(key)

    def let_go(self):
        self.held = ""

    def tap(self, key):
        self.teleop.on_keys(key, self.now_us)

    def restart(self, session):
        """Start the robot's service again."""
        self.driving = DriverCore(self._config, session)

    # --- time ----------------------------------------------------------------------------------------------------

    def run(self, seconds):
        """Let that much time pass."""
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.step()

    def until(self, condition, seconds=5.0):
        """Return the milliseconds until it holds; None if it does not."""
        started_us = self.now_us
        while not condition():
            if self.now_us - started_us > seconds * 1e6:
                return None
            self.step()
        return (self.now_us - started_us) / 1000

    def step(self):
        self.now_us += STEP_US
        if self.held and self.now_us >= self._repeat_due_us:
            self._repeat_due_us += self._repeat_us
            self.tap(self.held)
        self._deliver()
        if self.now_us >= self._frame_due_us:
            self._frame()
        if self.now_us >= self._tick_due_us:
            self._tick_due_us += TICK_US
            self.driving.tick(self.now_us, None, None)
            for message in self.driving.messages(self.now_us):
                self._send(self._to_operator, message)
        for message in self.teleop.messages(self.now_us):
            self.send(message)

    def send(self, message):
        """Send one message of the operator to the robot."""
        if message.channel is TWIST:
            self.commands.append((self.now_us, parse_twist(message.payload)))
        elif message.channel is REQUEST:
            self.requested.append(decode(Request, message.payload).verb)
        self.acked += message.channel is ACK
        self._send(self._to_robot, message)

    def _send(self, way, message):
        if self.connected and self._random.random() >= self.loss:
            way.append((self.now_us + self.delay_us, message))

    def _deliver(self):
        while self._to_robot and self._to_robot[0][0] <= self.now_us:
            self._at_robot(self._to_robot.pop(0)[1])
        handlers = {FRAME: self.teleop.on_frame, REPLY: self.teleop.on_reply,
                    STATUS: lambda message: self.teleop.on_status(message, self.now_us)}
        while self._to_operator and self._to_operator[0][0] <= self.now_us:
            message = self._to_operator.pop(0)[1]
            if message.channel is STATUS:
                self.last_status = message
            handlers.get(message.channel, lambda _message: None)(message)

    def _at_robot(self, message):
        if message.channel is TWIST:
            self.driving.on_twist(message, self.now_us)
        elif message.channel is REQUEST:
            self.driving.on_request(message, self.now_us)

    def _frame(self):
        self._frame_due_us += FRAME_US
        self._frames += 1
        self.driving.on_issued(self._frames, self.now_us, 0)
        header = FrameHeader(session=self.driving.session, seq=self._frames, t_us=self.now_us)
        self._send(self._to_operator, Message(FRAME, "", encode(header), b""))
        if self.vision:
            self._answers += 1
            echo = Echo(channel="frame", session=self.driving.session, seq=self._frames, t_us=self.now_us)
            answer = AnswerHeader(source="vision", session=VISION, seq=self._answers, echo=echo)
            self.driving.on_twist(Message(TWIST, "vision", encode(answer), b"0.1|0"), self.now_us)

    # --- the robot -----------------------------------------------------------------------------------------------

    @property
    def state(self):
        return self.driving.gate.state

    @property
    def applied(self):
        return self.driving.gate.applied

    @property
    def holder(self):
        return self.driving.gate.holder(self.now_us)

    def armed(self, key="i"):
        """Drive a little and stand still, as an operator at work."""
        self.run(0.2)
        self.hold(key)
        assert self.until(lambda: self.applied.linear_mps > 0.1) is not None
        self.let_go()
        assert self.until(lambda: self.applied.linear_mps == 0.0) is not None
        self.run(1.1)
        return self


def vision_drives():
    """Return a rig in which an operator handed over to vision."""
    rig = TeleopRig(vision=True).armed()
    rig.tap("\t")
    assert rig.until(lambda: rig.holder.session == VISION and rig.applied.linear_mps > 0.05 if rig.holder else False)
    rig.run(0.5)
    return rig
