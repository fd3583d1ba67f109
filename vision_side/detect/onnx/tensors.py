"""Images to input tensors, output tensors to detections. Pure.

Inputs: uint8 rows of pixels (1, H, W, 3), BGR unless configured, or float (1, 3, H, W), RGB as 0..1. Outputs:
`boxes` (K, 4), `scores` (K), `labels` (K), as Sightline's own; one (N, 6) of x1, y1, x2, y2, score, class; or one
(4 + classes, N) of cx, cy, w, h and a score for each class, as YOLO gives it, with overlaps still to be removed.
"""

import ast
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.protocol.messages import MAX_DETECTED_BOXES
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.onnx.engine import OnnxHeader, Tensor
from sightline.vision_side.detect.port import Detection, clean_label, clipped

Arrays = Mapping[str, NDArray[Any]]
_MAX_ROWS: Final = 100_000
_MAX_OVERLAP: Final = 0.5
_GRAY: Final = 114  # beside an image that is narrower or lower than the input; what YOLO was trained with
_STEP_PX: Final = 32  # an input of any size is rounded up to this
_TRIPLE: Final = {"boxes", "scores", "labels"}
_MAX_LABELS: Final = 1000


@dataclass(frozen=True, slots=True)
class Letterbox:
    """Place of the image in the input: `scale` input pixels for each of its own, from (`left`, `top`)."""

    scale: float
    left: int
    top: int


@dataclass(frozen=True, slots=True)
class ModelFormat:
    """The inputs and outputs of one model."""

    floats: bool
    rgb: bool
    size: tuple[int, int] | None
    """(rows, columns); None where any will do."""
    kind: str
    """triple, rows or yolo."""
    labels: tuple[str, ...]
    dtype: str = "uint8"
    batched: bool = False
    """True if it takes several images at once: inputs and outputs leave the number open."""


def model_format(header: OnnxHeader, names: Sequence[str], color: str) -> ModelFormat:
    """Raises ValueError for a model that takes or gives something else."""
    if len(header.inputs) != 1:
        raise ValueError(f"it takes {len(header.inputs)} inputs; expected one image")
    one = header.inputs[0]
    rows_first, channels_first = one.shape[3:] == (3,), len(one.shape) == 4 and one.shape[1] == 3
    floats = one.type in ("float32", "float16")
    if len(one.shape) != 4 or not ((one.type == "uint8" and rows_first) or (floats and channels_first)):
        raise ValueError(f"its input is {one.type} {_shape_text(one)}; it should be uint8 (1, H, W, 3) or float "
                         "(1, 3, H, W)")
    if one.shape[0] not in (1, None):
        raise ValueError(f"it takes {one.shape[0]} images in one batch; export it for 1, or for any number")
    rows, columns = one.shape[1:3] if rows_first and not floats else one.shape[2:4]
    size = (rows, columns) if rows and columns else None
    labels = tuple(map(clean_label, names)) or own_labels(header.metadata)
    kind = _kind(header.outputs, labels)
    batched = size is not None and one.shape[0] is None and all(_is_for_several(one, kind) for one in header.outputs)
    return ModelFormat(floats, floats if color == "auto" else color == "rgb", size, kind, labels, one.type, batched)


def _is_for_several(output: Tensor, kind: str) -> bool:
    """Return True if its first dimension is open and counts images."""
    sides = 2 if kind == "triple" and output.name != "boxes" else 3
    return len(output.shape) == sides and output.shape[0] is None


def _shape_text(one: Tensor) -> str:
    return "(" + ", ".join("?" if part is None else str(part) for part in one.shape) + ")"


def _kind(outputs: Sequence[Tensor], labels: Sequence[str]) -> str:
    if {one.name for one in outputs} >= _TRIPLE:
        return "triple"
    if len(outputs) == 1:
        shape = outputs[0].shape
        if shape and shape[-1] == 6:
            return "rows"
        if len(shape) == 3 and shape[1] is not None and shape[1] > 4:
            if labels and shape[1] != 4 + len(labels):
                raise ValueError(f"it has {shape[1] - 4} classes and {len(labels)} names; "
                                 "detector.options.names has one for each, in order")
            return "yolo"
    given = ", ".join(f"{one.name} {_shape_text(one)}" for one in outputs)
    raise ValueError(f"it gives {given}; it should be boxes, scores and labels, or one (N, 6), or one "
                     "(1, 4 + classes, N)")


