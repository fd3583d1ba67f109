"""The golden cases, stated by hand: key, header, payload, and the refusal if there is one. Pure."""

import json
import struct
from dataclasses import dataclass
from typing import Any

from protocol.channels import CHANNELS, key_for


@dataclass(frozen=True, slots=True)
class Case:
    """One message and what must become of it; `refuse` is None where it is accepted."""

    channel: str
    name: str
    purpose: str
    key: str
    header: bytes
    payload: bytes
    refuse: str | None


MALFORMED, NOT_FINITE, VERSION, INEXACT = "MALFORMED", "NOT_FINITE", "UNSUPPORTED_VERSION", "INEXACT_KEY"
SESSION, PEER = "0a1b2c3d", "4e5f6071"
STAMP: dict[str, Any] = {"v": 1, "session": SESSION, "seq": 41, "t_us": 1_500_000}
MOVED: dict[str, Any] = {"pose": [1.5, -0.25, 0.1], "moving": [0.2, -0.35]}
FRAME_HEADER = STAMP | MOVED | {"applied": [0.2, -0.35], "latency_us": 52_000}
SCAN_HEADER = STAMP | {"angle_min_rad": -3.14, "angle_increment_rad": 0.5, "range_min_m": 0.1, "range_max_m": 8.0}
ECHO: dict[str, Any] = {"channel": "frame", "session": SESSION, "seq": 41, "t_us": 1_500_000}
ANSWER: dict[str, Any] = {"v": 1, "source": "vision", "session": PEER, "seq": 7, "echo": ECHO, "compute_us": 2300}
ASK = {"v": 1, "source": "teleop", "session": PEER, "seq": 0, "echo": ECHO | {"channel": "status"}}
CAMERA = {"width_px": 640, "height_px": 480, "fx_px": 381.4, "fy_px": 381.4, "cx_px": 320.0, "cy_px": 240.0}
REPLY = {"to": PEER, "id": 3, "ok": True, "state": "HOLD", "detail": "armed"}


def packed(value: dict[str, Any]) -> bytes:
    """JSON without blanks."""
    return json.dumps(value, separators=(",", ":")).encode()


def without(value: dict[str, Any], *names: str) -> dict[str, Any]:
    """`value` less some fields."""
    return {name: item for name, item in value.items() if name not in names}


def echoing(echo: dict[str, Any]) -> dict[str, Any]:
    """The usual answer with another echo."""
    return ANSWER | {"echo": echo}


def jpeg(width_px: int, height_px: int, marker: int = 0xC0, components: int = 3, bits: int = 8) -> bytes:
    """The start of a JPEG up to its frame header; enough for a bounds check, no picture."""
    body = struct.pack(">BHHB", bits, height_px, width_px, components) + b"\x01\x11\x00" * components
    return b"\xff\xd8" + b"\xff" + bytes([marker]) + struct.pack(">H", len(body) + 2) + body


def segments(count: int) -> bytes:
    """A JPEG with `count` empty comments before its frame header."""
    return b"\xff\xd8" + b"\xff\xfe\x00\x02" * count + jpeg(320, 240)[2:]


def _case(
    channel: str,
    name: str,
    purpose: str,
    refuse: str | None = None,
    *,
    header: dict[str, Any] | bytes | None = None,
    payload: dict[str, Any] | bytes | None = None,
    key: str = "",
) -> Case:
    """A case that differs from the channel's valid message only in what is given."""
    source, usual_header, usual_payload = _USUAL[channel]
    head = usual_header if header is None else header
    body = usual_payload if payload is None else payload
    return Case(
        channel,
        name,
        purpose,
        key or key_for("r1", CHANNELS[channel], source),
        head if isinstance(head, bytes) else packed(head),
        body if isinstance(body, bytes) else packed(body),
        refuse,
    )


_USUAL: dict[str, tuple[str, dict[str, Any], dict[str, Any] | bytes]] = {
    "frame": ("", FRAME_HEADER, jpeg(640, 480)),
    "twist": ("vision", ANSWER, b"0.2000|-0.3500"),
    "ack": ("vision", ANSWER, b""),
    "request": ("teleop", ASK, {"id": 3, "verb": "arm"}),
    "reply": ("", STAMP, REPLY),
    "status": ("", STAMP, {"state": "HOLD", "reason": "armed; no command yet"}),
    "odometry": ("", STAMP, MOVED),
    "scan": ("", SCAN_HEADER, struct.pack("<4f", 0.5, 1.25, float("inf"), 8.0)),
    "camera": ("", STAMP, CAMERA),
}


