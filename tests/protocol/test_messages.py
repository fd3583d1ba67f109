"""Headers, payloads, keys and sizes: what is sent is read back, and any other bytes give a value or a WireError."""

import array
import json
import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sightline.protocol import channels
from sightline.protocol.channels import (
    CHANNELS,
    FRAME,
    MAX_HEADER_BYTES,
    SCAN,
    Direction,
    key_for,
    parse_key,
    pattern_for,
)
from sightline.protocol.codec import check_sizes, decode, decode_ranges, encode, encode_ranges
from sightline.protocol.errors import ConfigError, RejectReason, WireError
from sightline.protocol.messages import (
    MAX_INTEGER,
    AnswerHeader,
    Echo,
    FrameHeader,
    RequestHeader,
    RequestId,
    ScanHeader,
    Stamp,
)
from sightline.protocol.spec.message_cases import CASES
from sightline.protocol.transports.endpoints import check_robot_id

MODELS = sorted(
    {channel.header for channel in CHANNELS.values()} | {c.payload for c in CHANNELS.values() if c.payload},
    key=lambda model: model.__name__,
)
sessions = st.text("0123456789abcdef", min_size=8, max_size=8)
sources = st.from_regex(r"[a-z][a-z0-9_]{0,15}", fullmatch=True)
integers = st.integers(0, MAX_INTEGER)
numbers = st.floats(-1e6, 1e6)
stamps = {"session": sessions, "seq": integers, "t_us": integers}
echoes = st.builds(Echo, channel=st.sampled_from(["frame", "status", "beat"]), **stamps)
planars = st.tuples(numbers, numbers)
headers = st.one_of(
    st.builds(Stamp, **stamps),
    st.builds(
        FrameHeader,
        **stamps,
        pose=st.tuples(numbers, numbers, numbers),
        moving=planars,
        applied=planars,
        latency_us=st.none() | integers,
    ),
    st.builds(
        ScanHeader,
        **stamps,
        angle_min_rad=numbers,
        angle_increment_rad=numbers,
        range_min_m=numbers,
        range_max_m=numbers,
    ),
    st.builds(AnswerHeader, source=sources, session=sessions, seq=integers, echo=echoes, compute_us=integers,
              scan=st.none() | integers, mission=st.none() | st.builds(RequestId, digest=sessions, id=integers)),
    st.builds(RequestHeader, source=sources, session=sessions, seq=integers, echo=st.none() | echoes),
)


@given(headers)
def test_a_header_is_read_back_as_it_was_written_and_fits(header):
    data = encode(header)
    assert len(data) <= MAX_HEADER_BYTES
    assert decode(type(header), data) == header


def test_the_longest_frame_header_is_within_the_overhead_bound():
    """Key, header and encoding are a frame's overhead; four decimals, the longest integers of ten years."""
    ten_years_us = 10 * 365 * 24 * 3600 * 1_000_000
    header = FrameHeader(
        session="0a1b2c3d",
        seq=ten_years_us // 33_333,
        t_us=ten_years_us,
        pose=(-12.3456, -12.3456, -3.1416),
        moving=(-0.5123, -2.5123),
        applied=(-0.5123, -2.5123),
        latency_us=399_999,
    )
    assert len(encode(header)) + len(key_for("r1", FRAME)) + len("image/jpeg") <= 320


@settings(max_examples=150)
@given(st.sampled_from(MODELS), st.binary(max_size=600))
@example(FrameHeader, b"")
@example(FrameHeader, b"null")
@example(FrameHeader, b"[" * 512)
@example(Stamp, b'{"v":1,"session":"0a1b2c3d","seq":' + b"9" * 300 + b',"t_us":1}')
def test_any_bytes_give_a_message_or_a_wire_error(model, data):
    try:
        read = decode(model, data)
    except WireError as error:
        assert error.reason in (RejectReason.MALFORMED, RejectReason.UNSUPPORTED_VERSION)
        assert "\n" not in str(error)
    else:
        assert isinstance(read, model)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=150)
@given(st.data(), st.sampled_from(CASES), json_values)
def test_any_value_in_any_field_gives_a_message_or_a_wire_error(data, case, value):
    header = json.loads(case.header or b"{}") if case.refuse is None else {}
    field = data.draw(st.sampled_from([*header, "other"]))
    try:
        decode(CHANNELS[case.channel].header, json.dumps(header | {field: value}).encode())
    except WireError as error:
        assert error.reason in (RejectReason.MALFORMED, RejectReason.UNSUPPORTED_VERSION)


