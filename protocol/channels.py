"""ONE table of channels; keys, encodings, priorities, sizes and the specification's tables derive from it. Pure.

Everything towards the robot names its source in the key (`twist/vision`), so that access rules can say who may drive.
"""

import re
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Final

from sightline.protocol.errors import ConfigError
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

MAX_HEADER_BYTES = 512
KEY_PREFIX = "sightline"


class Direction(Enum):
    """Who publishes."""

    FROM_ROBOT = "robot -> others"
    TO_ROBOT = "others -> robot"


class Priority(Enum):
    """Order of sending when a link is full; the names are Zenoh's."""

    REAL_TIME = "REAL_TIME"
    INTERACTIVE_HIGH = "INTERACTIVE_HIGH"
    DATA = "DATA"
    DATA_LOW = "DATA_LOW"


@dataclass(frozen=True, slots=True)
class Channel:
    """One row of the table. `payload` is a JSON model, or None where the bytes are described by `encoding`."""

    name: str
    direction: Direction
    header: type[WireModel]
    payload: type[WireModel] | None
    encoding: str
    priority: Priority
    rate: str
    max_payload_bytes: int
    purpose: str
    when_full: str = "a newer one takes its place"
    """What becomes of a message that cannot leave at once."""
    passed_on: bool = False
    """Whether the robot hands it, as it came, to every other peer that wants it."""
    while_watched: bool = False
    """Said, and passed on, only while somebody listens: a picture nobody looks at is not worth its encoding."""
    said_by: tuple[str, ...] = ()
    """Who may say it where links have keys; empty for every source."""

    @property
    def has_source(self) -> bool:
        """Whether the key ends in the publisher's role."""
        return self.direction is Direction.TO_ROBOT


_OUT, _IN = Direction.FROM_ROBOT, Direction.TO_ROBOT
_JSON = "application/json"
JPEG: Final = "image/jpeg"
"""Encoding of every channel whose payload is a picture."""
DRIVERS: Final = ("vision", "operator", "teleop")
SOURCES_OF_ROLE: Final[dict[str, tuple[str, ...]]] = {
    "vision": ("vision",),
    "operator": ("operator", "teleop"),
    "detector": ("detector",),
    "viewer": (),
}
"""Role of a certificate -> the sources it may speak as towards a robot. A detector says what it sees and no more, a
viewer nothing, not even `ack`."""
KNOWN_SOURCES: Final = frozenset(source for sources in SOURCES_OF_ROLE.values() for source in sources)
"""The sources that a role speaks as; any other is made up by its peer, and possible only on a link without keys."""

FRAME = Channel("frame", _OUT, FrameHeader, None, JPEG, Priority.DATA, "camera rate, by credit", 1_000_000,
                "a picture, JPEG and nothing else", "none is taken without credit; a newer one takes its place")
TWIST = Channel("twist", _IN, AnswerHeader, None, "text/plain", Priority.REAL_TIME, "one per frame answered",
                MAX_TWIST_BYTES, "`linear|angular` in m/s and rad/s", said_by=DRIVERS)
ACK = Channel("ack", _IN, AnswerHeader, None, "application/octet-stream", Priority.REAL_TIME,
              "one per frame seen but not answered by a twist", 0, "returns credit, drives nothing; empty payload",
              said_by=DRIVERS)
REQUEST = Channel("request", _IN, RequestHeader, Request, _JSON, Priority.REAL_TIME, "as a person asks", 256,
                  "arm, disarm, stop, reset, acquire, release", "a newer one takes its place; who asks asks again")
REPLY = Channel("reply", _OUT, Stamp, Reply, _JSON, Priority.INTERACTIVE_HIGH, "one per request", 1024,
                "the answer to a request")
STATUS = Channel("status", _OUT, Stamp, Status, _JSON, Priority.INTERACTIVE_HIGH, "10 Hz", 4096,
                 "state, reason, holder, counters")
ODOMETRY = Channel("odometry", _OUT, Stamp, Odometry, _JSON, Priority.DATA, "20 Hz", 256, "pose and twist from wheels")
SCAN = Channel("scan", _OUT, ScanHeader, None, "application/octet-stream", Priority.DATA_LOW, "10 Hz", 16_384,
               "lidar ranges, little-endian float32, metres, inf = no return")
