"""The detector `onnx`: the metadata of a file, its inputs, its outputs, and its device."""

import json
import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.decode import DecodedImage, Decoder
from sightline.vision_side.detect.onnx.detector import SHIPPED, OnnxDetector
from sightline.vision_side.detect.onnx.engine import OnnxHeader, Tensor, open_engine
from sightline.vision_side.detect.onnx.self_test import difference, golden_picture, golden_text, read_golden
from sightline.vision_side.detect.onnx.tensors import Letterbox, ModelFormat, fit_picture, model_format, read_outputs
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame, Detection
from tests.contracts.detectors import assert_kept
from tests.fixtures.vision.onnx import brightness_model, model, node, part, tensor, value, yolo_model
from tests.fixtures.vision.vision import camera, jpeg_of, scene

pytestmark = pytest.mark.usefixtures("no_gpu")

BOXES = [[10.0, 20.0, 60.0, 90.0], [200.0, 40.0, 400.0, 300.0]]
PICTURE = DecodedImage(np.full((240, 320, 3), 128, np.uint8), 1)


def frame(bgr: np.ndarray, seq: int = 1) -> DetectFrame:
    header = FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333)
    return DetectFrame("r1", header, jpeg_of(bgr), Decoder(bgr.shape[1], bgr.shape[0], 10**7))


def detector(path: Path, **options: object) -> OnnxDetector:
    return OnnxDetector(OnnxDetector.Config(address=str(path), **options))


def header_of(path: Path) -> OnnxHeader:
    return open_engine(path, "cpu", 1).header


def test_model_file_names_its_inputs_and_outputs(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1], min_score="0.4")
    header = header_of(path)
    assert header.inputs == (Tensor("image", "uint8", (1, 240, 320, 3)),)
    assert [one.name for one in header.outputs] == ["boxes", "scores", "labels"]
    assert header.metadata == {"labels": '["ball", "legs"]', "min_score": "0.4"}


def test_onnx_runtime_stores_no_identity_of_the_machine_and_reports_nothing(tmp_path: Path) -> None:
    """By default it sends telemetry to its maker, and stores a number of the device and what it has not sent yet."""
    script = ("import sys; from pathlib import Path; from sightline.vision_side.detect.onnx.engine import open_engine; "
              "print(open_engine(Path(sys.argv[1]), 'cpu', 1).header.inputs[0].name)")
    # Nothing else of the environment: in CI it reports nothing by itself.
    home = {"HOME": str(tmp_path), "TMPDIR": str(tmp_path)}
    opened = subprocess.run([sys.executable, "-B", "-c", script, str(SHIPPED)], env=home, check=True,
                            capture_output=True, text=True)
    assert opened.stdout == "image\n" and list(tmp_path.iterdir()) == []


def test_constant_input_is_not_an_input(tmp_path: Path) -> None:
    path = model(tmp_path / "old.onnx", [node("Identity", ["x"], ["y"])], [tensor("w", np.ones(3, np.float32))],
                 [value("w", "float32", (3,)), value("x", "float32", (1, 3, None, None))],
                 [value("y", "float32", (1, 3, None, None))])
    assert header_of(path).inputs == (Tensor("x", "float32", (1, 3, None, None)),)


@given(data=st.binary(min_size=1, max_size=200))
def test_bytes_that_are_not_a_model_give_one_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.mktemp("bytes") / "m.onnx"
    path.write_bytes(data)
    with pytest.raises(ConfigError):
        detector(path)


@given(at=st.integers(0, 600), byte=st.integers(0, 255))
def test_a_broken_model_is_one_error(tmp_path_factory: pytest.TempPathFactory, at: int, byte: int) -> None:
    path = brightness_model(tmp_path_factory.mktemp("broken") / "m.onnx", BOXES, [0, 1])
    data = bytearray(path.read_bytes())
    data[at % len(data)] = byte
    for broken in (bytes(data), bytes(data[:at])):
        path.write_bytes(broken)
        try:
            detector(path, device="cpu")
        except (ConfigError, HardwareError) as error:
            assert str(error) and "\n" not in str(error)


