"""Turn a frame into a command: check bounds, decode, detect, run the mission. Pure: its clock is the capture time."""

from dataclasses import dataclass, field

from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import AnswerHeader, CameraModel, Echo, FrameHeader, RequestId, ScanHeader, Twist
from sightline.protocol.proof import NO_PROOF, Proof
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import DecodedImage, Decoder
from sightline.vision_side.detect.plugin_calls import checked_results
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame, Detection, DetectionResult, Detector
from sightline.vision_side.missions.port import Plan, RangeScan, View
from sightline.vision_side.missions.registry import MissionSpec, configured_mission
from sightline.vision_side.missions.switch import MissionSwitch
from sightline.vision_side.tracking.locate import place_px
from sightline.vision_side.tracking.prediction import LatencyEstimator
from sightline.vision_side.tracking.track import Target, from_odometry

SOURCE = "vision"
NO_ANSWER = "NO_ANSWER"
"""Value of `skipped` for a frame without an answer of the detector in time."""
# The longest time step. A longer gap contains no further information about the motion.
_MAX_DT_S = 0.5
# Largest age of a sighting for which the target is expected near its last place.
_EXPECTED_US = 500_000
# Largest rounding error of a camera model that the robot scales to another size.
_SAME_LENS_PX = 0.5
# Weight of earlier frames in the share of lost frames. The mean is over about sixty frames, two seconds at 30 fps.
_LOSS_WEIGHT = 63 / 64
# Share of lost frames above which each twist is sent twice. A long run of losses is then rare in both directions.
_TWICE_ABOVE = 0.05


@dataclass(frozen=True, slots=True)
class Frame:
    """A received frame. `deadline_us`, on this machine's clock, limits the time of a remote detector."""

    header: FrameHeader
    jpeg: bytes
    deadline_us: int = NO_DEADLINE


@dataclass(frozen=True, slots=True)
class Observation:
    """The result of one step for viewers.

    Args:
        phase: phase of the mission (`follow`: tracking, coasting, searching, lost), or "no image".
        detections: all detections, best first.
        target: the detection that the mission follows.
        bearing_rad: bearing of the target, left positive.
        distance_m: distance of the target, m.
        note: the rest of the line for the operator.
        done: True after the end of the mission.
        track: number of the track that the mission follows.
    """

    phase: str
    detections: tuple[Detection, ...] = ()
    target: Detection | None = None
    bearing_rad: float | None = None
    distance_m: float | None = None
    note: str = ""
    done: bool = False
    track: int | None = None


@dataclass(frozen=True, slots=True)
class PipelineAnswer:
    """The answer to one frame. Without a twist it only acknowledges the frame."""

    twist: Twist | None
    seen: Observation
    scan: int | None = None
    """Sequence number of the range scan that it used."""
    mission: str = ""
    """Name of the mission."""
    request: RequestId | None = None
    """The request for this mission, or None for the first mission."""
    result: DetectionResult | None = field(default=None, compare=False)
    """Result of the detector. It is not compared, because it contains the computing time."""
    skipped: str = ""
    """Reason why the frame was not used, or empty."""


