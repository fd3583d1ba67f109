"""Write trained weights as an ONNX file: uint8 BGR in, boxes, scores and labels out. Pure (ONNX).

The graph is written node by node, so that the file depends only on the table and the weights.
"""

import json
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import TensorProto, helper, numpy_helper

from sightline.sim.scenes.model import LABELS
from sightline.training.network import (
    BRIGHTNESS,
    COLORS,
    DARKEST,
    GEOMETRY,
    INPUT_PX,
    LOOKED_AT,
    OUTPUTS,
    SIZE_PX,
    STRIDE,
    Layer,
    Weights,
    network,
)

WIDTH_PX, HEIGHT_PX = INPUT_PX
OPSET: Final = 17
IR_VERSION: Final = 8
"""Version that runtimes of opset 17 read."""
MOST_BOXES: Final = 32
SAME_BOX: Final = 0.5
"""Overlap (intersection over union) of two boxes above which the score of the worse one becomes 0."""
_LARGEST: Final = 3.2  # of a log size: 390 pixels; keeps exp() finite for any image

_NO_PEAK: Final = -30.0

class Graph:
    """The nodes and constants of a graph."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def add(self, kind: str, takes: Sequence[str], name: str, **how: Any) -> str:
        """Add a node with one output. Returns the name of the output."""
        self.nodes.append(helper.make_node(kind, list(takes), [name], name=name, **how))
        return name

    def constant(self, name: str, value: Any, kind: Any = np.float32) -> str:
        """Add a number or an array to the graph."""
        self.constants.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name


def onnx_bytes(weights: Weights, properties: dict[str, str]) -> bytes:
    """Return the ONNX file. Its metadata contains `properties` and the labels."""
    graph = Graph()
    last = _image(graph)
    for layer in network():
        last = _layer(graph, layer, weights)
    _decoded(graph, last)
    outputs = _suppressed(graph)
    model = helper.make_model(
        helper.make_graph(
            graph.nodes, "detector",
            [helper.make_tensor_value_info("image", TensorProto.UINT8, [1, HEIGHT_PX, WIDTH_PX, 3])],
            [helper.make_tensor_value_info(name, kind, shape) for name, kind, shape in outputs], graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="sightline",
    )
    helper.set_model_props(model, {"labels": json.dumps(LABELS), **properties})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def weights_in(data: bytes) -> Weights:
    """Return the weights in a file of `onnx_bytes`; in a larger network, those of its layers with these names. Raises
    ValueError for a file that is invalid or lacks a layer.
    """
    try:
        model = onnx.load_from_string(data)
    except DecodeError:
        raise ValueError("it is not an ONNX model") from None
    if not model.graph.node:
        raise ValueError("it is not an ONNX model, or an empty one")
    held = {one.name: numpy_helper.to_array(one) for one in model.graph.initializer}
    weights: Weights = {}
    channels = {"image": COLORS}
    for layer in network():
        channels[layer.name] = layer.channels
        if layer.kind in ("add", "add-up"):
            continue
        each = 1 if layer.kind == "depthwise" else channels[layer.takes[0]]
        shape = (layer.channels, each, layer.kernel, layer.kernel)
        weight, bias = (held.get(f"{layer.name}.{part}", np.zeros(0)) for part in ("weight", "bias"))
        if weight.size != np.prod(shape) or bias.size != layer.channels:
            raise ValueError(f"it has no layer `{layer.name}` of {layer.channels} channels")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise ValueError(f"its layer `{layer.name}` has weights that are not finite")
        if layer.takes[0] == "image":
            weight = weight.reshape(layer.channels, layer.kernel, layer.kernel, COLORS).transpose(0, 3, 1, 2)
        weights[f"{layer.name}.weight"], weights[f"{layer.name}.bias"] = weight.reshape(shape), bias
    return weights


def _image(graph: Graph) -> str:
    """Convert uint8 NHWC to float of the same mean brightness: one plane whose columns are blue, green, red in turn.

    This copies no data: the first convolution moves three columns for each pixel.
    """
    names = [graph.constant(f"seen.{name}", [value], np.int64) for name, value in
             (("first", 0), ("end", HEIGHT_PX), ("axis", 1), ("step", LOOKED_AT))]
    graph.add("Slice", ["image", *names], "image.few")
    graph.add("Cast", ["image.few"], "image.few.float", to=TensorProto.FLOAT)
    graph.add("ReduceMean", ["image.few.float"], "image.mean", keepdims=0)
    graph.add("Max", ["image.mean", graph.constant("darkest", 255 * DARKEST)], "image.level")
    graph.add("Div", [graph.constant("brightness", BRIGHTNESS), "image.level"], "image.gain")
    plane = graph.constant("plane", [1, 1, HEIGHT_PX, COLORS * WIDTH_PX], np.int64)
    graph.add("Reshape", ["image", plane], "image.plane")
    return graph.add("DequantizeLinear", ["image.plane", "image.gain"], "picture")


def _layer(graph: Graph, layer: Layer, weights: Weights) -> str:
    takes = list(layer.takes)
    after = f"{layer.name}.sum" if layer.relu and layer.kind != "head" else layer.name
    if layer.kind in ("add", "add-up"):
        if layer.kind == "add-up":
            takes[1] = _doubled(graph, takes[1])
        graph.add("Add", takes, after)
    else:
        _convolution(graph, layer, takes[0], weights, after)
    return graph.add("Relu", [after], layer.name) if after != layer.name else after


def _convolution(graph: Graph, layer: Layer, source: str, weights: Weights, name: str) -> None:
    """Add a convolution. The first one has its colors side by side in columns instead of in channels."""
    weight, bias = weights[f"{layer.name}.weight"], weights[f"{layer.name}.bias"]
    side, colors = weight.shape[2], 1
    if source == "image":
        source, colors = "picture", COLORS
        weight = weight.transpose(0, 2, 3, 1).reshape(layer.channels, 1, side, side * colors)
    takes = [source, graph.constant(f"{layer.name}.weight", weight), graph.constant(f"{layer.name}.bias", bias)]
    around, groups = (side - 1) // 2, layer.channels if layer.kind == "depthwise" else 1
    graph.add("Conv", takes, name, kernel_shape=[side, side * colors], strides=[layer.stride, layer.stride * colors],
              pads=[around, around * colors] * 2, group=groups)


def _doubled(graph: Graph, name: str) -> str:
    scales = graph.constant(f"{name}.scales", [1, 1, 2, 2])
    return graph.add("Resize", [name, "", scales], f"{name}.doubled", mode="nearest",
                     coordinate_transformation_mode="asymmetric", nearest_mode="floor")


def _decoded(graph: Graph, head: str) -> None:
    """Add the best cells: `corners` (4, K), which are x1, y1, x2, y2, `top.scores` (K,) and `labels` (K,)."""
    rows, columns = HEIGHT_PX // STRIDE, WIDTH_PX // STRIDE
    maps = [f"heat.{label}" for label in LABELS]
    _split(graph, head, [*maps, "rest"], [*[1] * len(LABELS), GEOMETRY], axis=1)
    graph.add("Max", maps, "best")
    graph.add("MaxPool", ["best"], "around", kernel_shape=[3, 3], pads=[1, 1, 1, 1], strides=[1, 1])
    # A peak is at least as large as all cells around it; all other cells count less than any peak.
    graph.add("GreaterOrEqual", ["best", "around"], "is_peak")
    graph.add("Where", ["is_peak", "best", graph.constant("no_peak", _NO_PEAK)], "peaks")
    _shaped(graph, "peaks", "peaks.flat", [rows * columns])
    most = graph.constant("most", [MOST_BOXES], np.int64)
    graph.nodes.append(helper.make_node("TopK", ["peaks.flat", most], ["marks", "cells"], name="topk", axis=0))
    graph.add("Sigmoid", ["marks"], "top.scores")
    _shaped(graph, head, "flat.all", [OUTPUTS, rows * columns])
    graph.add("Gather", ["flat.all", "cells"], "own.all", axis=1)
    _split(graph, "own.all", ["own.heat", "off", "log"], [len(LABELS), 2, GEOMETRY - 2])
    graph.add("ArgMax", ["own.heat"], "labels", axis=0, keepdims=0)
    _corners(graph, rows, columns)


def _corners(graph: Graph, rows: int, columns: int) -> None:
    """Convert cells and their geometry, x and y together, to `corners`, within the image."""
    down, across = np.mgrid[:rows, :columns] + 0.5
    graph.constant("cell.middles", np.stack([across.ravel(), down.ravel()]))
    graph.add("Gather", ["cell.middles", "cells"], "cell", axis=1)
    graph.add("Add", ["cell", "off"], "at")
    graph.add("Mul", ["at", graph.constant("stride", STRIDE)], "at.px")
    graph.add("Min", ["log", graph.constant("largest", _LARGEST)], "bounded")
    graph.add("Exp", ["bounded"], "size")
    graph.add("Mul", ["size", graph.constant("half_size", SIZE_PX / 2)], "half.px")
    graph.add("Sub", ["at.px", "half.px"], "low.free")
    graph.add("Add", ["at.px", "half.px"], "high.free")
    graph.add("Concat", ["low.free", "high.free"], "edges", axis=0)
    graph.add("Max", ["edges", graph.constant("zero", 0.0)], "inner")
    limits = [[WIDTH_PX], [HEIGHT_PX]] * 2
    graph.add("Min", ["inner", graph.constant("limits", limits)], "corners")


def _suppressed(graph: Graph) -> list[tuple[str, int, list[int]]]:
    """Set the scores of covered boxes to 0. Returns names, types and shapes of the outputs."""
    graph.add("Transpose", ["corners"], "boxes", perm=[1, 0])
    _split(graph, "corners", ["low", "high"], [2, 2])
    for end in ("low", "high"):
        _shaped(graph, end, f"{end}.across", [2, 1, MOST_BOXES])
        _shaped(graph, end, f"{end}.down", [2, MOST_BOXES, 1])
    graph.add("Min", ["high.across", "high.down"], "shared.high")
    graph.add("Max", ["low.across", "low.down"], "shared.low")
    graph.add("Sub", ["shared.high", "shared.low"], "shared")
    graph.add("Max", ["shared", "zero"], "shared.sides")
    graph.add("ReduceProd", ["shared.sides"], "common", axes=[0], keepdims=0)
    graph.add("Sub", ["high", "low"], "sides")
    graph.add("ReduceProd", ["sides"], "area", axes=[0], keepdims=0)
    _shaped(graph, "area", "area.down", [MOST_BOXES, 1])
    graph.add("Add", ["area", "area.down"], "areas")
    graph.add("Sub", ["areas", "common"], "union")
    graph.add("Mul", ["union", graph.constant("same", SAME_BOX)], "enough")
    graph.add("Greater", ["common", "enough"], "is_same")
    graph.add("Cast", ["is_same"], "same.float", to=TensorProto.FLOAT)
    better = graph.constant("better", np.tril(np.ones((MOST_BOXES, MOST_BOXES)), -1))
    graph.add("Mul", ["same.float", better], "covered")
    graph.add("ReduceMax", ["covered"], "is_covered", axes=[1], keepdims=0)
    graph.add("Sub", [graph.constant("one", 1.0), "is_covered"], "kept")
    graph.add("Mul", ["top.scores", "kept"], "scores")
    return [("boxes", TensorProto.FLOAT, [MOST_BOXES, 4]), ("scores", TensorProto.FLOAT, [MOST_BOXES]),
            ("labels", TensorProto.INT64, [MOST_BOXES])]


def _split(graph: Graph, name: str, parts: list[str], sizes: list[int], axis: int = 0) -> None:
    takes = [name, graph.constant(f"{name}.sizes", sizes, np.int64)]
    graph.nodes.append(helper.make_node("Split", takes, parts, name=f"{name}.split", axis=axis))


def _shaped(graph: Graph, source: str, name: str, shape: list[int]) -> None:
    graph.add("Reshape", [source, graph.constant(f"{name}.shape", shape, np.int64)], name)


def shifted(weights: Weights, thresholds: Sequence[float]) -> Weights:
    """Return the same detector with each label's threshold moved to the score 0.5, so that the file contains it."""
    bias = weights["head.bias"].copy()
    for number, threshold in enumerate(thresholds):
        bias[number] -= float(np.log(threshold / (1 - threshold)))
    assert len(bias) == OUTPUTS
    return {**weights, "head.bias": bias}
