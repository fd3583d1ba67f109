"""Every parser of what a peer sends, fed with whatever: a value within its bounds, or the one error it may raise.

The corpus in `fuzz_corpus/<parser>/` runs as it is, one file each, and seeds the fuzzing by small changes.
"""

import math
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.protocol.channels import CHANNELS, MAX_HEADER_BYTES, SCAN, key_for, parse_key
from sightline.protocol.codec import decode, decode_ranges, encode, encode_ranges
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import WireModel
from sightline.protocol.text import MAX_TWIST_BYTES, format_twist, parse_twist
from sightline.protocol.transports.endpoints import check_robot_id
from sightline.protocol.transports.websocket.framing import MAX_BLOCK_BYTES, MAX_HELLO_BYTES, pack, parse_hello, unpack
from sightline.protocol.transports.websocket.legacy_text import (
    MAX_BOXES,
    MAX_BOXES_BYTES,
    decode_picture,
    encode_picture,
    format_boxes,
    parse_boxes,
    parse_dashed,
    text_bound,
)

CORPUS = Path(__file__).parent / "fuzz_corpus"
MOST_PICTURE_BYTES = 120
"""Small, so that what is over the bound fits into a corpus."""
MODELS = {
    model.__name__: (model, size)
    for channel in CHANNELS.values()
    for model, size in ((channel.header, 512), (channel.payload, channel.max_payload_bytes))
    if model is not None
}
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "50"))  # more for a night's run


def check_twist(data):
    twist = parse_twist(data)
    assert len(data) <= MAX_TWIST_BYTES
    assert math.isfinite(twist.linear_mps) and math.isfinite(twist.angular_rad_s)
    left, _, right = data.decode("ascii").partition("|")
    assert (twist.linear_mps, twist.angular_rad_s) == (float(left), float(right))
    if max(abs(twist.linear_mps), abs(twist.angular_rad_s)) < 1e9:
        written = format_twist(twist)
        assert format_twist(parse_twist(written)) == written


def check_jpeg(data):
    size = read_jpeg_size(data, max_pixels=1_000_000)
    assert 1 <= size.width_px * size.height_px <= 1_000_000 and size.components in (1, 3)
    assert data[:2] == b"\xff\xd8" and read_jpeg_size(data + b"rest", max_pixels=1_000_000) == size


def check_ranges(data):
    ranges_m = decode_ranges(data)
    assert len(ranges_m) * 4 == len(data) <= SCAN.max_payload_bytes
    assert all(range_m >= 0 for range_m in ranges_m)
    assert encode_ranges(ranges_m) == data


def check_key(data):
    parsed = parse_key(data.decode("utf-8", "surrogateescape"))
    if parsed is not None:
        robot, channel, source = parsed
        assert key_for(check_robot_id(robot), channel, source).encode() == data


def check_picture(data):
    jpeg = decode_picture(data, MOST_PICTURE_BYTES)
    assert len(jpeg) <= MOST_PICTURE_BYTES and len(data) <= text_bound(MOST_PICTURE_BYTES)
    for newlines in (False, True):
        assert decode_picture(encode_picture(jpeg, newlines), MOST_PICTURE_BYTES) == jpeg


def check_dashed(data):
    twist = parse_dashed(data)
    assert len(data) <= MAX_TWIST_BYTES
    assert math.isfinite(twist.linear_mps) and math.isfinite(twist.angular_rad_s)


def check_boxes(data):
    boxes = parse_boxes(data)
    assert len(boxes) <= MAX_BOXES and len(data) <= MAX_BOXES_BYTES
    assert all(0 <= box.y_min <= box.y_max <= 1 and 0 <= box.x_min <= box.x_max <= 1 for box in boxes)
    written = format_boxes(boxes)
    assert format_boxes(parse_boxes(written)) == written


