"""Heads of exported models: YOLO of version 5 and 8, without overlaps, with masks, and the labels of COCO."""

import numpy as np
import pytest

from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.onnx.engine import OnnxHeader, Tensor
from sightline.vision_side.detect.onnx.tensors import (
    COCO,
    ModelFormat,
    circle_of,
    fit_picture,
    model_format,
    read_outputs,
)
from sightline.vision_side.detect.port import Detection

PICTURE = DecodedImage(np.full((240, 320, 3), 128, np.uint8), 1)
INPUT = Tensor("images", "float32", (1, 3, 640, 640))
CUP = "{0: 'cup', 1: 'plate'}"
CUP_NAMES = ("cup", "plate")


def form_of(*shapes: tuple[int | None, ...], names: tuple[str, ...] = (), metadata: str = "") -> ModelFormat:
    outputs = tuple(Tensor(f"output{index}", "float32", shape) for index, shape in enumerate(shapes))
    return model_format(OnnxHeader((INPUT,), outputs, {"names": metadata} if metadata else {}), names, "auto")


@pytest.mark.parametrize(
    ("shapes", "names", "kind", "masks"),
    [
        ([(1, 84, 8400)], "", "yolo", 0),
        ([(1, 25200, 85)], "", "yolov5", 0),
        ([(1, 300, 6)], "", "rows", 0),
        ([(1, 25200, 6)], "{0: 'ball'}", "yolov5", 0),
        ([(1, 5, 8400)], "{0: 'ball'}", "yolo", 0),
        ([(None, 6, None)], CUP, "yolo", 0),
        ([(None, None, 7)], CUP, "yolov5", 0),
        ([(1, 6, 4)], CUP, "yolo", 0),
        ([(1, 116, 8400), (1, 32, 160, 160)], "", "yolo", 32),
        ([(1, 25200, 117), (1, 32, 160, 160)], "", "yolov5", 32),
        ([(1, 300, 38), (1, 32, 160, 160)], "", "rows", 32),
    ],
)
def test_shapes_and_names_identify_the_head(shapes: list, names: str, kind: str, masks: int) -> None:
    form = form_of(*shapes, metadata=names)
    assert (form.kind, form.masks) == (kind, masks)


