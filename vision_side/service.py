"""The vision service: newest frame in, twist or acknowledgement out, over a `Link`. Shell.

One printed line per change of state, never one per frame. Ends within a second of SIGTERM or SIGINT.
"""

import secrets
import time
from collections import Counter
from collections.abc import Callable
from typing import TypeVar

from sightline.protocol.channels import ACK, CAMERA, FRAME, MAX_HEADER_BYTES, TWIST
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import CameraModel, FrameHeader, Stamp
from sightline.protocol.refusals import RejectReason
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.protocol.text import format_twist
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.serving.service import Counts
from sightline.vision_side.detect.around import attach_detector
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.detect.hsv import HsvDetector
from sightline.vision_side.detect.port import Detector
from sightline.vision_side.detect.timing import TimedDetector
from sightline.vision_side.dispatch import NO_FRAMES, MissionChannel
from sightline.vision_side.pipeline import Frame, Observation, Pipeline, PipelineAnswer, encode_answer
from sightline.vision_side.sessions import SessionSelector
from sightline.vision_side.viewing import ViewPublisher

_SILENCE_S = 3.0
_NO_FRAMES_S = 1.0  # twice what the slowest stream takes between two frames
_CAMERA_PATIENCE_S = 1.5
_TOLD_COUNTS = tuple(10**power for power in range(10))  # a camera gone bad is told at 1, 10, 100 ... pictures
_TOLD_PHASES = {"searching": "target not in sight, searching", "lost": "target lost"}
LogLine = Callable[[str], None]
Model = TypeVar("Model", CameraModel, FrameHeader, Stamp)


def open_service(config: VisionConfig, link: Link, say: LogLine, eyes: Detector | None = None) -> "Service":
    """The service that fits the configured detector, for one robot. `eyes` are that detector, if it is built."""
    if config.detector.kind == "boxes":
        from sightline.vision_side.boxes_service import BoxesService

        return BoxesService(config, link, say)
    return Service(config, link, say, eyes)