def _usual() -> list[Case]:
    return [_case(channel, "usual", "a complete message") for channel in CHANNELS]


def _stamps() -> list[Case]:
    """What holds for every header, on every channel."""
    return [case for channel in CHANNELS for case in _header_cases(channel, _USUAL[channel][1])]


def _header_cases(channel: str, header: dict[str, Any]) -> list[Case]:
    return [
        _case(channel, "unknown_field", "unknown fields are ignored", header=header | {"later": [1]}),
        _case(channel, "version_2", "another version is refused by name", VERSION, header=header | {"v": 2}),
        _case(channel, "no_session", "a required field is missing", MALFORMED, header=without(header, "session")),
        _case(channel, "session_upper", "8 lower-case hex", MALFORMED, header=header | {"session": "0A1B2C3D"}),
        _case(channel, "seq_negative", "integers are bounded below", MALFORMED, header=header | {"seq": -1}),
        _case(channel, "seq_2_53", "integers are bounded above", MALFORMED, header=header | {"seq": 2**53}),
        _case(channel, "seq_text", "no type is converted", MALFORMED, header=header | {"seq": "7"}),
        _case(channel, "header_cut", "cut short", MALFORMED, header=packed(header)[:-1]),
        _case(channel, "header_513", "513 bytes of header", MALFORMED, header=packed(header).ljust(513)),
        _case(channel, "header_512", "512 bytes of header", header=packed(header).ljust(512)),
    ]


def _frames() -> list[Case]:
    return [
        _case("frame", "stamp_only", "odometry and latency may be left out", header=STAMP),
        _case("frame", "latency_null", "null is as good as absent", header=FRAME_HEADER | {"latency_us": None}),
        _case("frame", "seq_max", "the largest integer", header=FRAME_HEADER | {"seq": 2**53 - 1}),
        _case("frame", "seq_real", "7.0 is no integer", MALFORMED, header=FRAME_HEADER | {"seq": 7.0}),
        _case("frame", "time_true", "true is no integer", MALFORMED, header=FRAME_HEADER | {"t_us": True}),
        _case("frame", "pose_of_two", "a pose has three numbers", MALFORMED, header=FRAME_HEADER | {"pose": [0, 0]}),
        _case("frame", "pose_far", "numbers end at a million", MALFORMED, header=FRAME_HEADER | {"pose": [2e6, 0, 0]}),
        _case("frame", "pose_nan", "NaN in a header", MALFORMED, header=FRAME_HEADER | {"pose": [float("nan"), 0, 0]}),
        _case("frame", "no_header", "a frame needs its header", MALFORMED, header=b""),
        _case("frame", "header_array", "a header is an object", MALFORMED, header=b"[1]"),
        _case("frame", "header_not_utf8", "a header is UTF-8", MALFORMED, header=b'{"v":1,"session":"\xff"}'),
        _case("frame", "no_time", "a frame without its time", MALFORMED, header=without(FRAME_HEADER, "t_us")),
        _case("frame", "other_session", "of another start", header=FRAME_HEADER | {"session": PEER}),
        _case("frame", "with_source", "a robot's key has no role", INEXACT, key="sightline/r1/frame/vision"),
        _case("frame", "robot_wildcard", "a wildcard for the robot", INEXACT, key="sightline/*/frame"),
        _case("frame", "foreign_prefix", "another prefix", INEXACT, key="starline/r1/frame"),
    ]


