"""The conversion of a TensorFlow.js graph to ONNX: axis orders, padding, and the boxes of NanoDet's heads."""

import io
import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("onnx", "train")
demanded.module("pybullet", "sim")

from sightline.training import nanodet
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.onnx.engine import open_engine
from sightline.vision_side.detect.onnx.tensors import COCO, fit_picture, model_format, read_outputs

pytestmark = pytest.mark.usefixtures("no_gpu")

PERSON, CHANNELS = 0, len(COCO) + 44


class Package:
    """An npm package with a graph of one convolution and a bias for each stride."""

    def __init__(self) -> None:
        self.nodes: list[dict] = [{"name": "input_1", "op": "Placeholder", "attr": {}}]
        self.listed: list[dict] = []
        self.data = b""

    def constant(self, name: str, value: np.ndarray) -> str:
        half = value.dtype == np.float16
        stored = {"quantization": {"dtype": "float16"}, "dtype": "float32"} if half else {"dtype": str(value.dtype)}
        self.listed.append({"name": name, "shape": list(value.shape), **stored})
        self.data += value.tobytes()
        return name

    def node(self, op: str, name: str, *inputs: str, **attributes: object) -> str:
        self.nodes.append({"name": name, "op": op, "input": list(inputs), "attr": attributes})
        return name

    def head(self, stride: int, kernel: np.ndarray, bias: np.ndarray) -> None:
        ends = self.constant(f"ends{stride}", np.array([[0, 0], [0, 0], [1, 0], [2, 0]], np.int32))
        order = self.constant(f"order{stride}", np.array([0, 2, 3, 1], np.int32))
        back = self.constant(f"back{stride}", np.array([0, 3, 1, 2], np.int32))
        padded = self.node("Pad", f"pad{stride}", "input_1", ends)
        turned = self.node("Transpose", f"turned{stride}", padded, order)
        strides = {"list": {"i": ["1", str(stride), str(stride), "1"]}}
        seen = self.node("Conv2D", f"seen{stride}", turned, self.constant(f"kernel{stride}", kernel), strides=strides)
        moved = self.node("Add", f"moved{stride}", seen, self.constant(f"bias{stride}", bias))
        planes = self.node("Transpose", f"planes{stride}", moved, back)
        self.node("SplitV", f"split{stride}", planes)

    def write(self, path: Path) -> Path:
        text = json.dumps({"modelTopology": {"node": self.nodes}, "weightsManifest": [{"weights": self.listed}]})
        with tarfile.open(path, "w:gz") as archive:
            for name, data in (("nanodet.json", text.encode()), ("nanodet.bin", self.data)):
                member = tarfile.TarInfo(f"package/models/{name}")
                member.size = len(data)
                archive.addfile(member, io.BytesIO(data))
        return path


def head_bias(score: float, bins: tuple[int, int, int, int]) -> np.ndarray:
    """Every class at 0 except one, and each side of the box at one whole distance, in strides."""
    bias = np.full(CHANNELS, -20.0)
    bias[PERSON] = np.log(score / (1 - score))
    for side, distance in enumerate(bins):
        bias[len(COCO) + 11 * side + distance] = 20.0
    return bias.astype(np.float16)


def test_heads_become_boxes_about_the_middles_of_their_cells(tmp_path: Path) -> None:
    package = Package()
    for stride, score in ((8, 0.1), (16, 0.1), (32, 0.3)):
        kernel = np.zeros((stride, stride, 3, CHANNELS), np.float16)
        kernel[2, 1, 2, PERSON] = 4.0 if stride == 32 else 0.0  # red of the pixel 2 below and 1 beside the first
        package.head(stride, kernel, head_bias(score, (1, 2, 3, 4)))
    path = tmp_path / "nanodet.onnx"
    nanodet.convert(package.write(tmp_path / "package.tgz"), path)
    engine = open_engine(path, "cpu", 1)
    form = model_format(engine.header, (), "auto")
    assert (form.kind, form.size, form.labels[:2]) == ("yolo", (256, 320), ("person", "bicycle"))
    picture = np.full((256, 320, 3), (104, 116, 0), np.uint8)  # far below the mean of red
    picture[33, 63] = (104, 116, 255)  # 1, 1 before the pads of 1 above and 2 to the left: cell (1, 2)
    decoded = DecodedImage(picture, 1)
    pixels, fitting = fit_picture(decoded, form)
    (one,) = read_outputs(engine.run(pixels), form, fitting, decoded, 0.5)
    middle_x, middle_y = 2.5 * 32, 1.5 * 32
    assert one.label == "person" and one.score > 0.9
    assert (one.x1_px, one.y1_px, one.x2_px, one.y2_px) == pytest.approx(
        (middle_x - 32, max(0, middle_y - 64), middle_x + 96, middle_y + 128), abs=0.5)
