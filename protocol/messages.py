"""Define every message on the wire as a frozen, strict, bounded pydantic model. Pure.

A header travels next to its payload (Zenoh attachment). The other models are the payloads of JSON channels.
Names contain units. Signs follow REP 103: x forward, y left, counter-clockwise positive. Times are the robot's
monotonic clock.
"""

from enum import StrEnum
from typing import Annotated, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sightline.protocol import NAME_PATTERN, ROLE_PATTERN, VERSION
from sightline.protocol.proof import session_digest

MAX_INTEGER = 2**53 - 1  # the largest integer that every JSON reader holds exactly
MAX_CHANNELS_SHOWN = 16
"""Most channels in a status, so that it stays small."""
MAX_DETECTED_BOXES = 64
"""Security limit for the boxes of one image."""

# A Literal would let `true` and 1.0 pass as 1.
Version = Annotated[int, Field(ge=VERSION, le=VERSION, description="version of this protocol")]
Element = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
"""One element of a hash chain (`protocol/proof.py`)."""
SessionId = Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")]
Source = Annotated[str, Field(pattern=f"^{ROLE_PATTERN}$")]
RobotId = Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")]
Counter = Annotated[int, Field(ge=0, le=MAX_INTEGER)]
Percent = Annotated[int, Field(ge=0, le=100)]
Microseconds = Annotated[int, Field(ge=0, le=MAX_INTEGER)]
Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
LEAST_SIDE_PX, MOST_SIDE_PX = 16, 8192
PixelCount = Annotated[int, Field(ge=LEAST_SIDE_PX, le=MOST_SIDE_PX)]
"""Width or height of an image."""
Planar = tuple[Number, Number]  # (linear_mps, angular_rad_s)
Pose = tuple[Number, Number, Number]
"""(x_m, y_m, yaw_rad) in the odometry frame."""


