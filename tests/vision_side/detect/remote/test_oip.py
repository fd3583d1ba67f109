"""The Open Inference Protocol without a network: requests, answers, and any reply of a hostile server."""

import contextlib
import json
import random
from dataclasses import asdict, replace

import numpy as np
import pytest

from sightline.vision_side.detect.remote.client import NoAnswerError, NoAnswerReason
from sightline.vision_side.detect.remote.oip import (
    Inferred,
    OipModel,
    OipSettings,
    TensorSlot,
    detections_of,
    model_of,
    tensor_of,
)
from sightline.vision_side.detect.remote.oip_http import read_infer, read_metadata
from tests.fixtures.vision.remote import ASKED, BALL_JPEG, JPEG_INPUT, OUTPUTS, frame

PIXELS = TensorSlot("image", "UINT8", (-1, 240, 320, 3))
SIZE = (320, 240)


def _metadata(inputs, outputs, **more):
    told = {"inputs": [asdict(one) for one in inputs], "outputs": [asdict(one) for one in outputs]}
    return json.dumps({"name": "ball", "versions": ["1", "3"], "platform": "x", **told, **more}).encode()


def _binary(boxes, scores, labels, **more):
    """(body, length of its JSON) as Triton answers."""
    columns = {"boxes": np.float32(boxes), "scores": np.float32(scores), "labels": np.int64(labels)}
    kinds = {"boxes": "FP32", "scores": "FP32", "labels": "INT64"}
    head = json.dumps({"id": ASKED, "model_version": "1", "outputs": [
        {"name": name, "datatype": kinds[name], "shape": column.shape,
         "parameters": {"binary_data_size": column.nbytes}} for name, column in columns.items()], **more}).encode()
    return head + b"".join(column.tobytes() for column in columns.values()), str(len(head))


def _found(answer, **settings):
    return detections_of(answer, OipSettings(address="", **settings), (1.0, 1.0), SIZE)


# --- models ----------------------------------------------------------------------------------------------------------


def test_metadata_defines_the_request():
    model = read_metadata(_metadata([JPEG_INPUT], OUTPUTS))
    assert model == OipModel("ball", "3", JPEG_INPUT, ("boxes", "scores", "labels")) and model.takes_jpeg
    assert not read_metadata(_metadata([PIXELS], OUTPUTS[:2])).takes_jpeg


@pytest.mark.parametrize(("inputs", "outputs", "why"), [
    ([], OUTPUTS, "takes 0 inputs"), ([JPEG_INPUT, PIXELS], OUTPUTS, "takes 2 inputs"),
    ([TensorSlot("image", "FP32", (1, 3, 240, 320))], OUTPUTS, "FP32; BYTES"),
    ([PIXELS], OUTPUTS[:1], "scores missing"),
    ([PIXELS], [], "boxes and scores missing"), ([TensorSlot("image", "UINT8", (240, 320))], OUTPUTS, "not an image"),
    ([TensorSlot("image", "UINT8", (1, 240, 320, 4))], OUTPUTS, "not an image"),
    ([TensorSlot("image", "BYTES", (1, 1, 1))], OUTPUTS, "not one JPEG"),
    *[([PIXELS], [replace(one, datatype=kind) if one.name == name else one for one in OUTPUTS], f"{name} are {kind}, ")
      for name in ("boxes", "scores") for kind in ("INT8", "UINT8")],
])  # fmt: skip
def test_model_that_does_not_fit_gives_a_readable_error(inputs, outputs, why):
    with pytest.raises(NoAnswerError, match=why) as error:
        read_metadata(_metadata(inputs, outputs))
    assert error.value.reason is NoAnswerReason.UNFIT and "docs/how-to/remote-detectors.md" in error.value.detail


def test_a_jpeg_is_sent_as_one_bytes_element():
    tensor, stretch = tensor_of(model_of("m", "", [JPEG_INPUT], OUTPUTS), frame(), False)
    assert tensor.data == len(BALL_JPEG).to_bytes(4, "little") + BALL_JPEG
    assert (tensor.shape, stretch) == ((1, 1), (1.0, 1.0))


