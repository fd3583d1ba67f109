"""The legacy protocol's text forms: strict readers, and writers whose text the legacy code reads."""

import base64

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.websocket.legacy_text import (
    MAX_BOXES,
    LegacyBox,
    decode_picture,
    detections_from_boxes,
    encode_picture,
    format_boxes,
    parse_boxes,
    parse_dashed,
    text_bound,
)

FINITE = st.floats(allow_nan=False, allow_infinity=False)
UNIT = st.floats(0, 1)


@given(st.binary(max_size=2000))
def test_image_is_encoded_as_in_the_legacy_program(jpeg):
    assert encode_picture(jpeg) == base64.encodebytes(jpeg)
    assert encode_picture(jpeg, newlines=False) == base64.b64encode(jpeg)


@given(st.binary(max_size=2000), st.sampled_from([b"\n", b"\r\n", b""]))
def test_an_image_is_read_with_any_line_ends_and_within_its_bound(jpeg, line_end):
    text = encode_picture(jpeg).replace(b"\n", line_end)
    assert len(text) <= text_bound(len(jpeg))
    assert decode_picture(text, len(jpeg)) == jpeg
    if jpeg:
        with pytest.raises(WireError, match="at most"):
            decode_picture(text, len(jpeg) - 1)


@pytest.mark.parametrize(
    "text",
    [b"====", b"AAA", b"AA=A", b"AA AAAA", b"AAAA\0", b"AA==AAAA", "ＡＡＡＡ".encode(), b"AAA_", b"-1|0", b"\xff"],
)
def test_invalid_base64_is_rejected(text):
    with pytest.raises(WireError) as refusal:
        decode_picture(text, 1000)
    assert refusal.value.reason is RejectReason.MALFORMED


@given(st.binary(max_size=300))
def test_any_bytes_are_an_image_or_a_wire_error(text):
    try:
        assert len(decode_picture(text, 100)) <= 100
    except WireError as refusal:
        assert refusal.reason is RejectReason.MALFORMED


@given(FINITE, FINITE)
def test_dashed_twists_of_the_legacy_program_are_read(linear, angular):
    text = f"{linear}-{angular}".encode()
    twist = parse_dashed(text)
    assert (twist.linear_mps, twist.angular_rad_s) == (linear, angular)
    assert twist == parse_twist(f"{linear}|{angular}".encode())


@given(FINITE, FINITE)
def test_swapped_axes_exchange_the_two_numbers(linear, angular):
    twist = parse_dashed(f"{angular}-{linear}".encode(), swapped=True)
    assert (twist.linear_mps, twist.angular_rad_s) == (linear, angular)


@pytest.mark.parametrize(
    ("text", "linear", "angular"),
    [(b"-1-2", -1, 2), (b"1--2", 1, -2), (b"-1--2", -1, -2), (b"1e-2-3", 0.01, 3), (b"1E+1--2e-1", 10, -0.2),
     (b"-1e-1--1e-1", -0.1, -0.1), (b"+1-+2", 1, 2), (b".5-5.", 0.5, 5),
     (b"2.302820955670696-0", 2.302820955670696, 0)],
)  # fmt: skip
def test_negatives_and_exponents_in_dashed_twists(text, linear, angular):
    twist = parse_dashed(text)
    assert (twist.linear_mps, twist.angular_rad_s) == (linear, angular)


@pytest.mark.parametrize(
    "text",
    [b"", b"-", b"1", b"1-", b"-1", b"1-2-3", b"1---2", b"1|2", b"1 - 2", b"nan-1", b"1-inf", b"1_0-2",
     b"1-" + b"0" * 63],
)  # fmt: skip
def test_invalid_dashed_twist_is_rejected(text):
    with pytest.raises(WireError) as refusal:
        parse_dashed(text)
    assert refusal.value.reason is RejectReason.MALFORMED


def test_a_dashed_twist_that_overflows_is_not_finite():
    with pytest.raises(WireError) as refusal:
        parse_dashed(b"1e999-0")
    assert refusal.value.reason is RejectReason.NOT_FINITE


@given(st.lists(st.tuples(UNIT, UNIT, UNIT, UNIT), max_size=MAX_BOXES))
def test_boxes_survive_the_way_there_and_back(corners):
    boxes = [LegacyBox(min(a, b), min(c, d), max(a, b), max(c, d)) for a, b, c, d in corners]
    read = parse_boxes(format_boxes(boxes))
    assert len(read) == len(boxes)
    for box, got in zip(boxes, read, strict=True):
        assert (got.y_min, got.x_min, got.y_max, got.x_max) == pytest.approx(
            (box.y_min, box.x_min, box.y_max, box.x_max), abs=5e-5
        )


@pytest.mark.parametrize(
    "text",
    [b"-", b"0,0,1", b"0,0,1,1-", b"0,0,1,1.1", b"0,0,1,-1", b"0.5,0,0.4,1", b"0,1,1,0", b"0,0,1,1e-5", b"nan,0,1,1",
     b"0,0,1,1,1,1", b" 0,0,1,1", b"-".join([b"0,0,1,1"] * (MAX_BOXES + 1)), b"0,0,1,1." + b"0" * 1024],
)  # fmt: skip
def test_invalid_list_of_boxes_is_rejected(text):
    with pytest.raises(WireError) as refusal:
        parse_boxes(text)
    assert refusal.value.reason is RejectReason.MALFORMED


def test_box_outside_the_image_is_rejected():
    for corners in ((0, 0, 1, 1.01), (-0.1, 0, 1, 1), (0.5, 0, 0.4, 1), (float("nan"), 0, 1, 1)):
        with pytest.raises(ValueError, match="outside the image"):
            LegacyBox(*corners)
    with pytest.raises(ValueError, match="at most 16"):
        format_boxes([LegacyBox(0, 0, 1, 1)] * (MAX_BOXES + 1))


def test_boxes_become_detections_in_pixels_of_the_image_in_their_order():
    found = detections_from_boxes(parse_boxes(b"0.25,0.5,0.75,1-0,0,1,0.125"), JpegSize(640, 480, 3))
    assert (found.width_px, found.height_px) == (640, 480)
    corners = [(box.label, box.x1_px, box.y1_px, box.x2_px, box.y2_px) for box in found.boxes]
    assert corners == [("box", 320, 120, 640, 360), ("box", 0, 0, 80, 480)]
    assert detections_from_boxes((), JpegSize(16, 16, 1)).boxes == ()
