"""Detectors that are told what they see, and a robot, a person and a vision over a link in memory."""

from collections.abc import Sequence

from sightline.protocol.channels import ACK, CAMERA, FRAME, MISSION, REPORT, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import Echo, FrameHeader, RequestHeader, Stamp
from sightline.protocol.mission_messages import MissionReport, MissionRequest
from sightline.protocol.transports.memory import MemoryNetwork
from tests.vision_rig import camera, jpeg_of, scene
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Maker, result_of
from sightline.vision_side.service import Service

MODEL = camera()
BALL = jpeg_of(scene(MODEL, 1.0, 0.2))


def box(x: float, y: float = 50.0, size: float = 40.0, label: str = "ball", score: float = 0.9) -> Detection:
    return Detection(x, y, x + size, y + size, score, label)


class Told:
    """A detector that is told what it sees; None is no answer."""

    def __init__(self, *answers: Sequence[Detection] | None) -> None:
        self.answers = list(answers)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        told = [self.answers.pop(0) for _ in frames]
        return [None if one is None else result_of(frame, one, Maker("told"))
                for frame, one in zip(frames, told, strict=True)]


class Bench:
    """A robot, a person and a vision with a shadow, over a link in memory."""

    def __init__(self, config: VisionConfig, eyes=None) -> None:
        self.network = MemoryNetwork(seed=2)
        self.robot, self.person = self.network.link("r1"), self.network.link("r1", role="operator")
        self.reports, self.said, self.seq = [], [], 0
        self.twists, self.acks = self.robot.latest(TWIST), self.robot.latest(ACK)
        self.person.subscribe(REPORT, self.reports.append)
        self.service = Service(config, self.network.link("r1", role="vision"), self.said.append, eyes)
        self.robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=1, t_us=0)), encode(MODEL))
        self.turn()

    def turn(self) -> None:
        self.network.advance(self.network.now_us + 33_333)
        self.service.turn(0.0)
        self.network.advance(self.network.now_us + 1)

    def frame(self, jpeg: bytes = BALL) -> None:
        self.seq += 1
        header = FrameHeader(session="0000abcd", seq=self.seq, t_us=self.seq * 33_333)
        self.robot.publish(FRAME, encode(header), jpeg)
        self.turn()

    def ask(self, number: int, **options) -> MissionReport:
        cited = Echo(channel="status", session="0000abcd", seq=4, t_us=self.seq * 33_333)
        header = RequestHeader(source="operator", session="0000feed", seq=number, echo=cited)
        request = MissionRequest(id=number, name="detector", options=options)
        self.person.publish(MISSION, encode(header), encode(request), "operator")
        self.frame()
        return self.report()

    def report(self) -> MissionReport:
        self.service._dispatch._reporter._said_s = -1e9
        self.frame()
        return decode(MissionReport, self.reports[-1].payload, REPORT.max_payload_bytes)
