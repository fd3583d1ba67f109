"""Golden cases of everything whose payload is JSON or floats. Pure."""

import struct
from typing import Any

from protocol.golden_case import (
    ANSWER,
    ASK,
    BOX,
    CAMERA,
    DETECTIONS,
    MALFORMED,
    MOVED,
    NOT_FINITE,
    PEER,
    REPLY,
    Case,
    case,
    packed,
    without,
)


def payloads() -> list[Case]:
    status = {"state": "ACTIVE", "reason": "driving", "holder": {"source": "vision", "session": PEER}}
    last = {"source": "vision", "reason": "STALE", "detail": "frame 41 is 410 ms old"}
    counted = status | {"refused": {"STALE": 3}, "last_refusal": last}
    stop = {"id": 1, "verb": "stop"}
    return [
        case("request", "stop_without_echo", "stop needs no echo", header=without(ASK, "echo"), payload=stop),
        case("request", "unknown_verb", "verbs are a closed list", MALFORMED, payload={"id": 1, "verb": "dance"}),
        case("request", "verb_upper", "verbs are lower-case", MALFORMED, payload={"id": 1, "verb": "STOP"}),
        case("request", "no_id", "a request has an id", MALFORMED, payload={"verb": "stop"}),
        case("request", "payload_257", "257 bytes", MALFORMED, payload=packed(stop).ljust(257)),
        case("reply", "refused", "a request refused", payload=REPLY | {"ok": False, "detail": "vision drives"}),
        case("reply", "ok_as_1", "1 is not true", MALFORMED, payload=REPLY | {"ok": 1}),
        case("reply", "detail_201", "at most 200 characters", MALFORMED, payload=REPLY | {"detail": "x" * 201}),
        case("status", "with_holder", "somebody drives", payload=counted),
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
    """The usual picture with these boxes."""
    return DETECTIONS | {"boxes": list(boxes)}


def detections() -> list[Case]:
    """Boxes that somebody found."""
    name, guest = "detections", ANSWER | {"source": "guest"}
    circle = {"cx_px": 320.0, "cy_px": 225.0, "radius_px": 40.0}
    return [
        case(name, "saw_nothing", "looked, and saw nothing", payload=_found()),
        case(name, "boxes_absent", "as good as none", payload=without(DETECTIONS, "boxes")),
        case(name, "without_echo", "nobody knows which frame", header=without(guest, "echo")),
        case(name, "of_vision", "another role", header=ANSWER, key="sightline/r1/detections/vision"),
        case(name, "no_role", "a key without its role", "INEXACT_KEY", key="sightline/r1/detections"),
        case(name, "circle_and_track", "what a detector may add", payload=_found(BOX | {"circle": circle, "track": 9})),
        case(name, "boxes_64", "as many as may be", payload=_found(*[BOX] * 64)),
        case(name, "boxes_65", "one too many", MALFORMED, payload=_found(*[BOX] * 65)),
        case(name, "label_64", "64 characters", payload=_found(BOX | {"label": "x" * 64})),
        case(name, "label_65", "65 characters", MALFORMED, payload=_found(BOX | {"label": "x" * 65})),
        case(name, "label_empty", "a label is not empty", MALFORMED, payload=_found(BOX | {"label": ""})),
        case(name, "label_newline", "no control characters", MALFORMED, payload=_found(BOX | {"label": "a\nb"})),
        case(name, "score_above_1", "a score ends at 1", MALFORMED, payload=_found(BOX | {"score": 1.01})),
        case(name, "score_nan", "NaN is no number here", MALFORMED, payload=_found(BOX | {"score": float("nan")})),
        case(name, "corner_infinite", "nor is Infinity", MALFORMED, payload=_found(BOX | {"x2_px": float("inf")})),
        case(name, "inside_out", "the second corner is first", MALFORMED, payload=_found(BOX | {"x1_px": 361.0})),
        case(name, "beyond_the_picture", "a box may leave the picture", payload=_found(BOX | {"x1_px": -20.0})),
        case(name, "radius_zero", "a circle has a radius", MALFORMED,
             payload=_found(BOX | {"circle": circle | {"radius_px": 0}})),
        case(name, "no_size", "the picture's size is needed", MALFORMED, payload=without(DETECTIONS, "width_px")),
        case(name, "payload_32769", "32769 bytes", MALFORMED, payload=packed(DETECTIONS).ljust(32_769)),
        case(name, "payload_32768", "32768 bytes", payload=packed(DETECTIONS).ljust(32_768)),
    ]