@pytest.mark.parametrize(("shape", "sent", "stretch"), [
    ((-1, 240, 320, 3), (1, 240, 320, 3), (1, 1)), ((240, 320, 3), (240, 320, 3), (1, 1)),
    ((1, -1, -1, 3), (1, 240, 320, 3), (1, 1)), ((-1, 3, 120, 160), (1, 3, 120, 160), (2, 2)),
    ((1, 480, 480, 3), (1, 480, 480, 3), (320 / 480, 0.5)),
])
def test_pixels_are_sent_at_the_size_that_the_model_takes(shape, sent, stretch):
    one = frame()
    tensor, factors = tensor_of(model_of("m", "", [TensorSlot("image", "UINT8", shape)], OUTPUTS), one, False)
    assert tensor.shape == sent and factors == pytest.approx(stretch) and len(tensor.data) == np.prod(sent)
    if sent[1:] == (240, 320, 3):
        assert tensor.data == one.picture().bgr.tobytes()


def test_colors_go_in_the_configured_order():
    model = model_of("m", "", [PIXELS], OUTPUTS)
    bgr, rgb = (np.frombuffer(tensor_of(model, frame(), order)[0].data, np.uint8).reshape(240, 320, 3)
                for order in (False, True))
    assert np.array_equal(bgr[:, :, ::-1], rgb) and not np.array_equal(bgr, rgb)


# --- answers ---------------------------------------------------------------------------------------------------------


def test_binary_and_json_answers_are_the_same():
    boxes, scores, labels = [[10, 20, 30, 40], [50, 60, 70, 80]], [0.5, 0.75], [0, 2]
    body, length = _binary(boxes, scores, labels)
    plain = json.dumps({"outputs": [
        {"name": "boxes", "datatype": "FP32", "shape": [2, 4], "data": boxes},
        {"name": "scores", "datatype": "FP32", "shape": [2], "data": scores},
        {"name": "labels", "datatype": "INT64", "shape": [2], "data": labels}]}).encode()
    names = ("ball", "box")
    found = _found(read_infer(body, length, ASKED), labels=names)
    assert found == _found(read_infer(plain, None, ASKED), labels=names)
    assert read_infer(body, length, ASKED).version == "1" and not read_infer(plain, None, ASKED).version
    assert [(one.label, one.score, one.x1_px) for one in found] == [("2", 0.75, 50), ("ball", 0.5, 10)]


@pytest.mark.parametrize(("boxes", "scores", "labels"), [
    (np.zeros((1, 3, 4)), np.zeros((1, 3)), np.zeros((1, 3))), (np.zeros((3, 4)), np.zeros(3), np.zeros((3, 1))),
    (np.zeros((1, 1, 3, 4)), np.zeros((3, 1)), np.zeros(3)), (np.zeros((0, 4)), np.zeros(0), np.zeros(0)),
    (np.zeros((1, 0, 4)), np.zeros((1, 0)), np.zeros((1, 0))),
])
def test_padded_rows_give_no_boxes_for_any_batch_dimension(boxes, scores, labels):
    assert _found(read_infer(*_binary(boxes, scores, labels), ASKED)) == ()


def test_boxes_in_the_models_pixels_become_those_of_the_image():
    outputs = {"boxes": np.array([[10.0, 10, 20, 20]]), "scores": np.array([0.9])}
    one = detections_of(Inferred(outputs), OipSettings(address="", labels=("ball",)), (2.0, 3.0), SIZE)[0]
    assert (one.x1_px, one.y1_px, one.x2_px, one.y2_px, one.label) == (20, 30, 40, 60, "ball")


@pytest.mark.parametrize(("boxes", "scores", "count"), [
    ([[0, 0, 1, 2.0]], [0.9], 1), ([[0.1, 0.1, 0.9, 0.9], [5, 5, 9, 9]], [0.9, 0.9], 2),
    ([[0.1, 0.1, 0.9, 0.9], [5, 5, 9, 9]], [0.2, 0.9], 1), ([[0, 0, 0, 0]], [0.9], 0),
])
def test_small_boxes_in_pixels_are_an_answer(boxes, scores, count):
    assert len(_found(read_infer(*_binary(boxes, scores, [0] * len(scores)), ASKED))) == count


