"""The shadow: it sees what the driving detector sees, is compared with it and never steers."""

import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from sightline.protocol.errors import ConfigError
from sightline.protocol.log import faults
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame, Detection, DetectionResult, Maker, result_of
from sightline.vision_side.detect.shadow import REPORT_EVERY_US, Agreement, ShadowDetector, disagreement
from sightline.vision_side.missions.registry import configured_mission
from tests.fixtures.links import until
from tests.fixtures.vision.detector import BALL, Bench


def result(t_us: int, *boxes: tuple[float, float, float, float], name: str = "hsv") -> DetectionResult:
    found = tuple(Detection(*box, 0.9, "ball") for box in boxes)
    return DetectionResult("r1", "0000abcd", 1, t_us, 320, 240, found, name)


def anything(_label: str) -> bool:
    return True


HERE, NEAR, AWAY = (10, 10, 50, 50), (14, 8, 52, 50), (200, 10, 240, 50)


@pytest.mark.parametrize(
    ("mine", "other", "words"),
    [((), (), ""), ((HERE,), (NEAR,), ""), ((HERE,), (NEAR, AWAY), ""), ((HERE,), (AWAY, NEAR), "ball at (220, 30)"),
     ((HERE,), (), "onnx nothing"), ((), (HERE,), "hsv nothing")],
)
def test_shadow_compares_only_followable_detections(mine: tuple, other: tuple, words: str) -> None:
    what = disagreement(result(1, *mine), result(1, *other, name="onnx"), anything)
    assert words in what if words else not what


MISSIONS = {
    "follow": VisionConfig(), "cup": VisionConfig.model_validate({"target": {"label": "cup"}}),
    "legs": VisionConfig.model_validate({"mission": {"kind": "legs"}}),
    "whatever": VisionConfig.model_validate({"mission": {"kind": "legs", "options": {"label": ""}}}),
    "band": VisionConfig.model_validate({"mission": {"kind": "band"}}),
}  # fmt: skip


@pytest.mark.parametrize(("mission", "mine", "boxes", "agree"), [
    ("follow", "target", (("light-red", AWAY), ("ball", NEAR)), True), ("follow", "ball", (("legs", NEAR),), False),
    ("cup", "cup", (("ball", AWAY), ("cup", NEAR)), True), ("cup", "cup", (("ball", NEAR),), False),
    ("cup", "cup", (("target", NEAR),), True),
    ("legs", "legs", (("ball", NEAR),), False), ("legs", "legs", (("ball", AWAY), ("legs", NEAR)), True),
    ("legs", "legs", (("legs", AWAY),), False), ("whatever", "legs", (("ball", AWAY),), False),
    ("band", "ball", (("light-red", NEAR),), True),
])  # fmt: skip
def test_detections_outside_the_mission_do_not_disagree(mission: str, mine: str, boxes: tuple, agree: bool) -> None:
    goes_by = configured_mission(MISSIONS[mission]).goes_by
    found = tuple(Detection(*box, 0.9, label) for label, box in boxes)
    driving = replace(result(1), detections=(Detection(*HERE, 0.9, mine),))
    assert (disagreement(driving, replace(result(1), detections=found), goes_by) == "") is agree


def test_shadow_ignores_detections_outside_the_mission() -> None:
    legs = replace(result(1), detections=(Detection(*NEAR, 0.9, "legs"),))
    assert disagreement(result(1), legs, configured_mission(VisionConfig()).goes_by) == ""


def test_disagreement_is_logged_at_a_limited_rate() -> None:
    agreement, lines = Agreement(), []
    for index in range(600):  # 20 s
        other = () if index % 2 else (HERE,)
        lines.append(agreement.add(result(index * 33_333, HERE), result(index * 33_333, *other, name="onnx"), anything))
    told = [line for line in lines if line]
    assert len(told) == 1 + 600 * 33_333 // REPORT_EVERY_US
    assert "50%" in told[-1]
    assert (agreement.compared, agreement.differed, agreement.share) == (600, 300, 0.5)


