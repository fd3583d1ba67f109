"""The detectors `torch`, `ultralytics`, `transformers`: pickles, missing packages, models with random weights."""

import importlib
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.onnx.frameworks import (
    FrameworkDetector,
    TorchDetector,
    TransformersDetector,
    UltralyticsDetector,
)
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame, DetectionResult, Detector
from sightline.vision_side.detect.registry import check_vision
from tests.fixtures import demanded
from tests.fixtures.vision.vision import jpeg_of

ALL = (TorchDetector, UltralyticsDetector, TransformersDetector)
GREY = np.full((240, 320, 3), 128, np.uint8)


class Ran:
    """Creates the file `path` when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def made(kind: type[FrameworkDetector], **options: object) -> FrameworkDetector:
    return kind(kind.Config(device="cpu", **options))


def result_of(detector: Detector, bgr: np.ndarray = GREY) -> DetectionResult:
    header = FrameHeader(session="0000abcd", seq=1, t_us=33_333)
    frame = DetectFrame("r1", header, jpeg_of(bgr), Decoder(bgr.shape[1], bgr.shape[0], 10**7))
    (result,) = detector.detect([frame], NO_DEADLINE)
    assert result is not None
    return result


def rejected(kind: type[FrameworkDetector], **options: object) -> str:
    with pytest.raises(ConfigError) as caught:
        made(kind, **options)
    text = str(caught.value)
    assert text and "\n" not in text and len(text) <= 300
    return text


@pytest.mark.parametrize("kind", ALL)
def test_missing_package_is_one_line_with_the_command_and_the_license(kind, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, kind.package, None)
    assert rejected(kind, address="model.pt") == (
        f"{kind.package} is not installed: pip install {kind.package} ({kind.license}; no part of Sightline)")


@pytest.mark.parametrize("kind", ALL)
def test_detector_without_a_model_names_an_example(kind) -> None:
    assert f"write e.g. {kind.kind}:" in rejected(kind)


@pytest.mark.parametrize("size", [(0, 64), (64, 0), (-1, 64), (8193, 64), (64,), (64, 64, 3)])
def test_size_that_no_input_has_is_invalid(size) -> None:
    with pytest.raises(ValidationError, match="size"):
        TorchDetector.Config(size=size)
    assert TorchDetector.Config(size=(1, 8192)).size == (1, 8192)


# --- the frameworks that need not be installed: what is taken from their answers -------------------------------------


class Numbers:
    """An array as a tensor of PyTorch."""

    def __init__(self, *values: object) -> None:
        self._array = np.array(values, np.float32)

    def detach(self):
        return self

    cpu = detach

    def numpy(self):
        return self._array


def fake_torch(monkeypatch) -> None:
    torch = SimpleNamespace(__version__="0", cuda=SimpleNamespace(is_available=lambda: False))
    monkeypatch.setitem(sys.modules, "torch", torch)


def fake_ultralytics(monkeypatch, masks: object) -> None:
    boxes = SimpleNamespace(xyxy=Numbers([10, 20, 60, 90], [0, 0, 9, 9]), conf=Numbers(0.9, 0.6), cls=Numbers(1, 0))
    model = SimpleNamespace(names={0: "cup", 1: "sports ball"},
                            predict=lambda image, **_: [SimpleNamespace(boxes=boxes, masks=masks)])
    package = SimpleNamespace(__version__="8", YOLO=lambda path: model)
    monkeypatch.setitem(sys.modules, "ultralytics", package)
    fake_torch(monkeypatch)


def test_ultralytics_boxes_and_names_become_detections(monkeypatch, tmp_path: Path) -> None:
    down, across = np.mgrid[:256, :320]
    disk = (across - 35) ** 2 + (down - 55) ** 2 < 20**2
    fake_ultralytics(monkeypatch, SimpleNamespace(data=Numbers(disk, np.ones((256, 320)))))
    (tmp_path / "m.onnx").write_bytes(b"any")
    detector = made(UltralyticsDetector, address=str(tmp_path / "m.onnx"), refine=())
    ball, cup = result_of(detector).detections
    assert (ball.label, cup.label, cup.circle) == ("sports ball", "cup", None)
    assert (ball.x1_px, ball.y2_px) == (10, 90 - 8), "the image of 240 rows stands in the middle of 256"
    assert ball.circle is not None and ball.circle.radius_px == pytest.approx(20, abs=0.5)
    assert detector.maker.detector == "ultralytics:m.onnx" and len(detector.maker.model_hash) == 16


def test_model_of_ultralytics_without_boxes_names_the_tasks_that_have_some(monkeypatch, tmp_path: Path) -> None:
    """A model of the task obb or classify: the result has `boxes` None. Before, the line named `xyxy`."""
    fake_ultralytics(monkeypatch, None)
    sys.modules["ultralytics"].YOLO("").predict = lambda image, **_: [SimpleNamespace(boxes=None, masks=None)]
    (tmp_path / "m.onnx").write_bytes(b"any")
    assert "it gives no boxes; use a model for the task detect or segment" in rejected(
        UltralyticsDetector, address=str(tmp_path / "m.onnx"))


@pytest.mark.parametrize("name", ["m.pt", "m.pth", "m.yaml", "yolo11n", "m.engine"])
def test_all_but_exported_models_of_ultralytics_may_run_code(monkeypatch, tmp_path: Path, name: str) -> None:
    fake_ultralytics(monkeypatch, None)
    path = tmp_path / name
    path.write_bytes(b"any")
    assert "which can run any code" in rejected(UltralyticsDetector, address=str(path))
    detector = made(UltralyticsDetector, address=str(path), pickle=True)
    assert any("can run any code" in line for line in detector.notices())


@pytest.mark.parametrize("kind", [UltralyticsDetector, TransformersDetector])
def test_missing_and_large_files_are_one_line(kind, monkeypatch, tmp_path: Path) -> None:
    fake_ultralytics(monkeypatch, None)
    monkeypatch.setitem(sys.modules, "transformers", SimpleNamespace(__version__="5"))
    missing = rejected(kind, address=str(tmp_path / "nowhere"))
    assert missing.endswith(": No such file or directory; check the path, and that you may read it"), "before: onnx:..."
    path = tmp_path / "config.json"
    with path.open("wb") as file:
        file.truncate(2**31)
    address = tmp_path if kind is TransformersDetector else path
    assert "has 2147483648 bytes" in rejected(kind, address=str(address))


def test_folder_of_transformers_needs_weights_that_are_not_a_pickle(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "transformers", SimpleNamespace(__version__="5"))
    (tmp_path / "config.json").write_text("{}")
    assert "no model.safetensors" in rejected(TransformersDetector, address=str(tmp_path))
    (tmp_path / "pytorch_model.bin").write_bytes(b"any")
    assert "may be a Python pickle" in rejected(TransformersDetector, address=str(tmp_path))


def test_error_of_a_framework_is_one_line(monkeypatch, tmp_path: Path) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("a long\ntext " + "x" * 500)

    fake_torch(monkeypatch)
    monkeypatch.setitem(sys.modules, "ultralytics", SimpleNamespace(__version__="8", YOLO=fail))
    (tmp_path / "m.onnx").write_bytes(b"any")
    text = rejected(UltralyticsDetector, address=str(tmp_path / "m.onnx"))
    assert "cannot be opened: RuntimeError: a long text" in text


# --- PyTorch, where it is installed -----------------------------------------------------------------------------------


@pytest.fixture
def torch():
    return demanded.module("torch", "train")


def random_yolo(torch, shape: tuple[int, int]):
    """A network of random weights whose answer has the shape of a head of YOLO."""

    class Net(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = torch.nn.Conv2d(3, shape[0] * shape[1], 16, 16)

        def forward(self, image):
            return self.layer(image).mean((2, 3)).sigmoid().reshape(1, *self.shape) * 60

        shape: tuple[int, int]

    Net.shape = shape
    torch.manual_seed(1)
    return Net()


def scores_at_most_1(torch, net, first: int):
    class Bounded(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = net

        def forward(self, image):
            found = self.net(image)
            return torch.cat([found[:, :first], found[:, first:] / 60], 1)

    return Bounded()


def script(torch, module, path: Path, **extra: str) -> Path:
    traced = torch.jit.trace(module.eval(), torch.zeros(1, 3, 64, 64))
    torch.jit.save(traced, str(path), _extra_files=extra)
    return path


@pytest.mark.slow
def test_torchscript_of_yolo_has_the_size_and_names_of_its_file(torch, tmp_path: Path) -> None:
    net = scores_at_most_1(torch, random_yolo(torch, (6, 40)), 4)
    stated = '{"imgsz": [64, 64], "names": {"0": "cup", "1": "plate"}}'
    path = script(torch, net, tmp_path / "m.torchscript", **{"config.txt": stated})
    detector = made(TorchDetector, address=str(path))
    found = result_of(detector).detections
    assert found and {one.label for one in found} <= {"cup", "plate"}
    assert all(0 <= one.x1_px < one.x2_px <= 320 and 0 <= one.y1_px < one.y2_px <= 240 for one in found)
    assert detector.maker.detector == "torch:m.torchscript" and detector.maker.device == "cpu"


@pytest.mark.slow
def test_torchscript_that_gives_something_else_is_one_line(torch, tmp_path: Path) -> None:
    net = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * 64 * 64, 10))
    text = rejected(TorchDetector, address=str(script(torch, net, tmp_path / "m.torchscript")), size=(64, 64))
    assert "gives output0 (1, 10)" in text
    assert "cannot be opened: RuntimeError" in rejected(
        TorchDetector, address=str(tmp_path / "m.torchscript"), size=(96, 96))


LISTED = """
import torch
from typing import Dict, List

