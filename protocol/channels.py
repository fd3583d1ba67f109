"""The only table of channels. Keys, encodings, priorities, sizes and the specification derive from it. Pure.

Each key toward the robot names its source (`twist/vision`), so that access rules can grant the right to drive.
"""

import re
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Final

from sightline.protocol import ROLE_PATTERN
from sightline.protocol.messages import (
    AnswerHeader,
    CameraModel,
    Detections,
    DetectionsHeader,
    FrameHeader,
    MissionReport,
    MissionRequest,
    Odometry,
    Reply,
    Request,
    RequestHeader,
    ScanHeader,
    Stamp,
    Status,
    WireModel,
)
from sightline.protocol.text import MAX_TWIST_BYTES
from sightline.protocol.transports.endpoints import ROBOT_ID, check_robot_id

MAX_HEADER_BYTES = 512
KEY_PREFIX = "sightline"


class Direction(Enum):
    """Publishing side of a channel."""

    FROM_ROBOT = "robot -> others"
    TO_ROBOT = "others -> robot"


class Priority(Enum):
    """Order of sending on a full link. The names are those of Zenoh."""

    REAL_TIME = "REAL_TIME"
    INTERACTIVE_HIGH = "INTERACTIVE_HIGH"
    DATA = "DATA"
    DATA_LOW = "DATA_LOW"


@dataclass(frozen=True, slots=True)
class Channel:
    """One row of the table. `payload` is a JSON model, or None if `encoding` describes the bytes."""

    name: str
    direction: Direction
    header: type[WireModel]
    payload: type[WireModel] | None
    encoding: str
    priority: Priority
    rate: str
    max_payload_bytes: int
    purpose: str
    when_full: str = "a newer message replaces it"
    """Rule for a message that cannot leave immediately."""
    passed_on: bool = False
    """True if the robot forwards the message unchanged to every other peer that subscribes to it."""
    while_watched: bool = False
    """True if a peer publishes it only while a viewer subscribes, which saves the encoding."""
    published_by: tuple[str, ...] = ()
    """Sources that may publish it on links with keys. Empty for every source."""

    @property
    def has_source(self) -> bool:
        """Return True if the key ends in the publisher's role."""
        return self.direction is Direction.TO_ROBOT


_OUT, _IN = Direction.FROM_ROBOT, Direction.TO_ROBOT
_JSON = "application/json"
JPEG: Final = "image/jpeg"
"""Encoding of every channel whose payload is an image."""
DRIVERS: Final = ("vision", "operator", "teleop")
SOURCES_OF_ROLE: Final[dict[str, tuple[str, ...]]] = {
    "vision": ("vision",),
    "operator": ("operator", "teleop"),
    "detector": ("detector",),
    "viewer": (),
}
"""Role of a certificate -> the sources that it may use toward a robot. A detector publishes only its detections. A
viewer publishes nothing, not even `ack`."""
KNOWN_SOURCES: Final = frozenset(source for sources in SOURCES_OF_ROLE.values() for source in sources)
"""All sources of a role. A peer can use any other source only on a link without keys."""

FRAME = Channel("frame", _OUT, FrameHeader, None, JPEG, Priority.DATA, "camera rate, by credit", 1_000_000,
                "an image, JPEG and nothing else", "no image is captured without credit; a newer message replaces it")
TWIST = Channel("twist", _IN, AnswerHeader, None, "text/plain", Priority.REAL_TIME, "one per frame answered",
                MAX_TWIST_BYTES, "`linear|angular` in m/s and rad/s", published_by=DRIVERS)
ACK = Channel("ack", _IN, AnswerHeader, None, "application/octet-stream", Priority.REAL_TIME,
              "one per frame seen but not answered by a twist", 0, "returns credit, drives nothing; empty payload",
              published_by=DRIVERS)
REQUEST = Channel("request", _IN, RequestHeader, Request, _JSON, Priority.REAL_TIME, "on demand", 256,
                  "arm, disarm, stop, reset, acquire, release", "a newer message replaces it; the requester repeats it")
REPLY = Channel("reply", _OUT, Stamp, Reply, _JSON, Priority.INTERACTIVE_HIGH, "one per request", 1024,
                "the answer to a request")
STATUS = Channel("status", _OUT, Stamp, Status, _JSON, Priority.INTERACTIVE_HIGH, "10 Hz", 4096,
                 "state, reason, holder, counters")
