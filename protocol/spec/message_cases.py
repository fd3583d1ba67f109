"""Golden cases of every channel: header, payload, and the reason for rejecting it, if any. Pure."""

import json
import struct
from dataclasses import dataclass
from typing import Any

from sightline.protocol.channels import CHANNELS, key_for


@dataclass(frozen=True, slots=True)
class MessageCase:
    """One message and its required result; `refuse` is None for an accepted message."""

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
REQUESTED = {"v": 1, "source": "teleop", "session": PEER, "seq": 0, "echo": ECHO | {"channel": "status"}}
CAMERA = {"width_px": 640, "height_px": 480, "fx_px": 381.4, "fy_px": 381.4, "cx_px": 320.0, "cy_px": 240.0}
BOX = {"label": "person", "score": 0.91, "x1_px": 280.0, "y1_px": 120.5, "x2_px": 360.0, "y2_px": 330.0}
DETECTIONS: dict[str, Any] = {"width_px": 640, "height_px": 480, "boxes": [BOX]}
REPLY = {"to": PEER, "id": 3, "ok": True, "state": "HOLD", "detail": "armed"}
MISSION: dict[str, Any] = {"id": 5, "name": "goto", "waypoints": [[1.5, 1.5], [0.0, -2.0]]}
REPORT: dict[str, Any] = {"mission": "goto", "phase": "driving", "note": "to waypoint 1 of 2",
                          "asked": {"digest": PEER, "id": 5}, "detector": "hsv", "device": "cpu"}

TARGET: dict[str, Any] = {"label": "ball", "score": 0.93, "track": 4, "bearing_rad": 0.05, "distance_m": 0.8,
                          "cx_px": 150, "cy_px": 118.5, "radius_px": 22.4, "width_px": 320, "height_px": 240}


def packed(value: dict[str, Any]) -> bytes:
    """Encode as JSON without spaces."""
    return json.dumps(value, separators=(",", ":")).encode()