def _pictures() -> list[Case]:
    return [
        _case("frame", "jpeg_progressive", "SOF2", payload=jpeg(320, 240, 0xC2)),
        _case("frame", "jpeg_grey", "one component", payload=jpeg(320, 240, components=1)),
        _case("frame", "jpeg_full_hd", "as many pixels as allowed by default", payload=jpeg(1920, 1080)),
        _case("frame", "jpeg_one_row_more", "a row over the bound", MALFORMED, payload=jpeg(1920, 1081)),
        _case("frame", "jpeg_bomb", "65500 x 65500 in 21 bytes", MALFORMED, payload=jpeg(65_500, 65_500)),
        _case("frame", "jpeg_zero_width", "no width", MALFORMED, payload=jpeg(0, 480)),
        _case("frame", "jpeg_zero_height", "no height", MALFORMED, payload=jpeg(640, 0)),
        _case("frame", "jpeg_cmyk", "four components", MALFORMED, payload=jpeg(640, 480, components=4)),
        _case("frame", "jpeg_12_bit", "12 bits", MALFORMED, payload=jpeg(640, 480, bits=12)),
        _case("frame", "jpeg_lossless", "SOF3", MALFORMED, payload=jpeg(640, 480, 0xC3)),
        _case("frame", "jpeg_arithmetic", "SOF9", MALFORMED, payload=jpeg(640, 480, 0xC9)),
        _case("frame", "jpeg_scan_first", "SOS before SOF", MALFORMED, payload=b"\xff\xd8\xff\xda\x00\x08" + bytes(6)),
        _case("frame", "jpeg_63_segments", "63 segments, then SOF", payload=segments(63)),
        _case("frame", "jpeg_64_segments", "64 segments before SOF", MALFORMED, payload=segments(64)),
        _case("frame", "jpeg_segment_short", "length 1", MALFORMED, payload=b"\xff\xd8\xff\xfe\x00\x01" + bytes(8)),
        _case("frame", "jpeg_segment_past_end", "too long", MALFORMED, payload=b"\xff\xd8\xff\xfe\xff\xff" + bytes(8)),
        _case("frame", "jpeg_fill_byte", "0xFF before a marker", payload=b"\xff\xd8\xff" + jpeg(640, 480)[2:]),
        _case("frame", "jpeg_cut_in_sof", "cut in the frame header", MALFORMED, payload=jpeg(640, 480)[:11]),
        _case("frame", "jpeg_soi_only", "nothing after SOI", MALFORMED, payload=b"\xff\xd8"),
        _case("frame", "jpeg_empty", "no bytes", MALFORMED, payload=b""),
        _case("frame", "png", "another format", MALFORMED, payload=b"\x89PNG\r\n\x1a\n" + bytes(24)),
    ]


_TWISTS_GOOD = {
    "zero": b"0|0",
    "plus": b"+0.1|+0.2",
    "integer": b"1|-2",
    "bare_point": b".5|5.",
    "exponent": b"2e-1|1E+0",
    "seventeen_digits": b"2.3028209556706964|0",
    "too_fast": b"48|48",
    "minus_zero": b"-0.0000|0.0000",
    "underflow": b"1e-999|0",
    "bytes_64": b"0." + b"0" * 29 + b"|0." + b"0" * 30,
}
_TWISTS_MALFORMED = {
    "empty": b"",
    "one_number": b"0.1",
    "three_numbers": b"1|2|3",
    "comma": b"0,1|0",
    "minus_joined": b"0.1-0.2",
    "blank": b"0.1| 0.2",
    "newline": b"0.1|0.2\n",
    "nul": b"0.1|0.2\x00",
    "underscore": b"1_0|2",
    "hexadecimal": b"0x1p3|0",
    "two_signs": b"--1|0",
    "point_alone": b".|0",
    "exponent_alone": b"e5|0",
    "exponent_4_digits": b"1e0001|0",
    "arabic_digits": "٣|٠".encode(),
    "full_width_digits": "１|０".encode(),
    "unicode_minus": "−1|0".encode(),
    "byte_order_mark": b"\xef\xbb\xbf0|0",
    "bytes_65": b"0." + b"0" * 30 + b"|0." + b"0" * 30,
    "json": b'{"linear":0.1}',
}
_TWISTS_NOT_FINITE = {"nan": b"nan|0", "inf": b"0|inf", "minus_infinity": b"-Infinity|0", "overflow": b"1e999|0"}


def _twists() -> list[Case]:
    good = [_case("twist", f"text_{name}", "within the grammar", payload=text) for name, text in _TWISTS_GOOD.items()]
    bad = [
        _case("twist", f"text_{name}", "outside the grammar", MALFORMED, payload=text)
        for name, text in _TWISTS_MALFORMED.items()
    ]
    return [*good, *bad] + [
        _case("twist", f"text_{name}", "not a finite number", NOT_FINITE, payload=text)
        for name, text in _TWISTS_NOT_FINITE.items()
    ]