class Service:
    """What is known of the robot on the other end, and the pipeline that fits it."""

    def __init__(self, config: VisionConfig, link: Link, say: LogLine, eyes: Detector | None = None) -> None:
        self._config, self._link, self._say = config, link, say
        self._eyes = eyes or configured_detector(config)
        self._plain = TimedDetector(HsvDetector(config.hsv))
        attach_detector(self._eyes, link)
        self._cameras: LatestSlot[Message] = link.latest(CAMERA)
        self._frames = self._arrivals(link)
        self._camera: CameraModel | None = None
        self._pipeline: Pipeline | None = None
        self._session = secrets.token_hex(4)
        self._robot_session = ""
        self._sessions = SessionSelector()
        self._said: dict[str, str] = {}
        self._counted: Counter[str] = Counter()
        if config.camera is not None:
            self._use(config.camera)
        self._heard_s = time.monotonic()
        self._blind_since_s = 0.0
        self._newest: tuple[int, int | None] = (0, None)
        self.answered = self.steered = 0
        self.skipped: Counter[str] = Counter()
        self._dispatch = MissionChannel(config, link, self._tell, self._refuse)
        self._viewing = ViewPublisher(config, link, self._tell)

    def _arrivals(self, link: Link) -> LatestSlot[Message]:
        """Where what is to be answered arrives."""
        return link.latest(FRAME)

    def turn(self, wait_s: float) -> None:
        """Wait up to `wait_s` for a frame and answer it."""
        message = self._frames.take(wait_s)
        started_ns = time.perf_counter_ns()
        if message is not None and self._pipeline is not None:
            self._frame(message, started_ns)
            self._look_at_camera()  # afterwards: it says the same twice a second, and frames are in a hurry
            return
        self._look_at_camera()
        if message is not None:
            self._frame(message, started_ns)
        else:
            self._note_silence(time.monotonic())

    def _note_silence(self, now_s: float) -> None:
        if now_s - self._heard_s > _NO_FRAMES_S:
            self._dispatch.after(now_s, self._pipeline, None, NO_FRAMES)
        if now_s - self._heard_s > _SILENCE_S:
            self._robot_session = ""
            self._tell("link", f"no frames from robot {self._config.robot} at {endpoints_text(self._config)}; is "
                               "`sightline robot` running there, with this robot id?")

    def counts(self) -> Counts:
        """What is done so far; from any thread."""
        heard, (compute_us, latency_us) = time.monotonic() - self._heard_s <= _SILENCE_S, self._newest
        return Counts(self._config.robot, heard and self.answered > 0, self.answered, self.steered,
                      dict(self.skipped.copy()), self._frames.dropped, compute_us, latency_us)

    def _look_at_camera(self) -> None:
        """Take in the camera's model; a new one needs a new pipeline."""
        message = self._cameras.take()
        if message is None or self._decoded(Stamp, message.header, MAX_HEADER_BYTES) is None:
            return
        camera = self._decoded(CameraModel, message.payload, CAMERA.max_payload_bytes)
        if camera is not None and camera != self._camera:
            self._use(camera)

    def _use(self, camera: CameraModel) -> None:
        self._camera = camera
        before = self._pipeline
        self._pipeline = (before.with_camera(camera) if before
                          else Pipeline(self._config, camera, self._plain, eyes=self._eyes))
        self._counted.clear()
        lens = "calibrated" if camera.calibrated else "not calibrated"
        self._tell("camera", f"camera is {camera.width_px}x{camera.height_px}, fx {camera.fx_px:.1f} px, {lens}")

    def _frame(self, message: Message, started_ns: int) -> None:
        header = self._decoded(FrameHeader, message.header, MAX_HEADER_BYTES)
        if header is None:
            return
        if not self._sessions.admits(header.session, header.t_us, monotonic_us()):
            self.skipped["OTHER_SESSION"] += 1
            self._tell("other", f"frames of session {header.session} are refused: robot {self._config.robot} is "
                                f"steered in session {self._sessions.current}; two robots with this id? give each its "
                                "own with --robot")
            return
        self._heard_s = time.monotonic()
        if header.session != self._robot_session:
            self._robot_session = header.session
            self._tell("link", f"frames from robot {self._config.robot}, session {header.session}")
        if self._pipeline is None:
            self._wait_for_camera()
            self._publish(header, PipelineAnswer(None, Observation("no picture", note="no camera model yet")), 0)
            return
        self._dispatch.before(self._pipeline, header)
        deadline_us = monotonic_us() + round(self._config.detector.deadline_s * 1e6)
        answer = self._pipeline.step(Frame(header, message.payload, deadline_us))
        if answer.twist is None:
            self._count_skipped(self._pipeline.skipped)
        self._publish(header, answer, (time.perf_counter_ns() - started_ns) // 1000)
        self._tell_phase(answer)
        self._dispatch.after(time.monotonic(), self._pipeline, header, answer.seen)
        self._viewing.show(header, answer, self._pipeline.mission.name, self._camera,
                           started_ns=started_ns, jpeg=message.payload)

    def _count_skipped(self, skipped: Counter[str]) -> None:
        """Add what this pipeline has skipped since the last time to what earlier ones did."""
        self.skipped.update(skipped - self._counted)
        self._counted = skipped.copy()

    def _wait_for_camera(self) -> None:
        """The model comes twice a second; only a longer wait is worth a word."""
        self._blind_since_s = self._blind_since_s or time.monotonic()
        if time.monotonic() - self._blind_since_s > _CAMERA_PATIENCE_S:
            self._tell("camera", "frames come, but no camera model; is the robot of another version?")

    def _publish(self, header: FrameHeader, answer: PipelineAnswer, compute_us: int) -> None:
        self.answered += 1
        self.steered += answer.twist is not None
        self._newest = (compute_us, header.latency_us)
        stamp = encode_answer(header, self._session, self.answered, compute_us, answer)
        if answer.twist is None:
            self._link.publish(ACK, stamp, b"")
        else:
            self._link.publish(TWIST, stamp, format_twist(answer.twist))

    def _decoded(self, model: type[Model], data: bytes, max_bytes: int) -> Model | None:
        try:
            return decode(model, data, max_bytes)
        except WireError as error:
            self._refuse(error)
            return None

    def _refuse(self, error: WireError) -> None:
        self.skipped[error.reason] += 1
        if error.reason is RejectReason.UNSUPPORTED_VERSION:
            self._tell("version", error.detail)

    def _tell_phase(self, answer: PipelineAnswer) -> None:
        seen = answer.seen
        if answer.twist is None:
            count = self.skipped.total()
            if count in _TOLD_COUNTS:
                self._say(f"vision: pictures skipped so far: {count}; this one: {seen.note}")
        elif seen.phase in _TOLD_PHASES:
            self._tell("phase", _TOLD_PHASES[seen.phase])
        elif seen.phase == "tracking" and seen.distance_m is not None:
            self._tell("phase", f"target seen at {seen.distance_m:.2f} m", "seen")
        elif seen.phase != "coasting":
            self._tell("phase", ": ".join(filter(None, (seen.phase, seen.note))), seen.phase)

    def _tell(self, about: str, line: str, state: str = "") -> None:
        """Print `line` if what it is about changed since it was last told."""
        if self._said.get(about) != (state or line):
            self._said[about] = state or line
            self._say(f"vision: {line}")


def endpoints_text(config: VisionConfig) -> str:
    return ", ".join([*config.connect, *(f"{one} (listening)" for one in config.listen)]) or "nowhere"


