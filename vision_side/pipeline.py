"""A frame in, a command out: bound, decode, detect, track, steer. Pure: the clock is the frame's capture time."""

import math
from collections import Counter
from dataclasses import dataclass

from protocol import VERSION
from protocol.errors import WireError
from protocol.messages import STILL, AnswerHeader, CameraModel, Echo, FrameHeader, Pose, Twist
from vision_side.config import VisionConfig
from vision_side.decode import Decoder
from vision_side.detect.boxes import locate_box
from vision_side.detect.hsv import HsvDetector
from vision_side.detect.port import Detection, Detector
from vision_side.foretell import Foretelling, Motion
from vision_side.search import Search
from vision_side.sphere import Sighting, locate
from vision_side.steer import Aim, Steer
from vision_side.track import Target, Track, from_odometry

Detections = tuple[Detection, ...]
Places = list[Sighting | None]
SOURCE = "vision"
_MAX_DT_S = 0.5  # a longer gap between frames says nothing more about what happened in it


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame as it came."""

    header: FrameHeader
    jpeg: bytes


@dataclass(frozen=True, slots=True)
class Seen:
    """What a person may want to see of one step.

    `phase` is tracking, coasting, searching, lost or no picture; bearing (left positive) and distance are the track's
    at the time of capture, over the floor from the lens; `target` is the detection that is followed.
    """

    phase: str
    detections: Detections = ()
    target: Detection | None = None
    bearing_rad: float | None = None
    distance_m: float | None = None
    note: str = ""


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to one frame; without a twist it only acknowledges."""

    twist: Twist | None
    seen: Seen