ODOMETRY = Channel("odometry", _OUT, Stamp, Odometry, _JSON, Priority.DATA, "20 Hz", 256, "pose and twist from wheels")
SCAN = Channel("scan", _OUT, ScanHeader, None, "application/octet-stream", Priority.DATA_LOW, "10 Hz", 16_384,
               "lidar ranges, little-endian float32, meters, inf = no return")
CAMERA = Channel("camera", _OUT, Stamp, CameraModel, _JSON, Priority.INTERACTIVE_HIGH, "2 Hz", 1024,
                 "the camera's model and mounting")
DETECTIONS = Channel("detections", _IN, DetectionsHeader, Detections, _JSON, Priority.INTERACTIVE_HIGH,
                     "one per examined image", 32_768, "boxes from a detector; the robot passes them on",
                     passed_on=True)
MISSION = Channel("mission", _IN, RequestHeader, MissionRequest, _JSON, Priority.INTERACTIVE_HIGH, "on demand",
                  4096, "the requested mission; the robot passes it on", passed_on=True,
                  published_by=("operator", "teleop"))
REPORT = Channel("report", _IN, DetectionsHeader, MissionReport, _JSON, Priority.INTERACTIVE_HIGH,
                 "2 Hz, 10 Hz with a target, and on a change", 2048, "the state of the mission; the robot passes it on",
                 passed_on=True, published_by=("vision",))
OVERLAY = Channel("overlay", _IN, DetectionsHeader, None, JPEG, Priority.DATA_LOW, "15 Hz at most, while watched",
                  250_000, "the image with the detections drawn on it; the robot passes it on",
                  passed_on=True, while_watched=True, published_by=("vision",))
PREVIEW = Channel("preview", _IN, DetectionsHeader, None, JPEG, Priority.DATA_LOW, "10 Hz at most, while watched",
                  100_000, "the image at a small size; the robot passes it on", passed_on=True, while_watched=True,
                  published_by=("vision",))

CHANNELS: dict[str, Channel] = {
    channel.name: channel
    for channel in (FRAME, TWIST, ACK, REQUEST, REPLY, STATUS, ODOMETRY, SCAN, CAMERA, DETECTIONS, MISSION, REPORT,
                    OVERLAY, PREVIEW)
}

_SOURCE = re.compile(ROLE_PATTERN)


@lru_cache(maxsize=1024)  # called for each message; with cold caches the pattern alone costs 50 us
def key_for(robot: str, channel: Channel, source: str = "") -> str:
    """Return the exact key of a channel.

    Args:
        robot: robot id.
        channel: the channel.
        source: role of the sender, required toward the robot and forbidden from it.

    Raises:
        ValueError: the source does not fit the channel.
        ConfigError: the robot id is invalid.
    """
    if channel.has_source != bool(source) or (source and not _SOURCE.fullmatch(source)):
        raise ValueError(f"channel {channel.name} with source {source!r}")
    tail = f"/{source}" if source else ""
    return f"{KEY_PREFIX}/{check_robot_id(robot)}/{channel.name}{tail}"


def pattern_for(robot: str, channel: Channel) -> str:
    """Return the key expression for a subscriber of `channel`. The subscriber still checks received keys exactly."""
    tail = "/*" if channel.has_source else ""
    return f"{KEY_PREFIX}/{check_robot_id(robot)}/{channel.name}{tail}"


_MAX_KEY_CHARS: Final = len(KEY_PREFIX) + 32 + max(map(len, CHANNELS)) + 16 + len("///")


def parse_key(key: str) -> tuple[str, Channel, str] | None:
    """Split an exact key into (robot, channel, source). Return None for any other text, also with wildcards."""
    # A transport may deliver a key of 64 KB, and the cache would store many of them.
    return _parse_key(key) if len(key) <= _MAX_KEY_CHARS else None


@lru_cache(maxsize=1024)
def _parse_key(key: str) -> tuple[str, Channel, str] | None:
    parts = key.split("/")
    channel = CHANNELS.get(parts[2]) if len(parts) in (3, 4) and parts[0] == KEY_PREFIX else None
    if channel is None or channel.has_source != (len(parts) == 4) or not ROBOT_ID.fullmatch(parts[1]):
        return None
    source = parts[3] if channel.has_source else ""
    if channel.has_source and not _SOURCE.fullmatch(source):
        return None
    return parts[1], channel, source
