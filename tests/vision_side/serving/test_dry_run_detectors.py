"""`vision --dry-run` prints the notices of its detector from the start on, for example an unexpected device."""

from dataclasses import dataclass

from sightline.protocol.clock import monotonic_us
from sightline.protocol.config import Config as Settings
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.detect.port import Maker, result_of
from sightline.vision_side.serving.dry_run import AckingService, LocalRun
from tests.fixtures.vision.detector import BALL, MODEL
from tests.fixtures.vision.detector import Bench as DrivingBench

STARTS, GONE = "m.onnx runs on cpu: no GPU runtime is installed", "detector far: no answer: LATE"


class Talking:
    """A detector that reports its device at first, and then a missing answer with each frame."""

    class Config(Settings):
        """None."""

    def __init__(self, config):
        self.lines = [STARTS]

    def detect(self, frames, deadline_us):
        self.lines.append(GONE)
        return [result_of(one, (), Maker("talking")) for one in frames]

    def notices(self):
        lines, self.lines = self.lines, []
        return lines


CONFIG = VisionConfig(camera=MODEL, detector=DetectorConfig(kind=f"{__name__}:Talking"))


class DryBench(DrivingBench):
    """A `DrivingBench` with a vision service that drives nothing."""

    def __init__(self, config):
        super().__init__(config, Talking(None))
        self.service = AckingService(config, self.network.link("r1", role="vision"), self.said.append)


def test_dry_run_detects_in_the_images_of_a_robot():
    said = []
    AckingService(CONFIG, MemoryNetwork(seed=3).link("r1", role="vision"), said.append)
    assert f"vision: detector: {STARTS}" in said, "before any frame"
    bench = DryBench(CONFIG)
    bench.said.clear()
    bench.frame()
    assert f"vision: detector: {GONE}" in bench.said


@dataclass(frozen=True)
class Capture:
    """A picture."""

    jpeg: bytes
    t_us: int


class Camera:
    """One of this machine."""

    model = MODEL
    t_us = 0

    def read(self, timeout_s):
        self.t_us += 33_333
        return Capture(BALL, self.t_us)


def test_a_detector_has_as_long_as_when_it_drives():
    watching = LocalRun(CONFIG, Camera(), lambda _line: None)
    heard, step = [], watching._pipeline.step
    watching._pipeline.step = lambda frame: heard.append(frame.deadline_us) or step(frame)
    before_us = monotonic_us()
    watching.turn()
    patience_us = CONFIG.detector.deadline_s * 1e6
    assert before_us + patience_us <= heard[0] <= monotonic_us() + patience_us


def test_dry_run_detects_in_the_images_of_a_local_camera():
    said = []
    watching = LocalRun(CONFIG, Camera(), said.append)
    assert said == [f"vision: detector: {STARTS}"]
    watching.turn()
    assert f"vision: detector: {GONE}" in said