def without(value: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return `value` without some fields."""
    return {name: item for name, item in value.items() if name not in names}


def echoing(echo: dict[str, Any]) -> dict[str, Any]:
    """Return the usual answer with another echo."""
    return ANSWER | {"echo": echo}


def jpeg(width_px: int, height_px: int, marker: int = 0xC0, components: int = 3, bits: int = 8) -> bytes:
    """Return the start of a JPEG up to its frame header, which is sufficient for a size check."""
    body = struct.pack(">BHHB", bits, height_px, width_px, components) + b"\x01\x11\x00" * components
    return b"\xff\xd8" + b"\xff" + bytes([marker]) + struct.pack(">H", len(body) + 2) + body


def segments(count: int) -> bytes:
    """Return a JPEG with `count` empty comments before its frame header."""
    return b"\xff\xd8" + b"\xff\xfe\x00\x02" * count + jpeg(320, 240)[2:]


def case(
    channel: str,
    name: str,
    purpose: str,
    refuse: str | None = None,
    *,
    header: dict[str, Any] | bytes | None = None,
    payload: dict[str, Any] | bytes | None = None,
    key: str = "",
) -> MessageCase:
    """Create a case from the valid message of the channel, with the given changes."""
    source, usual_header, usual_payload = USUAL[channel]
    head = usual_header if header is None else header
    body = usual_payload if payload is None else payload
    return MessageCase(
        channel,
        name,
        purpose,
        key or key_for("r1", CHANNELS[channel], source),
        head if isinstance(head, bytes) else packed(head),
        body if isinstance(body, bytes) else packed(body),
        refuse,
    )


USUAL: dict[str, tuple[str, dict[str, Any], dict[str, Any] | bytes]] = {
    "frame": ("", FRAME_HEADER, jpeg(640, 480)),
    "twist": ("vision", ANSWER, b"0.2000|-0.3500"),
    "ack": ("vision", ANSWER, b""),
    "request": ("teleop", REQUESTED, {"id": 3, "verb": "arm"}),
    "reply": ("", STAMP, REPLY),
    "status": ("", STAMP, {"state": "HOLD", "reason": "armed; no command yet"}),
    "odometry": ("", STAMP, MOVED),
    "scan": ("", SCAN_HEADER, struct.pack("<4f", 0.5, 1.25, float("inf"), 8.0)),
    "camera": ("", STAMP, CAMERA),
    "detections": ("guest", ANSWER | {"source": "guest"}, DETECTIONS),
    "mission": ("operator", REQUESTED | {"source": "operator"}, MISSION),
    "report": ("vision", ANSWER, REPORT),
    "overlay": ("vision", ANSWER, jpeg(640, 480)),
    "preview": ("vision", ANSWER, jpeg(320, 240)),
}


# Golden cases of frames: headers and images. Pure.


def frames() -> list[MessageCase]:
    return [
        case("frame", "stamp_only", "odometry and latency may be left out", header=STAMP),
        case("frame", "latency_null", "null is as good as absent", header=FRAME_HEADER | {"latency_us": None}),
        case("frame", "seq_max", "the largest integer", header=FRAME_HEADER | {"seq": 2**53 - 1}),
        case("frame", "seq_real", "7.0 is not an integer", MALFORMED, header=FRAME_HEADER | {"seq": 7.0}),
        case("frame", "time_true", "true is not an integer", MALFORMED, header=FRAME_HEADER | {"t_us": True}),
        case("frame", "pose_of_two", "a pose has three numbers", MALFORMED, header=FRAME_HEADER | {"pose": [0, 0]}),
        case("frame", "pose_far", "numbers end at a million", MALFORMED, header=FRAME_HEADER | {"pose": [2e6, 0, 0]}),
        case("frame", "pose_nan", "NaN in a header", MALFORMED, header=FRAME_HEADER | {"pose": [float("nan"), 0, 0]}),
        case("frame", "no_header", "a frame needs its header", MALFORMED, header=b""),
        case("frame", "header_array", "a header is an object", MALFORMED, header=b"[1]"),
        case("frame", "header_not_utf8", "a header is UTF-8", MALFORMED, header=b'{"v":1,"session":"\xff"}'),
        case("frame", "no_time", "a frame without its time", MALFORMED, header=without(FRAME_HEADER, "t_us")),
        case("frame", "other_session", "of another start", header=FRAME_HEADER | {"session": PEER}),
        case("frame", "with_source", "a robot's key has no role", INEXACT, key="sightline/r1/frame/vision"),
        case("frame", "robot_wildcard", "a wildcard for the robot", INEXACT, key="sightline/*/frame"),
        case("frame", "foreign_prefix", "another prefix", INEXACT, key="starline/r1/frame"),
    ]


def pictures() -> list[MessageCase]:
    return [
        case("frame", "jpeg_progressive", "SOF2", payload=jpeg(320, 240, 0xC2)),
        case("frame", "jpeg_grey", "one component", payload=jpeg(320, 240, components=1)),
        case("frame", "jpeg_full_hd", "as many pixels as allowed by default", payload=jpeg(1920, 1080)),
        case("frame", "jpeg_one_row_more", "a row over the bound", MALFORMED, payload=jpeg(1920, 1081)),
        case("frame", "jpeg_bomb", "65500 x 65500 in 21 bytes", MALFORMED, payload=jpeg(65_500, 65_500)),
        case("frame", "jpeg_zero_width", "no width", MALFORMED, payload=jpeg(0, 480)),
        case("frame", "jpeg_zero_height", "no height", MALFORMED, payload=jpeg(640, 0)),
        case("frame", "jpeg_cmyk", "four components", MALFORMED, payload=jpeg(640, 480, components=4)),
        case("frame", "jpeg_12_bit", "12 bits", MALFORMED, payload=jpeg(640, 480, bits=12)),
        case("frame", "jpeg_lossless", "SOF3", MALFORMED, payload=jpeg(640, 480, 0xC3)),
        case("frame", "jpeg_arithmetic", "SOF9", MALFORMED, payload=jpeg(640, 480, 0xC9)),
        case("frame", "jpeg_scan_first", "SOS before SOF", MALFORMED, payload=b"\xff\xd8\xff\xda\x00\x08" + bytes(6)),
        case("frame", "jpeg_63_segments", "63 segments, then SOF", payload=segments(63)),
        case("frame", "jpeg_64_segments", "64 segments before SOF", MALFORMED, payload=segments(64)),
        case("frame", "jpeg_segment_short", "length 1", MALFORMED, payload=b"\xff\xd8\xff\xfe\x00\x01" + bytes(8)),
        case("frame", "jpeg_segment_past_end", "too long", MALFORMED, payload=b"\xff\xd8\xff\xfe\xff\xff" + bytes(8)),
        case("frame", "jpeg_fill_byte", "0xFF before a marker", payload=b"\xff\xd8\xff" + jpeg(640, 480)[2:]),
        case("frame", "jpeg_cut_in_sof", "cut in the frame header", MALFORMED, payload=jpeg(640, 480)[:11]),
        case("frame", "jpeg_soi_only", "nothing after SOI", MALFORMED, payload=b"\xff\xd8"),
        case("frame", "jpeg_empty", "no bytes", MALFORMED, payload=b""),
        case("frame", "png", "another format", MALFORMED, payload=b"\x89PNG\r\n\x1a\n" + bytes(24)),
    ]


def views() -> list[MessageCase]:
    """Return cases of images that the vision service creates for viewers."""
    return [
        case("overlay", "without_echo", "for showing only", header=without(ANSWER, "echo")),
        case("overlay", "no_role", "a key without its role", INEXACT, key="sightline/r1/overlay"),
        case("overlay", "jpeg_bomb", "65500 x 65500", MALFORMED, payload=jpeg(65_500, 65_500)),
        case("overlay", "jpeg_empty", "no bytes", MALFORMED, payload=b""),
        case("preview", "without_echo", "for showing only", header=without(ANSWER, "echo")),
        case("preview", "no_role", "a key without its role", INEXACT, key="sightline/r1/preview"),
        case("preview", "png", "another format", MALFORMED, payload=b"\x89PNG\r\n\x1a\n" + bytes(24)),
        case("preview", "jpeg_cut_in_sof", "cut in the frame header", MALFORMED, payload=jpeg(320, 240)[:11]),
    ]


# Golden cases of twists and acknowledgements. Pure.


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


def twists() -> list[MessageCase]:
    good = [case("twist", f"text_{name}", "within the grammar", payload=text) for name, text in _TWISTS_GOOD.items()]
    bad = [
        case("twist", f"text_{name}", "outside the grammar", MALFORMED, payload=text)
        for name, text in _TWISTS_MALFORMED.items()
    ]
    return [*good, *bad] + [
        case("twist", f"text_{name}", "not a finite number", NOT_FINITE, payload=text)
        for name, text in _TWISTS_NOT_FINITE.items()
    ]


def answers() -> list[MessageCase]:
    guest = "sightline/r1/twist/guest"
    return [
        case("twist", "guest", "a guest needs no header", header=b"", key=guest),
        case("twist", "no_header", "any other role needs one", MALFORMED, header=b""),
        case("twist", "no_compute", "compute_us may be left out", header=without(ANSWER, "compute_us")),
        case("twist", "with_scan_and_mission", "what else it went by",
             header=ANSWER | {"scan": 12, "mission": {"digest": PEER, "id": 5}}),
        case("twist", "with_proof", "an element of the sender's chain", header=ANSWER | {"proof": "0f" * 16}),
        case("twist", "with_next_proof", "near the end of the chain",
             header=ANSWER | {"proof": "0f" * 16, "next_proof": "a5" * 16}),
        case("twist", "proof_upper", "lower-case digits", MALFORMED, header=ANSWER | {"proof": "0F" * 16}),
        case("twist", "proof_31", "32 digits", MALFORMED, header=ANSWER | {"proof": "0f" * 15 + "0"}),
        case("twist", "scan_negative", "integers are bounded below", MALFORMED, header=ANSWER | {"scan": -1}),
        case("twist", "mission_no_id", "named in full", MALFORMED, header=ANSWER | {"mission": {"digest": PEER}}),
        case("twist", "no_echo", "a twist must cite what it answers", MALFORMED, header=without(ANSWER, "echo")),
        case("twist", "echo_of_scan", "no scan is cited", MALFORMED, header=echoing(ECHO | {"channel": "scan"})),
        case("twist", "echo_no_time", "an echo is complete", MALFORMED, header=echoing(without(ECHO, "t_us"))),
        case("twist", "source_upper", "a role is lower-case", MALFORMED, header=ANSWER | {"source": "Vision"}),
        case("twist", "source_long", "at most 16 characters", MALFORMED, header=ANSWER | {"source": "v" * 17}),
        case("twist", "wildcard", "a wildcard for the role", INEXACT, key="sightline/r1/twist/*"),
        case("twist", "wildcard_all", "a wildcard for all", INEXACT, key="**"),
        case("twist", "no_source", "a key without its role", INEXACT, key="sightline/r1/twist"),
        case("twist", "deeper", "a key with one part more", INEXACT, key="sightline/r1/twist/vision/1"),
        case("twist", "key_upper", "a role in the key is lower-case", INEXACT, key="sightline/r1/twist/Vision"),
        case("ack", "with_payload", "an ack has no payload", MALFORMED, payload=b"0|0"),
    ]


# Golden cases of all channels with a JSON or float payload. Pure.


def payloads() -> list[MessageCase]:
    status = {"state": "ACTIVE", "reason": "driving", "holder": {"source": "vision", "digest": PEER}}
    last = {"source": "vision", "reason": "STALE", "detail": "frame 41 is 410 ms old"}
    counted = status | {"refused": {"STALE": 3}, "last_refusal": last}
    stop = {"id": 1, "verb": "stop"}
    return [
        case("request", "stop_without_echo", "stop needs no echo", header=without(REQUESTED, "echo"), payload=stop),
        case("request", "with_proof", "of the driver", header=REQUESTED | {"proof": "0f" * 16}),
        case("request", "unknown_verb", "verbs are a closed list", MALFORMED, payload={"id": 1, "verb": "dance"}),
        case("request", "verb_upper", "verbs are lower-case", MALFORMED, payload={"id": 1, "verb": "STOP"}),
        case("request", "no_id", "a request has an id", MALFORMED, payload={"verb": "stop"}),
        case("request", "payload_257", "257 bytes", MALFORMED, payload=packed(stop).ljust(257)),
        case("reply", "refused", "a rejected request", payload=REPLY | {"ok": False, "detail": "vision drives"}),
        case("reply", "ok_as_1", "1 is not true", MALFORMED, payload=REPLY | {"ok": 1}),
        case("reply", "detail_201", "at most 200 characters", MALFORMED, payload=REPLY | {"detail": "x" * 201}),
        case("status", "with_holder", "with a driver", payload=counted),
        case("status", "unknown_state", "a closed list", MALFORMED, payload=status | {"state": "FLYING"}),
        case("status", "refused_negative", "not below 0", MALFORMED, payload=status | {"refused": {"STALE": -1}}),
        case("status", "payload_4097", "4097 bytes", MALFORMED, payload=packed(status).ljust(4097)),
        case("odometry", "no_twist", "both fields are needed", MALFORMED, payload=without(MOVED, "moving")),
        case("odometry", "infinite", "finite numbers only", MALFORMED, payload=MOVED | {"moving": [float("inf"), 0]}),
        case("scan", "empty", "no rays", payload=b""),
        case("scan", "ragged", "no whole float", MALFORMED, payload=bytes(6)),
        case("scan", "nan", "a range is a number", NOT_FINITE, payload=struct.pack("<2f", 1.0, float("nan"))),
        case("scan", "negative", "a range is not negative", NOT_FINITE, payload=struct.pack("<f", -0.5)),
        case("scan", "minus_infinity", "nor minus infinity", NOT_FINITE, payload=struct.pack("<f", float("-inf"))),
        case("camera", "mounted", "with mounting and distortion",
              payload=CAMERA | {"distortion": [0.1, -0.2], "z_m": 0.12, "pitch_rad": -0.1, "calibrated": True}),
        case("camera", "focal_zero", "a focal length is positive", MALFORMED, payload=CAMERA | {"fx_px": 0}),
        case("camera", "nine_terms", "at most eight terms", MALFORMED, payload=CAMERA | {"distortion": [0.0] * 9}),
        case("camera", "width_15", "at least 16 pixels", MALFORMED, payload=CAMERA | {"width_px": 15}),
    ]


def _found(*boxes: dict[str, Any]) -> dict[str, Any]:
    """Return the usual detections with these boxes."""
    return DETECTIONS | {"boxes": list(boxes)}


def detections() -> list[MessageCase]:
    """Return cases of boxes from a detector."""
    name, guest = "detections", ANSWER | {"source": "guest"}
    circle = {"cx_px": 320.0, "cy_px": 225.0, "radius_px": 40.0}
    return [
        case(name, "saw_nothing", "looked, and saw nothing", payload=_found()),
        case(name, "boxes_absent", "as good as none", payload=without(DETECTIONS, "boxes")),
        case(name, "without_echo", "without the frame", header=without(guest, "echo")),
        case(name, "of_vision", "another role", header=ANSWER, key="sightline/r1/detections/vision"),
        case(name, "no_role", "a key without its role", "INEXACT_KEY", key="sightline/r1/detections"),
        case(name, "circle_and_track", "what a detector may add", payload=_found(BOX | {"circle": circle, "track": 9})),
        case(name, "who_looked", "the detector, its device and the hash of its model",
             payload=_found(BOX) | {"detector": "onnx", "device": "cuda", "model": "9f86d081884c7d65"}),
        case(name, "boxes_64", "as many as may be", payload=_found(*[BOX] * 64)),
        case(name, "boxes_65", "one too many", MALFORMED, payload=_found(*[BOX] * 65)),
        case(name, "label_64", "64 characters", payload=_found(BOX | {"label": "x" * 64})),
        case(name, "label_65", "65 characters", MALFORMED, payload=_found(BOX | {"label": "x" * 65})),
        case(name, "label_empty", "a label is not empty", MALFORMED, payload=_found(BOX | {"label": ""})),
        case(name, "label_newline", "no control characters", MALFORMED, payload=_found(BOX | {"label": "a\nb"})),
        case(name, "score_above_1", "a score ends at 1", MALFORMED, payload=_found(BOX | {"score": 1.01})),
        case(name, "score_nan", "NaN is not a number here", MALFORMED, payload=_found(BOX | {"score": float("nan")})),
        case(name, "corner_infinite", "nor is Infinity", MALFORMED, payload=_found(BOX | {"x2_px": float("inf")})),
        case(name, "inside_out", "the second corner is first", MALFORMED, payload=_found(BOX | {"x1_px": 361.0})),
        case(name, "beyond_the_picture", "a box may leave the picture", payload=_found(BOX | {"x1_px": -20.0})),
        case(name, "radius_zero", "a circle has a radius", MALFORMED,
             payload=_found(BOX | {"circle": circle | {"radius_px": 0}})),
        case(name, "no_size", "the picture's size is needed", MALFORMED, payload=without(DETECTIONS, "width_px")),
        case(name, "payload_32769", "32769 bytes", MALFORMED, payload=packed(DETECTIONS).ljust(32_769)),
        case(name, "payload_32768", "32768 bytes", payload=packed(DETECTIONS).ljust(32_768)),
    ]


def missions() -> list[MessageCase]:
    """Return cases of requested missions."""
    name, most = "mission", {"options": {f"option_{number}": 1 for number in range(16)}}
    return [
        case(name, "name_alone", "what a mission needs is its own default", payload={"id": 1, "name": "follow"}),
        case(name, "of_teleop", "another role", header=REQUESTED, key="sightline/r1/mission/teleop"),
        case(name, "options", "of every kind", payload=MISSION | {"options": {"a": True, "b.c": 0.5, "d": "left"}}),
        case(name, "option_number_1", "a number, not a truth", payload=MISSION | {"options": {"confirm": 1}}),
        case(name, "options_16", "as many as may be", payload=MISSION | most),
        case(name, "options_17", "one too many", MALFORMED,
             payload=MISSION | {"options": most["options"] | {"more": 1}}),
        case(name, "option_list", "no list", MALFORMED, payload=MISSION | {"options": {"a": [1]}}),
        case(name, "option_null", "nor nothing", MALFORMED, payload=MISSION | {"options": {"a": None}}),
        case(name, "option_nan", "NaN is not a number", MALFORMED, payload=MISSION | {"options": {"a": float("nan")}}),
        case(name, "option_text_65", "65 characters", MALFORMED, payload=MISSION | {"options": {"a": "x" * 65}}),
        case(name, "option_name_upper", "names are lower-case", MALFORMED, payload=MISSION | {"options": {"A": 1}}),
        case(name, "path_to_code", "a name, never a path to code", MALFORMED, payload=MISSION | {"name": "os:system"}),
        case(name, "name_33", "33 letters", MALFORMED, payload=MISSION | {"name": "a" * 33}),
        case(name, "no_name", "a mission has a name", MALFORMED, payload=without(MISSION, "name")),
        case(name, "waypoints_64", "as many as may be", payload=MISSION | {"waypoints": [[1.0, -1.0]] * 64}),
        case(name, "waypoints_65", "one too many", MALFORMED, payload=MISSION | {"waypoints": [[1.0, -1.0]] * 65}),
        case(name, "waypoint_far", "within 100 m", MALFORMED, payload=MISSION | {"waypoints": [[100.1, 0.0]]}),
        case(name, "waypoint_at_100_m", "100 m", payload=MISSION | {"waypoints": [[100, -100]]}),
        case(name, "waypoint_of_three", "two numbers", MALFORMED, payload=MISSION | {"waypoints": [[1.0, 2.0, 3.0]]}),
        case(name, "waypoint_text", "no type is converted", MALFORMED, payload=MISSION | {"waypoints": [["1", 2.0]]}),
        case(name, "payload_4097", "4097 bytes", MALFORMED, payload=packed(MISSION).ljust(4097)),
    ]


def reports() -> list[MessageCase]:
    """Return cases of mission reports."""
    name = "report"
    return [
        case(name, "without_echo", "before the first frame", header=without(ANSWER, "echo")),
        case(name, "name_and_phase", "all that is needed", payload={"mission": "follow", "phase": "tracking"}),
        case(name, "refused", "why a mission was rejected",
             payload=REPORT | {"refused": "no mission called 'gota'; did you mean 'goto'?"}),
        case(name, "done", "it is over", payload=REPORT | {"done": True, "note": "reached 2 of 2"}),
        case(name, "measured", "with the model and its time",
             payload=REPORT | {"device": "cuda", "model": "9f86d081884c7d65", "inference_us": 1060}),
        case(name, "of_a_path", "a mission of one's own", payload=REPORT | {"mission": "my_missions:Circle"}),
        case(name, "target", "what it follows", payload=REPORT | {"target": TARGET}),
        case(name, "target_far_right", "without a circle or a distance",
             payload=REPORT | {"target": without(TARGET, "radius_px", "distance_m", "track") | {"bearing_rad": -0.5}}),
        case(name, "target_null", "null is as good as absent", payload=REPORT | {"target": None}),
        case(name, "target_no_size", "the image has a size", MALFORMED,
             payload=REPORT | {"target": without(TARGET, "width_px")}),
        case(name, "target_radius_0", "a circle has a radius", MALFORMED,
             payload=REPORT | {"target": TARGET | {"radius_px": 0}}),
        case(name, "target_behind", "not below 0", MALFORMED, payload=REPORT | {"target": TARGET | {"distance_m": -1}}),
        case(name, "target_unsure", "at most 1", MALFORMED, payload=REPORT | {"target": TARGET | {"score": 1.5}}),
        case(name, "no_phase", "a phase is needed", MALFORMED, payload=without(REPORT, "phase")),
        case(name, "note_201", "at most 200 characters", MALFORMED, payload=REPORT | {"note": "x" * 201}),
        case(name, "asked_no_id", "an id is needed", MALFORMED, payload=REPORT | {"asked": {"digest": PEER}}),
        case(name, "done_as_1", "1 is not true", MALFORMED, payload=REPORT | {"done": 1}),
        case(name, "time_negative", "not below 0", MALFORMED, payload=REPORT | {"inference_us": -1}),
        case(name, "payload_2049", "2049 bytes", MALFORMED, payload=packed(REPORT).ljust(2049)),
    ]


# The golden cases, defined by hand: key, header, payload, and the rejection, if any. Pure.


def _usual() -> list[MessageCase]:
    return [case(channel, "usual", "a complete message") for channel in CHANNELS]


def _stamps() -> list[MessageCase]:
    """Return cases that apply to every header, on every channel."""
    return [one for channel in CHANNELS for one in _header_cases(channel, USUAL[channel][1])]


def _header_cases(channel: str, header: dict[str, Any]) -> list[MessageCase]:
    return [
        case(channel, "unknown_field", "unknown fields are ignored", header=header | {"later": [1]}),
        case(channel, "version_2", "another version is rejected by name", VERSION, header=header | {"v": 2}),
        case(channel, "no_session", "a required field is missing", MALFORMED, header=without(header, "session")),
        case(channel, "session_upper", "8 lower-case hex", MALFORMED, header=header | {"session": "0A1B2C3D"}),
        case(channel, "seq_negative", "integers are bounded below", MALFORMED, header=header | {"seq": -1}),
        case(channel, "seq_2_53", "integers are bounded above", MALFORMED, header=header | {"seq": 2**53}),
        case(channel, "seq_text", "no type is converted", MALFORMED, header=header | {"seq": "7"}),
        case(channel, "header_cut", "cut short", MALFORMED, header=packed(header)[:-1]),
        case(channel, "header_513", "513 bytes of header", MALFORMED, header=packed(header).ljust(513)),
        case(channel, "header_512", "512 bytes of header", header=packed(header).ljust(512)),
    ]


CASES: tuple[MessageCase, ...] = (
    *_usual(), *_stamps(), *frames(), *pictures(), *twists(), *answers(), *payloads(), *detections(), *missions(),
    *reports(), *views(),
)
"""Every case; the first of a channel is its example in the specification."""
