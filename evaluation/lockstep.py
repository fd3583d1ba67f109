"""The whole loop in virtual time: the logic of the services, a simulated world, a network in memory. Pure.

No logic is here: robot, driver, stream and vision are the classes of the real processes. Every delay and
loss is drawn from the seed, so a run repeats bit for bit, about twenty times faster than real.
"""

import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from sightline.evaluation.labels import Labels
from sightline.evaluation.scenario_config import robot_config, vision_config
from sightline.evaluation.score.figures import AnsweredFrame, RimSpeeds, RunRecord
from sightline.evaluation.score.sabotage import HEALTHY, SeamDetector, Seams
from sightline.protocol.channels import ACK, FRAME, SCAN, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import FrameHeader, State
from sightline.protocol.text import format_twist
from sightline.protocol.transports.link import LatestSlot, Message
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.ports import Picture
from sightline.robot_side.safety.limits import TICK_US
from sightline.sim.process import PeriodicTimer
from sightline.sim.robot import RobotModel
from sightline.sim.scenario import Scenario
from sightline.sim.world.world import World
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.plugin_calls import close_detector, notices_of
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.missions.ranges import decode_scan
from sightline.vision_side.pipeline import SOURCE, Frame, FrameLoss, Pipeline, PipelineAnswer, answer_header

COMPUTE_US = 4_000
"""Virtual compute time of one frame: one step of the world, more than it takes in reality."""
_SAMPLE_US = 20_000
_ROBOT_SESSION, _VISION_SESSION = "00000001", "00000002"


@dataclass(frozen=True, slots=True)
class Conditions:
    """Network conditions: total added latency (half on each leg), total jitter, loss on each leg."""

    latency_ms: float = 0.0
    loss: float = 0.0
    jitter_ms: float = 0.0


@dataclass(slots=True)
class Run(RunRecord):
    """The result of a run."""

    twists: list[bytes] = field(default_factory=list)
    """Every twist of the vision service, in order."""
    states: set[State] = field(default_factory=set)
    news: list[str] = field(default_factory=list)
    """Lines of the detector for the operator."""


