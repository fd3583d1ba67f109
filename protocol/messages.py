"""Every message on the wire as a frozen, strict, bounded pydantic model. Pure.

Headers travel beside the payload (Zenoh attachment); payloads of JSON channels are the other models. Units are in the
names; signs as in REP 103: x forward, y left, counter-clockwise positive. Times are the robot's monotonic clock.
"""

from enum import StrEnum
from typing import Annotated, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sightline.protocol import VERSION

MAX_INTEGER = 2**53 - 1  # the largest integer that every JSON reader holds exactly
MAX_CHANNELS_SHOWN = 16
"""Of a status, so that it stays small."""
MAX_DETECTED_BOXES = 64
"""Security limit: more is no scene that a robot steers by."""

Version = Annotated[int, Field(ge=VERSION, le=VERSION)]  # a Literal would let `true` and 1.0 pass as 1
SessionId = Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")]
Source = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,15}$")]
RobotId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$")]
Counter = Annotated[int, Field(ge=0, le=MAX_INTEGER)]
Percent = Annotated[int, Field(ge=0, le=100)]
Microseconds = Annotated[int, Field(ge=0, le=MAX_INTEGER)]
Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
LEAST_SIDE_PX, MOST_SIDE_PX = 16, 8192
PixelCount = Annotated[int, Field(ge=LEAST_SIDE_PX, le=MOST_SIDE_PX)]
"""Width or height of a picture."""
Planar = tuple[Number, Number]  # (linear_mps, angular_rad_s)
Pose = tuple[Number, Number, Number]
"""(x_m, y_m, yaw_rad) in the odometry frame."""


class WireModel(BaseModel):
    """Base of everything on the wire. Unknown fields are ignored, so that a newer minor peer is understood."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", ser_json_inf_nan="constants")


class Twist(WireModel):
    """A velocity: forward speed and turn rate. Finite; the robot clamps it to its own limits."""

    linear_mps: Annotated[float, Field(allow_inf_nan=False)]
    angular_rad_s: Annotated[float, Field(allow_inf_nan=False)]


STILL = Twist(linear_mps=0.0, angular_rad_s=0.0)


# --- headers -----------------------------------------------------------------------------------------------------


class Stamp(WireModel):
    """Header of everything a robot publishes: its session (new at each start), a count per channel, its clock."""

    v: Version = VERSION
    session: SessionId
    seq: Counter
    t_us: Microseconds


class FrameHeader(Stamp):
    """Header of a frame. `t_us` is the capture time; the rest is what the robot did and knew at that moment."""

    pose: Pose = (0.0, 0.0, 0.0)
    """Odometry."""
    moving: Planar = (0.0, 0.0)
    """Twist measured from the wheels."""
    applied: Planar = (0.0, 0.0)
    """Twist last given to the wheels by the gate, after every limit."""
    latency_us: Microseconds | None = None
    """Capture to accepted command, as the robot itself measured for the last accepted command."""


class ScanHeader(Stamp):
    """Header of a lidar scan; the payload is little-endian float32 ranges in metres, inf for no return."""

    angle_min_rad: Number
    angle_increment_rad: Number
    range_min_m: Number
    range_max_m: Number


class Echo(WireModel):
    """Names one thing the robot issued, field for field, so that the robot can judge its age by its own record."""

    channel: Literal["frame", "status", "beat"]
    session: SessionId
    seq: Counter
    t_us: Microseconds


class RequestId(WireModel):
    """Names a mission that somebody asked for: the asker's session, and the id in the payload."""

    session: SessionId
    id: Counter


class AnswerHeader(WireModel):
    """Header of a twist and of an ack: who answers, which frame, and how long the computing took.

    `scan` and `mission` name what else it went by, so that a recording can be answered again, byte for byte.
    """

    v: Version = VERSION
    source: Source
    session: SessionId
    seq: Counter
    echo: Echo
    compute_us: Microseconds = 0
    scan: Counter | None = None
    mission: RequestId | None = None