def check_hello(data):
    hello = parse_hello(data.decode("utf-8", "surrogateescape"))
    assert len(data) <= MAX_HELLO_BYTES and parse_hello(encode(hello).decode("utf-8")) == hello


def check_packet(data):
    packet = unpack(data, "r1", "vision")
    assert len(packet.header) <= MAX_BLOCK_BYTES and packet.key.startswith("sightline/r1/")
    assert data.endswith(packet.payload) and len(packet.payload) <= len(data) - 2
    parsed = parse_key(packet.key)
    if parsed is not None and len(packet.header) <= MAX_HEADER_BYTES:
        _, channel, source = parsed
        again = unpack(pack(channel, source, "vision", packet.header, packet.payload), "r1", "vision")
        assert (again.header, again.payload) == (packet.header, packet.payload)


def check_model(model, size):
    def check(data):
        message: WireModel = decode(model, data, size)
        assert len(data) <= size
        assert decode(model, encode(message), 1 << 20) == message

    return check


PARSERS = {
    "twist": check_twist,
    "jpeg": check_jpeg,
    "ranges": check_ranges,
    "key": check_key,
    "picture": check_picture,
    "dashed": check_dashed,
    "boxes": check_boxes,
    "hello": check_hello,
    "packet": check_packet,
    **{name: check_model(model, size) for name, (model, size) in MODELS.items()},
}
SEEDS = {name: [path.read_bytes() for path in sorted((CORPUS / name).iterdir())] for name in PARSERS}
TOKENS = [
    b"0", b"1", b"-", b".", b"e999", b"|", b"/", b"*", b"\0", b"\xff", b"\xff\xc0", b"null", b"true", b"{", b"}", b"[",
    b'"', b",", b'"v":1', b"9007199254740992", b"1e400", b"NaN", b"\\ud800", b"\xed\xa0\x80", b"\xc2\xb2",
]  # fmt: skip


def read(name, data):
    """Parse `data`. Assert that a rejection has a reason and one readable line."""
    try:
        PARSERS[name](data)
    except WireError as error:
        assert isinstance(error.reason, RejectReason) and error.detail and "\n" not in error.detail
        str(error).encode()  # printable: no lone surrogate gets into a log
        return error.reason
    return None


@st.composite
def changed(draw, name):
    """A seed of the corpus with up to six bytes or tokens put in, taken out or replaced; or just bytes."""
    data = bytearray(draw(st.sampled_from(SEEDS[name])))
    for _ in range(draw(st.integers(0, 6))):
        at = draw(st.integers(0, len(data)))
        gone = draw(st.sampled_from([0, 0, 1, 1, 2, 16, len(data)]))
        data[at : at + gone] = draw(st.sampled_from(TOKENS) | st.binary(max_size=4))
    return bytes(data)


@pytest.mark.parametrize("name", PARSERS)
def test_every_parser_accepts_and_rejects_parts_of_its_corpus(name):
    outcomes = {read(name, data) for data in SEEDS[name]}
    if name == "key":
        robots = {parse_key(data.decode("utf-8", "surrogateescape")) is None for data in SEEDS[name]}
        assert robots == {True, False}
    else:
        assert None in outcomes and len(outcomes) > 1


@pytest.mark.parametrize(
    ("name", "path"),
    [(name, path) for name in PARSERS for path in sorted((CORPUS / name).iterdir())],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_corpus_file_name_states_its_result(name, path):
    stated = path.name.split("-")[0]
    if name == "key":
        assert (parse_key(path.read_bytes().decode("utf-8", "surrogateescape")) is not None) == (stated == "read")
    else:
        assert (read(name, path.read_bytes()) or "read") == stated


@pytest.mark.parametrize("name", PARSERS)
def test_parser_accepts_or_rejects_any_bytes(name):
    @settings(max_examples=EXAMPLES, derandomize="FUZZ_EXAMPLES" not in os.environ)
    @given(changed(name) | st.binary(max_size=64))
    def target(data):
        read(name, data)

    target()
