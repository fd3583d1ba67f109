"""`sightline.v1` framing: byte for byte both ways, any field order in, and nothing but WireError for nonsense."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.protocol.channels import CHANNELS, DETECTIONS, MAX_HEADER_BYTES, TWIST, key_for
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.transports.websocket.framing import MAX_BLOCK_BYTES, IncomingMessage, pack, parse_hello, unpack

ROLES = st.from_regex(r"[a-z][a-z0-9_]{0,15}", fullmatch=True)
HEADERS = st.one_of(
    st.binary(max_size=MAX_HEADER_BYTES),
    st.just(b"{}"),
    st.dictionaries(st.text(max_size=8), st.integers() | st.text(max_size=8), max_size=5).map(json.dumps).map(
        str.encode
    ),
    st.binary(max_size=60).map(lambda tail: b'{"' + tail),
)  # fmt: skip
BLOCK = b'{"channel":"twist","v":1,"source":"vision","session":"4e5f6071","seq":7}'


def framed(block: bytes, payload: bytes = b"0|0") -> bytes:
    return len(block).to_bytes(2) + block + payload


@given(st.sampled_from(list(CHANNELS.values())), ROLES, ROLES, HEADERS, st.binary(max_size=99))
def test_a_message_arrives_as_it_was_sent(channel, role, source, header, payload):
    if channel.has_source and b'"source"' in header:
        header = b""  # the source in a header is the message's; that has a test of its own
    source = source if channel.has_source else ""
    message = pack(channel, source, role, header, payload)
    assert unpack(message, "r1", role) == IncomingMessage(key_for("r1", channel, source), header, payload)
    assert len(message) <= 2 + MAX_BLOCK_BYTES + len(payload)


def test_a_usual_header_is_one_json_object_with_the_channel_first():
    header = b'{"v":1,"source":"vision","session":"4e5f6071","seq":7}'
    assert pack(TWIST, "vision", "vision", header, b"0|0") == framed(BLOCK)
    assert pack(TWIST, "guest", "vision", b"", b"0|0") == framed(b'{"channel":"twist","source":"guest"}')


def test_message_that_is_passed_on_is_one_json_object_if_its_header_names_its_source():
    header = b'{"v":1,"source":"guest","session":"00000000","seq":7}'
    message = pack(DETECTIONS, "guest", "", header, b"{}")
    assert message == framed(b'{"channel":"detections",' + header[1:], b"{}")
    assert unpack(message, "r1", "robot") == IncomingMessage("sightline/r1/detections/guest", header, b"{}")


@pytest.mark.parametrize("header", [
    b'{"v":1}', b'{"source":"vision"}', b'{"source":"guest","source":"vision"}', b'{"source":"guest"', b'{"source":7}'])
def test_header_that_does_not_name_the_source_follows_an_object_of_its_own(header):
    message = pack(DETECTIONS, "guest", "vision", header, b"{}")
    assert message == framed(b'{"channel":"detections","source":"guest"}' + header, b"{}")
    assert unpack(message, "r1", "vision") == IncomingMessage("sightline/r1/detections/guest", header, b"{}")


def test_fields_may_come_in_any_order_and_with_blanks():
    block = b'{ "v": 1, "session": "4e5f6071", "source": "teleop", "seq": 7, "channel": "twist" }'
    assert unpack(framed(block), "r1", "vision") == IncomingMessage("sightline/r1/twist/teleop", block, b"0|0")


def test_source_comes_from_the_header_or_the_hello():
    assert unpack(framed(BLOCK), "r1", "teleop").key == "sightline/r1/twist/vision"
    assert unpack(framed(b'{"channel":"twist"}'), "r1", "guest").key == "sightline/r1/twist/guest"
    assert unpack(framed(b'{"channel":"twist","source":7,"v":1}'), "r1", "guest").key == "sightline/r1/twist"


def test_source_in_a_header_from_a_robot_is_ignored():
    assert unpack(framed(b'{"channel":"frame","v":1,"source":"vision"}'), "r1", "").key == "sightline/r1/frame"


@pytest.mark.parametrize("rest", [b'"v":1,', b"}", b"junk", b' "v":1,,}', b""])
def test_unreadable_header_is_passed_to_the_receiver(rest):
    packet = unpack(framed(b'{"channel":"twist",' + rest), "r1", "vision")
    assert packet == IncomingMessage("sightline/r1/twist/vision", b"{" + rest, b"0|0")


@pytest.mark.parametrize(
    "message",
    [b"", b"\0", b"\0\5{}", b"\xff\xff", framed(b""), framed(b"{}"), framed(b"[1]"), framed(b'{"channel":7}'),
     framed(b"\xff"), framed(b'{"v":1}'), framed(b"[" * 500),
     framed(b'{"channel":"twist","x":"' + b"a" * MAX_BLOCK_BYTES + b'"}')],
)  # fmt: skip
def test_broken_framing_is_rejected(message):
    with pytest.raises(WireError) as refusal:
        unpack(message, "r1", "vision")
    assert refusal.value.reason is RejectReason.MALFORMED


@given(st.binary(max_size=200) | st.binary(max_size=100).map(framed))
def test_any_bytes_are_a_packet_or_a_wire_error(message):
    try:
        assert unpack(message, "r1", "vision").key.startswith("sightline/r1/")
    except WireError as refusal:
        assert refusal.reason is RejectReason.MALFORMED


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "MALFORMED"),
        ("0.1|0", "MALFORMED"),
        ('{"robot":"r1"}', "session"),
        ('{"robot":"r/1","session":"0000beef"}', "robot"),
        ('{"robot":"r1","session":"0000beef","role":"V"}', "role"),
        ('{"robot":"r1","session":"0000beef","v":2}', "UNSUPPORTED_VERSION"),
        ('{"robot":"r1","session":"0000beef","wants":["' + "a" * 33 + '"]}', "wants"),
        ('{"robot":"r1","session":"0000beef","wants":' + json.dumps(["a"] * 33) + "}", "wants"),
        ('{"robot":"r1","session":"0000beef","x":"' + "a" * 1024 + '"}', "at most 1024"),
        ("\ud800", "MALFORMED"),
    ],
)
def test_invalid_hello_is_rejected_with_the_field(text, said):
    with pytest.raises(WireError, match=said):
        parse_hello(text)


def test_a_hello_of_a_newer_peer_is_read():
    hello = parse_hello('{"robot":"r1","session":"0000beef","wants":["frame","smell"],"nose":true}')
    assert (hello.role, hello.wants) == ("", ("frame", "smell"))
