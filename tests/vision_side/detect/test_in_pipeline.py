"""Detectors in the pipeline and the service: "saw nothing" searches, "no answer" holds, nonsense is rejected."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sightline.protocol.messages import MAX_DETECTED_BOXES, MAX_INTEGER, FrameHeader
from sightline.vision_side.config import DetectorConfig, TargetConfig, VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.onnx.detector import OnnxDetector
from sightline.vision_side.detect.plugin_calls import checked_results, validated
from sightline.vision_side.detect.port import NO_DEADLINE, Circle, DetectFrame, Maker, result_of
from sightline.vision_side.pipeline import NO_ANSWER, Frame, Pipeline
from tests.fixtures.vision.detector import Bench, Told, box
from tests.fixtures.vision.onnx import brightness_model
from tests.fixtures.vision.vision import camera, jpeg_of, scene

MODEL = camera()
BALL = jpeg_of(scene(MODEL, 1.0, 0.2))
EMPTY = jpeg_of(np.full((240, 320, 3), 140, np.uint8))


def frame(seq: int, jpeg: bytes = BALL) -> Frame:
    return Frame(FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333), jpeg)


def pipeline(detector, **config: object) -> Pipeline:
    return Pipeline(VisionConfig(**config), MODEL, detector)


def test_the_color_detector_is_one_like_any_other() -> None:
    colour = pipeline(Hsv(Hsv.Config()))
    for seq in range(1, 30):
        answer = colour.step(frame(seq, jpeg_of(scene(MODEL, 1.0 + 0.01 * seq, 0.2, seed=seq))))
        assert answer.twist is not None and answer.result is not None
        assert (answer.result.seq, answer.result.detector, answer.mission) == (seq, "hsv", "follow")


def test_empty_result_starts_a_search_and_no_answer_does_not() -> None:
    nothing, silent = pipeline(Told(*[()] * 40)), pipeline(Told(*[None] * 40))
    for seq in range(1, 40):
        answers = nothing.step(frame(seq)), silent.step(frame(seq))
        assert (answers[0].skipped, answers[1].skipped) == ("", NO_ANSWER)
    assert answers[0].twist is not None and answers[0].seen.phase == "searching"
    assert answers[1].twist is None and answers[1].seen.phase == "no answer"


def test_image_of_another_size_in_the_middle_of_a_run_moves_nothing(tmp_path, no_gpu) -> None:
    path = brightness_model(tmp_path / "m.onnx", [[140.0, 100.0, 180.0, 140.0]], [0])
    model = pipeline(OnnxDetector(OnnxDetector.Config(address=str(path), refine=())))
    other = jpeg_of(np.full((480, 640, 3), 140, np.uint8))
    answers = [model.step(frame(seq, other if seq == 3 else EMPTY)) for seq in range(1, 6)]
    assert [one.skipped for one in answers] == ["", "", "MALFORMED", "", ""]
    assert answers[2].twist is None and answers[2].result is None and "640x480" in answers[2].seen.note
    assert all(one.twist is not None and one.seen.phase == "tracking" for one in answers[3:])


def test_mission_continues_after_a_missing_answer() -> None:
    good = [box(140, 100)]
    eyes = pipeline(Told(*[good] * 5, None, None, *[good] * 3))
    phases = [eyes.step(frame(seq)).seen.phase for seq in range(1, 11)]
    assert phases == ["tracking"] * 5 + ["no answer"] * 2 + ["tracking"] * 3


class Strange:
    """A detector whose answer is changed on its way."""

    def __init__(self, change) -> None:
        self.change = change

    def detect(self, frames, deadline_us):
        return self.change(result_of(frames[0], (box(140, 100),), Maker("strange", "", "cpu")))


@pytest.mark.parametrize(
    "change",
    [
        lambda one: [replace(one, seq=99)],
        lambda one: [replace(one, robot="r2")],
        lambda one: [replace(one, session="0000beef")],
        lambda one: [replace(one, width_px=640)],
        lambda one: [replace(one, detections=(box(math.nan),))],
        lambda one: [replace(one, detections=(replace(box(1), score=math.inf),))],
        lambda one: [replace(one, detections=(replace(box(1), score=1.2),))],
        lambda one: [replace(one, detections=(replace(box(1), label="x" * 65),))],
        lambda one: [replace(one, detections=(replace(box(1), label=""),))],
        lambda one: [replace(one, detections=(replace(box(1), label="a\x1b[2J"),))],
        lambda one: [replace(one, detections=(replace(box(1), circle=Circle(9.0, 9.0, 0.0)),))],
        lambda one: [replace(one, detections=(replace(box(1), circle=Circle(math.nan, 9.0, 1.0)),))],
        lambda one: [replace(one, detections=(replace(box(1), track_id=-1),))],
        lambda one: [replace(one, detections=(box(1),) * (MAX_DETECTED_BOXES + 1))],
        lambda one: [replace(one, device=None)], lambda one: [replace(one, model_hash=None)],
        lambda one: [replace(one, detector=7)],
        lambda one: [replace(one, compute_us=None)], lambda one: [replace(one, compute_us=math.nan)],
        lambda one: [], lambda one: [one, one], lambda one: None, lambda one: ["boxes"], lambda one: 1 / 0,
    ],
)  # fmt: skip
def test_invalid_reply_counts_as_no_answer(change) -> None:
    strange = pipeline(Strange(change))
    answer = strange.step(frame(1))
    assert answer.twist is None and answer.seen.phase == "no answer" and answer.seen.note
    assert answer.skipped == NO_ANSWER and answer.result is None


def test_a_plug_in_may_be_called_after_any_file() -> None:
    named = {"detector": "b\u3000ll\udce9.onnx", "device": "\x1b[2J"}
    bench = Bench(VisionConfig(), Strange(lambda one: [replace(one, **named)]))
    bench.frame()
    report = bench.report()
    assert (report.detector, report.device, report.note) == ("b?ll?.onnx", "?[2J", "")


def test_any_error_of_a_plug_in_is_reported() -> None:
    def raises(_one):
        raise OSError("ball\udce9.onnx\x1b[2J is gone")

    bench = Bench(VisionConfig(), Strange(raises))
    bench.frame()
    assert bench.report().note == "invalid answer of the detector: OSError: ball?.onnx?[2J is gone"


@pytest.mark.parametrize(("told_us", "us"), [
    (1234.5, 1234), (np.int64(7), 7), (np.float32(9.0), 9), (2**60, MAX_INTEGER), (-3, 0),
])  # fmt: skip
def test_any_time_of_a_plug_in_is_reported(told_us, us) -> None:
    bench = Bench(VisionConfig(), Strange(lambda one: [replace(one, compute_us=told_us)]))
    bench.frame()
    assert bench.report().inference_us == us


class OfOneOdd:
    """Fails for every batch that holds a certain robot's frame, which a plug-in should not."""

    def detect(self, frames, deadline_us):
        if any(one.robot == "odd" for one in frames):
            raise RuntimeError("an odd picture")
        return [result_of(one, (), Maker("mine", "", "cpu")) for one in frames]


