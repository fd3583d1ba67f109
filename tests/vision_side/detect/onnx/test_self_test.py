"""The detector `onnx`: a device that fails in the middle, golden outputs under other options, things on things."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.onnx import detector as onnx_detector
from sightline.vision_side.detect.onnx.self_test import golden_picture, golden_text
from sightline.vision_side.detect.port import NO_DEADLINE, Detection
from tests.fixtures.vision.onnx import brightness_model, yolo_model
from tests.vision_side.detect.onnx.test_detector import detector, frame

BOXES = [[10.0, 20.0, 60.0, 90.0], [200.0, 40.0, 300.0, 200.0]]
GREY = np.full((240, 320, 3), 128, np.uint8)


class _Dying:
    """An onnxruntime whose GPU is lost while it runs: with its fallback on, the CPU takes over without a word."""

    __version__ = "0"

    class SessionOptions:
        pass

    class InferenceSession:
        def __init__(self, path, options, providers, enable_fallback):
            self.falls_back, self.on, self.lost = bool(enable_fallback), providers, False

        def disable_fallback(self):
            self.falls_back = False

        def get_providers(self):
            return self.on

        def get_inputs(self):
            return [SimpleNamespace(name="image", type="tensor(uint8)", shape=[1, 240, 320, 3])]

        def get_outputs(self):
            kinds = {"boxes": ("tensor(float)", [1, 4]),
                     "scores": ("tensor(float)", [1]), "labels": ("tensor(int64)", [1])}
            return [SimpleNamespace(name=name, type=kind, shape=shape) for name, (kind, shape) in kinds.items()]

        def get_modelmeta(self):
            return SimpleNamespace(custom_metadata_map={"labels": '["ball", "legs"]'})

        def run(self, names, inputs):
            if self.lost and not self.falls_back:
                raise RuntimeError("CUDA failure 719: unspecified launch failure")
            return [np.array([[1.0, 1, 9, 9]]), np.array([0.9]), np.array([0])]

    @staticmethod
    def get_available_providers():
        return ["CUDAExecutionProvider", "CPUExecutionProvider"]


def test_lost_gpu_gives_no_answer_and_never_uses_the_cpu(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", _Dying)
    eye = detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]), device="cuda", refine=())
    assert eye.detect([frame(GREY)], NO_DEADLINE)[0].device == "cuda" and eye.notices() == []
    eye._engine._session.lost = True
    assert eye.detect([frame(GREY)], NO_DEADLINE) == [None]
    assert "CUDA failure" in eye.notices()[0]


@pytest.mark.parametrize(("device", "fix"), [
    ("cuda", "try --device cpu, or fetch the file again"), ("cpu", "fetch the file again, or remove 'golden' from"),
])
def test_fix_of_a_wrong_answer_fits_the_device(tmp_path: Path, monkeypatch, device: str, fix: str) -> None:
    """Before, a quantized model on the CPU was to run on the CPU."""
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", _Dying)
    golden = {"labels": '["ball"]', "golden": '[[30, 30, 90, 90, 0.9, "ball"]]'}
    given = SimpleNamespace(custom_metadata_map=golden)
    monkeypatch.setattr(_Dying.InferenceSession, "get_modelmeta", lambda _: given)
    with pytest.raises(HardwareError, match=rf"on {device} \(.* is missing; {fix}"):
        detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]), device=device)


def test_real_runtime_can_stay_on_its_device(tmp_path: Path) -> None:
    eye = detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]))
    assert eye._engine._session._enable_fallback is False


def test_a_golden_output_is_of_the_models_own_labels_and_least_score(tmp_path: Path) -> None:
    plain = detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1], min_score="0.1"), refine=())
    (found,) = plain._detections([(frame(GREY), DecodedImage(golden_picture(), 1))])
    assert 0.3 < found[0].score < 0.6
    golden = golden_text(found)
    named = detector(brightness_model(tmp_path / "g.onnx", BOXES, [0, 1], golden=golden), names=("a", "b"))
    assert [one.label for one in named.detect([frame(GREY)], NO_DEADLINE)[0].detections] == ["a", "b"]
    sure = brightness_model(tmp_path / "s.onnx", BOXES, [0, 1], min_score="0.9", golden="[]")
    assert len(detector(sure, min_score=0.05).detect([frame(GREY)], NO_DEADLINE)[0].detections) == 2
    wrong = golden_text([Detection(1, 1, 9, 9, 0.99, "ball")])
    with pytest.raises(HardwareError, match="ball at"):
        detector(brightness_model(tmp_path / "w.onnx", BOXES, [0, 1], golden=wrong), names=("a", "b"))


@pytest.mark.parametrize(("change", "words"), [
    (lambda one: setattr(one, "ir_version", 99), "it is newer than this ONNX Runtime; export it with opset 17"),
    (lambda one: setattr(one.opset_import[0], "version", 99), "it is newer than this ONNX Runtime"),
    (lambda one: setattr(one.graph.node[0], "op_type", "Own"), "ONNX Runtime lacks one of its operators"),
    (lambda one: setattr(one.graph.initializer[0], "data_location", 1), "its weights are in a file of their own"),
])
def test_model_that_this_runtime_cannot_open_has_the_reason_and_the_fix(tmp_path: Path, change, words: str) -> None:
    path = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1])
    one = onnx.load(path)
    change(one)
    path.write_bytes(one.SerializeToString())
    with pytest.raises(ConfigError, match=f"cannot be opened: {words}"):
        detector(path)


@pytest.mark.skipif(not onnx_detector.SHIPPED.is_file(), reason="no shipped model; run the tests in a whole clone")
def test_copy_of_the_model_that_comes_along_looks_again_as_it_does(tmp_path: Path) -> None:
    copy = tmp_path / "mine.onnx"
    copy.write_bytes(onnx_detector.SHIPPED.read_bytes())
    one, other = (detector(path) for path in (onnx_detector.SHIPPED, copy))
    assert one._looks_at_doubts and other._looks_at_doubts and one._expected_bonus == other._expected_bonus > 0
    assert not detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]))._looks_at_doubts


def test_least_score_of_the_metadata_that_is_not_a_number_is_named(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1], min_score="abc")
    with pytest.raises(ConfigError, match="min_score of its metadata is 'abc'; expected 0 to 1"):
        detector(path)


@pytest.mark.skipif(not onnx_detector.SHIPPED.is_file(), reason="no shipped model; run the tests in a whole clone")
@pytest.mark.parametrize("options", [{"names": ("a",)}, {"min_score": 0.05}, {"min_score": 0.9}])
def test_the_model_that_comes_along_opens_with_any_names_and_least_score(options: dict) -> None:
    config = onnx_detector.OnnxDetector.Config(device="cpu", **options)
    assert onnx_detector.OnnxDetector(config).maker.device == "cpu"


def test_labels_of_metadata_and_options_are_cleaned(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1], words=("", "a\x1b[2J" + "x" * 99))
    assert onnx_detector.read_onnx_model(onnx_detector.OnnxDetector.Config(address=str(path))).form.labels == (
        "thing", ("a[2J" + "x" * 99)[:64])
    named = onnx_detector.OnnxDetector.Config(address=str(path), names=("\n", "b"))
    assert onnx_detector.read_onnx_model(named).form.labels == ("thing", "b")


def test_cup_on_a_plate_is_detected_with_the_plate(tmp_path: Path) -> None:
    columns = np.array([[32, 33, 32, 10], [32, 32, 33, 10], [20, 20, 22, 8], [20, 20, 22, 8],
                        [0.9, 0.8, 0.1, 0.7], [0.1, 0.2, 0.85, 0.1]])
    eye = detector(yolo_model(tmp_path / "yolo.onnx", columns, names="{0: 'cup', 1: 'plate'}"))
    (result,) = eye.detect([frame(np.full((64, 64, 3), 90, np.uint8))], NO_DEADLINE)
    assert [(one.label, round(one.score, 2)) for one in result.detections] == [
        ("cup", 0.9), ("plate", 0.85), ("cup", 0.7)]
