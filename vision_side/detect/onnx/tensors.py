"""Convert images to input tensors, and output tensors to detections. Pure.

Inputs: uint8 rows of pixels (1, H, W, 3), BGR unless configured, or float (1, 3, H, W), RGB from 0 to 1. Outputs, one
of these: `boxes` (K, 4), `scores` (K), `labels` (K), as in Sightline's model, with optional `masks` (K, h, w);
(N, 6) of x1, y1, x2, y2, score, class; (4 + classes, N) of cx, cy, w, h and a score for each class, as in YOLO since
version 8; (N, 5 + classes) with a score of the box before the class scores, as in YOLOv5. The last two forms still
contain overlaps. A YOLO row may end with numbers for a mask; a second output then has the prototypes of the masks.
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
from sightline.vision_side.detect.port import Circle, Detection, clean_label, clipped, is_normalized

Arrays = Mapping[str, NDArray[Any]]
_MAX_ROWS: Final = 100_000
_MAX_OVERLAP: Final = 0.5
_GRAY: Final = 114  # border next to an image that does not fill the input, as in the training of YOLO
_STEP_PX: Final = 32  # an open input size is rounded up to a multiple of this
_STRIDES: Final = (8, 16, 32)
"""Sizes of the cells of YOLO in px. Since version 8 each cell gives one box, in YOLOv5 three."""
_TRIPLE: Final = {"boxes", "scores", "labels"}
_SUPPRESSED: Final = 1000
"""With more rows, six numbers are one class of YOLOv5. With fewer, they are boxes without overlaps."""
_COMPARED: Final = 1000
"""Boxes with the highest scores that are compared for overlaps; at most 64 of them count."""
_LEAST_ROUND: Final = 0.8
"""Least share of the enclosing circle that a round mask fills. A square fills 0.64."""
_MAX_LABELS: Final = 1000
_ROUNDING_PX: Final = 1.0
_COCO: Final = (
    "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,stop sign,parking meter,"
    "bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,backpack,umbrella,handbag,tie,suitcase,frisbee,"
    "skis,snowboard,sports ball,kite,baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,"
    "cup,fork,knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,"
    "potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,keyboard,cell phone,microwave,oven,toaster,sink,"
    "refrigerator,book,clock,vase,scissors,teddy bear,hair drier,toothbrush"
)
COCO: Final = tuple(_COCO.split(","))
"""The labels of the 80 classes of COCO, in their usual order. Source: Lin et al., Microsoft COCO, 2014."""
_NO_CLASS: Final = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
"""Numbers without a class among the 91 of the original COCO files, which torchvision and DETR use."""


@dataclass(frozen=True, slots=True)
class Letterbox:
    """Place of the image in the input: `scale` input pixels for each image pixel, from (`left`, `top`)."""

    scale: float
    left: int
    top: int


@dataclass(frozen=True, slots=True)
class ModelFormat:
    """Layout of the inputs and outputs of one model."""

    floats: bool
    rgb: bool
    size: tuple[int, int] | None
    """(rows, columns); None if the model accepts any size."""
    kind: str
    """triple, rows, yolo or yolov5."""
    labels: tuple[str, ...]
    dtype: str = "uint8"
    batched: bool = False
    """True if it accepts several images: inputs and outputs leave the first dimension open."""
    masks: int = 0
    """Numbers at the end of each row, which combine the prototypes to a mask."""


def model_format(header: OnnxHeader, names: Sequence[str], color: str) -> ModelFormat:
    """Parse inputs and outputs. Raises ValueError for an unknown layout."""
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
    if bool(rows) != bool(columns):
        raise ValueError(f"its input is {_shape_text(one)}; export it with both H and W fixed, or with both open")
    size = (rows, columns) if rows and columns else None
    labels = named_labels(names) or own_labels(header.metadata)
    kind, classes, masks = _kind(header.outputs, labels, size)
    if not labels and classes == len(COCO):
        labels = COCO
    batched = size is not None and one.shape[0] is None and all(_is_for_several(one, kind) for one in header.outputs)
    rgb = floats if color == "auto" else color == "rgb"
    return ModelFormat(floats, rgb, size, kind, labels, one.type, batched, masks)


def named_labels(names: Sequence[str]) -> tuple[str, ...]:
    """Return the labels of a configuration. `coco` and `coco91` are the labels of COCO, in either numbering."""
    if tuple(names) == ("coco91",):
        words = iter(COCO)
        return tuple("none" if number in _NO_CLASS else next(words) for number in range(len(COCO) + len(_NO_CLASS)))
    return COCO if tuple(names) == ("coco",) else tuple(map(clean_label, names))


def _is_for_several(output: Tensor, kind: str) -> bool:
    """Return True if its first dimension is open and counts images."""
    sides = 2 if kind == "triple" and output.name != "boxes" else 3 + _is_prototypes(output)
    return len(output.shape) == sides and output.shape[0] is None


def _is_prototypes(output: Tensor) -> bool:
    """Return True for (1, M, h, w): prototypes, which the M numbers of a box combine to its mask."""
    return len(output.shape) == 4 and output.shape[1] is not None


def _shape_text(one: Tensor) -> str:
    return "(" + ", ".join("?" if part is None else str(part) for part in one.shape) + ")"


def _kind(
    outputs: Sequence[Tensor], labels: Sequence[str], size: tuple[int, int] | None
) -> tuple[str, int, int]:
    """Return the kind, its number of classes (0 if unknown), and the numbers of a mask in each row."""
    is_triple = {one.name for one in outputs} >= _TRIPLE
    for one in outputs:
        if "int8" in one.type and (one.name in ("boxes", "scores") or not is_triple):
            raise ValueError(f"its output {one.name} is {one.type}, which is quantized; export it with float outputs")
    if is_triple:
        return "triple", 0, 0
    masks = next((one.shape[1] or 0 for one in outputs if _is_prototypes(one)), 0)
    rows = [one for one in outputs if not _is_prototypes(one)]
    shape = rows[0].shape if len(rows) == 1 and len(outputs) <= 2 else ()
    if shape and shape[-1] == 6 + masks and (len(shape) < 2 or (shape[-2] or 0) <= _SUPPRESSED):
        return "rows", 0, masks
    if len(shape) == 3:
        by_row = _is_by_row(shape, len(labels), masks, size)
        classes = (shape[2] or 0) - 5 - masks if by_row else (shape[1] or 0) - 4 - masks
        if classes > 0 and labels and classes != len(labels):
            raise ValueError(f"it has {classes} classes and {len(labels)} names; "
                             "detector.options.names has one for each, in order")
        if classes > 0:
            return "yolov5" if by_row else "yolo", classes, masks
    given = ", ".join(f"{one.name} {_shape_text(one)}" for one in outputs)
    raise ValueError(f"it gives {given}; it should be boxes, scores and labels, or one (N, 6), or one "
                     "(1, 4 + classes, N), or one (1, N, 5 + classes)")


def _is_by_row(shape: Sequence[int | None], labels: int, masks: int, size: tuple[int, int] | None) -> bool:
    """Return True if each row is a box: by the number of labels, or of boxes, or because these outnumber classes."""
    if labels and shape[1] == 4 + labels + masks:
        return False
    if labels and shape[2] == 5 + labels + masks:
        return True
    cells = sum((size[0] // stride) * (size[1] // stride) for stride in _STRIDES) if size else -1
    if (shape[2] == cells) != (shape[1] == 3 * cells):
        return shape[2] != cells
    return shape[1] is None or (shape[2] is not None and shape[2] < shape[1])


def own_labels(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """Read the labels: `labels` is a JSON list; `names`, of other exporters, a Python dictionary by number."""
    try:
        if "labels" in metadata:
            found = json.loads(metadata["labels"])
        else:
            names = ast.literal_eval(metadata.get("names", "{}"))
            if isinstance(names, dict):  # a number without a name is its own label
                names = [names.get(number, number) for number in range(min(max(names, default=-1), _MAX_LABELS) + 1)]
            found = [names[index] for index in range(len(names))]
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
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

    Raises ValueError for outputs with another shape than in the header, and for non-finite numbers in boxes that
    count. Such an answer differs from "detected nothing".
    """
    boxes, scores, labels = _READERS[form.kind](outputs, form.masks)
    count = len(boxes)
    if boxes.shape != (count, 4) or scores.shape != (count,) or labels.shape != (count,):
        raise ValueError(f"boxes {boxes.shape}, scores {scores.shape}, labels {labels.shape}")
    counts = np.flatnonzero(~(scores < min_score))  # includes nan
    boxes, scores, labels = boxes[counts], scores[counts], labels[counts]
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all() and np.isfinite(labels).all()):
        raise ValueError("a box, score or label is nan or infinite")
    if (scores > 1).any():
        raise ValueError(f"invalid score {scores.max():g}: not between 0 and 1")
    _check_corners(boxes)
    first = np.argsort(-scores, kind="stable")
    if form.kind.startswith("yolo"):
        first = first[:_COMPARED]
        first = first[_uncovered(boxes[first], scores[first], labels[first])]
    first = first[:MAX_DETECTED_BOXES]  # the boxes with the highest scores
    circles = _circles(outputs, form, counts[first], boxes[first])
    corner, scale = np.array([letterbox.left, letterbox.top]), picture.scale / letterbox.scale
    placed = (boxes[first] - [*corner, *corner]) * scale
    height, width = (one * picture.scale for one in picture.bgr.shape[:2])
    found = (Detection(x1, y1, x2, y2, score, _word(form.labels, label), ring and _moved(ring, corner, scale))
             for (x1, y1, x2, y2), score, label, ring in
             zip(placed.tolist(), scores[first].tolist(), labels[first].tolist(), circles, strict=True))
    return tuple(one for one in (clipped(one, width, height) for one in found) if one is not None)