def _answers() -> list[Case]:
    guest = "sightline/r1/twist/guest"
    return [
        _case("twist", "guest", "a guest needs no header", header=b"", key=guest),
        _case("twist", "no_header", "any other role needs one", MALFORMED, header=b""),
        _case("twist", "no_compute", "compute_us may be left out", header=without(ANSWER, "compute_us")),
        _case("twist", "no_echo", "a twist must cite what it answers", MALFORMED, header=without(ANSWER, "echo")),
        _case("twist", "echo_of_scan", "no scan is cited", MALFORMED, header=echoing(ECHO | {"channel": "scan"})),
        _case("twist", "echo_no_time", "an echo is complete", MALFORMED, header=echoing(without(ECHO, "t_us"))),
        _case("twist", "source_upper", "a role is lower-case", MALFORMED, header=ANSWER | {"source": "Vision"}),
        _case("twist", "source_long", "at most 16 characters", MALFORMED, header=ANSWER | {"source": "v" * 17}),
        _case("twist", "wildcard", "a wildcard for the role", INEXACT, key="sightline/r1/twist/*"),
        _case("twist", "wildcard_all", "a wildcard for all", INEXACT, key="**"),
        _case("twist", "no_source", "a key without its role", INEXACT, key="sightline/r1/twist"),
        _case("twist", "deeper", "a key with one part more", INEXACT, key="sightline/r1/twist/vision/1"),
        _case("twist", "key_upper", "a role in the key is lower-case", INEXACT, key="sightline/r1/twist/Vision"),
        _case("ack", "with_payload", "an ack has no payload", MALFORMED, payload=b"0|0"),
    ]


def _payloads() -> list[Case]:
    status = {"state": "ACTIVE", "reason": "driving", "holder": {"source": "vision", "session": PEER}}
    last = {"source": "vision", "reason": "STALE", "detail": "frame 41 is 410 ms old"}
    counted = status | {"refused": {"STALE": 3}, "last_refusal": last}
    stop = {"id": 1, "verb": "stop"}
    return [
        _case("request", "stop_without_echo", "stop needs no echo", header=without(ASK, "echo"), payload=stop),
        _case("request", "unknown_verb", "verbs are a closed list", MALFORMED, payload={"id": 1, "verb": "dance"}),
        _case("request", "verb_upper", "verbs are lower-case", MALFORMED, payload={"id": 1, "verb": "STOP"}),
        _case("request", "no_id", "a request has an id", MALFORMED, payload={"verb": "stop"}),
        _case("request", "payload_257", "257 bytes", MALFORMED, payload=packed(stop).ljust(257)),
        _case("reply", "refused", "a request refused", payload=REPLY | {"ok": False, "detail": "vision drives"}),
        _case("reply", "ok_as_1", "1 is not true", MALFORMED, payload=REPLY | {"ok": 1}),
        _case("reply", "detail_201", "at most 200 characters", MALFORMED, payload=REPLY | {"detail": "x" * 201}),
        _case("status", "with_holder", "somebody drives", payload=counted),
        _case("status", "unknown_state", "a closed list", MALFORMED, payload=status | {"state": "FLYING"}),
        _case("status", "refused_negative", "not below 0", MALFORMED, payload=status | {"refused": {"STALE": -1}}),
        _case("status", "payload_4097", "4097 bytes", MALFORMED, payload=packed(status).ljust(4097)),
        _case("odometry", "no_twist", "both fields are needed", MALFORMED, payload=without(MOVED, "moving")),
        _case("odometry", "infinite", "finite numbers only", MALFORMED, payload=MOVED | {"moving": [float("inf"), 0]}),
        _case("scan", "empty", "no rays", payload=b""),
        _case("scan", "ragged", "no whole float", MALFORMED, payload=bytes(6)),
        _case("scan", "nan", "a range is a number", NOT_FINITE, payload=struct.pack("<2f", 1.0, float("nan"))),
        _case("scan", "negative", "a range is not negative", NOT_FINITE, payload=struct.pack("<f", -0.5)),
        _case("scan", "minus_infinity", "nor minus infinity", NOT_FINITE, payload=struct.pack("<f", float("-inf"))),
        _case("camera", "mounted", "with mounting and distortion",
              payload=CAMERA | {"distortion": [0.1, -0.2], "z_m": 0.12, "pitch_rad": -0.1, "calibrated": True}),
        _case("camera", "focal_zero", "a focal length is positive", MALFORMED, payload=CAMERA | {"fx_px": 0}),
        _case("camera", "nine_terms", "at most eight terms", MALFORMED, payload=CAMERA | {"distortion": [0.0] * 9}),
        _case("camera", "width_15", "at least 16 pixels", MALFORMED, payload=CAMERA | {"width_px": 15}),
    ]


CASES: tuple[Case, ...] = (
    *_usual(), *_stamps(), *_frames(), *_pictures(), *_twists(), *_answers(), *_payloads(),
)
"""Every case; the first of a channel is its example in the specification."""