class RequestHeader(WireModel):
    """Header of a request or mission. `echo` names the newest `status` seen; only stop, disarm, release may lack it."""

    v: Version = VERSION
    source: Source
    session: SessionId
    seq: Counter
    echo: Echo | None = None


class DetectionsHeader(WireModel):
    """Header of what vision says beside its twists: who looked, at which frame; without `echo` for showing only."""

    v: Version = VERSION
    source: Source
    session: SessionId
    seq: Counter
    echo: Echo | None = None
    compute_us: Microseconds = 0


class Verb(StrEnum):
    """What can be asked of a robot."""

    ARM = "arm"
    DISARM = "disarm"
    STOP = "stop"
    RESET = "reset"
    ACQUIRE = "acquire"
    RELEASE = "release"


class Request(WireModel):
    """A request; `id` is the asker's own and comes back in the reply."""

    id: Counter
    verb: Annotated[Verb, Field(strict=False)]


class Reply(WireModel):
    """The answer to a request: `to` and `id` name it; `detail` is one line for a person."""

    to: SessionId
    id: Counter
    ok: bool
    state: Annotated[str, Field(max_length=32)]
    detail: Annotated[str, Field(max_length=200)]


class State(StrEnum):
    """States of the gate."""

    DISARMED = "DISARMED"
    HOLD = "HOLD"
    ACTIVE = "ACTIVE"
    DEGRADED = "DEGRADED"
    STOPPED = "STOPPED"
    FAULT = "FAULT"


class Holder(WireModel):
    """The driver of the moment."""

    source: Source
    session: SessionId


class LastRejection(WireModel):
    """The newest refusal, in words."""

    source: Annotated[str, Field(max_length=32)]
    reason: Annotated[str, Field(max_length=32)]
    detail: Annotated[str, Field(max_length=200)]


class StreamStatus(WireModel):
    """What the robot's stream does: frames sent, answers that never came, frames allowed in flight, rate."""

    sent: Counter = 0
    credit_timeouts: Counter = 0
    window: Counter = 1
    fps: Number = 0.0
    dropped_commands: Counter = 0
    refused_pictures: Counter = 0
    calibrated: bool = False
    """Whether the camera's model was measured."""
    overtaken: Counter = 0
    """Frames that a newer one replaced on the way: in a slot of the peer, or on the link."""
    dropped: Annotated[dict[str, Counter], Field(max_length=MAX_CHANNELS_SHOWN)] = {}
    """By channel: what was published and replaced by something newer before a peer had room for it."""
    missed_captures: Counter = 0
    """Captures that the camera's slot dropped because the stream asked for none."""
    quality_percent: Percent = 100
    scale_percent: Percent = 100
    """How pictures are encoded to fit the link: shares of the configured quality and of the side lengths."""


class Status(WireModel):
    """Everything a person needs to know why the robot moves or does not. Published at 10 Hz."""

    state: Annotated[State, Field(strict=False)]
    reason: Annotated[str, Field(max_length=200)]
    holder: Holder | None = None
    applied: Planar = (0.0, 0.0)
    frame_age_us: Microseconds | None = None
    latency_us: Microseconds | None = None
    accepted: Counter = 0
    refused: dict[str, Counter] = {}
    last_refusal: LastRejection | None = None
    stream: StreamStatus = StreamStatus()
    auto_arm: bool = False
    tick_late_max_us: Microseconds = 0
    network_restarts: Counter = 0
    max_linear_mps: Number = 0.0
    max_angular_rad_s: Number = 0.0


class Odometry(WireModel):
    """Where the wheels say the robot is, and how it moves."""

    pose: Pose
    moving: Planar


class DetectedCircle(WireModel):
    """A circle in pixels of the encoded picture, where the detector knows one."""

    cx_px: Number
    cy_px: Number
    radius_px: Annotated[float, Field(gt=0, le=1e6)]


