"""`hsv`, and the learned detector with a color set, report once a color range that marks the floor."""

import numpy as np
import pytest

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame
from sightline.vision_side.detect.registry import build_detector
from tests.fixtures.vision.vision import camera, jpeg_of, scene

MODEL = camera()
GRAY, YELLOW = (140, 140, 140), (30, 180, 200)


def room(yellow_share: float) -> bytes:
    """An image whose lower part is yellow."""
    picture = np.full((240, 320, 3), GRAY, np.uint8)
    picture[240 - round(240 * yellow_share) :] = YELLOW
    return jpeg_of(picture)


RANGE = {"hsv": {"ranges": [{"hue_low_deg": 30, "hue_high_deg": 68}]}}


def notices_after(images: list[bytes], kind: str) -> list[str]:
    detector = build_detector(kind, {}, VisionConfig.model_validate(RANGE))
    detector.notices()  # of the device
    decoder = Decoder(320, 240, 320 * 240)
    for seq, jpeg in enumerate(images):
        header = FrameHeader(session="0000abcd", seq=seq, t_us=seq)
        detector.detect([DetectFrame("r1", header, jpeg, decoder)], NO_DEADLINE)
    return detector.notices() + detector.notices()


@pytest.mark.parametrize("kind", ["hsv", "onnx"])
@pytest.mark.parametrize("share", [0.3, 0.6, 1.0])
def test_a_range_that_marks_the_floor_is_reported_once_with_the_fix(share: float, kind: str) -> None:
    (line,) = notices_after([room(share)] * 40, kind)
    assert f"marks {share:.0%} of the image" in line and "pick-color" in line and "\n" not in line


@pytest.mark.parametrize("kind", ["hsv", "onnx"])
@pytest.mark.parametrize("images", [
    [room(0.0)] * 40,
    [room(0.2)] * 40,
    [room(0.6)] * 14 + [room(0.0)] * 90,
    [room(0.0)] * 90 + [room(0.6)] * 60,  # a target that has come near
    [jpeg_of(scene(MODEL, 0.4, 0.0))] * 40,  # a ball of 0.1 m radius, 0.4 m ahead
    [b"not a picture"] * 40,
])
def test_a_target_and_a_room_of_other_colors_are_not_reported(images: list[bytes], kind: str) -> None:
    assert notices_after(images, kind) == []


def test_a_color_of_the_floor_does_not_count_from_the_first_image_on() -> None:
    detector = build_detector("onnx", {"second_look": False, "refine": []}, VisionConfig.model_validate(RANGE))
    detector.notices()  # of the device
    decoder = Decoder(320, 240, 320 * 240)
    answer = {"boxes": np.array([(40.0, 150.0, 100.0, 210.0)], np.float32), "scores": np.array([0.4], np.float32),
              "labels": np.array([0], np.float32)}
    detector._engine.run = lambda _pixels: answer

    def found(jpeg: bytes) -> int:
        frame = DetectFrame("r1", FrameHeader(session="0000abcd", seq=1, t_us=1), jpeg, decoder)
        (result,) = detector.detect([frame], NO_DEADLINE)
        return len(result.detections)

    ball = np.full((240, 320, 3), GRAY, np.uint8)
    ball[150:210, 40:100] = YELLOW
    assert found(jpeg_of(ball)) == 1
    assert [found(room(0.6)) for _ in range(20)] == [0] * 20
    assert len(detector.notices()) == 1 and found(jpeg_of(ball)) == 0