@given(headers)
def test_a_header_cut_at_any_byte_is_rejected(header):
    data = encode(header)
    for length in range(len(data)):
        with pytest.raises(WireError):
            decode(type(header), data[:length])


@pytest.mark.parametrize("version", [0, 2, -1, "1", 1.5, None, [1], 10**30])
@pytest.mark.parametrize("model", [Stamp, FrameHeader, ScanHeader, AnswerHeader, RequestHeader])
def test_another_version_is_named_in_the_rejection(model, version):
    usual = next(c for c in CASES if c.refuse is None and CHANNELS[c.channel].header is model)
    with pytest.raises(WireError, match="this peer uses 1") as refusal:
        decode(model, json.dumps(json.loads(usual.header) | {"v": version}).encode())
    assert refusal.value.reason is RejectReason.UNSUPPORTED_VERSION


@given(st.lists(st.floats(0, width=32, allow_nan=False), max_size=720))
def test_ranges_are_read_back(ranges_m):
    assert list(decode_ranges(encode_ranges(array.array("f", ranges_m)))) == ranges_m


@given(st.binary(max_size=128))
def test_any_bytes_give_ranges_or_a_wire_error(data):
    try:
        ranges_m = decode_ranges(data)
    except WireError as error:
        assert error.reason in (RejectReason.MALFORMED, RejectReason.NOT_FINITE)
    else:
        assert len(ranges_m) * 4 == len(data)
        assert all(value >= 0 and not math.isnan(value) for value in ranges_m)


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
def test_sizes_are_exact(channel):
    check_sizes(channel, bytes(MAX_HEADER_BYTES), bytes(channel.max_payload_bytes))
    for header, payload in ((MAX_HEADER_BYTES + 1, 0), (0, channel.max_payload_bytes + 1)):
        with pytest.raises(WireError) as refusal:
            check_sizes(channel, bytes(header), bytes(payload))
        assert refusal.value.reason is RejectReason.MALFORMED
    with pytest.raises(WireError):
        decode_ranges(bytes(SCAN.max_payload_bytes + 4))


robots = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}", fullmatch=True)


@given(robots, st.sampled_from(list(CHANNELS.values())), sources)
def test_a_key_is_split_as_it_was_joined(robot, channel, role):
    source = role if channel.direction is Direction.TO_ROBOT else ""
    key = key_for(robot, channel, source)
    assert parse_key(key) == (robot, channel, source)
    assert pattern_for(robot, channel) == (key.rpartition("/")[0] + "/*" if source else key)


@given(st.text(max_size=40) | st.from_regex(r"sightline/[^\n]{0,12}/(frame|twist)(/[^\n]{0,12})?", fullmatch=True))
@example("sightline/r1/frame\n")
@example("sightline/r1/twist/vision\n")
@example("sightline//frame")
@example("sightline/r1/twist/")
@example("sightline/**/frame")
def test_a_key_is_exact_or_none(key):
    parsed = parse_key(key)
    if parsed is not None:
        assert key_for(*parsed) == key
        assert "*" not in key
        assert "$" not in key


def test_longest_key_is_read_and_a_longer_one_is_not_stored():
    longest = max((one for one in CHANNELS.values() if one.has_source), key=lambda one: len(one.name))
    key = key_for("a" * 32, longest, "b" * 16)
    assert parse_key(key) == ("a" * 32, longest, "b" * 16)
    stored = channels._parse_key.cache_info().misses
    assert parse_key(key + "b") is None and parse_key("x" * 65_536) is None
    assert channels._parse_key.cache_info().misses == stored


@pytest.mark.parametrize("robot", ["", "r1/r2", "*", "r*", "-r1", ".", "a" * 33, "r 1", "r1\n", "é", "r1$"])
def test_invalid_robot_id_is_rejected_with_a_reason(robot):
    with pytest.raises(ConfigError, match="letters, digits") as refusal:
        check_robot_id(robot)
    assert repr(robot) in str(refusal.value)
    assert refusal.value.exit_code == 2
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
def test_source_is_required_only_toward_the_robot(channel):
    wrong = "" if channel.has_source else "vision"
    with pytest.raises(ValueError, match=channel.name):
        key_for("r1", channel, wrong)
    for source in ("Vision", "v*", "a/b", "v" * 17, "1v"):
        with pytest.raises(ValueError, match=channel.name):
            key_for("r1", channel, source)