def test_failure_for_one_robot_keeps_the_answers_of_others() -> None:
    decoder = Decoder(320, 240, 10**6)
    frames = [DetectFrame(robot, frame(1).header, BALL, decoder) for robot in ("r1", "odd", "r2")]
    first, odd, second = checked_results(OfOneOdd(), frames, NO_DEADLINE)
    assert (first.robot, second.robot) == ("r1", "r2") and "an odd picture" in odd


def test_remote_detector_is_skipped_after_the_deadline() -> None:
    class Slow(OfOneOdd):
        calls = 0

        def detect(self, frames, deadline_us):
            self.calls += 1
            return super().detect(frames, deadline_us)

    decoder, slow = Decoder(320, 240, 10**6), Slow()
    frames = [DetectFrame(robot, frame(1).header, BALL, decoder) for robot in ("r1", "odd", "r2", "r3")]
    clock = iter([100, 101, 102, 103])
    first, odd, *late = checked_results(slow, frames, 101, lambda: next(clock))
    assert first.robot == "r1" and "an odd picture" in odd and late == [odd, odd] and slow.calls == 3


def test_boxes_beyond_the_image_are_cut_and_those_outside_left_out() -> None:
    one = DetectFrame("r1", frame(1).header, BALL, Decoder(320, 240, 10**6))
    found = result_of(one, (box(-20), box(500), box(100)), Maker("x"))
    inside = validated(one, found).detections
    assert [(one.x1_px, one.x2_px) for one in inside] == [(0, 20), (100, 140)]
    whole = result_of(one, (box(100),), Maker("x"))
    assert validated(one, whole) is whole