def _check_corners(boxes: NDArray[Any]) -> None:
    """Raises ValueError for boxes in another order than x1, y1, x2, y2, or in another unit than pixels.

    Without this they would lie outside of the image, which is the same as "saw nothing".
    """
    turned = boxes[(boxes[:, 2:] < boxes[:, :2] - _ROUNDING_PX).any(axis=1)]
    if len(turned):
        raise ValueError(f"a box ({', '.join(f'{one:g}' for one in turned[0])}) ends before it begins; expected x1, "
                         "y1, x2, y2")
    if is_normalized(boxes):
        raise ValueError("all boxes lie within two pixels of the corner, as if from 0 to 1; export them in pixels of "
                         "the input")


def split_batch(outputs: Arrays, count: int) -> list[dict[str, NDArray[Any]]]:
    """Split the outputs of `count` images. Raises ValueError for another number."""
    if any(one.shape[:1] != (count,) for one in outputs.values()):
        raise ValueError(f"outputs of {', '.join(str(one.shape) for one in outputs.values())} for {count} images")
    return [{name: one[index : index + 1] for name, one in outputs.items()} for index in range(count)]


def _word(labels: Sequence[str], label: float) -> str:
    index = int(label)
    return labels[index] if 0 <= index < len(labels) else clean_label(str(index))


