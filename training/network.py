"""The network as one table, from which the PyTorch module and the ONNX graph are made. Pure.

A heat map of where the middles of things are, one for each label, and for each cell how far off the middle is and how
large the thing. Depthwise layers carry the width; 288 rows halve evenly four times, so no layer pads.
"""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from sightline.sim.scenes.model import LABELS

INPUT_PX: Final = (384, 288)
"""Width and height of the input: images of 320x240 are enlarged, which finds more small balls at as many false ones,
for 1.4 times the time. Decision 14."""
STRIDE: Final = 4
"""Pixels to one cell of the heat map, each way."""
SIZE_PX: Final = 16.0
"""Sizes are learned as the logarithm of how many of these."""
GEOMETRY: Final = 4
"""Middle off the cell's by x, by y, in cells; log width, log height."""
OUTPUTS: Final = len(LABELS) + GEOMETRY
TAUGHT: Final = 1
"""Heat maps of distractors: the network separates them better from the others if it has to name them. Left out of the
ONNX file ..."""
AGAINST: Final = 0.5
"""... but for this share, by which what looks like one of those looks less like a ball. Found on the scenes that choose
thresholds: of 0, 0.3, 0.4, 0.5 and 0.65 the most hits at 3 % of false alarms, 4 to 7 points more than 0. Lights and
legs gain nothing by it. The files that ship, trained for longer and over photographs, have 0.2."""
BRIGHTNESS: Final = 0.5
"""Each image is scaled to this mean before all else, so that dim and bright look alike ..."""
DARKEST: Final = 0.03
"""... unless it is darker than this, which would scale up mere noise."""
LOOKED_AT: Final = 16
"""Each sixteenth row is enough to know how bright an image is."""
COLORS: Final = 3

Kind = Literal["conv", "depthwise", "add", "add-up", "head"]

Weights = dict[str, npt.NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Layer:
    """One step: `takes` names the layers before it. `add-up` doubles the second's size first."""

    name: str
    kind: Kind
    takes: tuple[str, ...]
    channels: int
    kernel: int = 1
    stride: int = 1
    relu: bool = True


def network() -> tuple[Layer, ...]:
    """Return all layers in order. The last one is the output."""
    layers = [
        Layer("half", "conv", ("image",), 16, 2, 2),
        *_down("quarter", "half", 32, 5),
        *_block("fine1", "quarter", 32, 3),
        *_block("fine2", "fine1", 32, 3),
        *_down("eighth", "fine2", 64, 5),
        *_block("middle1", "eighth", 64, 5),
        *_block("middle2", "middle1", 64, 5),
        *_down("sixteenth", "middle2", 128, 5),
    ]
    last = "sixteenth"
    for number in range(1, 4):
        layers += _block(f"coarse{number}", last, 128, 5)
        last = f"coarse{number}"
    return (
        *layers,
        *_up("middle", last, "middle2", 64, 5),
        *_up("top", "middle", "fine2", 32, 5),
        Layer("head", "head", ("top",), OUTPUTS),
    )


def _down(name: str, source: str, channels: int, kernel: int) -> list[Layer]:
    """Look around in each channel at every second place, mix the channels."""
    before = {"half": 16, "fine2": 32, "middle2": 64}[source]
    return [
        Layer(f"{name}.around", "depthwise", (source,), before, kernel, 2, relu=False),
        Layer(name, "conv", (f"{name}.around",), channels),
    ]


def _block(name: str, source: str, channels: int, kernel: int) -> list[Layer]:
    """Look around in each channel, mix the channels, add to what came in."""
    return [
        Layer(f"{name}.around", "depthwise", (source,), channels, kernel),
        Layer(f"{name}.mixed", "conv", (f"{name}.around",), channels, relu=False),
        Layer(name, "add", (source, f"{name}.mixed"), channels),
    ]


def _up(name: str, source: str, beside: str, channels: int, kernel: int) -> list[Layer]:
    """Bring what is known of the surroundings to twice the size and look again."""
    return [
        Layer(f"{name}.narrow", "conv", (source,), channels, relu=False),
        Layer(f"{name}.joined", "add-up", (beside, f"{name}.narrow"), channels, relu=False),
        Layer(f"{name}.around", "depthwise", (f"{name}.joined",), channels, kernel),
        Layer(name, "conv", (f"{name}.around",), channels),
    ]