def own_labels(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """Read the labels: `labels` is a JSON list; `names`, as others write it, a Python dictionary of numbers."""
    try:
        if "labels" in metadata:
            found = json.loads(metadata["labels"])
        else:
            names = ast.literal_eval(metadata.get("names", "{}"))
            found = [names[index] for index in range(len(names))]
    except (ValueError, SyntaxError, KeyError, TypeError, RecursionError, MemoryError):
        raise ValueError("its metadata names no labels: `labels` is a JSON list of words") from None
    if not isinstance(found, list) or len(found) > _MAX_LABELS:
        raise ValueError(f"its metadata names no labels: `labels` is a JSON list of at most {_MAX_LABELS} words")
    return tuple(clean_label(str(one)) for one in found)


def fit_picture(picture: DecodedImage, form: ModelFormat) -> tuple[NDArray[Any], Letterbox]:
    """Return the input with the image in its center, and the position of the image."""
    bgr: NDArray[Any] = picture.bgr
    rows, columns = form.size or tuple(-(-one // _STEP_PX) * _STEP_PX for one in bgr.shape[:2])
    scale = min(rows / bgr.shape[0], columns / bgr.shape[1]) if form.size else 1.0
    height, width = min(rows, round(bgr.shape[0] * scale)), min(columns, round(bgr.shape[1] * scale))
    top, left = (rows - height) // 2, (columns - width) // 2
    if (height, width) != bgr.shape[:2]:
        bgr = cv2.resize(bgr, (width, height), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    if (height, width) != (rows, columns):
        bgr = cv2.copyMakeBorder(bgr, top, rows - height - top, left, columns - width - left, cv2.BORDER_CONSTANT,
                                 value=(_GRAY, _GRAY, _GRAY))
    if form.rgb:
        bgr = bgr[..., ::-1]
    if not form.floats:
        return np.ascontiguousarray(bgr)[None], Letterbox(scale, left, top)
    planes = np.ascontiguousarray(bgr.transpose(2, 0, 1), dtype=form.dtype)[None]
    planes /= 255
    return planes, Letterbox(scale, left, top)


def read_outputs(
    outputs: Arrays, form: ModelFormat, letterbox: Letterbox, picture: DecodedImage, min_score: float
) -> tuple[Detection, ...]:
    """Return the detections, best first, in px of the encoded image.

    Raises ValueError for outputs of another shape than in the header, and for numbers that are not finite in what
    counts: that is not the same as "saw nothing".
    """
    boxes, scores, labels = _READERS[form.kind](outputs)
    count = len(boxes)
    if boxes.shape != (count, 4) or scores.shape != (count,) or labels.shape != (count,):
        raise ValueError(f"boxes {boxes.shape}, scores {scores.shape}, labels {labels.shape}")
    counts = ~(scores < min_score)  # nan counts, too
    boxes, scores, labels = boxes[counts], scores[counts], labels[counts]
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all() and np.isfinite(labels).all()):
        raise ValueError("a box, score or label is nan or infinite")
    if (scores > 1).any():
        raise ValueError(f"invalid score {scores.max():g}: not between 0 and 1")
    first = np.argsort(-scores, kind="stable")
    if form.kind == "yolo":
        first = first[_uncovered(boxes[first], scores[first], labels[first])]
    first = first[:MAX_DETECTED_BOXES]  # the surest so many count
    placed = (boxes[first] - [letterbox.left, letterbox.top] * 2) / letterbox.scale * picture.scale
    height, width = (one * picture.scale for one in picture.bgr.shape[:2])
    found = (Detection(x1, y1, x2, y2, score, _word(form.labels, label)) for (x1, y1, x2, y2), score, label in
             zip(placed.tolist(), scores[first].tolist(), labels[first].tolist(), strict=True))
    return tuple(one for one in (clipped(one, width, height) for one in found) if one is not None)


def split_batch(outputs: Arrays, count: int) -> list[dict[str, NDArray[Any]]]:
    """Split the outputs of `count` images. Raises ValueError for another number."""
    if any(one.shape[:1] != (count,) for one in outputs.values()):
        raise ValueError(f"outputs of {', '.join(str(one.shape) for one in outputs.values())} for {count} images")
    return [{name: one[index : index + 1] for name, one in outputs.items()} for index in range(count)]


def _word(labels: Sequence[str], label: float) -> str:
    index = int(label)
    return labels[index] if 0 <= index < len(labels) else clean_label(str(index))


def _triple(outputs: Arrays) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    boxes, scores, labels = (np.asarray(outputs[name], np.float64) for name in ("boxes", "scores", "labels"))
    boxes = boxes.reshape(-1, 4) if boxes.size % 4 == 0 else boxes
    return _bounded(boxes), scores.reshape(-1), labels.reshape(-1)


def _rows(outputs: Arrays) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    (rows,) = outputs.values()
    if rows.ndim < 2 or rows.shape[-1] != 6:
        raise ValueError(f"an output of {rows.shape}")
    rows = _bounded(rows.reshape(-1, 6).astype(np.float64))
    return rows[:, :4], rows[:, 4], rows[:, 5]


def _yolo(outputs: Arrays) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    (columns,) = outputs.values()
    if columns.ndim != 3 or columns.shape[0] != 1 or columns.shape[1] <= 4:
        raise ValueError(f"an output of {columns.shape}")
    rows = _bounded(columns[0].T).astype(np.float64)
    half, classes = rows[:, 2:4] / 2, rows[:, 4:]
    labels = classes.argmax(axis=1)
    boxes = np.column_stack([rows[:, :2] - half, rows[:, :2] + half])
    return boxes, classes[np.arange(len(rows)), labels], labels.astype(np.float64)


def _bounded(rows: NDArray[Any]) -> NDArray[Any]:
    if len(rows) > _MAX_ROWS:
        raise ValueError(f"{len(rows)} boxes, at most {_MAX_ROWS}")
    return rows


_READERS: Final = {"triple": _triple, "rows": _rows, "yolo": _yolo}


def _uncovered(boxes: NDArray[Any], scores: NDArray[Any], labels: NDArray[Any]) -> NDArray[np.intp]:
    """Indices of the boxes that no surer one of the same class overlaps: a cup may stand on a plate."""
    corners = np.column_stack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]])
    kept = np.zeros(len(boxes), bool)
    for label in np.unique(labels):
        own = np.flatnonzero(labels == label)
        best = cv2.dnn.NMSBoxes(corners[own].tolist(), scores[own].tolist(), 0.0, _MAX_OVERLAP)
        kept[own[np.array(best, np.intp).reshape(-1)]] = True
    return np.flatnonzero(kept)