@pytest.mark.parametrize(
    ("shapes", "words"),
    [
        ([(1, 84, 8400), (1, 300, 6)], r"gives output0 \(1, 84, 8400\), output1"),
        ([(1, 1000)], r"gives output0 \(1, 1000\)"),
        ([(1, 4, 8400)], "4 \\+ classes"),
        ([(1, 3, 80, 80, 85)], "80, 80, 85"),
        ([(1, 30, 8400), (1, 32, 160, 160)], "it should be boxes"),
    ],
)
def test_model_with_other_outputs_is_rejected(shapes: list, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        form_of(*shapes)


@pytest.mark.parametrize("kind", ["tensor(int8)", "uint8"])
@pytest.mark.parametrize(
    "outputs",
    [{"boxes": (5, 4), "scores": (5,), "labels": (5,)}, {"output0": (1, 84, 8400)}, {"output0": (1, 300, 6)}],
)
def test_quantized_boxes_and_scores_are_rejected_and_labels_of_bytes_are_not(outputs: dict, kind: str) -> None:
    """Before, a byte of 1 was a score of 1, and int8 scores, which may be below 0, were "saw nothing"."""
    for quantized in outputs:
        header = OnnxHeader((INPUT,), tuple(Tensor(name, kind if name == quantized else "float32", shape)
                                            for name, shape in outputs.items()), {})
        if quantized == "labels":
            assert model_format(header, (), "auto").kind == "triple"
            continue
        with pytest.raises(ValueError, match=r"its output .* is .*int8.*, which is quantized"):
            model_format(header, (), "auto")


@pytest.mark.parametrize("shape", [(1, 3, None, 320), (1, 3, 320, None)])
def test_model_with_one_open_side_is_rejected(shape: tuple[int | None, ...]) -> None:
    """Its warm-up may have the right size, and an image of the robot another one."""
    header = OnnxHeader((Tensor("images", "float32", shape),), (Tensor("output0", "float32", (1, 84, 8400)),), {})
    with pytest.raises(ValueError, match="export it with both H and W fixed, or with both open"):
        model_format(header, (), "auto")


@pytest.mark.parametrize("side", range(32, 673, 64))
@pytest.mark.parametrize("classes", [1, 80, 365, 601, 996])
def test_number_of_boxes_identifies_the_head_of_a_model_without_names(side: int, classes: int) -> None:
    """A small input may have fewer boxes than classes: (1, 605, 525) was read as YOLOv5 with 520 classes."""
    boxes = sum((side // stride) ** 2 for stride in (8, 16, 32))
    image = Tensor("images", "float32", (1, 3, side, side))
    for kind, shape in ("yolo", (1, 4 + classes, boxes)), ("yolov5", (1, 3 * boxes, 5 + classes)):
        if shape[-1] != 6:
            form = model_format(OnnxHeader((image,), (Tensor("output0", "float32", shape),), {}), (), "auto")
            assert (form.kind, form.labels == COCO) == (kind, classes == 80)


@pytest.mark.parametrize("names", ["{1: 'cup', 3: 'plate'}", "{3: 'plate', 1: 'cup'}"])
def test_number_without_a_name_is_the_label_of_its_class(names: str) -> None:
    assert form_of((1, 300, 6), metadata=names).labels == ("0", "cup", "2", "plate")
    assert form_of((1, 8, 8400), metadata=names).kind == "yolo"


@pytest.mark.parametrize("names", [
    "{10**9: 'cup'}", "{1000000000: 'cup'}", "{'0': 'cup'}", "{0.5: 'cup'}", "7", "{'cup'}", "{(): 'cup'}",
    "{None: 'cup', 0: 'plate'}",
])
def test_names_that_do_not_number_classes_are_one_line(names: str) -> None:
    with pytest.raises(ValueError, match="its metadata names no labels"):
        form_of((1, 300, 6), metadata=names)


def test_number_of_names_must_match_the_classes() -> None:
    for shape in ((1, 84, 8400), (1, 25200, 85)):
        with pytest.raises(ValueError, match="80 classes and 2 names"):
            form_of(shape, names=("cup", "plate"))


def test_model_of_80_classes_without_names_has_the_labels_of_coco() -> None:
    assert form_of((1, 84, 8400)).labels == COCO and len(COCO) == 80
    assert form_of((1, 85, 8400)).labels == ()
    assert form_of((1, 300, 6), names=("coco",)).labels == COCO
    by_coco = form_of((1, 300, 6), names=("coco91",)).labels
    assert len(by_coco) == 91
    assert [by_coco[number] for number in (1, 13, 37, 62, 90)] == [
        "person", "stop sign", "sports ball", "chair", "toothbrush"]


def read(outputs: dict, form: ModelFormat, picture: DecodedImage = PICTURE) -> tuple[Detection, ...]:
    return read_outputs(outputs, form, fit_picture(picture, form)[1], picture, 0.25)


def test_yolov5_score_is_that_of_the_box_times_that_of_the_class() -> None:
    rows = np.zeros((1, 3, 7), np.float32)
    rows[0, 0] = (320, 320, 100, 100, 0.9, 0.1, 0.8)
    rows[0, 1] = (322, 320, 100, 100, 0.8, 0.1, 0.8)  # the same plate again
    rows[0, 2] = (100, 200, 50, 50, 0.2, 1.0, 0.0)  # a sure class of what is hardly a thing
    (one,) = read({"output0": rows}, form_of((1, 25200, 7), names=CUP_NAMES))
    assert (one.label, one.score) == ("plate", pytest.approx(0.72))
    # 640x640 holds 320x240 at twice its size, with 80 gray rows above.
    assert (one.x1_px, one.y1_px, one.x2_px, one.y2_px) == pytest.approx((135, 95, 185, 145))


TRIPLE = ModelFormat(True, True, (640, 640), "triple", CUP_NAMES, "float32")


def triple(*boxes: tuple[float, float, float, float], scores: tuple[float, ...] = ()) -> dict:
    given = np.array(scores or [0.9] * len(boxes), np.float32)
    return {"boxes": np.array(boxes, np.float32), "scores": given, "labels": np.zeros(len(boxes), np.int64)}


@pytest.mark.parametrize("boxes", [
    [(0.1, 0.2, 0.3, 0.4)], [(0.0, 0.0, 1.0, 1.0)], [(0.5, 0.4, 1.9, 0.7), (0.9, 0.9, 1.0, 1.99)],
    [(0.1, 0.2, 0.3, 0.4), (320.0, 320.0, 320.0, 400.0)],  # the second one has no area
])
def test_boxes_from_0_to_1_are_an_error_and_not_an_empty_answer(boxes: list) -> None:
    """Before, they lay in the gray border, so that the answer was "saw nothing"."""
    with pytest.raises(ValueError, match="from 0 to 1; export them in pixels"):
        read(triple(*boxes), TRIPLE)
    columns = np.array([[((x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1, 0.9, 0.1) for x1, y1, x2, y2 in boxes]])
    with pytest.raises(ValueError, match="from 0 to 1; export them in pixels"):
        read({"output0": columns.transpose(0, 2, 1)}, form_of((1, 6, 8400), names=CUP_NAMES))


@pytest.mark.parametrize("box", [(200, 180, 40, 200), (200, 180, 240, 60), (300, 300, 298.9, 310)])
def test_box_that_ends_before_it_begins_is_an_error(box: tuple) -> None:
    """It is x, y, width and height: before, it was left out without a line."""
    with pytest.raises(ValueError, match=r"a box \(.* ends before it begins; expected x1, y1, x2, y2"):
        read(triple((100, 300, 140, 340), box), TRIPLE)


@pytest.mark.parametrize("rows", [
    [(100, 300, 140, 340, 0, 0.9)], [(100, 300, 140, 340, 1, 0.9), (0, 0, 0, 0, 0, 0)],
    [(100, 300, 140, 340, 0, 0.2), (200, 300, 240, 340, 7, 1.0)],
])
def test_rows_with_the_class_before_the_score_are_an_error(rows: list) -> None:
    """Before, class 0 was a score of 0, so that the answer was "saw nothing", and class 1 a score of 1."""
    form = form_of((1, 300, 6))
    with pytest.raises(ValueError, match="class before its score; expected x1, y1, x2, y2, score, class"):
        read({"output0": np.array([rows], np.float32)}, form)
    right = np.array([rows], np.float32)[..., [0, 1, 2, 3, 5, 4]]
    assert {one.label for one in read({"output0": right}, form)} == {str(row[4]) for row in rows if row[5] > 0.25}


@pytest.mark.parametrize(("row", "count"), [
    ((100, 300, 140, 340, 1, 2), 1), ((100, 300, 140, 340, 0.9, 1.98), 1), ((0, 0, 0, 0, 0, 0), 0),
])
def test_rows_of_whole_scores_or_of_a_quantized_class_count(row: tuple, count: int) -> None:
    assert len(read({"output0": np.array([[row]], np.float32)}, form_of((1, 300, 6)))) == count


def test_boxes_that_do_not_count_or_have_no_area_change_nothing() -> None:
    thing, flat, corner = (100, 300, 140, 340), (300, 300, 299.1, 310), (0.1, 0.1, 0.9, 0.9)
    assert len(read(triple(thing, (200, 180, 40, 40), corner, scores=(0.9, 0.2, 0.2)), TRIPLE)) == 1
    assert len(read(triple(thing, flat, corner), TRIPLE)) == 1
    assert read(triple(flat, (0, 0, 0, 0)), TRIPLE) == ()
    assert read(triple((0, 78, 2, 90)), TRIPLE) != ()


def disk(rows: int, columns: int, x: float, y: float, radius: float) -> np.ndarray:
    down, across = np.mgrid[:rows, :columns] + 0.5
    return (across - x) ** 2 + (down - y) ** 2 <= radius**2


@pytest.mark.parametrize("by_row", [False, True])
def test_round_mask_of_yolo_becomes_a_circle(by_row: bool) -> None:
    prototypes = np.where(np.stack([disk(160, 160, 80, 80, 10), disk(160, 160, 40, 60, 30)]), 1.0, -1.0)
    boxes = np.array([[320, 240], [320, 240], [80, 60], [80, 60]], np.float32)
    masks = np.array([[3, 0], [0, 3]], np.float32)  # the second is half of a disk that goes on beyond its box
    scores = np.array([[0.9, 0.1], [0.1, 0.8]], np.float32)
    boxes[0, 1] = 200
    columns = np.concatenate([boxes, *([np.ones((1, 2), np.float32)] if by_row else []), scores, masks])[None]
    form = form_of((1, 9000, 9) if by_row else (1, 8, 8400), (1, 2, 160, 160), names=CUP_NAMES)
    outputs = {"output0": columns.transpose(0, 2, 1) if by_row else columns, "output1": prototypes[None]}
    first, second = read(outputs, form)
    assert first.circle is not None and second.circle is None
    circle = first.circle
    assert (circle.cx_px, circle.cy_px, circle.radius_px) == pytest.approx((160, 120, 20), abs=0.3)


@pytest.mark.parametrize("shape", [(2, 8), (1, 2, 8)])
def test_round_mask_beside_a_row_becomes_a_circle(shape: tuple[int, ...]) -> None:
    prototypes = np.where(np.stack([disk(160, 160, 80, 80, 10), disk(160, 160, 40, 60, 30)]), 1.0, -1.0)[None]
    rows = np.array([[280, 280, 360, 360, 0.9, 0, 3, 0], [120, 200, 160, 280, 0.8, 1, 0, 3]], np.float32)
    form = form_of(shape, (1, 2, 160, 160), names=CUP_NAMES)
    first, second = read({"output0": rows.reshape(shape), "output1": prototypes}, form)
    assert (form.kind, first.label, second.circle) == ("rows", "cup", None)
    circle = first.circle
    assert circle is not None
    assert (circle.cx_px, circle.cy_px, circle.radius_px) == pytest.approx((160, 120, 20), abs=0.3)


def test_masks_beside_boxes_become_circles() -> None:
    form = ModelFormat(True, True, (240, 320), "triple", ("ball", "box"), "float32")
    square = np.zeros((240, 320))
    square[100:140, 200:240] = 1
    masks = np.stack([square, disk(240, 320, 60.5, 80, 15)])[:, None]
    outputs = {"boxes": np.array([[200, 100, 240, 140], [45, 65, 76, 95]]), "scores": np.array([0.5, 0.9]),
               "labels": np.array([1, 0]), "masks": masks}
    ball, box = read(outputs, form)
    assert (ball.label, box.label, box.circle) == ("ball", "box", None)
    assert (ball.circle.cx_px, ball.circle.cy_px, ball.circle.radius_px) == pytest.approx((60.5, 80, 15), abs=0.2)


def test_only_a_round_mask_has_a_circle() -> None:
    assert circle_of(np.zeros((9, 9), bool)) is None
    assert circle_of(np.ones((9, 9), bool)) is None
    assert circle_of(disk(40, 80, 20, 20, 12) | disk(40, 80, 50, 20, 12)) is None
    small = circle_of(disk(40, 40, 20, 20, 4))
    assert small is not None and small.radius_px == pytest.approx(4, abs=0.2)


def test_images_of_other_sizes_in_one_run_keep_their_own_pixels() -> None:
    form = form_of((1, 6, 8400), names=CUP_NAMES)
    for height, width in ((240, 320), (480, 640), (61, 97), (240, 320)):
        picture = DecodedImage(np.zeros((height, width, 3), np.uint8), 1)
        columns = np.array([[320], [320], [64], [64], [0.9], [0.0]], np.float32)[None]
        (one,) = read({"output0": columns}, form, picture)
        assert ((one.x1_px + one.x2_px) / 2, (one.y1_px + one.y2_px) / 2) == pytest.approx(
            (width / 2, height / 2), abs=0.6)