class DetectedBox(WireModel):
    """One object in pixels of the encoded picture; `x2_px` >= `x1_px` and `y2_px` >= `y1_px`, which are exclusive."""

    label: Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]{1,64}$")]
    score: Annotated[float, Field(ge=0, le=1)]
    x1_px: Number
    y1_px: Number
    x2_px: Number
    y2_px: Number
    circle: DetectedCircle | None = None
    track: Counter | None = None
    """The detector's own number for an object that it follows from frame to frame."""

    @model_validator(mode="after")
    def _is_not_inside_out(self) -> Self:
        if self.x2_px < self.x1_px or self.y2_px < self.y1_px:
            raise ValueError("the second corner of a box is not left of or above the first")
        return self


class Detections(WireModel):
    """What was found in one picture of this size, best first. No boxes: looked, and saw nothing."""

    width_px: PixelCount
    height_px: PixelCount
    boxes: Annotated[tuple[DetectedBox, ...], Field(max_length=MAX_DETECTED_BOXES)] = ()
    detector: Annotated[str, Field(max_length=64)] = ""
    device: Annotated[str, Field(max_length=32)] = ""
    model: Annotated[str, Field(max_length=64)] = ""


class CameraModel(WireModel):
    """Pinhole model of the encoded picture. Pixel (0, 0) is the top-left corner of the top-left pixel.

    Mounting: the lens at (`x_m`, `y_m`, `z_m`) from the axle's midpoint on the floor, looking forward,
    tilted up by `pitch_rad`.
    """

    width_px: PixelCount
    height_px: PixelCount
    fx_px: Annotated[float, Field(gt=0, le=1e5)]
    fy_px: Annotated[float, Field(gt=0, le=1e5)]
    cx_px: Number
    cy_px: Number
    distortion: Annotated[tuple[Number, ...], Field(max_length=8)] = ()
    """OpenCV order k1, k2, p1, p2, k3 ...; empty when there is none."""
    x_m: Number = 0.0
    y_m: Number = 0.0
    z_m: Number = 0.0
    pitch_rad: Number = 0.0
    calibrated: bool = False


# What is said about missions: what vision is to do, and what it does. Frozen, strict, bounded models. Pure.


MAX_WAYPOINTS: Final = 64
"""Of one mission; a longer way is several."""
MAX_WAYPOINT_M: Final = 100.0
"""Each way from where odometry began: further off, wheels no longer know where they are."""
MAX_OPTIONS: Final = 16

MissionName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,31}$")]
"""As vision's own machine knows it; never a path to code."""
OptionName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_.]{0,63}$")]
OptionValue = bool | Number | Annotated[str, Field(max_length=64)]
Metres = Annotated[float, Field(ge=-MAX_WAYPOINT_M, le=MAX_WAYPOINT_M)]


class MissionRequest(WireModel):
    """What vision is to do from now on; `id` is the asker's own and comes back in the report."""

    id: Counter
    name: MissionName
    waypoints: Annotated[tuple[tuple[Metres, Metres], ...], Field(max_length=MAX_WAYPOINTS)] = ()
    """(x_m, y_m) in the odometry frame."""
    options: Annotated[dict[OptionName, OptionValue], Field(max_length=MAX_OPTIONS)] = {}
    """For the mission's own configuration; a dot reaches into its tables."""


class MissionReport(WireModel):
    """What vision does at the moment.

    `phase` is one or two words for a person, `note` the rest of the line. `asked` names the newest mission that was
    asked for, `refused` says why it was not taken up.
    """

    mission: Annotated[str, Field(max_length=64)]
    phase: Annotated[str, Field(max_length=32)]
    note: Annotated[str, Field(max_length=200)] = ""
    done: bool = False
    asked: RequestId | None = None
    refused: Annotated[str, Field(max_length=200)] = ""
    detector: Annotated[str, Field(max_length=64)] = ""
    device: Annotated[str, Field(max_length=32)] = ""
    model: Annotated[str, Field(max_length=64)] = ""
    inference_us: Microseconds | None = None