# --- a part of an image, enlarged by the fit to the input ---------------------------------------------------------


TILE_SHARE: Final = 0.6
"""Of the image's sides: the sides of a tile."""


@dataclass(frozen=True, slots=True)
class ImageTile:
    """A part of an image as an image of its own, and its place: its upper left corner, px of the encoded image."""

    picture: DecodedImage
    left_px: int
    top_px: int

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height, px of the encoded image."""
        rows, columns = self.picture.bgr.shape[:2]
        return int(columns) * self.picture.scale, int(rows) * self.picture.scale

    def shows_middle(self, one: Detection) -> bool:
        """Return True if the middle of `one`, in px of the whole image, is inside."""
        width, height = self.size_px
        x, y = (one.x1_px + one.x2_px) / 2 - self.left_px, (one.y1_px + one.y2_px) / 2 - self.top_px
        return 0 <= x < width and 0 <= y < height

    def shows_all(self, one: Detection) -> bool:
        """Return True if `one`, in px of this tile, is clear of its border: it may go on beyond."""
        width, height = self.size_px
        return one.x1_px > 1 and one.y1_px > 1 and one.x2_px < width - 1 and one.y2_px < height - 1

    def in_image(self, one: Detection) -> Detection:
        """Return a detection in this tile in px of the whole image."""
        return replace(one, x1_px=one.x1_px + self.left_px, y1_px=one.y1_px + self.top_px,
                       x2_px=one.x2_px + self.left_px, y2_px=one.y2_px + self.top_px)


def tile_about(picture: DecodedImage, place_px: tuple[float, float]) -> ImageTile:
    """Cut the tile about a place, in px of the encoded image; at the border it moves inside."""
    rows, columns = picture.bgr.shape[:2]
    height, width = max(1, round(rows * TILE_SHARE)), max(1, round(columns * TILE_SHARE))
    left = min(max(0, round(place_px[0] / picture.scale - width / 2)), columns - width)
    top = min(max(0, round(place_px[1] / picture.scale - height / 2)), rows - height)
    part = np.ascontiguousarray(picture.bgr[top : top + height, left : left + width])
    return ImageTile(DecodedImage(part, picture.scale), left * picture.scale, top * picture.scale)
