"""The detector service over a link in memory: its messages, drops and counts for every answer of the detector."""

from dataclasses import replace

import pytest

from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import Detections, FrameHeader
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.filters import LabelFilter
from sightline.vision_side.detect.port import Circle, Detection, Maker, result_of
from sightline.vision_side.serving.detector_service import DetectorService, ServingOptions
from tests.fixtures.vision.remote import BALL_JPEG

HSV = Hsv(Hsv.Config(hsv=HsvConfig()))
GOOD = Detection(10.0, 10.0, 50.0, 50.0, 0.9, "ball")
LONGEST = Detection(10.123456789012345, 11.123456789012345, 312.1234567890123, 232.1234567890123, 0.12345678901234567,
                    "\N{LARGE YELLOW CIRCLE}" * 64, Circle(-1.2345678901234567, 120.12345678901235, 1.2345678901234567),
                    track_id=2**53 - 1)


class Named:
    """A detector that returns the detections in `found` or raises its exception, and returns `notices` once."""

    def __init__(self, *found, **changes):
        self.found, self.changes, self.lines = found, changes, []

    def detect(self, frames, deadline_us):
        if self.found and isinstance(self.found[0], Exception):
            raise self.found[0]
        return [replace(result_of(one, self.found, Maker("named", device="cpu")), **self.changes) for one in frames]

    def notices(self):
        lines, self.lines = self.lines, []
        return lines


class Bench:
    """A robot, and the service that looks at its frames."""

    def __init__(self, detector, **serving):
        self.network, self.words, self.seq, self.present = MemoryNetwork(seed=31), [], 0, ["r1"]
        self.robot = self.network.link("r1")
        self.heard = self.robot.latest(DETECTIONS)
        self.service = DetectorService(self, detector, ServingOptions("named", **serving), self.words.append)

    def robots(self):
        return self.present

    def on_new_robot(self, callback):
        self.ring = callback

    def link(self, robot):
        return self.network.link(robot, role="detector")

    def look(self, jpeg=BALL_JPEG):
        """Return the service's answer to one more frame; None without an answer."""
        self.service.turn()
        self.seq += 1
        self.robot.publish(FRAME, encode(FrameHeader(session="0000abcd", seq=self.seq, t_us=self.seq)), jpeg)
        self.network.advance(self.network.now_us + 1)
        self.service.turn()
        self.network.advance(self.network.now_us + 1)
        message = self.heard.take()
        return message and decode(Detections, message.payload, DETECTIONS.max_payload_bytes)

    def tally(self):
        return self.service.counters()["r1"]


def test_rejected_request_adds_no_load_and_each_reason_is_logged_once():
    named = Named(GOOD)
    bench = Bench(named)
    assert bench.look() is not None
    named.found = (ValueError("out of memory"),)
    for _ in range(30):
        assert bench.look() is None
    named.found, named.changes = (GOOD,), {"device": "d" * 100}
    for _ in range(30):
        assert bench.look() is None
    told = [line for line in bench.words if "receives the frames" not in line]
    assert len(told) == 2 and "out of memory" in told[0] and "cannot be sent" in told[1]
    bench.service._check_load(1e9)
    assert bench.tally().rejected == 60 and "overloaded" not in bench.service.about() and len(bench.words) == 3


def test_a_robot_that_left_is_forgotten_and_its_frames_stay_in_the_totals():
    bench = Bench(Named(GOOD))
    assert bench.look() is not None
    bench.service._check_load(1e9)
    bench.present = []
    assert bench.look() is None
    assert bench.service.counters() == {} and bench.words[-1] == "detector: r1 left"
    bench.service._check_load(2e9)
    assert "0 robots, 1 frames answered, 0 dropped" in bench.service.about() and "overload" not in bench.service.about()
    bench.present = ["r1"]
    assert bench.look() is not None and bench.tally().served == 1
    assert "1 robots, 2 frames answered" in bench.service.about()


def test_number_of_logged_reasons_is_bounded():
    named = Named()
    bench = Bench(named)
    for number in range(100):
        named.found = (ValueError(f"failure {number}"),)
        bench.look()
    assert 4 < len(bench.words) < 20


def test_an_answer_that_is_too_long_for_the_wire_loses_its_last_boxes_and_ends_nothing():
    bench = Bench(Named(*[LONGEST] * 64))
    said = bench.look()
    assert said is not None and 50 < len(said.boxes) < 64 and said.boxes[0].label == LONGEST.label
    assert bench.look() is not None and bench.tally().served == 2


@pytest.mark.parametrize(("detector", "why"), [
    (Named(replace(GOOD, label="")), "label"), (Named(replace(GOOD, label="a\x1b[2J")), "label"),
    (Named(replace(GOOD, label="\ud800")), "label"), (Named(replace(GOOD, circle=Circle(1.0, 1.0, 0.0))), "radius"),
    (Named(replace(GOOD, track_id=-1)), "track"), (Named(GOOD, detector="d" * 65), "detector"),
    (Named(GOOD, device="d" * 33), "device"), (Named(GOOD, model_hash="h" * 65), "model"),
    (Named(*[GOOD] * 65), "65 boxes"), (Named(RuntimeError("out of memory")), "out of memory"),
])
def test_value_beyond_the_wire_is_counted_and_logged_once(detector, why):
    bench = Bench(detector)
    assert bench.look() is None and bench.look() is None
    assert (bench.tally().rejected, bench.tally().served) == (2, 0)
    (line,) = [one for one in bench.words if "receives the frames" not in one]
    assert why in line and line.startswith("detector: ") and "\n" not in line


def test_notices_of_the_detector_are_logged_at_the_start_and_on_change():
    detector = Named(GOOD)
    detector.lines = ["m.onnx runs on cpu: no GPU runtime is installed"]
    bench = Bench(LabelFilter(detector, ("ball",)))
    bench.service.turn()
    assert bench.words[0] == "detector: m.onnx runs on cpu: no GPU runtime is installed"
    detector.lines = ["no answer: LATE"]
    bench.look()
    assert "detector: no answer: LATE" in bench.words


def test_model_and_device_are_known_before_the_first_frame():
    known = Named()
    known.maker = Maker("named", "0123456789abcdef", "cuda")
    assert Bench(LabelFilter(known, ("ball",))).service.about().startswith("named 01234567 on cuda: ")
    assert Bench(Named()).service.about().startswith("named: ")
    assert Bench(HSV).service.about().startswith("named on cpu: ")


class Late:
    """Gives no answer, or one, after the deadline."""

    def __init__(self, answers):
        self.answers = answers

    def detect(self, frames, deadline_us):
        while monotonic_us() <= deadline_us:
            pass
        return [result_of(one, (), Maker("late")) if self.answers else None for one in frames]


@pytest.mark.parametrize("answers", [True, False])
def test_answer_after_the_deadline_is_late_and_not_rejected(answers):
    bench = Bench(Late(answers), deadline_us=5_000)
    assert bench.look() is None
    assert (bench.tally().late, bench.tally().rejected) == (1, 0)