BOXES = [[10, 20, 30, 40]]
ANSWERS = {
    "nan box": (_binary([[np.nan, 0, 1, 1]], [0.9], [0]), NoAnswerReason.NOT_FINITE),
    "infinite score": (_binary(BOXES, [np.inf], [0]), NoAnswerReason.NOT_FINITE),
    "boxes of five": (_binary([[1, 2, 3, 4, 5]], [0.9], [0]), NoAnswerReason.MALFORMED),
    "flat boxes": (_binary([1, 2, 3, 4], [0.9], [0]), NoAnswerReason.MALFORMED),
    "two batches": (_binary(np.zeros((2, 1, 4)), np.zeros((2, 1)), np.zeros((2, 1))), NoAnswerReason.MALFORMED),
    "more scores": (_binary(BOXES, [0.9, 0.9], [0]), NoAnswerReason.MALFORMED),
    "more labels": (_binary(BOXES, [0.9], [0, 1]), NoAnswerReason.MALFORMED),
    "inside out": (_binary([[30, 20, 10, 40]], [0.9], [0]), NoAnswerReason.MALFORMED),
    "normalized": (_binary([[0.1, 0.2, 0.3, 0.4], [0.5, 0.5, 1.1, 1.9]], [0.9, 0.8], [0, 0]), NoAnswerReason.UNFIT),
    "score of two": (_binary(BOXES, [2.0], [0]), NoAnswerReason.MALFORMED),
    "too many rows": (_binary(np.zeros((1025, 4)), np.zeros(1025), np.zeros(1025)), NoAnswerReason.TOO_MANY),
    "other frame": (_binary(BOXES, [0.9], [0], id="0000abcd-2"), NoAnswerReason.OTHER_FRAME),
    "no outputs": ((b'{"outputs":[]}', None), NoAnswerReason.MALFORMED),
    "html": ((b"<html>", None), NoAnswerReason.MALFORMED),
    "nested": ((b'{"outputs":' + b"[" * 50_000, None), NoAnswerReason.MALFORMED),
    "length of text": ((_binary(BOXES, [0.9], [0])[0], "many"), NoAnswerReason.MALFORMED),
    "length negative": ((_binary(BOXES, [0.9], [0])[0], "-1"), NoAnswerReason.MALFORMED),
    "length too long": ((_binary(BOXES, [0.9], [0])[0], "99999"), NoAnswerReason.MALFORMED),
    "binary cut": ((_binary(BOXES, [0.9], [0])[0][:-4], _binary(BOXES, [0.9], [0])[1]), NoAnswerReason.MALFORMED),
}  # fmt: skip


@pytest.mark.parametrize("name", ANSWERS)
def test_a_hostile_answer_is_rejected_with_its_reason(name):
    (body, length), reason = ANSWERS[name]
    with pytest.raises(NoAnswerError) as error:
        _found(read_infer(body, length, ASKED))
    assert error.value.reason is reason and len(error.value.detail) <= 160


@pytest.mark.parametrize("output", [
    {"shape": [-1, 4]}, {"shape": [1 << 40, 4]}, {"shape": [1] * 9}, {"shape": [1024, 1024, 4]}, {"datatype": "FP128"},
    {"data": [[1, 2, 3]]}, {"data": "text"}, {"data": [[1, 2, 3, "x"]]}, {"data": None}, {"data": [10**400, 1, 1, 1]},
    {"data": {"a": 1}}, {"parameters": {"binary_data_size": -1}}, {"parameters": {"binary_data_size": 1 << 60}},
])  # fmt: skip
def test_a_misshapen_tensor_is_rejected(output):
    usual = {"name": "boxes", "datatype": "FP32", "shape": [1, 4], "data": [1, 2, 3, 4]} | output
    body = json.dumps({"outputs": [usual, {"name": "scores", "datatype": "FP32", "shape": [1], "data": [1]}]}).encode()
    with pytest.raises(NoAnswerError):
        _found(read_infer(body, None, ASKED))


def _is_a_box(one):
    inside = 0 <= one.x1_px < one.x2_px <= SIZE[0] and 0 <= one.y1_px < one.y2_px <= SIZE[1]
    return inside and 0.25 <= one.score <= 1 and one.label.isprintable()


@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("kind", ["json", "metadata"])
def test_random_bytes_raise_no_other_error(kind, seed):
    rng = random.Random(seed)
    body, length = _binary(BOXES, [0.9], [0])
    usual, read = {
        "json": (body, lambda data: _found(read_infer(data, length, ASKED))),
        "metadata": (_metadata([PIXELS], OUTPUTS), lambda data: read_metadata(data) and ()),
    }[kind]
    for _ in range(600):
        data = bytearray(usual)
        for _ in range(rng.randint(1, 6)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        with contextlib.suppress(NoAnswerError):
            assert all(_is_a_box(one) for one in read(bytes(data[: rng.randint(0, len(data))] or data)))
