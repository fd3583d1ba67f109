"""A frame in, a command out: bound, decode, detect, then the mission. Pure: the clock is the frame's capture time."""

from dataclasses import dataclass, field

from sightline.protocol.errors import WireError
from sightline.protocol.messages import AnswerHeader, CameraModel, Echo, FrameHeader, RequestId, ScanHeader, Twist
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import DecodedImage, Decoder
from sightline.vision_side.detect.plugin_calls import checked_results
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame, Detection, DetectionResult, Detector
from sightline.vision_side.missions.port import Plan, RangeScan, View
from sightline.vision_side.missions.registry import MissionSpec, configured_mission
from sightline.vision_side.missions.switch import MissionSwitch
from sightline.vision_side.tracking.prediction import LatencyEstimator

SOURCE = "vision"
NO_ANSWER = "NO_ANSWER"
"""In `skipped`: the detector did not answer the frame, in time or at all."""
_MAX_DT_S = 0.5  # a longer gap between frames says nothing more about what happened in it


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame as it came. `deadline_us`, on this machine's clock, is how long a detector elsewhere may take."""

    header: FrameHeader
    jpeg: bytes
    deadline_us: int = NO_DEADLINE


@dataclass(frozen=True, slots=True)
class Observation:
    """What a person may want to see of one step.

    `phase` is the mission's own word (of `follow`: tracking, coasting, searching, lost), or no picture; bearing (left
    positive) and distance are those of what the mission goes by; `target` is the detection that is followed.
    """

    phase: str
    detections: tuple[Detection, ...] = ()
    target: Detection | None = None
    bearing_rad: float | None = None
    distance_m: float | None = None
    note: str = ""
    done: bool = False


@dataclass(frozen=True, slots=True)
class PipelineAnswer:
    """The answer to one frame; without a twist it only acknowledges."""

    twist: Twist | None
    seen: Observation
    scan: int | None = None
    """The number of the range scan that it used."""
    mission: str = ""
    """The mission's name."""
    request: RequestId | None = None
    """The request for this mission; None for the one it began with."""
    result: DetectionResult | None = field(default=None, compare=False)
    """Not compared: it has the time that the detector took."""
    skipped: str = ""
    """Why the frame was not used; empty if it was."""


