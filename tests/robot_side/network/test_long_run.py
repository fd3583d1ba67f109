"""Ten simulated minutes of the closed loop over a bad link, in virtual time: the robot's own logic, an ideal vision."""

import math

import pytest

from sightline.protocol.channels import FRAME, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader, State, Twist
from sightline.protocol.text import format_twist
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.ports import Picture, WheelAngles
from sightline.robot_side.safety.limits import STOP_TIME_BOUND_US, SafetyConfig

pytestmark = pytest.mark.computes

TICK_US, FRAME_US = 20_000, 33_333
OUTAGE_S = 2


class LongRun:
    """Wheels follow at once; vision turns towards the origin from the pose in the frame's header."""

    def __init__(self, seed: int, outage_from_s: int):
        self.outage_us = outage_from_s * 1_000_000, (outage_from_s + OUTAGE_S) * 1_000_000
        config = RobotConfig(safety=SafetyConfig(auto_arm=True), range_sensor=PluginChoice(kind="none"))
        self.network = MemoryNetwork(seed, delay_us=40_000, jitter_us=60_000, loss=0.1)
        self.driving = DriverCore(config, "0000aaaa")
        self.sending = NetworkCore(config.stream, "0000aaaa", 0, config.max_frame_bytes)
        self.robot, self.vision = self.network.link("r1"), self.network.link("r1", "vision")
        self.robot.subscribe(TWIST, self._on_twist)
        self.vision.subscribe(FRAME, self._on_frame)
        self.now_us = self.answers = 0
        self.angles = [0.0, 0.0]
        self.speeds = (0.0, 0.0)
        self.trace = []
        self.accepted_us = 0
        self.oldest_motion_us = 0

    def _cut(self) -> bool:
        return self.outage_us[0] <= self.now_us < self.outage_us[1]

    def _on_twist(self, message: Message) -> None:
        before = self.driving.gate.accepted
        ack = None if self._cut() else self.driving.on_twist(message, self.network.now_us)
        if ack is not None:
            self.sending.on_command_ack(ack, self.network.now_us)
        if self.driving.gate.accepted > before:
            self.accepted_us = self.network.now_us

    def _on_frame(self, message: Message) -> None:
        if self._cut():
            return
        header = decode(FrameHeader, message.header)
        x, y, yaw = header.pose
        bearing = math.remainder(math.atan2(2.0 - y, -x) - yaw, math.tau)
        twist = Twist(linear_mps=0.4, angular_rad_s=max(-2.0, min(2.0, 1.5 * bearing)))
        echo = Echo.of(header)
        answer = AnswerHeader(source="vision", session="0000bbbb", seq=self.answers, echo=echo)
        self.answers += 1
        self.vision.publish(TWIST, encode(answer), format_twist(twist))

    def run(self, seconds: float) -> "LongRun":
        """Advance tick by tick; frames are captured on the tick after they are due."""
        frame_due_us = 0
        while self.now_us < seconds * 1e6:
            self.now_us += TICK_US
            self.network.advance(self.now_us)
            if self.now_us >= frame_due_us and self.sending.may_capture(self.now_us, listening=True):
                frame_due_us += FRAME_US
                header, message = self.sending.on_camera(Picture(b"jpeg", self.now_us), self.now_us)
                self.driving.on_issued(header.seq, header.t_us, 0)
                self.robot.publish(message.channel, message.header, message.payload)
            self._tick()
        return self

    def _tick(self) -> None:
        self.angles = [angle + speed * TICK_US / 1e6 for angle, speed in zip(self.angles, self.speeds, strict=True)]
        self.speeds = self.driving.tick(self.now_us, WheelAngles(*self.angles, self.now_us), None)
        self.sending.motion = self.driving.motion()
        if self.now_us - self.accepted_us > STOP_TIME_BOUND_US:
            assert self.speeds == (0.0, 0.0), f"still moving at {self.now_us} us"
        self.trace.append((self.speeds, self.driving.gate.state))


@pytest.mark.parametrize("seconds", [120, pytest.param(600, marks=pytest.mark.slow)])
def test_minutes_over_a_bad_link_drive_stop_in_the_outage_and_repeat_identically(seconds):
    run = LongRun(11, seconds // 2).run(seconds)
    moving = [speeds != (0.0, 0.0) for speeds, _ in run.trace]
    assert sum(moving) / len(moving) > 0.9, "the link is bad, not gone"
    outage = [state for _, state in run.trace[run.outage_us[0] // TICK_US + 40 : run.outage_us[1] // TICK_US]]
    assert set(outage) == {State.HOLD}
    assert run.trace[-1][1] in (State.ACTIVE, State.DEGRADED)
    assert min(run.network.dropped["FROM_ROBOT"], run.network.dropped["TO_ROBOT"]) > seconds
    again = LongRun(11, seconds // 2).run(seconds)
    assert again.trace == run.trace
    assert LongRun(12, seconds // 2).run(30).trace != run.trace[: 30 * 50]
