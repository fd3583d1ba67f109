"""What a golden case is, and each channel's usual message, from which the cases differ. Pure."""

import json
import struct
from dataclasses import dataclass
from typing import Any

from sightline.protocol.channels import CHANNELS, key_for


@dataclass(frozen=True, slots=True)
class MessageCase:
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
BOX = {"label": "person", "score": 0.91, "x1_px": 280.0, "y1_px": 120.5, "x2_px": 360.0, "y2_px": 330.0}
DETECTIONS: dict[str, Any] = {"width_px": 640, "height_px": 480, "boxes": [BOX]}
REPLY = {"to": PEER, "id": 3, "ok": True, "state": "HOLD", "detail": "armed"}
MISSION: dict[str, Any] = {"id": 5, "name": "goto", "waypoints": [[1.5, 1.5], [0.0, -2.0]]}
REPORT: dict[str, Any] = {"mission": "goto", "phase": "driving", "note": "to waypoint 1 of 2",
                          "asked": {"session": PEER, "id": 5}, "detector": "hsv", "device": "cpu"}


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
    """A case that differs from the channel's valid message only in what is given."""
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
    "request": ("teleop", ASK, {"id": 3, "verb": "arm"}),
    "reply": ("", STAMP, REPLY),
    "status": ("", STAMP, {"state": "HOLD", "reason": "armed; no command yet"}),
    "odometry": ("", STAMP, MOVED),
    "scan": ("", SCAN_HEADER, struct.pack("<4f", 0.5, 1.25, float("inf"), 8.0)),
    "camera": ("", STAMP, CAMERA),
    "detections": ("guest", ANSWER | {"source": "guest"}, DETECTIONS),
    "mission": ("operator", ASK | {"source": "operator"}, MISSION),
    "report": ("vision", ANSWER, REPORT),
    "overlay": ("vision", ANSWER, jpeg(640, 480)),
    "preview": ("vision", ANSWER, jpeg(320, 240)),
}
