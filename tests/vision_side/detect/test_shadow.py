"""The shadow: it sees what the driving detector sees, never steers, and takes over when it is told to."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.color.detectors import Hsv
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
def test_what_counts_is_what_would_be_steered_by(mine: tuple, other: tuple, words: str) -> None:
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
def test_what_the_mission_does_not_go_by_is_no_disagreement(mission: str, mine: str, boxes: tuple, agree: bool) -> None:
    goes_by = configured_mission(MISSIONS[mission]).goes_by
    found = tuple(Detection(*box, 0.9, label) for label, box in boxes)
    driving = replace(result(1), detections=(Detection(*HERE, 0.9, mine),))
    assert (disagreement(driving, replace(result(1), detections=found), goes_by) == "") is agree


def test_what_a_mission_does_not_go_by_counts_as_nothing() -> None:
    legs = replace(result(1), detections=(Detection(*NEAR, 0.9, "legs"),))
    assert disagreement(result(1), legs, configured_mission(VisionConfig()).goes_by) == ""


def test_disagreement_is_told_now_and_then_only() -> None:
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
    assert any("two" in line and "one" in line for line in both.news())


def test_a_shadow_that_hangs_delays_nothing_and_then_sees_the_newest(pair) -> None:
    _, shadow, both = pair
    shadow.gate.clear()
    for seq in range(1, 50):
        assert names(both.detect([frame(seq)], NO_DEADLINE)) == ["one"]
    shadow.gate.set()
    assert until(lambda: ("r1", 49) in shadow.seen)
    assert len(shadow.seen) <= 2


def test_it_takes_over_when_told_for_that_robot_only_and_gives_back(pair) -> None:
    _, _, both = pair
    assert "no frame" in both.promote("r1", True)
    both.detect([frame(1), frame(1, "r2")], NO_DEADLINE)
    assert until(lambda: both.promote("r1", True) == "")
    assert names(both.detect([frame(2, "r2"), frame(2), frame(3, "r2")], NO_DEADLINE)) == ["one", "two", "one"]
    assert "promoted" in both.shadow_text("r1") and "promoted" not in both.shadow_text("r2")
    assert both.promote("r1", False) == ""
    assert names(both.detect([frame(3)], NO_DEADLINE)) == ["one"]


def test_who_drives_a_robot_of_a_fleet_looks_on_at_none_which_it_would_keep_waiting(pair) -> None:
    driving, shadow, both = pair
    both.detect([frame(1), frame(1, "r2")], NO_DEADLINE)
    assert until(lambda: both.promote("r1", True) == "" and len(shadow.seen) == 2)
    driving.seen.clear(), shadow.seen.clear()
    for seq in range(2, 20):
        assert names(both.detect([frame(seq), frame(seq, "r2")], NO_DEADLINE)) == ["two", "one"]
    time.sleep(0.1)
    assert {robot for robot, _ in driving.seen} == {"r2"} and {robot for robot, _ in shadow.seen} == {"r1"}
    assert both.promote("r2", True) == "", "it answers, as it drives the other"
    both.detect([frame(20), frame(20, "r2")], NO_DEADLINE)
    assert until(lambda: {"r1", "r2"} == {robot for robot, _ in driving.seen}), "now the other one looks on at both"


def test_no_robot_waits_for_looks_at_others_once_both_drive(pair) -> None:
    """Those that waited are left out; only the look that is under way is waited for."""
    _, shadow, both = pair
    fleet = [f"r{number}" for number in range(8)]
    both.detect([frame(1, robot) for robot in fleet], NO_DEADLINE)
    assert until(lambda: len(shadow.seen) == 8)
    shadow.gate.clear()
    both.detect([frame(2, robot) for robot in fleet], NO_DEADLINE)
    assert both.promote("r0", True) == ""
    both.detect([frame(3, robot) for robot in fleet[1:]], NO_DEADLINE)
    shadow.gate.set()
    assert names(both.detect([frame(3, "r0")], NO_DEADLINE)) == ["two"]
    time.sleep(0.1)
    assert [seq for _, seq in shadow.seen[8:]] in ([2, 3], [3])
    assert both.shadow_text("r0") == "promoted; shadow looks on at none"
    assert both.shadow_text("r1") == "shadow looks on at none"


def test_in_a_large_fleet_the_last_look_at_a_robot_counts_however_long_ago(pair, monkeypatch) -> None:
    _, shadow, both = pair
    for robot in ("r1", "r2"):
        both.detect([frame(1, robot)], NO_DEADLINE)
        assert until(lambda robot=robot: (robot, 1) in shadow.seen)
    shadow.answers = False
    both.detect([frame(2, "r2")], NO_DEADLINE)
    assert until(lambda: ("r2", 2) in shadow.seen)
    shadow.answers, now_us = True, monotonic_us() + 2_900_000
    monkeypatch.setattr("sightline.vision_side.detect.shadow.monotonic_us", lambda: now_us)
    both.detect([frame(2, "r3")], NO_DEADLINE)
    assert until(lambda: ("r3", 2) in shadow.seen)
    now_us += 2_900_000
    assert until(lambda: both.promote("r1", True) == "")
    assert "does not answer" in both.promote("r2", True)
    now_us += 200_000
    assert "does not answer" in both.promote("r3", True)


def test_who_fails_on_a_robots_frames_is_not_promoted_for_it(pair) -> None:
    _, shadow, both = pair
    both.detect([frame(1)], NO_DEADLINE)
    assert until(lambda: shadow.seen == [("r1", 1)])
    look = shadow.detect
    shadow.detect = lambda frames, until_us: look(frames, until_us) if frames[0].robot == "r2" else 1 / 0
    both.detect([frame(2)], NO_DEADLINE)
    assert until(lambda: any("failed" in line for line in both.news()))
    both.detect([frame(2, "r2")], NO_DEADLINE)
    assert until(lambda: both.promote("r2", True) == "")
    assert both.promote("r2", False) == "" and "does not answer" in both.promote("r1", True)


def test_both_are_closed_whichever_fails_to(pair) -> None:
    driving, shadow, both = pair
    closed = []
    driving.close, shadow.close = lambda: 1 / 0, lambda: closed.append("two")
    with pytest.raises(ConfigError, match=r"close\(\) raises"):
        both.close()
    driving.close = lambda: None
    assert closed == ["two"]


def test_who_does_not_answer_is_not_promoted(pair) -> None:
    _, shadow, both = pair
    shadow.answers = False
    both.detect([frame(1)], NO_DEADLINE)
    assert until(lambda: shadow.seen == [("r1", 1)])
    assert "does not answer" in both.promote("r1", True)
    assert names(both.detect([frame(2)], NO_DEADLINE)) == ["one"]


def test_a_shadow_can_be_promoted_when_the_driving_one_fell_silent(pair) -> None:
    driving, _, both = pair
    driving.answers = False
    assert both.detect([frame(1)], NO_DEADLINE) == [None]
    assert until(lambda: both.promote("r1", True) == "")
    assert names(both.detect([frame(2)], NO_DEADLINE)) == ["two"]


def test_a_shadow_that_raises_is_told_and_goes_on(pair) -> None:
    _, shadow, both = pair
    shadow.detect, good = None, shadow.detect  # calling None raises
    both.detect([frame(1)], NO_DEADLINE)
    assert until(lambda: any("failed" in line for line in both.news()))
    shadow.detect = good
    both.detect([frame(2)], NO_DEADLINE)
    assert until(lambda: ("r1", 2) in shadow.seen)


def test_a_person_promotes_it_live_and_the_report_says_who_looks() -> None:
    eyes = ShadowDetector(Hsv(Hsv.Config()), Eye(200, "two"), "two", 10**7)
    bench = Bench(VisionConfig(), eyes)
    try:
        bench.frame()
        bench.frame()
        report = bench.report()
        assert (report.detector.split(",")[0], report.device) == ("hsv", "cpu")
        assert until(lambda: eyes.shadow_text("r1") == "shadow 0% agree")
        report = bench.ask(1, shadow=True)
        assert report.refused == "" and report.detector.startswith("two, promoted; shadow")
        assert report.inference_us == 5 and report.mission == "follow"
        assert "alone" in bench.ask(2, shadow=1.5).refused
        assert bench.ask(3, shadow=False).detector.startswith("hsv")
    finally:
        eyes.close()


def test_without_a_shadow_there_is_nobody_to_promote() -> None:
    bench = Bench(VisionConfig())
    bench.frame()
    assert "--shadow" in bench.ask(1, shadow=True).refused


def test_the_configuration_builds_it() -> None:
    bench = Bench(VisionConfig(detector=DetectorConfig(kind="hsv", shadow="adaptive")))
    try:
        for _ in range(8):
            bench.frame()
        assert until(lambda: "% agree" in bench.service._detector.shadow_text("r1") or bench.frame())
    finally:
        bench.service._detector.close()


def test_grey_pictures_agree_on_nothing() -> None:
    assert disagreement(result(1), result(1, name="onnx"), anything) == ""
    assert np.isfinite(Agreement().share)