def test_boxes_scores_and_labels_become_detections(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", BOXES, [1, 0])
    eye = detector(path, device="cpu", refine=())
    result = eye.detect([frame(np.full((240, 320, 3), 128, np.uint8))], NO_DEADLINE)[0]
    assert result is not None
    first, second = result.detections
    assert (first.x1_px, first.y1_px, first.x2_px, first.y2_px) == pytest.approx((10, 20, 60, 90), abs=0.01)
    assert (second.x2_px, second.y2_px) == (320, 240), "clipped"
    assert (first.label, second.label) == ("legs", "ball")
    assert first.score == pytest.approx(0.5, abs=0.01)
    assert (result.detector, result.device, len(result.model_hash)) == ("onnx:m.onnx", "cpu", 16)


def test_detection_below_the_minimum_score_does_not_count(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1], min_score="0.6")
    dark, light = frame(np.full((240, 320, 3), 120, np.uint8)), frame(np.full((240, 320, 3), 200, np.uint8))
    counts = [len(one.detections) if one else None for one in detector(path).detect([dark, light], NO_DEADLINE)]
    assert counts == [0, 2]
    assert len(detector(path, min_score=0.1).detect([dark], NO_DEADLINE)[0].detections) == 2


def test_half_scale_and_other_shapes_come_back_in_the_images_own_pixels(tmp_path: Path) -> None:
    eye = detector(brightness_model(tmp_path / "m.onnx", BOXES[:1], [0]), refine=())
    for width, height, expected in ((640, 480, (20, 40, 120, 180)), (160, 120, (5, 10, 30, 45)),
                                    (480, 480, (0, 40, 40, 180))):  # in the middle of a wider input
        (result,) = eye.detect([frame(np.full((height, width, 3), 128, np.uint8))], NO_DEADLINE)
        box = result.detections[0]
        assert (box.x1_px, box.y1_px, box.x2_px, box.y2_px) == pytest.approx(expected, abs=0.6)


def test_yolo_is_read_and_its_overlaps_are_removed(tmp_path: Path) -> None:
    columns = np.array([[32, 33, 10], [32, 32, 10], [20, 20, 8], [20, 20, 8], [0.9, 0.8, 0.7]])
    eye = detector(yolo_model(tmp_path / "yolo.onnx", columns))
    (result,) = eye.detect([frame(np.full((64, 64, 3), 90, np.uint8))], NO_DEADLINE)
    assert [(one.label, round(one.score, 2)) for one in result.detections] == [("cup", 0.9), ("cup", 0.7)]
    assert (result.detections[0].x1_px, result.detections[0].y2_px) == pytest.approx((22, 42), abs=0.01)


def test_onnx_detector_keeps_the_contract(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1])
    assert_kept(lambda: detector(path))


def test_no_answer_after_the_deadline(tmp_path: Path) -> None:
    eye = detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]))
    assert eye.detect([frame(PICTURE.bgr)], 0) == [None]


@pytest.mark.parametrize("kind", ["cuda", "tensorrt"])
def test_missing_device_is_rejected_with_the_fix(tmp_path: Path, kind: str) -> None:
    path = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1])
    with pytest.raises(HardwareError, match=r"--device .*onnxruntime-gpu") as refused:
        detector(path, device=kind)
    assert refused.value.exit_code == 3
    assert "\n" not in str(refused.value)


def test_auto_device_logs_once_that_it_runs_on_the_cpu(tmp_path: Path) -> None:
    eye = detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]))
    assert len(told := eye.notices()) == 1 and "cpu" in told[0]
    eye.detect([frame(PICTURE.bgr)], NO_DEADLINE)
    assert eye.notices() == []
    chosen = detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]), device="cpu")
    assert chosen.notices() == [], "nothing is reported of the CPU where it was chosen"


class _FakeRuntime:
    """An onnxruntime built for CUDA on a machine whose GPU does not work: it lists CUDA and gives the CPU."""

    __version__ = "0"

    class SessionOptions:
        pass

    class InferenceSession:
        def __init__(self, path: str, options: object, providers: list[str], enable_fallback: int) -> None:
            self.asked = providers

        def disable_fallback(self) -> None:
            pass

        def get_providers(self) -> list[str]:
            return ["CPUExecutionProvider"]

        def get_inputs(self) -> list[SimpleNamespace]:
            return []

        get_outputs = get_inputs

        def get_modelmeta(self) -> SimpleNamespace:
            return SimpleNamespace(custom_metadata_map={})

        def run(self, names: list[str], inputs: dict) -> list[np.ndarray]:
            return [np.zeros((0, 4)), np.zeros(0), np.zeros(0)]

    @staticmethod
    def get_available_providers() -> list[str]:
        return ["CUDAExecutionProvider", "CPUExecutionProvider"]