class Pipeline:
    """Steers one robot by its frames. It is a deterministic function of its inputs, in their order."""

    def __init__(
        self, config: VisionConfig, camera: CameraModel, detector: Detector, chosen: MissionSpec | None = None
    ) -> None:
        """Create the pipeline of one robot.

        Args:
            config: configuration of the vision service.
            camera: model of the robot's camera.
            detector: finds objects in its frames.
            chosen: first mission, or None for that of `config`.

        Raises:
            ConfigError: the mission is unknown.
        """
        self._config = config
        self._camera = camera
        self._next_camera: CameraModel | None = None
        """A camera model for another image size, until the first such image."""
        self._detector = detector
        self._decoder = Decoder(camera.width_px, camera.height_px, config.max_pixels)
        self._first = chosen or configured_mission(config)
        self._session = ""
        self._scan: tuple[ScanHeader, RangeScan] | None = None
        self._forget()

    def _forget(self) -> None:
        """Forget all earlier frames and the requested mission."""
        self._mission_switch = MissionSwitch(self._first, self._camera)
        self._request: RequestId | None = None
        self.restart_clock()

    def restart_clock(self) -> None:
        """Forget the time of the last frame, if it was false or is of another lens."""
        self._latency = LatencyEstimator(self._config.latency)
        self._last_us: int | None = None
        self._seen_at: tuple[int, tuple[float, float]] | None = None
        self._track: tuple[int, Target] | None = None

    @property
    def camera(self) -> CameraModel:
        """Return the camera model of the last image."""
        return self._camera

    @property
    def mission(self) -> MissionSpec:
        """Return the newest mission."""
        return self._mission_switch.chosen

    @property
    def request(self) -> RequestId | None:
        """Return the request for the newest mission, or None for the first mission."""
        return self._request

    def switch(self, chosen: MissionSpec, request: RequestId, session: str) -> None:
        """Switch to another mission from the next frame on. The robot first comes to rest.

        Args:
            chosen: the mission. It ends with the session.
            request: the request; a repeated one changes nothing.
            session: session id of the robot.
        """
        self._use_session(session)
        # Requests are repeated on a lossy link. A repetition must not restart the mission.
        if request != self._request:
            self._request = request
            self._mission_switch.switch(chosen)

    def _use_session(self, session: str) -> None:
        """Forget everything at a new session of the robot."""
        # A new session has new odometry, so old positions would be wrong.
        if session != self._session:
            self._session = session
            self._forget()

    def put_scan(self, stamp: ScanHeader, scan: RangeScan) -> None:
        """Store the newest range scan for the following frames."""
        self._scan = (stamp, scan)

    def set_camera(self, camera: CameraModel) -> None:
        """Use another camera model from the next frame on, or from its first image on if that has another size."""
        # Images of the former size may still arrive, because of a computation or another order on the network.
        self._next_camera = camera
        if _size_px(camera) == _size_px(self._camera):
            self._use_next_camera()

    def _use_next_camera(self) -> None:
        """Use the waiting camera model. A mission starts again with another lens, and continues with another size."""
        if self._next_camera is None:
            return
        former, camera, self._next_camera = self._camera, self._next_camera, None
        self._camera = camera
        self._decoder = Decoder(camera.width_px, camera.height_px, self._config.max_pixels)
        is_scaled = _is_scaled(former, camera)
        if self._mission_switch.set_camera(camera, is_scaled=is_scaled) or not is_scaled:
            self.restart_clock()
        elif self._seen_at is not None:
            t_us, (x_px, y_px) = self._seen_at
            across, down = camera.width_px / former.width_px, camera.height_px / former.height_px
            self._seen_at = t_us, (x_px * across, y_px * down)

    def fits(self, jpeg: bytes) -> bool:
        """Return True if an image has the size of the newest camera model. Does not decode."""
        try:
            if self._next_camera is not None:
                return _is_of(jpeg, self._next_camera, self._config.max_pixels)
            self._decoder.check(jpeg)
        except WireError:
            return False
        return True

    def step(self, frame: Frame) -> PipelineAnswer:
        """Answer one frame. Never raises for any JPEG bytes.

        Args:
            frame: header and JPEG.

        Returns:
            The answer. Its `skipped` names the reason if the frame cannot be used.
        """
        # An older frame would move the clock of the mission back.
        if not self._is_new(frame.header):
            return self._skip("OUT_OF_ORDER", "frame is not newer than the last")
        try:
            if self._next_camera is not None and _is_of(frame.jpeg, self._next_camera, self._config.max_pixels):
                self._use_next_camera()
            picture = self._decoder.decode(frame.jpeg)
        except WireError as error:
            # An invalid image is acknowledged, too. Otherwise the robot waits for its credit until the timeout.
            return self._skip(error.reason, error.detail)
        shown = DetectFrame(self._config.robot, frame.header, frame.jpeg, self._decoder, picture)
        shown.goes_by = self.mission.goes_by
        shown.expected_px = self._expected_px(frame.header)
        # A result that does not fit its frame counts as no answer: a plug-in must not steer by another frame.
        (result,) = checked_results(self._detector, [shown], frame.deadline_us)
        if isinstance(result, str):
            # No twist, so the robot holds. Only "detected nothing" may start a search.
            return self._skip(NO_ANSWER, result, "no answer")
        return self._answer(frame.header, result.detections, picture, result)

    def follow(self, header: FrameHeader, detections: tuple[Detection, ...]) -> PipelineAnswer:
        """Answer a frame with detections of another service.

        Args:
            header: header of the examined frame.
            detections: objects, best first; empty means "detected nothing".
        """
        if not self._is_new(header):
            return self._skip("OUT_OF_ORDER", "the examined frame is not newer than the last")
        self._use_next_camera()  # the caller has read the boxes with it
        return self._answer(header, detections, None)

    def _is_new(self, header: FrameHeader) -> bool:
        """Return True if `header` is newer than the last frame of its session."""
        self._use_session(header.session)
        return self._last_us is None or header.t_us > self._last_us

    def _skip(self, reason: str, note: str, phase: str = "no image") -> PipelineAnswer:
        return self.acknowledge(Observation(phase, note=note), reason)

    def acknowledge(self, seen: Observation, skipped: str = "") -> PipelineAnswer:
        """Acknowledge a frame without a step. The answer names the mission and contains no twist."""
        return PipelineAnswer(None, seen, None, self.mission.name, self._request, skipped=skipped)

    def _answer(
        self, header: FrameHeader, detections: tuple[Detection, ...], picture: DecodedImage | None,
        result: DetectionResult | None = None,
    ) -> PipelineAnswer:
        dt_s = self._tick(header)
        stamp, scan = self._newest_scan(header)
        view = View(header, dt_s, self._latency.total_s, self._camera, detections, picture, scan)
        plan = self._mission_switch.step(view)
        if plan.target is not None:
            one = plan.target
            self._seen_at = header.t_us, ((one.x1_px + one.x2_px) / 2, (one.y1_px + one.y2_px) / 2)
        self._track = (header.t_us, plan.track) if plan.track is not None else None
        return PipelineAnswer(plan.twist, _seen(plan, detections), stamp.seq if stamp else None, self.mission.name,
                              self._request, result)

    def _tick(self, header: FrameHeader) -> float:
        """Return the seconds since the last frame, and update the latency from the robot's measurement."""
        # The clock is the capture time, so that a replayed recording produces the same twists, byte for byte.
        dt_s = min((header.t_us - self._last_us) / 1e6, _MAX_DT_S) if self._last_us is not None else 0.0
        self._last_us = header.t_us
        self._latency.measure(header.latency_us, dt_s)
        return dt_s

    def _expected_px(self, header: FrameHeader) -> tuple[float, float] | None:
        """Return the expected image position of the followed target, if it was seen a moment ago."""
        if self._seen_at is None or header.t_us - self._seen_at[0] > _EXPECTED_US:
            return None
        if self._track is None:
            return self._seen_at[1]
        # A robot that turns at 1.5 rad/s moves the target by 14 of 320 px between two images at 30 fps, and by 95 px at
        # 3 fps. That is half the width of the enlarged part.
        before_us, target = self._track
        place = target.after((header.t_us - before_us) / 1e6)
        return place_px(*from_odometry(header.pose, *place), self._seen_at[1], self._camera)

    def _newest_scan(self, header: FrameHeader) -> tuple[ScanHeader | None, RangeScan | None]:
        """Return the newest scan for a mission that uses scans."""
        # A scan of another session can be from another robot, and its clock is not comparable.
        if self._scan is None or not self.mission.wants_scan or self._scan[0].session != header.session:
            return None, None
        return self._scan


