"""The model `onnx:nanodet`: a human in a photograph, and none in a forest."""

from pathlib import Path

import pytest

from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import DetectorConfig, TargetConfig, VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.onnx.detector import NANODET
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame, Detection, Detector, corners, overlap
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.pipeline import Frame, Pipeline
from tests.fixtures.vision.vision import camera

pytestmark = [
    pytest.mark.usefixtures("no_gpu"),
    pytest.mark.skipif(not NANODET.is_file(), reason="no shipped model; run the tests in a whole clone"),
]
ROOT = Path(__file__).parents[4]
PERSON = (ROOT / "tests/fixtures/vision/astronaut.jpg").read_bytes()
"""The astronaut Eileen Collins, 320x240. NASA, public domain."""
FOREST = (ROOT / "evaluation/score/photographs/gkj-phalzer_forest_01-v01.jpg").read_bytes()


@pytest.fixture(scope="module")
def nanodet() -> Detector:
    detector = DetectorConfig(kind="onnx:nanodet", device="cpu", labels=("person",))
    return configured_detector(VisionConfig(detector=detector, target=TargetConfig(label="person")))


def found_in(detector: Detector, jpeg: bytes) -> tuple[Detection, ...]:
    size = read_jpeg_size(jpeg, 10**7)
    header = FrameHeader(session="0000abcd", seq=1, t_us=1)
    decoder = Decoder(size.width_px, size.height_px, 10**7)
    (result,) = detector.detect([DetectFrame("r1", header, jpeg, decoder)], NO_DEADLINE)
    assert result is not None
    return result.detections


def test_person_in_a_photograph_has_the_golden_box(nanodet: Detector) -> None:
    (one,) = found_in(nanodet, PERSON)
    assert one.label == "person" and one.score == pytest.approx(0.68, abs=0.04)
    assert overlap(corners(one), (12, 8, 221, 234)) > 0.95


def test_mission_turns_to_a_human_on_the_left(nanodet: Detector) -> None:
    follow = Pipeline(VisionConfig(target=TargetConfig(label="person")), camera(), nanodet)
    for seq in range(1, 4):
        answer = follow.step(Frame(FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333), PERSON))
    assert answer.seen.phase == "tracking" and answer.seen.target.label == "person"
    assert answer.seen.bearing_rad > 0 and answer.twist.angular_rad_s > 0


def test_photograph_without_people_has_no_person(nanodet: Detector) -> None:
    assert found_in(nanodet, FOREST) == ()
