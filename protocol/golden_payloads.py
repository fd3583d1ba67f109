"""Golden cases of everything whose payload is JSON or floats. Pure."""

import struct
from typing import Any

from sightline.protocol.spec.message_cases import (
    ANSWER,
    ASK,
    BOX,
    CAMERA,
    DETECTIONS,
    MALFORMED,
    MISSION,
    MOVED,
    NOT_FINITE,
    PEER,
    REPLY,
    REPORT,
    MessageCase,
    case,
    packed,
    without,
)


def payloads() -> list[MessageCase]:
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


def detections() -> list[MessageCase]:
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
        case(name, "who_looked", "the detector, its device and the hash of its model",
             payload=_found(BOX) | {"detector": "onnx", "device": "cuda", "model": "9f86d081884c7d65"}),
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


def missions() -> list[MessageCase]:
    """What vision is asked to do."""
    name, most = "mission", {"options": {f"option_{number}": 1 for number in range(16)}}
    return [
        case(name, "name_alone", "what a mission needs is its own default", payload={"id": 1, "name": "follow"}),
        case(name, "of_teleop", "another role", header=ASK, key="sightline/r1/mission/teleop"),
        case(name, "options", "of every kind", payload=MISSION | {"options": {"a": True, "b.c": 0.5, "d": "left"}}),
        case(name, "option_number_1", "a number, not a truth", payload=MISSION | {"options": {"confirm": 1}}),
        case(name, "options_16", "as many as may be", payload=MISSION | most),
        case(name, "options_17", "one too many", MALFORMED,
             payload=MISSION | {"options": most["options"] | {"more": 1}}),
        case(name, "option_list", "no list", MALFORMED, payload=MISSION | {"options": {"a": [1]}}),
        case(name, "option_null", "nor nothing", MALFORMED, payload=MISSION | {"options": {"a": None}}),
        case(name, "option_nan", "NaN is no number", MALFORMED, payload=MISSION | {"options": {"a": float("nan")}}),
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
    """What vision does."""
    name = "report"
    return [
        case(name, "without_echo", "before the first frame", header=without(ANSWER, "echo")),
        case(name, "name_and_phase", "all that is needed", payload={"mission": "follow", "phase": "tracking"}),
        case(name, "refused", "why a mission was not taken up",
             payload=REPORT | {"refused": "no mission called 'gota'; did you mean 'goto'?"}),
        case(name, "done", "it is over", payload=REPORT | {"done": True, "note": "reached 2 of 2"}),
        case(name, "measured", "with the model and its time",
             payload=REPORT | {"device": "cuda", "model": "9f86d081884c7d65", "inference_us": 1060}),
        case(name, "of_a_path", "a mission of one's own", payload=REPORT | {"mission": "my_missions:Circle"}),
        case(name, "no_phase", "a phase is needed", MALFORMED, payload=without(REPORT, "phase")),
        case(name, "note_201", "at most 200 characters", MALFORMED, payload=REPORT | {"note": "x" * 201}),
        case(name, "asked_no_id", "an id is needed", MALFORMED, payload=REPORT | {"asked": {"session": PEER}}),
        case(name, "done_as_1", "1 is not true", MALFORMED, payload=REPORT | {"done": 1}),
        case(name, "time_negative", "not below 0", MALFORMED, payload=REPORT | {"inference_us": -1}),
        case(name, "payload_2049", "2049 bytes", MALFORMED, payload=packed(REPORT).ljust(2049)),
    ]