class WireModel(BaseModel):
    """Base of every message. Unknown fields are ignored, so that a peer can add fields without a new version."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", ser_json_inf_nan="constants")


class Twist(WireModel):
    """A velocity: forward speed and turn rate, both finite. The robot reduces it to its own limits."""

    linear_mps: Annotated[float, Field(allow_inf_nan=False)]
    angular_rad_s: Annotated[float, Field(allow_inf_nan=False)]


STILL = Twist(linear_mps=0.0, angular_rad_s=0.0)


# --- headers -----------------------------------------------------------------------------------------------------


class Stamp(WireModel):
    """Header of every message from a robot: its session (new at each start), a count per channel, its clock."""

    v: Version = VERSION
    session: SessionId = Field(description="the sender's start: 8 hex digits drawn at random")
    seq: Counter = Field(description="count of the sender's messages on this channel within the session")
    t_us: Microseconds = Field(description="the robot's monotonic clock: capture of a frame or scan, else publication")


class FrameHeader(Stamp):
    """Header of a frame. `t_us` is the capture time. All other fields describe the robot at that time."""

    pose: Pose = Field(default=(0.0, 0.0, 0.0), description="odometry: x, y, yaw")
    moving: Planar = Field(default=(0.0, 0.0), description="measured at the wheels: linear, angular")
    applied: Planar = Field(
        default=(0.0, 0.0), description="last given to the wheels, after every limit: linear, angular"
    )
    latency_us: Microseconds | None = Field(
        default=None, description="from capture to acceptance of the last command since arming, on its clock; or null"
    )


class ScanHeader(Stamp):
    """Header of a lidar scan; the payload is little-endian float32 ranges in meters, inf for no return."""

    angle_min_rad: Number = Field(description="direction of the first ray; 0 is ahead, left positive")
    angle_increment_rad: Number = Field(description="from one ray to the next")
    range_min_m: Number = Field(
        description="a smaller range: an obstacle too close to measure; 0: no echo, so nothing is known"
    )
    range_max_m: Number = Field(description="nothing is known beyond; inf: no obstacle")


class Echo(WireModel):
    """Names one message of the robot, field for field, so that the robot computes its age from its own record."""

    channel: Literal["frame", "status", "beat"] = Field(description="which of its channels")
    session: SessionId = Field(description="the robot's")
    seq: Counter = Field(description="as in that message")
    t_us: Microseconds = Field(description="as in that message")

    @classmethod
    def of(cls, stamp: Stamp) -> Self:
        """Name the frame or the status that has this header."""
        channel: Literal["frame", "status"] = "frame" if isinstance(stamp, FrameHeader) else "status"
        return cls(channel=channel, session=stamp.session, seq=stamp.seq, t_us=stamp.t_us)


_DIGEST: Final = "of the requester: first 8 hex digits of the SHA-256 of `source/session`"


class RequestId(WireModel):
    """Names a requested mission: the digest of the requester, and the id in the payload."""

    digest: SessionId = Field(description=_DIGEST)
    id: Counter = Field(description="of the mission")


class SenderHeader(WireModel):
    """Header of every message to a robot: role, session, count per channel."""

    v: Version = VERSION
    source: Source = Field(description="the sender's role; equal to the one in the key")
    session: SessionId = Field(description="the sender's start: 8 hex digits drawn at random")
    seq: Counter = Field(description="count of the sender's messages on this channel within the session")

    @property
    def digest(self) -> str:
        """Return the public name of the sender, in place of its session."""
        return session_digest(self.source, self.session)


_PROOF: Final = "the next element of the sender's hash chain; of the first command its commitment"
_NEXT_PROOF: Final = "near the end of the chain: the first element of the next chain, never sent as `proof`"


class AnswerHeader(SenderHeader):
    """Header of a twist and of an ack: the sender, the frame, and the computing time.

    `scan` and `mission` name its other inputs, so that a replayed recording produces the same answer, byte for byte.
    """

    echo: Echo = Field(description="what this message answers, field for field")
    compute_us: Microseconds = Field(
        default=0, description="how long the sender computed, from receiving the frame to sending this"
    )
    scan: Counter | None = Field(
        default=None, description="`seq` of the newest scan that was used, of the frame's session"
    )
    mission: RequestId | None = Field(default=None, description="the requested mission that it carries out")
    proof: Element | None = Field(default=None, description=_PROOF)
    next_proof: Element | None = Field(default=None, description=_NEXT_PROOF)


class RequestHeader(SenderHeader):
    """Header of a request or mission. `echo` names the newest `status`. Only stop, disarm and release may omit it."""

    echo: Echo | None = Field(default=None, description="the newest received `status`")
    proof: Element | None = Field(default=None, description=_PROOF)
    next_proof: Element | None = Field(default=None, description=_NEXT_PROOF)


class DetectionsHeader(SenderHeader):
    """Header of detections, reports and images: the sender and the frame. Without `echo` it is for display only."""

    echo: Echo | None = Field(
        default=None, description="the frame that was examined or is shown; of a report the newest"
    )
    compute_us: Microseconds = Field(
        default=0, description="how long the sender computed, from receiving the frame to sending this"
    )


class Verb(StrEnum):
    """The requests that a robot accepts."""

    ARM = "arm"
    DISARM = "disarm"
    STOP = "stop"
    RESET = "reset"
    ACQUIRE = "acquire"
    RELEASE = "release"


class Request(WireModel):
    """A request. The reply repeats `id`."""

    id: Counter = Field(description="the requester's own count of requests")
    verb: Verb = Field(strict=False, description="what is requested")


class Reply(WireModel):
    """The answer to the request that `to` and `id` name."""

    to: SessionId = Field(description="digest " + _DIGEST)
    id: Counter = Field(description="of the request")
    ok: bool = Field(description="whether it was done, or was so already")
    state: str = Field(max_length=32, description="of the gate, afterwards")
    detail: str = Field(max_length=200, description="one line for the operator; of a rejected request `REASON: words`")


class State(StrEnum):
    """States of the gate."""

    DISARMED = "DISARMED"
    HOLD = "HOLD"
    ACTIVE = "ACTIVE"
    DEGRADED = "DEGRADED"
    STOPPED = "STOPPED"
    FAULT = "FAULT"


class Holder(WireModel):
    """The driver that holds the lease, as a robot knows it. No message contains it: a peer could copy the session."""

    source: Source
    session: SessionId


GUEST: Final = Holder(source="guest", session="00000000")
"""All clients without headers."""


class LeaseHolder(WireModel):
    """The driver that holds the lease, as a robot shows it."""

    source: Source = Field(description="its role")
    digest: SessionId = Field(description="first 8 hex digits of the SHA-256 of `source/session`")

    @classmethod
    def of(cls, source: str, session: str) -> Self:
        """Create it for the driver with this session."""
        return cls(source=source, digest=session_digest(source, session))


class LastRejection(WireModel):
    """The newest rejection."""

    source: str = Field(max_length=32, description="role in the key of the rejected message")
    reason: str = Field(max_length=32, description="its counter")
    detail: str = Field(max_length=200, description="one line for the operator")


class StreamStatus(WireModel):
    """State of the frame stream: frames sent, missing answers, frames in flight, rate."""

    sent: Counter = Field(default=0, description="frames sent")
    credit_timeouts: Counter = Field(default=0, description="frames whose answer never came")
    window: Counter = Field(default=1, description="frames that may be in flight")
    fps: Number = Field(default=0.0, description="frames sent in the last second")
    dropped_commands: Counter = Field(default=0, description="commands that the driver did not take in time")
    refused_pictures: Counter = Field(
        default=0, description="images of the camera too large, not newer than the last or in the future"
    )
    calibrated: bool = Field(default=False, description="whether the camera's model was measured")
    overtaken: Counter = Field(default=0, description="frames that a newer one replaced on the way")
    dropped: dict[str, Counter] = Field(
        default={},
        max_length=MAX_CHANNELS_SHOWN,
        description="by channel: what a newer one replaced before a peer had room for it",
    )
    missed_captures: Counter = Field(default=0, description="images of the camera that were not requested in time")
    quality_percent: Percent = Field(default=100, description="share of the configured JPEG quality, to fit the link")
    scale_percent: Percent = Field(default=100, description="share of the configured side lengths, to fit the link")
    camera_fault: str = Field(
        default="", max_length=200, description="why no image comes from the camera; empty while images come"
    )


class Status(WireModel):
    """The state of the robot and the reason for it. Published at 10 Hz."""

    state: State = Field(strict=False, description="of the gate")
    reason: str = Field(max_length=200, description="why it is in this state, one line for the operator")
    holder: LeaseHolder | None = Field(default=None, description="the driver; null without one")
    applied: Planar = Field(
        default=(0.0, 0.0), description="last given to the wheels, after every limit: linear, angular"
    )
    frame_age_us: Microseconds | None = Field(
        default=None, description="age of the frame behind the command in force; null without one"
    )
    latency_us: Microseconds | None = Field(
        default=None, description="from capture to acceptance of the last command since arming, on its clock; or null"
    )
    accepted: Counter = Field(default=0, description="commands accepted since the start")
    refused: dict[str, Counter] = Field(default={}, description="rejections since the start, by reason")
    last_refusal: LastRejection | None = Field(default=None, description="the newest rejection")
    stream: StreamStatus = Field(default=StreamStatus(), description="the flow of frames")
    auto_arm: bool = Field(default=False, description="whether the robot arms without an operator")
    tick_late_max_us: Microseconds = Field(default=0, description="the latest tick of the driver's loop")
    network_restarts: Counter = Field(default=0, description="how often the network process was started again")
    faults: dict[str, Counter] = Field(
        default={},
        description="exceptions, failed writes and encoder warnings since the start, by part; the log has the details",
    )
    battery_v: Number | None = Field(
        default=None, description="voltage of the battery; null without a battery or a reading of the last 5 s"
    )
    max_linear_mps: Number = Field(default=0.0, description="limit of speed")
    max_angular_rad_s: Number = Field(default=0.0, description="limit of turning")


class Odometry(WireModel):
    """Position and velocity of the robot, measured at its wheels."""

    pose: Pose = Field(description="odometry: x, y, yaw")
    moving: Planar = Field(description="measured at the wheels: linear, angular")


class DetectedCircle(WireModel):
    """A circle in pixels of the encoded image, if the detector finds one."""

    cx_px: Number = Field(description="center, from the left")
    cy_px: Number = Field(description="center, from the top")
    radius_px: float = Field(gt=0, le=1e6, description="radius")


Label = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]{1,64}$")]


class DetectedBox(WireModel):
    """One object in pixels of the encoded image. `x2_px` >= `x1_px` and `y2_px` >= `y1_px` are exclusive."""

    label: Label = Field(description="what it is, as the detector names it")
    score: float = Field(ge=0, le=1, description="how sure the detector is")
    x1_px: Number = Field(description="left edge")
    y1_px: Number = Field(description="top edge")
    x2_px: Number = Field(description="right edge, exclusive; not left of `x1_px`")
    y2_px: Number = Field(description="bottom edge, exclusive; not above `y1_px`")
    circle: DetectedCircle | None = Field(default=None, description="if the detector finds one")
    track: Counter | None = Field(default=None, description="the detector's number for an object that it follows")

    @model_validator(mode="after")
    def _is_not_inside_out(self) -> Self:
        if self.x2_px < self.x1_px or self.y2_px < self.y1_px:
            raise ValueError("the second corner of a box must not be left of or above the first")
        return self


class Detections(WireModel):
    """The objects found in one image of this size."""

    width_px: PixelCount = Field(description="width of the encoded image")
    height_px: PixelCount = Field(description="height of the encoded image")
    boxes: tuple[DetectedBox, ...] = Field(
        default=(), max_length=MAX_DETECTED_BOXES, description="best first; empty: nothing was found"
    )
    detector: str = Field(default="", max_length=64, description="name of the detector")
    device: str = Field(default="", max_length=32, description="what the detector runs on")
    model: str = Field(default="", max_length=64, description="hash of its model")


class CameraModel(WireModel):
    """Pinhole model of the encoded image. Pixel (0, 0) is the top-left corner of the top-left pixel.

    Mounting: the lens is at (`x_m`, `y_m`, `z_m`) from the midpoint of the axle on the floor. It points forward, tilted
    up by `pitch_rad`.
    """

    width_px: PixelCount = Field(description="width of the encoded image")
    height_px: PixelCount = Field(description="height of the encoded image")
    fx_px: float = Field(gt=0, le=1e5, description="focal length, across")
    fy_px: float = Field(gt=0, le=1e5, description="focal length, down")
    cx_px: Number = Field(description="principal point, from the left")
    cy_px: Number = Field(description="principal point, from the top")
    distortion: tuple[Number, ...] = Field(
        default=(), max_length=8, description="k1, k2, p1, p2, k3 ... in OpenCV's order; empty for none"
    )
    x_m: Number = Field(default=0.0, description="the lens, ahead of the center of the axle")
    y_m: Number = Field(default=0.0, description="the lens, left of it")
    z_m: Number = Field(default=0.0, description="the lens, above the floor")
    pitch_rad: Number = Field(default=0.0, description="upwards positive")
    calibrated: bool = Field(default=False, description="whether the camera's model was measured")


# Missions: requests to the vision service, and its reports.


MAX_WAYPOINTS: Final = 64
"""Most waypoints of one mission."""
MAX_WAYPOINT_M: Final = 100.0
"""Largest distance from the start of odometry on each axis. Beyond it, wheel odometry is no longer accurate."""
MAX_OPTIONS: Final = 16

MissionName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,31}$")]
"""A name that the vision service knows, never a path to code."""
OptionName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_.]{0,63}$")]
OptionValue = bool | Number | Annotated[str, Field(max_length=64)]
Meters = Annotated[float, Field(ge=-MAX_WAYPOINT_M, le=MAX_WAYPOINT_M)]


class MissionRequest(WireModel):
    """The mission that the vision service runs from now on. The report repeats `id`."""

    id: Counter = Field(description="the requester's own count of missions; the same in a repetition")
    name: MissionName = Field(description="of the mission, as the vision service knows it")
    waypoints: tuple[tuple[Meters, Meters], ...] = Field(
        default=(), max_length=MAX_WAYPOINTS, description="x, y in the odometry frame, in order"
    )
    options: dict[OptionName, OptionValue] = Field(
        default={},
        max_length=MAX_OPTIONS,
        description="from the configuration of the mission; a dot selects an entry of a table",
        json_schema_extra={"additionalProperties": False},
    )


class ReportedTarget(WireModel):
    """The object that the mission follows, in an image of this size."""

    label: Label = Field(description="what it is, as the detector names it")
    score: float = Field(ge=0, le=1, description="how sure the detector is")
    track: Counter | None = Field(
        default=None, description="number of the frame from which on the mission follows it; null without a track"
    )
    bearing_rad: Number | None = Field(default=None, description="from the optical axis of the camera, left positive")
    distance_m: float | None = Field(default=None, ge=0, le=1e6, description="distance of the target")
    cx_px: Number = Field(description="center, from the left")
    cy_px: Number = Field(description="center, from the top")
    radius_px: float | None = Field(default=None, gt=0, le=1e6, description="radius, if the detector finds a circle")
    width_px: PixelCount = Field(description="width of the encoded image")
    height_px: PixelCount = Field(description="height of the encoded image")


class MissionReport(WireModel):
    """The state of the current mission."""

    mission: str = Field(max_length=64, description="its name")
    phase: str = Field(max_length=32, description="one or two words for the operator")
    note: str = Field(default="", max_length=200, description="the rest of the line")
    done: bool = Field(default=False, description="whether the mission is over; the robot stays where it is")
    asked: RequestId | None = Field(default=None, description="the newest requested mission")
    refused: str = Field(default="", max_length=200, description="why it was rejected; empty if it was accepted")
    detector: str = Field(default="", max_length=64, description="name of the detector")
    device: str = Field(default="", max_length=32, description="what the detector runs on")
    model: str = Field(default="", max_length=64, description="hash of its model")
    inference_us: Microseconds | None = Field(
        default=None, description="of the newest image; null where the detector does not report it"
    )
    faults: dict[str, Counter] = Field(
        default={}, description="exceptions of the vision service since the start, by part; its log has the tracebacks"
    )
    target: ReportedTarget | None = Field(
        default=None, description="what it follows, in the image of `echo`; null while it follows nothing"
    )
