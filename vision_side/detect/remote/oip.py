"""The Open Inference Protocol v2: models, tensors, configuration. Pure.

Specification: https://github.com/kserve/open-inference-protocol (JSON over HTTP), with Triton's binary tensors. A
supported model takes one input, a JPEG (datatype BYTES) or its pixels (UINT8, three channels). It gives `boxes` (K, 4)
xyxy in pixels of its input, `scores` (K) and, if it has several classes, `labels` (K).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.config import Config as Settings
from sightline.vision_side.config import Fraction
from sightline.vision_side.detect.port import DetectFrame, Detection, Label
from sightline.vision_side.detect.remote.client import MIN_SCORE, NoAnswerError, NoAnswerReason, read_columns
from sightline.vision_side.detect.remote.deadline import MAX_PIXELS, PixelBound

NUMBERS: Final = {"FP16": "<f2", "FP32": "<f4", "FP64": "<f8", "UINT8": "u1", "INT8": "i1", "INT16": "<i2",
                  "UINT16": "<u2", "INT32": "<i4", "UINT32": "<u4", "INT64": "<i8", "UINT64": "<u8", "BOOL": "?"}
MAX_DIMENSIONS: Final = 6
MAX_ELEMENTS: Final = 1 << 20
"""Security limit of one tensor. The answer as a whole has a limit in bytes."""
MAX_TENSORS: Final = 16
BOXES, SCORES, LABELS = "boxes", "scores", "labels"
_CHANNELS: Final = 3
_MAX_SIDE: Final = 8192
_MAX_LABEL_NUMBER: Final = 1 << 31  # for label numbers that are floats


class OipSettings(Settings):
    """The detector `oip+http`."""

    address: str
    labels: Annotated[tuple[Label, ...], Field(max_length=1024)] = ()
    """Names of the label numbers of the model, from 0."""
    min_score: Fraction = MIN_SCORE
    order: Literal["bgr", "rgb"] = "bgr"
    """Channel order of the input, for a model that takes pixels."""
    max_pixels: PixelBound = MAX_PIXELS


@dataclass(frozen=True, slots=True)
class TensorSlot:
    """One input or output in a model's metadata; -1 is an open dimension."""

    name: str
    datatype: str
    shape: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class OipModel:
    """A model of a server: its input, and the outputs to request."""

    name: str
    version: str
    input: TensorSlot
    outputs: tuple[str, ...]

    def title(self, scheme: str, answered: str) -> str:
        """Return the detector's name in results. It contains the version, because servers give no hash.

        The version of the answer is used if there is one, because a server may change the version while it runs.
        """
        version = answered or self.version
        return f"{scheme}:{self.name[:40]}" + (f" {version[:8]}" if version else "")

    @property
    def takes_jpeg(self) -> bool:
        """Return True for a model that takes JPEG."""
        return self.input.datatype == "BYTES"


@dataclass(frozen=True, slots=True)
class OipTensor:
    """One tensor to send: little-endian bytes of the binary extension."""

    name: str
    datatype: str
    shape: tuple[int, ...]
    data: bytes


@dataclass(frozen=True, slots=True)
class Inferred:
    """The tensors of an answer."""

    tensors: Mapping[str, NDArray[Any] | list[str]]
    version: str = ""
    """Version of the model that answered; empty if the server gives none."""


def model_of(name: str, version: str, inputs: Sequence[TensorSlot], outputs: Sequence[TensorSlot]) -> OipModel:
    """Parse the metadata of a model. Raises NoAnswerError UNFIT with the missing part."""
    if len(inputs) != 1:
        raise _unfit(name, f"it takes {len(inputs)} inputs; expected one image")
    one, given = inputs[0], {slot.name for slot in outputs}
    if one.datatype not in ("BYTES", "UINT8"):
        raise _unfit(name, f"its input is {one.datatype}; BYTES (a JPEG) or UINT8 (pixels) is given")
    if one.datatype == "UINT8" and (len(one.shape) not in (3, 4) or _layout(one.shape) is None):
        raise _unfit(name, f"its input of shape {list(one.shape)} is not an image of three channels")
    if one.datatype == "BYTES" and len(one.shape) not in (1, 2):
        raise _unfit(name, f"its input of shape {list(one.shape)} is not one JPEG")
    missing = {BOXES, SCORES} - given
    if missing:
        raise _unfit(name, f"it gives {', '.join(sorted(given)) or 'nothing'}; {' and '.join(sorted(missing))} missing")
    for slot in outputs:
        if slot.name in (BOXES, SCORES) and slot.datatype in ("INT8", "UINT8"):
            raise _unfit(name, f"its {slot.name} are {slot.datatype}, which is quantized; float expected")
    wanted = (BOXES, SCORES, LABELS) if LABELS in given else (BOXES, SCORES)
    return OipModel(name, version, one, wanted)


def _unfit(name: str, why: str) -> NoAnswerError:
    return NoAnswerError(NoAnswerReason.UNFIT, f"model {name!r}: {why}; see docs/how-to/remote-detectors.md")


def _layout(shape: tuple[int, ...]) -> tuple[int, int, bool] | None:
    """Return (rows, columns, channels first) of one image, or None without three channels."""
    last = shape[-3:]
    if last[2] == _CHANNELS:
        return last[0], last[1], False
    return (last[1], last[2], True) if last[0] == _CHANNELS else None