def _size_px(camera: CameraModel) -> tuple[int, int]:
    return camera.width_px, camera.height_px


def _is_of(jpeg: bytes, camera: CameraModel, max_pixels: int) -> bool:
    """Return True if an image has the size of `camera`. Raises WireError for bytes that are not an image."""
    size = read_jpeg_size(jpeg, max_pixels)
    return (size.width_px, size.height_px) == _size_px(camera)


def _is_scaled(former: CameraModel, camera: CameraModel) -> bool:
    """Return True if `camera` is `former` for images of another size: the same ray at each share of the image."""
    across, down = camera.width_px / former.width_px, camera.height_px / former.height_px
    scaled = {"fx_px": former.fx_px * across, "cx_px": former.cx_px * across,
              "fy_px": former.fy_px * down, "cy_px": former.cy_px * down}
    own = {name: getattr(camera, name) for name in ("width_px", "height_px", *scaled)}
    return former.model_copy(update=own) == camera and all(
        abs(own[name] - value) <= _SAME_LENS_PX for name, value in scaled.items())


def _seen(plan: Plan, detections: tuple[Detection, ...]) -> Observation:
    return Observation(plan.phase, detections, plan.target, plan.bearing_rad, plan.distance_m, plan.note, plan.done,
                       plan.track.number if plan.track else None)


class FrameLoss:
    """Estimates the share of frames that the network lost, by the gaps in the sequence numbers."""

    def __init__(self) -> None:
        self._share = 0.0
        self._newest: tuple[str, int, int] | None = None

    def update(self, header: FrameHeader, replaced: int) -> None:
        """Note a received frame.

        Args:
            header: header of the frame.
            replaced: number of frames so far that arrived and were replaced by newer ones.
        """
        session, seq, before = self._newest or ("", 0, 0)
        self._newest = (header.session, header.seq, replaced)
        if header.session == session:
            lost = max(0, header.seq - seq - 1 - (replaced - before))
            self._share = _LOSS_WEIGHT * (1 - (1 - self._share) * _LOSS_WEIGHT**lost)

    @property
    def copies(self) -> int:
        """Return how many times to send a twist, each with a new number, so that one loss does not lose the twist."""
        return 2 if self._share > _TWICE_ABOVE else 1


def answer_header(
    frame: FrameHeader, session: str, seq: int, compute_us: int = 0, answer: PipelineAnswer | None = None,
    *, proof: Proof = NO_PROOF,
) -> AnswerHeader:
    """Create the header of an answer.

    Args:
        frame: header of the frame, which `echo` cites field for field.
        session: session id of the vision service.
        seq: sequence number of the answer.
        compute_us: computing time, us.
        answer: the answer, which names its scan and its mission.
        proof: proof that the twist is of this service.
    """
    scan, mission = (answer.scan, answer.request) if answer else (None, None)
    return AnswerHeader(source=SOURCE, session=session, seq=seq, echo=Echo.of(frame), compute_us=compute_us, scan=scan,
                        mission=mission, proof=proof.proof, next_proof=proof.next_proof)