class Listed(torch.nn.Module):
    def forward(self, images: List[torch.Tensor]) -> Dict[str, torch.Tensor]:
        side = float(images[0].shape[1])
        found = torch.tensor([[0.0, 0.0, side, side]], dtype=torch.float32)
        return {"boxes": found, "scores": torch.ones(1), "labels": torch.zeros(1)}

class Fails(torch.nn.Module):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return image.reshape(7, 11)
"""


@pytest.mark.slow
def test_torchscript_that_takes_a_list_gets_one_and_any_other_reports_its_own_error(
    torch, tmp_path: Path, monkeypatch
) -> None:
    """Before, a model that failed on an image got a list, too, and the line was about the list."""
    (tmp_path / "my_scripts.py").write_text(LISTED)
    monkeypatch.syspath_prepend(str(tmp_path))
    scripts = importlib.import_module("my_scripts")
    for name in ("Listed", "Fails"):
        torch.jit.script(getattr(scripts, name)()).save(str(tmp_path / name))
    detector = made(TorchDetector, address=str(tmp_path / "Listed"), size=(64, 64))
    assert len(result_of(detector).detections) == 1
    for address in (str(tmp_path / "Fails"), "my_scripts:Fails"):
        line = rejected(TorchDetector, address=address, size=(64, 64))
        assert line.endswith("RuntimeError: shape '[7, 11]' is invalid for input of size 12288")


@pytest.mark.slow
def test_torchscript_that_is_cut_off_is_one_line(torch, tmp_path: Path) -> None:
    path = script(torch, random_yolo(torch, (6, 4)), tmp_path / "m.torchscript")
    data = path.read_bytes()
    for count, words in ((0, "0 bytes"), (1, "not a TorchScript"), (100, "truncated"), (len(data) - 30, "truncated")):
        path.write_bytes(data[:count])
        assert words in rejected(TorchDetector, address=str(path))


@pytest.mark.slow
def test_pickle_runs_only_where_it_is_requested_by_name(torch, tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    torch.save({"model": Ran(ran)}, tmp_path / "m.pt")
    (tmp_path / "old.pt").write_bytes(pickle.dumps(Ran(ran)))
    for name in ("m.pt", "old.pt"):
        assert "may be a Python pickle, which can run any code" in rejected(TorchDetector, address=str(tmp_path / name))
    assert not ran.exists()
    rejected(TorchDetector, address=str(tmp_path / "m.pt"), pickle=True)
    assert ran.exists(), "the risk is real"


MODULE = '''
import torch

class Net(torch.nn.Module):
    """Finds one box, whose score is its only weight."""

    def __init__(self):
        super().__init__()
        self.score = torch.nn.Parameter(torch.tensor(0.5))

    def forward(self, image):
        box = torch.tensor([[8.0, 16.0, 24.0, 40.0]])
        return [{"boxes": box, "scores": self.score.reshape(1), "labels": torch.tensor([37]),
                 "masks": torch.ones(1, 1, *image.shape[2:])}]

class Other:
    """No module."""
'''


@pytest.mark.slow
def test_class_of_a_module_gets_its_weights_without_code(torch, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "my_net.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    ran = tmp_path / "ran"
    torch.save({"score": torch.tensor(0.75)}, tmp_path / "weights.pt")
    options = {"address": "my_net:Net", "size": (48, 64), "names": ("coco91",)}
    (one,) = result_of(made(TorchDetector, weights=str(tmp_path / "weights.pt"), refine=(), **options)).detections
    assert (one.label, one.score) == ("sports ball", pytest.approx(0.75))
    assert (one.x1_px, one.y1_px, one.x2_px, one.y2_px) == pytest.approx((40, 80, 120, 200))
    torch.save({"score": Ran(ran)}, tmp_path / "bad.pt")
    assert "may be a Python pickle" in rejected(TorchDetector, weights=str(tmp_path / "bad.pt"), **options)
    assert not ran.exists()
    assert "not a torch.nn.Module" in rejected(TorchDetector, address="my_net:Other")
    assert "cannot be loaded" in rejected(TorchDetector, address="my_net:Nat")


@pytest.mark.slow
def test_configuration_check_reads_the_model(torch, tmp_path: Path) -> None:
    (tmp_path / "m.pt").write_bytes(pickle.dumps(1))
    with pytest.raises(ConfigError, match="may be a Python pickle"):
        check_vision(VisionConfig(detector=DetectorConfig(kind=f"torch:{tmp_path / 'm.pt'}")))


@pytest.mark.slow
def test_torch_without_a_gpu_rejects_cuda(torch, tmp_path: Path) -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    path = script(torch, random_yolo(torch, (6, 4)), tmp_path / "m.torchscript")
    with pytest.raises(HardwareError, match="--device cuda"):
        TorchDetector(TorchDetector.Config(address=str(path), device="cuda"))


# --- Transformers and Ultralytics, where they are installed -----------------------------------------------------------


def framework(name: str):
    try:
        return importlib.import_module(name)
    except ImportError as error:
        return demanded.do_without(name, f"no {name} ({error}); run: pip install {name}")


@pytest.mark.slow
def test_random_model_of_transformers_keeps_its_labels_and_the_image(torch, tmp_path: Path) -> None:
    transformers = framework("transformers")
    settings = transformers.YolosConfig(
        hidden_size=32, num_hidden_layers=2, num_attention_heads=2, intermediate_size=32, image_size=[64, 64],
        num_detection_tokens=10, id2label={0: "cup", 1: "plate"}, label2id={"cup": 0, "plate": 1})
    transformers.YolosForObjectDetection(settings).save_pretrained(tmp_path)
    transformers.YolosImageProcessor(size={"height": 64, "width": 64}).save_pretrained(tmp_path)
    detector = made(TransformersDetector, address=str(tmp_path), min_score=0.01)
    found = result_of(detector).detections
    assert found and {one.label for one in found} <= {"cup", "plate"}
    assert all(0 <= one.x1_px < one.x2_px <= 320 for one in found)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["yolo11n.yaml", "yolov8n-seg.yaml"])
def test_random_model_of_ultralytics_keeps_its_labels_and_the_image(torch, tmp_path: Path, name: str) -> None:
    ultralytics = framework("ultralytics")
    path = tmp_path / "random.pt"
    ultralytics.YOLO(name).save(path)
    assert "may be a Python pickle" in rejected(UltralyticsDetector, address=str(path))
    detector = made(UltralyticsDetector, address=str(path), pickle=True, min_score=0.0)
    assert len(detector.labels) == 80
    result_of(detector)