class _FailingRuntime(_FakeRuntime):
    """A runtime that cannot even query its GPU. Its own fallback prints that where a caller may expect JSON."""

    class InferenceSession(_FakeRuntime.InferenceSession):
        def __init__(self, path: str, options: object, providers: list[str], enable_fallback: int) -> None:
            if providers != ["CPUExecutionProvider"] and enable_fallback:
                print("EP Error")
            elif providers != ["CPUExecutionProvider"]:
                raise Exception("CUDA failure 100")  # as ONNX Runtime does


@pytest.mark.parametrize("runtime", [_FakeRuntime, _FailingRuntime])
def test_gpu_that_the_model_did_not_get_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], runtime: type
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", runtime)
    path = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1])
    with pytest.raises(HardwareError, match="on cpu instead"):
        open_engine(path, "cuda", 1)
    auto = open_engine(path, "auto", 1)
    assert auto.device == "cpu"
    assert "did not get it" in auto.note and capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "No such file"), (b"", "0 bytes"), (b"no model", "cannot be opened: it is not an ONNX file, or truncated"),
     (part(7, part(2, "empty")), "cannot be opened"), (pickle.dumps(1), "a file of PyTorch, not of ONNX"),
     (b"PK\x03\x04", "a file of PyTorch, not of ONNX")],
)
def test_file_that_is_not_a_model_gives_one_error_line(tmp_path: Path, content: bytes | None, words: str) -> None:
    path = tmp_path / "bad.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=words) as refused:
        detector(path)
    assert "\n" not in str(refused.value) and str(path) in str(refused.value)


def test_truncated_model_and_model_of_2_gb_are_one_line(tmp_path: Path) -> None:
    whole = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]).read_bytes()
    (tmp_path / "cut.onnx").write_bytes(whole[: len(whole) - 5])
    with pytest.raises(ConfigError, match=r"cut\.onnx cannot be opened: it is not an ONNX file, or truncated; "):
        detector(tmp_path / "cut.onnx")
    with (tmp_path / "large.onnx").open("wb") as file:
        file.truncate(2**31)
    with pytest.raises(ConfigError, match="has 2147483648 bytes; a model file has between 1 and 2147483648"):
        detector(tmp_path / "large.onnx")


def test_without_the_runtime_one_line_names_what_to_install(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r"pip install --editable '\.\[vision\]'") as missing:
        detector(brightness_model(tmp_path / "m.onnx", BOXES, [0, 1]))
    assert "\n" not in str(missing.value)


def test_model_of_another_kind_names_the_expected_kind() -> None:
    image = Tensor("x", "float32", (1, 3, 64, 64))
    with pytest.raises(ValueError, match=r"gives y \(1, 1000\)"):
        model_format(OnnxHeader((image,), (Tensor("y", "float32", (1, 1000)),)), (), "auto")
    with pytest.raises(ValueError, match="float32 \\(1, 128\\)"):
        model_format(OnnxHeader((Tensor("x", "float32", (1, 128)),), (Tensor("y", "float32", (1, 6)),)), (), "auto")
    with pytest.raises(ValueError, match="labels"):
        model_format(OnnxHeader((image,), (Tensor("y", "float32", (None, 6)),), {"labels": "{"}), (), "auto")


@pytest.mark.parametrize(("number", "name"), [(11, "double"), (3, "int8"), (4, "uint16")])
def test_type_that_no_input_may_have_is_named(tmp_path: Path, number: int, name: str) -> None:
    """Before, each of them was "other"."""
    shape = b"".join(part(1, part(1, size)) for size in (1, 3, 8, 8))
    image = part(1, "x") + part(2, part(1, part(1, number) + part(2, shape)))
    path = model(tmp_path / "m.onnx", [node("Identity", ["x"], ["y"])], [], [image], [image.replace(b"x", b"y", 1)])
    with pytest.raises(ConfigError, match=rf"its input is tensor\({name}\) \(1, 3, 8, 8\); it should be uint8"):
        detector(path)


FORM = ModelFormat(False, False, (240, 320), "triple", ("ball",))
STRAIGHT = Letterbox(1.0, 0, 0)


def _found_beside_a_good_one(box: float, score: float, label: float) -> tuple[Detection, ...]:
    outputs = {"boxes": np.array([[1, 1, 9, 9], [5, 5, box, 9]]), "scores": np.array([0.9, score]),
               "labels": np.array([0.0, label])}
    return read_outputs(outputs, FORM, STRAIGHT, PICTURE, 0.1)