def tensor_of(model: OipModel, frame: DetectFrame, rgb: bool) -> tuple[OipTensor, tuple[float, float]]:
    """Return the input for `frame`, and the factors from pixels of the answer to pixels of the encoded image.

    Raises WireError if the model takes pixels and the JPEG does not decode.
    """
    one = model.input
    if model.takes_jpeg:
        data = len(frame.jpeg).to_bytes(4, "little") + frame.jpeg
        return OipTensor(one.name, one.datatype, (1,) * len(one.shape), data), (1.0, 1.0)
    pixels = _fitted(frame.picture().bgr, one.shape, rgb)
    rows, columns = pixels.shape[:2]
    stretch = frame.width_px / columns, frame.height_px / rows
    laid = pixels.transpose(2, 0, 1) if (_layout(one.shape) or (0, 0, False))[2] else pixels
    shape = (1,) * (len(one.shape) - 3) + laid.shape
    return OipTensor(one.name, one.datatype, shape, laid.tobytes()), stretch


def _fitted(bgr: NDArray[np.uint8], shape: tuple[int, ...], rgb: bool) -> NDArray[Any]:
    """Return the pixels, scaled if the model has a fixed input size."""
    rows, columns, _ = _layout(shape) or (-1, -1, False)
    rows, columns = (rows if rows > 0 else bgr.shape[0]), (columns if columns > 0 else bgr.shape[1])
    if max(rows, columns) > _MAX_SIDE:
        raise NoAnswerError(NoAnswerReason.UNFIT, f"its input is {columns}x{rows} pixels, at most {_MAX_SIDE} a side")
    fitted: NDArray[Any] = bgr
    if fitted.shape[:2] != (rows, columns):
        fitted = cv2.resize(bgr, (columns, rows), interpolation=cv2.INTER_AREA)
    return fitted[:, :, ::-1] if rgb else fitted


# --- answers -----------------------------------------------------------------------------------------------------


def read_number_tensor(datatype: str, shape: Sequence[int], data: bytes) -> NDArray[Any]:
    """Decode a tensor of numbers. Raises NoAnswerError if shape and bytes do not fit."""
    kind = NUMBERS.get(datatype)
    if kind is None:
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"a tensor of datatype {datatype[:20]!r}")
    count = elements_of(shape)
    if len(data) != count * np.dtype(kind).itemsize:
        raise NoAnswerError(
            NoAnswerReason.MALFORMED, f"{len(data)} bytes for a {datatype} tensor of shape {list(shape)}"
        )
    return np.frombuffer(data, kind).reshape(tuple(shape))


def read_text_tensor(shape: Sequence[int], data: bytes) -> list[str]:
    """Decode a tensor of BYTES. Each element follows its length in four little-endian bytes."""
    texts, at = [], 0
    for _ in range(elements_of(shape)):
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        if at + 4 > len(data) or end > len(data):
            raise NoAnswerError(NoAnswerReason.MALFORMED, "a BYTES tensor is cut short")
        texts.append(data[at + 4 : end].decode("utf-8", "replace"))
        at = end
    if at != len(data):
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"{len(data) - at} bytes too many in a BYTES tensor")
    return texts


def elements_of(shape: Sequence[int]) -> int:
    """Count the elements of a tensor. Raises NoAnswerError for an invalid shape, or too many elements."""
    if len(shape) > MAX_DIMENSIONS or any(not 0 <= size <= MAX_ELEMENTS for size in shape):
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"a tensor of shape {list(shape)[:MAX_DIMENSIONS]}")
    count = math.prod(shape)
    if count > MAX_ELEMENTS:
        raise NoAnswerError(NoAnswerReason.TOO_MANY, f"a tensor of {count} elements, at most {MAX_ELEMENTS}")
    return count


def detections_of(
    answer: Inferred, settings: OipSettings, stretch: tuple[float, float], size_px: tuple[int, int]
) -> tuple[Detection, ...]:
    """Read the tensors of an answer. Raises NoAnswerError for a missing tensor or a wrong shape."""
    outputs = answer.tensors
    boxes, scores = (_numbers(outputs, name) for name in (BOXES, SCORES))
    boxes = boxes.reshape(boxes.shape[-2:]) if boxes.ndim > 2 and math.prod(boxes.shape[:-2]) == 1 else boxes
    scores = _flat(scores)
    labels = _labels(outputs.get(LABELS), len(scores) if scores.ndim else 0, settings.labels)
    return read_columns(boxes.astype(np.float64), scores.astype(np.float64), labels, stretch=stretch, size_px=size_px,
                        min_score=settings.min_score)


def _numbers(outputs: Mapping[str, NDArray[Any] | list[str]], name: str) -> NDArray[Any]:
    found = outputs.get(name)
    if not isinstance(found, np.ndarray):
        raise NoAnswerError(NoAnswerReason.MALFORMED, f"no numbers called {name!r} in the answer")
    return found


def _flat(column: NDArray[Any]) -> NDArray[Any]:
    """Convert (1, K) and (K, 1) to (K)."""
    return column.reshape(-1) if column.ndim > 1 and sum(size != 1 for size in column.shape) < 2 else column


def _labels(found: NDArray[Any] | list[str] | None, rows: int, names: tuple[str, ...]) -> list[str]:
    """Return texts unchanged, and numbers by their names. A number without a name becomes its own text."""
    if found is None:
        return [names[0] if names else "target"] * rows
    if isinstance(found, list):
        return found
    numbers = _flat(found)
    if np.issubdtype(numbers.dtype, np.floating) and (np.abs(numbers.astype(np.float64)) < _MAX_LABEL_NUMBER).all():
        whole = numbers.astype(np.int64)  # many exported models give class numbers as floats
        numbers = whole if np.array_equal(whole, numbers) else numbers
    if numbers.ndim != 1 or not np.issubdtype(numbers.dtype, np.integer):
        raise NoAnswerError(
            NoAnswerReason.MALFORMED,
            f"labels of shape {numbers.shape} and type {numbers.dtype}; they are text or whole numbers",
        )
    return [names[number] if 0 <= number < len(names) else str(number) for number in numbers.tolist()]