class Pipeline:
    """One robot's pictures with one camera model. A deterministic function of what it is given, in that order."""

    def __init__(
        self, config: VisionConfig, camera: CameraModel, detector: Detector, chosen: MissionSpec | None = None
    ) -> None:
        """`chosen` is the mission to begin with, that of `config` if None.

        Raises ConfigError for a mission that there is not.
        """
        self._config = config
        self._camera = camera
        self._detector = detector
        self._decoder = Decoder(camera.width_px, camera.height_px, config.max_pixels)
        self._first = chosen or configured_mission(config)
        self._session = ""
        self._scan: tuple[ScanHeader, RangeScan] | None = None
        self._forget()

    def _forget(self) -> None:
        """Everything that was learned from earlier frames, and the mission that was requested since."""
        self._mission_switch = MissionSwitch(self._first, self._camera)
        self._request: RequestId | None = None
        self._begin_clock()

    def _begin_clock(self) -> None:
        self._latency = LatencyEstimator(self._config.latency)
        self._last_us: int | None = None

    @property
    def mission(self) -> MissionSpec:
        """The newest chosen."""
        return self._mission_switch.chosen

    def switch(self, chosen: MissionSpec, request: RequestId, session: str) -> None:
        """From the next frame on come to rest, then carry out `chosen`; it ends with the robot's `session`.

        A request that was applied already changes nothing.
        """
        self._use_session(session)
        if request != self._request:
            self._request = request
            self._mission_switch.switch(chosen)

    def _use_session(self, session: str) -> None:
        """A new session of the robot begins with nothing."""
        if session != self._session:
            self._session = session
            self._forget()

    def put_scan(self, stamp: ScanHeader, scan: RangeScan) -> None:
        """The newest range scan, for the frames from the next one on."""
        self._scan = (stamp, scan)

    def set_camera(self, camera: CameraModel) -> None:
        """Use another camera of the same robot from the next frame on; a requested mission continues."""
        self._camera = camera
        self._decoder = Decoder(camera.width_px, camera.height_px, self._config.max_pixels)
        if self._request is None:
            self._forget()
            return
        self._begin_clock()
        if self.mission.needs_camera:
            self._mission_switch = MissionSwitch(self.mission, camera)

    def step(self, frame: Frame) -> PipelineAnswer:
        """Answer `frame`. Never raises for any JPEG bytes; the answer's `skipped` gives why one cannot be used."""
        if not self._is_new(frame.header):
            return self._skip("OUT_OF_ORDER", "frame is not newer than the last")
        try:
            picture = self._decoder.decode(frame.jpeg)
        except WireError as error:
            return self._skip(error.reason, error.detail)
        shown = DetectFrame(self._config.robot, frame.header, frame.jpeg, self._decoder, picture)
        shown.goes_by = self.mission.goes_by
        (result,) = checked_results(self._detector, [shown], frame.deadline_us)
        if isinstance(result, str):
            return self._skip(NO_ANSWER, result, "no answer")
        return self._answer(frame.header, result.detections, picture, result)

    def follow(self, header: FrameHeader, detections: tuple[Detection, ...]) -> PipelineAnswer:
        """Answer the frame of `header`, in which another service found `detections`; empty is "saw nothing"."""
        if not self._is_new(header):
            return self._skip("OUT_OF_ORDER", "what was looked at is not newer than the last")
        return self._answer(header, detections, None)

    def _is_new(self, header: FrameHeader) -> bool:
        """Whether `header` is newer than the last; a robot that started again begins with nothing."""
        self._use_session(header.session)
        return self._last_us is None or header.t_us > self._last_us

    def _skip(self, reason: str, note: str, phase: str = "no picture") -> PipelineAnswer:
        return self.acknowledge(Observation(phase, note=note), reason)

    def acknowledge(self, seen: Observation, skipped: str = "") -> PipelineAnswer:
        """An answer without a step: it names the mission and does not steer."""
        return PipelineAnswer(None, seen, None, self.mission.name, self._request, skipped=skipped)

    def _answer(
        self, header: FrameHeader, detections: tuple[Detection, ...], picture: DecodedImage | None,
        result: DetectionResult | None = None,
    ) -> PipelineAnswer:
        dt_s = self._tick(header)
        stamp, scan = self._newest_scan(header)
        view = View(header, dt_s, self._latency.total_s, self._camera, detections, picture, scan)
        plan = self._mission_switch.step(view)
        return PipelineAnswer(plan.twist, _seen(plan, detections), stamp.seq if stamp else None, self.mission.name,
                              self._request, result)

    def _tick(self, header: FrameHeader) -> float:
        """Seconds since the last picture; also takes in what the robot measured."""
        dt_s = min((header.t_us - self._last_us) / 1e6, _MAX_DT_S) if self._last_us is not None else 0.0
        self._last_us = header.t_us
        self._latency.measure(header.latency_us, dt_s)
        return dt_s

    def _newest_scan(self, header: FrameHeader) -> tuple[ScanHeader | None, RangeScan | None]:
        """For a mission that goes by scans; one of another session is of another robot, as far as anybody knows."""
        if self._scan is None or not self.mission.wants_scan or self._scan[0].session != header.session:
            return None, None
        return self._scan


def _seen(plan: Plan, detections: tuple[Detection, ...]) -> Observation:
    return Observation(plan.phase, detections, plan.target, plan.bearing_rad, plan.distance_m, plan.note, plan.done)


def answer_header(
    frame: FrameHeader, session: str, seq: int, compute_us: int = 0, answer: PipelineAnswer | None = None
) -> AnswerHeader:
    """The header of the answer to `frame`, naming it field for field, and what else `answer` went by."""
    scan, mission = (answer.scan, answer.request) if answer else (None, None)
    return AnswerHeader(source=SOURCE, session=session, seq=seq, echo=Echo.of(frame), compute_us=compute_us, scan=scan,
                        mission=mission)