@pytest.mark.parametrize(("box", "score", "label"), [
    (np.nan, 0.9, 0), (-np.inf, 0.9, 0), (9, np.nan, 0), (9, np.inf, 0), (9, 1.01, 0), (9, 7, 0), (9, 0.9, np.nan),
])  # fmt: skip
def test_invalid_numbers_count_as_no_answer(box: float, score: float, label: float) -> None:
    """A caller that takes them for "saw nothing" begins to search."""
    with pytest.raises(ValueError, match=r"nan or infinite|between 0 and 1"):
        _found_beside_a_good_one(box, score, label)


@pytest.mark.parametrize(("box", "score", "count"), [(np.nan, 0.05, 1), (9, -np.inf, 1), (1e300, 0.9, 2)])
def test_uncounted_rows_may_have_any_values(box: float, score: float, count: int) -> None:
    found = _found_beside_a_good_one(box, score, 0)
    assert len(found) == count and all(0 <= one.x1_px < one.x2_px <= 320 for one in found)


def test_a_million_boxes_and_other_shapes_are_rejected() -> None:
    many = {"boxes": np.zeros((200_000, 4)), "scores": np.ones(200_000), "labels": np.zeros(200_000)}
    with pytest.raises(ValueError, match="boxes"):
        read_outputs(many, FORM, STRAIGHT, PICTURE, 0.1)
    short = {"boxes": np.zeros((2, 4)), "scores": np.ones(3), "labels": np.zeros(3)}
    with pytest.raises(ValueError, match="scores"):
        read_outputs(short, FORM, STRAIGHT, PICTURE, 0.1)


def test_floats_are_planes_of_red_green_blue() -> None:
    bgr = np.zeros((64, 64, 3), np.uint8)
    bgr[:] = (0, 51, 255)
    pixels, _ = fit_picture(DecodedImage(bgr, 1), ModelFormat(True, True, (64, 64), "yolo", (), "float32"))
    assert pixels.shape == (1, 3, 64, 64) and pixels.dtype == np.float32
    assert pixels[0, :, 0, 0] == pytest.approx([1.0, 0.2, 0.0])


def test_a_ball_is_refined_to_less_than_a_pixel(tmp_path: Path) -> None:
    lens = camera(320, 240)
    picture = scene(lens, 0.8, 0.1)
    true = _true_centre(picture)
    rough = [[true[0] - 27, true[1] - 24, true[0] + 22, true[1] + 26]]
    eye = detector(brightness_model(tmp_path / "m.onnx", rough, [0]))
    (result,) = eye.detect([frame(picture)], NO_DEADLINE)
    circle = result.detections[0].circle
    assert circle is not None
    assert np.hypot(circle.cx_px - true[0], circle.cy_px - true[1]) < 0.5


def _true_centre(picture: np.ndarray) -> tuple[float, float]:
    """Return the center of the yellow pixels, which the drawing itself does not report."""
    rows, columns = np.nonzero(picture[..., 0] < 70)
    return float(columns.mean()) + 0.5, float(rows.mean()) + 0.5


def test_a_golden_output_that_differs_ends_it(tmp_path: Path) -> None:
    good = brightness_model(tmp_path / "m.onnx", BOXES, [0, 1], size=(240, 320))
    eye = detector(good, min_score=0.1, refine=())
    (found,) = eye._detections([(frame(golden_picture()), DecodedImage(golden_picture(), 1))])
    again = brightness_model(tmp_path / "g.onnx", BOXES, [0, 1], golden=golden_text(found))
    assert detector(again, min_score=0.1).maker.device == "cpu"
    other = golden_text([Detection(1, 1, 9, 9, 0.99, "ball")])
    # The minimum score for an image has no effect on the results that the file requires.
    for least in (0.1, 0.95):
        with pytest.raises(HardwareError, match="ball at \\(1, 1\\)"):
            detector(brightness_model(tmp_path / "w.onnx", BOXES, [0, 1], golden=other), min_score=least)
    with pytest.raises(ConfigError, match="golden"):
        detector(brightness_model(tmp_path / "b.onnx", BOXES, [0, 1], golden="[1]"))


def test_golden_text_round_trips_and_distinguishes() -> None:
    found = [Detection(10, 20, 60, 90, 0.9, "ball"), Detection(100, 20, 160, 90, 0.3, "legs")]
    back = read_golden(golden_text(found))
    assert difference(found, back, 0.25) == ""
    assert "missing" in difference(found, [], 0.25)
    assert "should not be there" in difference([], found, 0.25)
    assert difference(found, found[:1], 0.25) == "", "what is hardly sure enough may come and go"
    assert json.loads(golden_text([])) == []
    assert golden_picture().tobytes() == golden_picture().tobytes()