_Columns = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Boxes (K, 4), scores (K), labels (K)."""


def _triple(outputs: Arrays, _masks: int) -> _Columns:
    boxes, scores, labels = (np.asarray(outputs[name], np.float64) for name in ("boxes", "scores", "labels"))
    boxes = boxes.reshape(-1, 4) if boxes.size % 4 == 0 else boxes
    return _bounded(boxes), scores.reshape(-1), labels.reshape(-1)


def _rows(outputs: Arrays, masks: int) -> _Columns:
    rows = _of_boxes(outputs)
    if rows.ndim < 2 or rows.shape[-1] != 6 + masks:
        raise ValueError(f"an output of {rows.shape}")
    rows = _bounded(rows.reshape(-1, 6 + masks).astype(np.float64))
    scores, labels = rows[:, 4], rows[:, 5]
    if (labels % 1 > 0).any() and not (scores % 1 > 0).any():
        raise ValueError("each row has its class before its score; expected x1, y1, x2, y2, score, class")
    return rows[:, :4], scores, labels


def _yolo(outputs: Arrays, masks: int) -> _Columns:
    columns = _of_boxes(outputs)
    if columns.ndim != 3 or columns.shape[0] != 1 or columns.shape[1] <= 4 + masks:
        raise ValueError(f"an output of {columns.shape}")
    return _surest(columns[0], 4, masks)


def _yolov5(outputs: Arrays, masks: int) -> _Columns:
    rows = _of_boxes(outputs)
    if rows.ndim != 3 or rows.shape[0] != 1 or rows.shape[2] <= 5 + masks:
        raise ValueError(f"an output of {rows.shape}")
    boxes, scores, labels = _surest(rows[0].T, 5, masks)
    return boxes, scores * rows[0, :, 4], labels


def _surest(columns: NDArray[Any], first: int, masks: int) -> _Columns:
    """Return box and best class of each column: cx, cy, w, h, and from row `first` a score for each class."""
    _bounded(columns.T)
    half, classes = columns[2:4].astype(np.float64) / 2, columns[first : columns.shape[0] - masks]
    labels = classes.argmax(axis=0)
    boxes = np.concatenate([columns[:2] - half, columns[:2] + half]).T
    return boxes, classes[labels, np.arange(len(boxes))].astype(np.float64), labels.astype(np.float64)


def _of_boxes(outputs: Arrays) -> NDArray[Any]:
    """Return the output with the boxes, which does not have the four dimensions of mask prototypes."""
    return next((one for one in outputs.values() if one.ndim != 4), np.zeros(0))


def _bounded(rows: NDArray[Any]) -> NDArray[Any]:
    if len(rows) > _MAX_ROWS:
        raise ValueError(f"{len(rows)} boxes, at most {_MAX_ROWS}")
    return rows


_READERS: Final = {"triple": _triple, "rows": _rows, "yolo": _yolo, "yolov5": _yolov5}


# --- masks: only the circle of a round mask is used ----------------------------------------------------------------


def _circles(
    outputs: Arrays, form: ModelFormat, rows: NDArray[np.intp], boxes: NDArray[Any]
) -> list[Circle | None]:
    """Return the circle of the mask of each row, px of the input; None for a mask that is not round."""
    if form.kind == "triple":
        masks = np.asarray(outputs.get("masks", np.zeros(0)))
        if not masks.size:
            return [None] * len(rows)
        flat = masks.reshape(-1, *masks.shape[-2:])
        return [circle_of(flat[row] > 0.5) for row in rows]
    if not form.masks or form.size is None:
        return [None] * len(rows)
    prototypes = next(one[0] for one in outputs.values() if one.ndim == 4)
    table = _of_boxes(outputs)
    table = table[0].T if form.kind == "yolo" else table.reshape(-1, table.shape[-1])
    numbers = table[rows, -form.masks :]
    scale = form.size[0] / prototypes.shape[1]
    return [_of_prototypes(np.tensordot(one, prototypes, 1) > 0, box / scale, scale)
            for one, box in zip(numbers, boxes, strict=True)]


def _of_prototypes(mask: NDArray[np.bool_], box: NDArray[Any], scale: float) -> Circle | None:
    """Return the circle of the part of a mask inside its box."""
    x1, y1, x2, y2 = (max(0, round(float(one))) for one in box)
    inside = np.zeros_like(mask)
    inside[y1:y2, x1:x2] = mask[y1:y2, x1:x2]
    ring = circle_of(inside)
    return ring and _moved(ring, np.zeros(2), scale)


def circle_of(mask: NDArray[np.bool_]) -> Circle | None:
    """Return the circle with the center and the area of a mask, or None if the mask is not round.

    Args:
        mask: (rows, columns), True on the object.
    """
    points = np.argwhere(mask)[:, ::-1].astype(np.float32)
    if not len(points):
        return None
    radius = cv2.minEnclosingCircle(points)[1] + 0.5  # to the outer edge of the pixels
    if len(points) < _LEAST_ROUND * np.pi * radius * radius:
        return None
    x, y = points.mean(axis=0) + 0.5
    return Circle(float(x), float(y), float(np.sqrt(len(points) / np.pi)))


def _moved(ring: Circle, corner: NDArray[Any], scale: float) -> Circle:
    return Circle(float((ring.cx_px - corner[0]) * scale), float((ring.cy_px - corner[1]) * scale),
                  ring.radius_px * scale)


# --- overlaps ------------------------------------------------------------------------------------------------------


def _uncovered(boxes: NDArray[Any], scores: NDArray[Any], labels: NDArray[Any]) -> NDArray[np.intp]:
    """Return the boxes without an overlapping box of the same class and a higher score: a cup may stand on a plate."""
    corners = np.column_stack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]])
    kept = np.zeros(len(boxes), bool)
    for label in np.unique(labels):
        own = np.flatnonzero(labels == label)
        best = cv2.dnn.NMSBoxes(corners[own].tolist(), scores[own].tolist(), 0.0, _MAX_OVERLAP)
        kept[own[np.array(best, np.intp).reshape(-1)]] = True
    return np.flatnonzero(kept)


# --- a part of an image, enlarged by the fit to the input ---------------------------------------------------------


# Mean difference of largest and smallest channel, divided by the mean brightness: for a usual image; limit of a pale
# image; limit of a gray image, whose color is noise. A usual image at 0.3 of its saturation has 0.023.
_USUAL, _PALE, _COLORLESS = 0.077, 0.04, 0.005
_MOST_VIVID = 3.3
TILE_SHARE: Final = 0.6
"""Sides of a tile, as a share of the sides of the image."""
_SMALL_SHARE: Final = 24 / 320
"""Share of the image width: an object in doubt that is narrower is enlarged. Decision 14 compares other rules."""


@dataclass(frozen=True, slots=True)
class ImageTile:
    """A part of an image, with its upper left corner in px of the encoded image."""

    picture: DecodedImage
    left_px: int
    top_px: int
    is_mirrored: bool = False
    """True if left and right are swapped. Such a tile must show the whole image."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height, px of the encoded image."""
        rows, columns = self.picture.bgr.shape[:2]
        return int(columns) * self.picture.scale, int(rows) * self.picture.scale

    def shows_all(self, one: Detection) -> bool:
        """Return True if `one`, in px of this tile, is clear of the border, where an object may continue outside."""
        width, height = self.size_px
        is_clear = one.x1_px > 1 and one.y1_px > 1 and one.x2_px < width - 1 and one.y2_px < height - 1
        return is_clear or self.is_mirrored

    def holds(self, one: Detection) -> bool:
        """Return True if `one`, in px of the whole image, does not touch the border of this tile."""
        return self.shows_all(replace(one, x1_px=one.x1_px - self.left_px, y1_px=one.y1_px - self.top_px,
                                      x2_px=one.x2_px - self.left_px, y2_px=one.y2_px - self.top_px))

    def in_image(self, one: Detection) -> Detection:
        """Convert a detection from px of this tile to px of the whole image."""
        if self.is_mirrored:
            width = self.size_px[0]
            circle = one.circle and replace(one.circle, cx_px=width - one.circle.cx_px)
            return replace(one, x1_px=width - one.x2_px, x2_px=width - one.x1_px, circle=circle)
        circle = one.circle and _moved(one.circle, np.array([-self.left_px, -self.top_px]), 1.0)
        return replace(one, x1_px=one.x1_px + self.left_px, y1_px=one.y1_px + self.top_px,
                       x2_px=one.x2_px + self.left_px, y2_px=one.y2_px + self.top_px, circle=circle)