class Eye:
    """Sees one box, always, and counts; `gate` holds it up."""

    def __init__(self, x: float, name: str) -> None:
        self.x, self.name, self.seen = x, name, []
        self.gate = threading.Event()
        self.gate.set()
        self.answers = True

    def detect(self, frames, deadline_us):
        assert self.gate.wait(10)
        self.seen += [(one.robot, one.header.seq) for one in frames]
        box = Detection(self.x, 10, self.x + 40, 50, 0.9, "target")
        return [result_of(one, (box,), Maker(self.name, "", "cpu"), 5) if self.answers else None for one in frames]


def frame(seq: int, robot: str = "r1") -> DetectFrame:
    header = FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333)
    return DetectFrame(robot, header, BALL, Decoder(320, 240, 10**7))


@pytest.fixture
def pair():
    driving, shadow = Eye(10, "one"), Eye(200, "two")
    both = ShadowDetector(driving, shadow, "two", 10**7)
    yield driving, shadow, both
    shadow.gate.set()
    both.close()


def names(results) -> list[str]:
    return [one.detector if one else "" for one in results]


def test_the_shadow_sees_the_frames_and_never_answers_them(pair) -> None:
    _, shadow, both = pair
    for seq in range(1, 6):
        assert names(both.detect([frame(seq)], NO_DEADLINE)) == ["one"]
        assert until(lambda seq=seq: ("r1", seq) in shadow.seen)
    assert until(lambda: both.shadow_text("r1") == "shadow 0% agree")
    assert any("two" in line and "one" in line for line in both.notices())


def test_a_shadow_that_hangs_delays_nothing_and_then_sees_the_newest(pair) -> None:
    _, shadow, both = pair
    shadow.gate.clear()
    for seq in range(1, 50):
        assert names(both.detect([frame(seq)], NO_DEADLINE)) == ["one"]
    shadow.gate.set()
    assert until(lambda: ("r1", 49) in shadow.seen)
    assert len(shadow.seen) <= 2


def test_shadow_compares_by_the_mission_of_the_frame_and_counts_again_with_another(pair) -> None:
    _, _, both = pair
    both.detect([frame(1)], NO_DEADLINE)
    assert until(lambda: both.shadow_text("r1") == "shadow 0% agree")
    for_legs = frame(2)
    for_legs.goes_by = configured_mission(MISSIONS["legs"]).goes_by
    both.detect([for_legs], NO_DEADLINE)
    assert until(lambda: both.shadow_text("r1") == "shadow 100% agree"), "neither sees legs"


def test_shadow_receives_what_the_mission_expects(pair, monkeypatch) -> None:
    _, shadow, both = pair
    received = []
    monkeypatch.setattr(shadow, "detect", lambda frames, _deadline_us: received.extend(frames) or [None])
    driving = frame(1)
    driving.goes_by, driving.expected_px = configured_mission(MISSIONS["legs"]).goes_by, (12.0, 34.0)
    both.detect([driving], NO_DEADLINE)
    assert until(lambda: received)
    assert (received[0].goes_by, received[0].expected_px) == (driving.goes_by, driving.expected_px)


def test_shadow_and_detector_are_closed_if_one_close_fails(pair) -> None:
    driving, shadow, both = pair
    closed = []
    driving.close, shadow.close = lambda: 1 / 0, lambda: closed.append("two")
    with pytest.raises(ConfigError, match=r"close\(\) raises"):
        both.close()
    driving.close = lambda: None
    assert closed == ["two"]


@pytest.mark.parametrize("detect", [None, lambda *_: sys.exit(7)])  # calling None raises
def test_shadow_that_raises_is_reported_and_continues(pair, detect) -> None:
    _, shadow, both = pair
    shadow.detect, good = detect, shadow.detect
    both.detect([frame(1)], NO_DEADLINE)
    assert until(lambda: any("failed" in line for line in both.notices())) and faults()["detector"] == 1
    shadow.detect = good
    both.detect([frame(2)], NO_DEADLINE)
    assert until(lambda: ("r1", 2) in shadow.seen)


def test_the_configuration_builds_it() -> None:
    bench = Bench(VisionConfig(detector=DetectorConfig(kind="hsv", shadow="adaptive")))
    try:
        for _ in range(8):
            bench.frame()
        assert until(lambda: "% agree" in bench.service._detector.shadow_text("r1") or bench.frame())
    finally:
        bench.service._detector.close()


def test_gray_images_agree_on_nothing() -> None:
    assert disagreement(result(1), result(1, name="onnx"), anything) == ""
    assert np.isfinite(Agreement().share)
