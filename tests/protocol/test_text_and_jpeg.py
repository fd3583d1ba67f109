"""The twist grammar and the JPEG bound: whatever the bytes, a value within bounds or a WireError."""

import io
import math
import re

import numpy as np
import pytest
import simplejpeg
from hypothesis import example, given
from hypothesis import strategies as st

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import MAX_SEGMENTS, JpegSize, read_jpeg_size
from sightline.protocol.messages import Twist
from sightline.protocol.spec.message_cases import jpeg, segments
from sightline.protocol.text import MAX_TWIST_BYTES, format_twist, parse_twist
from tests.fixtures import demanded

ABNF_NUMBER = r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?"
GRAMMAR = re.compile(rf"{ABNF_NUMBER}\|{ABNF_NUMBER}", re.ASCII)
speeds = st.floats(-1e4, 1e4)


@given(speeds, speeds)
@example(-0.00001, 0.00004)
@example(-0.00005, 0.00005)
def test_written_twist_is_read_back_to_four_decimals(linear_mps, angular_rad_s):
    text = format_twist(Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s))
    assert re.fullmatch(rb"-?[0-9]+\.[0-9]{4}\|-?[0-9]+\.[0-9]{4}", text)
    assert b"-0.0000" not in text
    read = parse_twist(text)
    assert abs(read.linear_mps - linear_mps) <= 0.5001e-4
    assert abs(read.angular_rad_s - angular_rad_s) <= 0.5001e-4
    assert format_twist(read) == text


@given(st.binary(max_size=80) | st.text("0123456789+-.eE|_naif \n", max_size=70).map(str.encode))
@example(b"0.1|0.2\n")
@example(b"1e400|0")
def test_only_the_grammar_is_read_and_only_finite(data):
    try:
        twist = parse_twist(data)
    except WireError as error:
        assert error.reason in (RejectReason.MALFORMED, RejectReason.NOT_FINITE)
        return
    assert len(data) <= MAX_TWIST_BYTES
    assert GRAMMAR.fullmatch(data.decode("ascii"))
    assert math.isfinite(twist.linear_mps)
    assert math.isfinite(twist.angular_rad_s)


@given(st.from_regex(GRAMMAR, fullmatch=True))
def test_all_of_the_grammar_is_read(text):
    linear, angular = (float(number) for number in text.split("|"))
    fits = len(text) <= MAX_TWIST_BYTES
    if fits and math.isfinite(linear) and math.isfinite(angular):
        assert parse_twist(text.encode()) == Twist(linear_mps=linear, angular_rad_s=angular)
    else:
        with pytest.raises(WireError) as refusal:
            parse_twist(text.encode())
        assert refusal.value.reason is (RejectReason.NOT_FINITE if fits else RejectReason.MALFORMED)


@given(st.binary(max_size=400), st.sampled_from([b"", b"\xff\xd8", b"\xff\xd8\xff", jpeg(64, 64)[:13]]))
def test_any_bytes_give_a_size_within_the_bound_or_an_error(tail, head):
    try:
        size = read_jpeg_size(head + tail, max_pixels=10_000)
    except WireError as error:
        assert error.reason is RejectReason.MALFORMED
    else:
        assert 0 < size.width_px * size.height_px <= 10_000


@given(st.integers(0, 65_535), st.integers(0, 65_535), st.sampled_from([0xC0, 0xC1, 0xC2]), st.sampled_from([1, 3]))
@example(1920, 1080, 0xC0, 3)
@example(1920, 1081, 0xC0, 3)
def test_the_bound_is_exact_in_pixels(width_px, height_px, marker, components):
    data = jpeg(width_px, height_px, marker, components)
    if 0 < width_px * height_px <= 1920 * 1080:
        assert read_jpeg_size(data) == JpegSize(width_px, height_px, components)
    else:
        with pytest.raises(WireError):
            read_jpeg_size(data)


@pytest.mark.parametrize(("width_px", "height_px"), [(16, 16), (320, 240), (641, 479)])
@pytest.mark.parametrize("encoder", ["simplejpeg", "cv2", "cv2-progressive", "pillow"])
def test_real_images_pass_with_their_size(encoder, width_px, height_px):
    pixels = np.random.default_rng(3).integers(0, 255, (height_px, width_px, 3), np.uint8)
    size = read_jpeg_size(_encoded(encoder, pixels))
    assert size == JpegSize(width_px, height_px, 3)


def _encoded(encoder: str, pixels: np.ndarray) -> bytes:
    if encoder == "simplejpeg":
        return simplejpeg.encode_jpeg(pixels, quality=80)
    if encoder == "pillow":
        image = demanded.module("PIL.Image", "report").fromarray(pixels)
        with io.BytesIO() as buffer:
            image.save(buffer, "JPEG", comment="with a comment")
            return buffer.getvalue()
    cv2 = demanded.module("cv2", "vision")
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(encoder == "cv2-progressive")]
    return cv2.imencode(".jpg", pixels, options)[1].tobytes()


def test_an_image_cut_anywhere_before_its_size_is_rejected():
    whole = simplejpeg.encode_jpeg(np.zeros((48, 64, 3), np.uint8), quality=80)
    needed = whole.index(b"\xff\xc0") + 10
    for length in range(needed):
        with pytest.raises(WireError):
            read_jpeg_size(whole[:length])
    assert read_jpeg_size(whole[:needed]) == JpegSize(64, 48, 3)


@pytest.mark.parametrize("count", range(MAX_SEGMENTS - 2, MAX_SEGMENTS + 3))
def test_the_number_of_segments_is_bounded(count):
    if count < MAX_SEGMENTS:
        assert read_jpeg_size(segments(count)).width_px == 320
    else:
        with pytest.raises(WireError, match="segments"):
            read_jpeg_size(segments(count))