class Lockstep:
    """One robot, one vision service, one world. `step` advances all by one step of the world."""

    def __init__(
        self,
        world: World,
        robot: RobotConfig,
        vision: VisionConfig,
        conditions: Conditions,
        seed: int,
        *,
        seams: Seams = HEALTHY,
    ) -> None:
        self.world = world
        self._seams = seams
        self.run = Run()
        self.network = MemoryNetwork(
            seed, round(conditions.latency_ms * 1000), round(conditions.jitter_ms * 1000), conditions.loss
        )
        self.driving = DriverCore(robot, _ROBOT_SESSION)
        self._network_core = NetworkCore(robot.stream, _ROBOT_SESSION, 0, robot.max_frame_bytes)
        self._robot_link = self.network.link(robot.robot)
        self._robot_link.subscribe(TWIST, self._on_twist)
        self._robot_link.subscribe(ACK, lambda message: self._network_core.on_ack(message, self._now_us))
        self._vision_link = self.network.link(robot.robot, role=SOURCE)
        self._frames: LatestSlot[Message] = self._vision_link.latest(FRAME)
        self._detector = SeamDetector(configured_detector(vision), seams)
        self._pipeline = Pipeline(vision, world.camera_model, self._detector)
        self._scanned = self._vision_link.latest(SCAN) if self._pipeline.mission.wants_scan else None
        self._labels = Labels(vision.boxes, world.camera_model) if vision.detector.kind == "boxes" else None
        self._computed: deque[tuple[int, list[Message]]] = deque(maxlen=1)
        self._loss = FrameLoss()
        self._answers = 0
        self._compute_us = COMPUTE_US + seams.late_us
        self._camera_tick = 0
        self._frame_interval_us = 1e6 / world.robot.camera.fps
        self._scans = PeriodicTimer(1e6 / world.robot.lidar.rate_hz)
        self._now_us = 0

    def step(self) -> None:
        """Advance the world by one step, then run everything that is due."""
        self.world.step()
        self._now_us = self.world.now_us
        self.network.advance(self._now_us)
        self._see()
        self._film()
        if self._now_us % TICK_US == 0:
            self._tick()
        if self._now_us % _SAMPLE_US == 0:
            self.run.samples.append(self.world.truth())

    def close(self) -> None:
        """Collect the notices of the detector and close it."""
        self.run.news += notices_of(self._detector)
        close_detector(self._detector)

    # --- robot ---------------------------------------------------------------------------------------------------

    def _film(self) -> None:
        """Run the next tick of the camera. It captures an image if the stream wants one."""
        if self._now_us < self._camera_tick * self._frame_interval_us:
            return
        self._camera_tick += 1
        if not self._network_core.may_capture(self._now_us, self._robot_link.has_listener(FRAME)):
            return
        picture = Picture(self._seams.camera(self.world.render()), self._now_us)
        sent = self._network_core.on_camera(picture, self._now_us)
        if sent is not None:
            header, message = sent
            if self._labels is not None:
                self._labels.label(header, self.world.labels())
            self.driving.on_issued(header.seq, header.t_us, zlib.crc32(message.payload))
            self._robot_link.publish(message.channel, message.header, message.payload)

    def _on_twist(self, message: Message) -> None:
        ack = self.driving.on_twist(message, self._now_us)
        if self.run.accepted_us is None and self.driving.gate.accepted:
            self.run.accepted_us = self._now_us
        if ack is not None:
            self._network_core.on_command_ack(ack, self._now_us)
        self._tick()

    def _tick(self) -> None:
        scan = self._seams.scan(self.world.scan()) if self._scans.due(self._now_us) else None
        angles = self._seams.angles(self.world.wheel_angles())
        self._set_wheels(*self.driving.tick(self._now_us, angles, scan))
        self._network_core.motion = self.driving.motion()
        self._publish_scans()
        self.run.states.add(self.driving.gate.state)

    def _set_wheels(self, left_rad_s: float, right_rad_s: float) -> None:
        radius_m = self.world.robot.wheels.radius_m
        command = RimSpeeds(self._now_us, left_rad_s * radius_m, right_rad_s * radius_m)
        if not self.run.wheels or self.run.wheels[-1][1:] != command[1:]:
            self.run.wheels.append(command)
        self.world.set_wheels(*self._seams.wheels(left_rad_s, right_rad_s))

    def _publish_scans(self) -> None:
        """Pass scans to a mission that uses them. It needs no other message of the driver."""
        if self._scanned is None:
            return
        for message in self.driving.messages(self._now_us):
            if message.channel is SCAN:
                self._robot_link.publish(SCAN, message.header, message.payload)

    # --- vision --------------------------------------------------------------------------------------------------

    def _see(self) -> None:
        """Send computed answers, then take the newest frame: one at a time, as the real service does."""
        if self._computed and self._computed[0][0] > self._now_us:
            return
        if self._computed:
            _, messages = self._computed.popleft()
            for message in messages:
                self._vision_link.publish(message.channel, message.header, message.payload)
        taken = self._frames.take()
        if taken is not None:
            self._computed.append((self._now_us + self._compute_us, self._answer(taken)))

    def _answer(self, message: Message) -> list[Message]:
        frame = Frame(decode(FrameHeader, message.header), message.payload)
        scan = self._scanned.take() if self._scanned else None
        if scan is not None:
            self._pipeline.put_scan(*decode_scan(scan.header, scan.payload))
        answer = self._pipeline.step(frame) if self._labels is None else self._follow(self._labels, frame.header)
        self.run.answers.append(AnsweredFrame.of(frame.header.t_us, answer.seen))
        self._loss.update(frame.header, self._frames.dropped)
        if answer.twist is None:
            return [self._message(frame.header, answer, b"")]
        text = format_twist(answer.twist)
        self.run.twists.append(text)
        return [self._message(frame.header, answer, text) for _ in range(self._loss.copies)]

    def _message(self, header: FrameHeader, answer: PipelineAnswer, payload: bytes) -> Message:
        stamp = encode(answer_header(header, _VISION_SESSION, self._answers, self._compute_us, answer))
        self._answers += 1
        return Message(ACK if answer.twist is None else TWIST, SOURCE, stamp, payload)

    def _follow(self, labels: Labels, examined: FrameHeader) -> PipelineAnswer:
        header, found = labels.of(examined)
        camera = self.world.camera_model
        return self._pipeline.follow(header, self._seams.detections(found, (camera.width_px, camera.height_px)))


def run_lockstep(
    scenario: Scenario,
    model: RobotModel,
    seed: int,
    conditions: Conditions,
    seconds: float | None = None,
    *,
    vision: VisionConfig | None = None,
    mission: str | None = None,
    seams: Seams = HEALTHY,
    is_over: Callable[[Run], bool] = lambda _run: False,
) -> Run:
    """Run `scenario` for `seconds` (default: its own length), or until `is_over`, which is called each second.

    `vision` and `mission` replace those of the scenario. `seams` belong to a sabotage.
    """
    vision = vision or vision_config(scenario, model, seed, mission)
    with World(scenario, model, seed) as world:
        lockstep = Lockstep(world, robot_config(model, auto_arm=True), vision, conditions, seed, seams=seams)
        end_us = round((seconds or scenario.seconds) * 1e6)
        try:
            while world.now_us < end_us:
                lockstep.step()
                if world.now_us % 1_000_000 == 0 and is_over(lockstep.run):
                    break
        finally:
            lockstep.close()
        return lockstep.run