def vivid(picture: DecodedImage) -> DecodedImage:
    """Give a pale image the saturation of the training images; return any other image unchanged."""
    part = picture.bgr[::8, ::8].astype(np.int16)
    chroma = float((part.max(axis=2) - part.min(axis=2)).mean()) / max(1.0, float(part.mean()))
    if not _COLORLESS < chroma < _PALE:
        return picture
    more = min(_MOST_VIVID, _USUAL / chroma)
    mix = np.full((3, 3), (1 - more) / 3, np.float32) + more * np.eye(3, dtype=np.float32)
    return DecodedImage(np.asarray(cv2.transform(picture.bgr, mix), np.uint8), picture.scale)


def tile_about(picture: DecodedImage, place_px: tuple[float, float]) -> ImageTile:
    """Cut the tile around a place, in px of the encoded image. Near the border it moves inside the image."""
    rows, columns = picture.bgr.shape[:2]
    height, width = max(1, round(rows * TILE_SHARE)), max(1, round(columns * TILE_SHARE))
    left = min(max(0, round(place_px[0] / picture.scale - width / 2)), columns - width)
    top = min(max(0, round(place_px[1] / picture.scale - height / 2)), rows - height)
    part = np.ascontiguousarray(picture.bgr[top : top + height, left : left + width])
    return ImageTile(DecodedImage(part, picture.scale), left * picture.scale, top * picture.scale)


def view_again(picture: DecodedImage, one: Detection) -> ImageTile:
    """Return an image in which an object in doubt looks different: enlarged if it is small, otherwise mirrored."""
    tile = tile_about(picture, one.center_px)
    if (one.x2_px - one.x1_px) < _SMALL_SHARE * picture.bgr.shape[1] * picture.scale and tile.holds(one):
        return tile
    return ImageTile(DecodedImage(np.ascontiguousarray(picture.bgr[:, ::-1]), picture.scale), 0, 0, is_mirrored=True)