CAMERA = Channel("camera", _OUT, Stamp, CameraModel, _JSON, Priority.INTERACTIVE_HIGH, "2 Hz", 1024,
                 "the camera's model and mounting")
DETECTIONS = Channel("detections", _IN, DetectionsHeader, Detections, _JSON, Priority.INTERACTIVE_HIGH,
                     "one per picture looked at", 32_768, "boxes that somebody found; the robot passes them on",
                     passed_on=True)
MISSION = Channel("mission", _IN, RequestHeader, MissionRequest, _JSON, Priority.INTERACTIVE_HIGH, "as a person asks",
                  4096, "what vision is to do; the robot passes it on", passed_on=True,
                  said_by=("operator", "teleop"))
REPORT = Channel("report", _IN, DetectionsHeader, MissionReport, _JSON, Priority.INTERACTIVE_HIGH,
                 "2 Hz and on a change", 2048, "what vision does; the robot passes it on", passed_on=True,
                 said_by=("vision",))
OVERLAY = Channel("overlay", _IN, DetectionsHeader, None, JPEG, Priority.DATA_LOW, "15 Hz at most, while watched",
                  250_000, "the picture with what vision saw in it drawn over it; the robot passes it on",
                  passed_on=True, while_watched=True, said_by=("vision",))
PREVIEW = Channel("preview", _IN, DetectionsHeader, None, JPEG, Priority.DATA_LOW, "10 Hz at most, while watched",
                  100_000, "the picture made small; the robot passes it on", passed_on=True, while_watched=True,
                  said_by=("vision",))

CHANNELS: dict[str, Channel] = {
    channel.name: channel
    for channel in (FRAME, TWIST, ACK, REQUEST, REPLY, STATUS, ODOMETRY, SCAN, CAMERA, DETECTIONS, MISSION, REPORT,
                    OVERLAY, PREVIEW)
}

_ROBOT_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")
_SOURCE = re.compile(r"[a-z][a-z0-9_]{0,15}")


def check_robot_id(robot: str) -> str:
    """Return `robot` if it may stand in a key; raise ConfigError naming what is wrong otherwise."""
    if not _ROBOT_ID.fullmatch(robot):
        raise ConfigError(
            f"robot id {robot!r} is not usable: 1 to 32 letters, digits, '_', '-' or '.', starting with a letter or "
            "digit (no '/' or '*'), e.g. --robot r1"
        )
    return robot


@lru_cache(maxsize=1024)  # asked for each message, and after an idle camera period a pattern costs 50 us
def key_for(robot: str, channel: Channel, source: str = "") -> str:
    """The exact key of `channel` for `robot`; `source` is required towards the robot and forbidden from it."""
    if channel.has_source != bool(source) or (source and not _SOURCE.fullmatch(source)):
        raise ValueError(f"channel {channel.name} with source {source!r}")
    tail = f"/{source}" if source else ""
    return f"{KEY_PREFIX}/{check_robot_id(robot)}/{channel.name}{tail}"


def pattern_for(robot: str, channel: Channel) -> str:
    """The key expression that a subscriber of `channel` declares; received keys are still checked exactly."""
    tail = "/*" if channel.has_source else ""
    return f"{KEY_PREFIX}/{check_robot_id(robot)}/{channel.name}{tail}"


@lru_cache(maxsize=1024)
def parse_key(key: str) -> tuple[str, Channel, str] | None:
    """Split an exact key into (robot, channel, source); None for anything else, wildcards included."""
    parts = key.split("/")
    channel = CHANNELS.get(parts[2]) if len(parts) in (3, 4) and parts[0] == KEY_PREFIX else None
    if channel is None or channel.has_source != (len(parts) == 4) or not _ROBOT_ID.fullmatch(parts[1]):
        return None
    source = parts[3] if channel.has_source else ""
    if channel.has_source and not _SOURCE.fullmatch(source):
        return None
    return parts[1], channel, source