class Pipeline:
    """One robot's pictures with one camera model. A deterministic function of the frame sequence."""

    def __init__(self, config: VisionConfig, camera: CameraModel, detector: Detector | None = None) -> None:
        self._config = config
        self._camera = camera
        self._decoder = Decoder(camera.width_px, camera.height_px, config.max_pixels)
        self._detector = detector or HsvDetector(config.hsv)
        self.skipped: Counter[str] = Counter()
        self._session = ""
        self._forget()

    def _forget(self) -> None:
        """Everything that was learned from earlier frames."""
        self._track = Track(self._config.track)
        self._steer = Steer(self._config.steer, self._config.target.stand_off_m)
        self._search = Search(self._config.search)
        self._foretelling = Foretelling(self._config.latency)
        self._last_us: int | None = None

    def step(self, frame: Frame) -> Answer:
        """Answer `frame`. Never raises for any JPEG bytes; what cannot be used is counted in `skipped`."""
        if not self._is_new(frame.header):
            return self._skip("OUT_OF_ORDER", "frame is not newer than the last")
        try:
            picture = self._decoder.decode(frame.jpeg)
        except WireError as error:
            return self._skip(error.reason, error.detail)
        detections, radius_m = self._detector.detect(picture), self._config.target.radius_m
        return self._follow(frame.header, detections, [locate(one, self._camera, radius_m) for one in detections])

    def follow(self, header: FrameHeader, detections: Detections) -> Answer:
        """Answer the frame of `header`, in which somebody else found `detections`; empty is "saw nothing"."""
        if not self._is_new(header):
            return self._skip("OUT_OF_ORDER", "what was looked at is not newer than the last")
        otherwise_m, sizes = self._expected_m(header.pose), self._config.boxes
        places = [locate_box(one, self._camera, sizes, otherwise_m) for one in detections]
        return self._follow(header, detections, places)

    def _is_new(self, header: FrameHeader) -> bool:
        """Whether `header` is newer than the last; a robot that started again is met afresh."""
        if header.session != self._session:
            self._session = header.session
            self._forget()
        return self._last_us is None or header.t_us > self._last_us

    def _follow(self, header: FrameHeader, detections: Detections, places: Places) -> Answer:
        dt_s = self._tick(header)
        seen = self._track.step(dt_s, header.pose, self._sightings(places))
        answer = self._act(dt_s, header, detections, seen)
        if answer.twist is not None:
            self._foretelling.sent(header.t_us, answer.twist)
        return answer

    def _skip(self, reason: str, note: str) -> Answer:
        self.skipped[reason] += 1
        return Answer(None, Seen("no picture", note=note))

    def _tick(self, header: FrameHeader) -> float:
        """Seconds since the last picture; also lets the delay estimate and the integrals know what the robot did."""
        dt_s = min((header.t_us - self._last_us) / 1e6, _MAX_DT_S) if self._last_us is not None else 0.0
        self._last_us = header.t_us
        self._foretelling.measure(header.latency_us, dt_s)
        asked = self._foretelling.expected(header.t_us)
        if asked is not None and header.applied == (0.0, 0.0):
            self._steer.unmet(dt_s, -asked[0], -asked[1])
        return dt_s

    def _sightings(self, places: Places) -> list[Sighting]:
        target = self._config.target
        return [one for one in places if one and one.x_m**2 + one.y_m**2 <= target.max_range_m**2]

    def _expected_m(self, pose: Pose) -> float:
        """How far from the lens a thing is whose box does not tell: where it was last, or where the robot may stay."""
        target, boxes = self._track.target, self._config.boxes
        if target is None or (boxes.height_m is None and boxes.width_m is None):
            return self._config.target.stand_off_m
        x, y = from_odometry(pose, target.x_m, target.y_m)
        return math.hypot(x - self._camera.x_m, y - self._camera.y_m)

    def _act(self, dt_s: float, header: FrameHeader, detections: Detections, seen: Sighting | None) -> Answer:
        target = self._track.target
        if target is None:
            return self._look_around(dt_s, header, detections)
        x, y = from_odometry(header.pose, target.x_m, target.y_m)
        x, y = x - self._camera.x_m, y - self._camera.y_m
        bearing_rad = math.atan2(y, x)
        self._search.reset(bearing_rad)
        latency_s = self._foretelling.latency_s
        then = self._foretelling.motion(header.t_us, header.pose, header.moving, header.applied)
        aim = aim_at(target, then, self._camera, latency_s)
        twist = self._steer.step(dt_s, aim, latency_s, self._may_drive(target))
        phase = "tracking" if seen else "coasting"
        box = seen.detection if seen else None
        return Answer(twist, Seen(phase, detections, box, bearing_rad, math.hypot(x, y)))

    def _may_drive(self, target: Target) -> bool:
        config = self._config.track
        return target.sightings >= config.confirm and target.unseen_us <= config.coast_s * 1e6

    def _look_around(self, dt_s: float, header: FrameHeader, detections: Detections) -> Answer:
        self._steer.reset()
        twist = self._search.step(dt_s, header.pose, header.applied)
        phase = "searching" if twist is not None else "lost"
        return Answer(twist or STILL, Seen(phase, detections))


def aim_at(target: Target, robot: Motion, camera: CameraModel, ahead_s: float) -> Aim:
    """`target`, `ahead_s` from now, about the lens of `robot`."""
    x, y = from_odometry(robot.pose, target.x_m + target.vx_mps * ahead_s, target.y_m + target.vy_mps * ahead_s)
    vx, vy = from_odometry((0.0, 0.0, robot.pose[2]), target.vx_mps, target.vy_mps)
    return Aim(x - camera.x_m, y - camera.y_m, vx, vy, camera.x_m)


def answer_header(frame: FrameHeader, session: str, seq: int, compute_us: int = 0) -> AnswerHeader:
    """The header of the answer to `frame`, naming it field for field."""
    echo = Echo(channel="frame", session=frame.session, seq=frame.seq, t_us=frame.t_us)
    return AnswerHeader(source=SOURCE, session=session, seq=seq, echo=echo, compute_us=compute_us)


def encode_answer(frame: FrameHeader, session: str, seq: int, compute_us: int) -> bytes:
    """`encode(answer_header(...))` byte for byte, without the models: every part of it was checked when it came in."""
    return (f'{{"v":{VERSION},"source":"{SOURCE}","session":"{session}","seq":{seq},"echo":{{"channel":"frame",'
            f'"session":"{frame.session}","seq":{frame.seq},"t_us":{frame.t_us}}},"compute_us":{compute_us}}}').encode()