def test_image_is_decoded_once_for_all_detectors() -> None:
    class Counting(Decoder):
        count = 0

        def decode(self, jpeg):
            Counting.count += 1
            return super().decode(jpeg)

    asked = DetectFrame("r1", frame(1).header, BALL, Counting(320, 240, 10**6))
    assert asked.decoded is None
    assert asked.picture() is asked.picture() is asked.decoded
    assert Counting.count == 1


def test_lights_and_legs_are_followed_only_on_request() -> None:
    seen = [box(20, 100, label="legs"), box(260, 100, label="light red")]
    assert pipeline(Told(seen)).step(frame(1)).seen.target is None
    asked = pipeline(Told(seen), target=TargetConfig(label="legs")).step(frame(1)).seen
    assert asked.target is not None and asked.target.label == "legs"
    # A fallback, for example, can add such a box.
    coloured = [*seen, box(140, 100, label="target")]
    asked = pipeline(Told(coloured), target=TargetConfig(label="ball")).step(frame(1)).seen
    assert asked.target is not None and asked.target.label == "target"
    both = pipeline(Told([*seen, box(140, 100)])).step(frame(1)).seen
    assert both.target is not None and both.target.label == "ball"


def test_service_returns_credit_without_an_answer() -> None:
    bench = Bench(VisionConfig(), Told(None, [box(140, 100)], None))
    bench.frame()
    assert bench.acks.take() is not None and bench.twists.take() is None
    bench.frame()
    assert bench.twists.take() is not None
    bench.frame()
    assert bench.acks.take() is not None and bench.service.skipped[NO_ANSWER] == 2
    assert any("no answer" in line for line in bench.said)


def test_report_names_detector_device_and_time() -> None:
    class Timed(Told):
        def detect(self, frames, deadline_us):
            return [replace(one, detector="onnx:ball.onnx", model_hash="ab12", device="cuda", compute_us=1234)
                    for one in super().detect(frames, deadline_us)]

    bench = Bench(VisionConfig(detector=DetectorConfig(kind="hsv")), Timed(*[[box(140, 100)]] * 3))
    bench.frame()
    report = bench.report()
    said = (report.detector, report.model, report.device, report.inference_us)
    assert said == ("onnx:ball.onnx", "ab12", "cuda", 1234)


def test_the_color_detector_reports_how_long_it_took() -> None:
    bench = Bench(VisionConfig(detector=DetectorConfig(kind="hsv")))
    bench.frame()
    report = bench.report()
    assert (report.detector, report.device) == ("hsv", "cpu")
    assert report.inference_us is not None and 0 < report.inference_us < 1_000_000


def test_detector_deadline_is_passed() -> None:
    heard: list[int] = []

    class Listening(Told):
        def detect(self, frames, deadline_us):
            heard.append(deadline_us)
            return super().detect(frames, deadline_us)

    bench = Bench(VisionConfig(detector=DetectorConfig(deadline_s=0.25)), Listening([], []))
    import time

    before_us = time.monotonic_ns() // 1000
    bench.frame()
    after_us = time.monotonic_ns() // 1000
    assert before_us + 250_000 <= heard[0] <= after_us + 250_000
