"""`Service`: answers the frames of one robot, with its own detector or with published boxes. Shell."""

import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

from sightline.protocol.channels import ACK, CAMERA, DETECTIONS, FRAME, MAX_HEADER_BYTES, TWIST, Channel
from sightline.protocol.clock import RobotClock, monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.log import RepeatLimiter
from sightline.protocol.messages import CameraModel, FrameHeader, Stamp
from sightline.protocol.proof import NO_PROOF, ProofChain, session_digest
from sightline.protocol.text import format_twist
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.plugin_calls import attach_detector
from sightline.vision_side.detect.port import Detector
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.pipeline import Frame, FrameLoss, Observation, Pipeline, PipelineAnswer, answer_header
from sightline.vision_side.serving.detector_queue import percentile_95
from sightline.vision_side.serving.legacy_robot import assumed_camera, camera_line, is_legacy, target_box
from sightline.vision_side.serving.mission_channel import NO_FRAMES, MissionChannel
from sightline.vision_side.tracking.locate import REMEMBERED, BoxReader
from sightline.vision_side.viewing import ViewPublisher


@dataclass(frozen=True, slots=True)
class ServiceCounts:
    """The counters of one robot, which never decrease. Times belong to the newest frame, or are None."""

    robot: str
    receives: bool
    """True if frames came within the last seconds."""
    answered: int
    steered: int
    """Answers with a twist; the other answers only return credit."""
    skipped: dict[str, int]
    """Unused frames, by reason."""
    overtaken: int
    """Frames that a newer frame replaced while an older one was processed."""
    compute_us: int
    latency_us: int | None
    """Time from capture to accepted command, as the robot measured it."""
    drives: bool = True
    """False for a robot for which this service is standby only."""
    restarts: int = 0
    """How many times the robot's service failed and a new one started."""
    received: int = 0
    """Received frames, also those that no turn took."""
    busy_us: int = 0
    """Time in which `thread` answered its frames."""
    thread: int = 0
    queue_p95_us: int | None = None
    """95th percentile of the age of its frames at their turn; None without frames."""


_QUEUE_AGES: Final = 256
"""Ages stored for the percentile: those of some seconds."""
LIVE_S: Final = 10.0
"""Time without a turn after which the loop hangs. A turn waits 0.2 s for a frame, and computes one detection."""


@dataclass(slots=True)
class ServingState:
    """The state of a vision service for a supervisor. Safe from any thread."""

    counts: Callable[[], list[ServiceCounts]]
    """Returns the counters of each robot."""
    ending: threading.Event
    turned_s: float
    """Start of the newest turn of its loop, on `time.monotonic`."""
    is_open: Callable[[], bool]
    """Returns True with a session to a router or robot. A service that only listens does not need it."""

    @property
    def is_live(self) -> bool:
        """Return True while the loop turns."""
        return time.monotonic() - self.turned_s <= LIVE_S

    @property
    def is_ready(self) -> bool:
        """Return True while new robots are served: session and detector are open, and the service does not end."""
        return self.is_live and self.is_open() and not self.ending.is_set()

    def turns(self) -> bool:
        """Note a turn. Returns False when the service must end."""
        self.turned_s = time.monotonic()
        return not self.ending.is_set()


Observe = Callable[[ServingState], None]
"""Receives the state once, when the loop begins."""


# The session of the steered robot, when frames of several sessions arrive. Pure.
#
# A robot that restarts begins a new session, and the newest session is used immediately. But on a network without keys
# any client can send one frame of a new session, and two robots may have one id. Therefore an earlier session that
# continues is used again, because a restarted robot cannot continue its old session. From then on it is replaced only
# after silence. Within a session, a frame is invalid if its time or number runs ahead of this machine's clock.


GOES_ON_US: Final = 300_000
"""An earlier session is alive if its frames cover this time, both in capture and in arrival. That is more than a few
delayed frames, and as little as a robot without answers can show (it sends a frame every 120 to 500 ms)."""
SILENT_US: Final = 1_000_000
"""Silence after which a session may be replaced. The slowest stream sends twice in this time, and no robot restarts so
fast."""
KEPT: Final = 8
"""Number of stored earlier sessions. A forgotten session counts as new."""


@dataclass(slots=True)
class _Earlier:
    """A session that was replaced: arrival of its last frame, and the first later frame on both clocks."""

    received_us: int
    again_us: int = 0
    captured_us: int = 0

    def goes_on(self, captured_us: int, now_us: int) -> bool:
        """Return True if its frames continue for so long that the session cannot have ended."""
        if not self.again_us or now_us - self.received_us > SILENT_US:
            self.again_us, self.captured_us = now_us, captured_us
        self.received_us = now_us
        return min(now_us - self.again_us, captured_us - self.captured_us) >= GOES_ON_US


class SessionSelector:
    """Selects frames by their session. Times use this machine's clock, except `captured_us` (robot's clock)."""

    def __init__(self) -> None:
        self.current = ""
        self._received_us = 0
        self._is_proven = False
        """True if the current session continued next to another one. Then the other session does not end it."""
        self._earlier: dict[str, _Earlier] = {}
        self.clock = RobotClock()

    def check(self, stamp: Stamp, now_us: int) -> None:
        """Check that a frame is from the steered robot. This frame may change the session.

        Raises:
            WireError: OTHER_SESSION, or FROM_FUTURE for a time or number that runs ahead or goes back too far.
        """
        if stamp.session != self.current:
            if not self._replaces(stamp.session, stamp.t_us, now_us):
                raise WireError(RejectReason.OTHER_SESSION, f"{stamp.session}: steered in session {self.current}")
            self._follow(stamp.session)
        if not self.clock.update(stamp.session, stamp.t_us, now_us, stamp.seq):
            raise WireError(RejectReason.FROM_FUTURE, "frame disagrees with this clock")
        self._received_us = now_us

    @property
    def proven(self) -> str:
        """Return the current session if it continued next to another one, or empty."""
        return self.current if self._is_proven else ""

    def _replaces(self, session: str, captured_us: int, now_us: int) -> bool:
        if self._is_proven and now_us - self._received_us <= SILENT_US:
            return False
        earlier = self._earlier.get(session)
        if earlier is not None and not earlier.goes_on(captured_us, now_us):
            return False
        self._is_proven = earlier is not None
        return True

    def _follow(self, session: str) -> None:
        self._earlier.pop(session, None)
        if self.current:
            self._earlier[self.current] = _Earlier(self._received_us)
        if len(self._earlier) > KEPT:
            del self._earlier[min(self._earlier, key=lambda name: self._earlier[name].received_us)]
        self.current = session


# The vision service: newest frame in, twist or acknowledgement out, over a `Link`. Shell.
#
# One printed line per change of state, never one per frame. It ends within a second of SIGTERM or SIGINT.


_SILENCE_S = 3.0
_NO_FRAMES_S = 1.0  # twice the time between two frames of the slowest stream
_CAMERA_PATIENCE_S = 1.5
_REPORTED_COUNTS = tuple(10**power for power in range(10))
_LONG_ROW = 30  # a second at 30 fps
_REPORTED_PHASES = {"searching": "no target, searching", "lost": "target lost"}
LogLine = Callable[[str], None]
Model = TypeVar("Model", CameraModel, FrameHeader, Stamp)


def open_service(
    config: VisionConfig, link: Link, report: LogLine, detector: Detector | None = None, *, is_standby: bool = False
) -> "Service":
    """Create the service for one robot, for the kind of its detector (default: that of `config`)."""
    kind = BoxesService if config.detector.kind == "boxes" else Service
    return kind(config, link, report, detector, is_standby=is_standby)


class SkipCounter:
    """Counts skipped frames, and selects those to log: number 1, 10, 100 ..., and each new reason.

    After a long row of used frames each reason is new again. A frequent one is then logged after 1, 2, 4 ... 60 s.
    """

    def __init__(self) -> None:
        self.count = 0
        self._used_in_a_row = 0
        self._known: set[str] = set()
        self._limiter = RepeatLimiter()

    def use(self) -> None:
        """Note a frame that is not skipped."""
        self._used_in_a_row += 1
        if self._used_in_a_row == _LONG_ROW:
            self._known.clear()

    def skip(self, reason: str, now_us: int) -> bool:
        """Count a skipped frame. Returns True if it should be logged."""
        is_new = reason not in self._known and self._limiter.due(reason, now_us) > 0
        if is_new:
            self._known.add(reason)
        self.count, self._used_in_a_row = self.count + 1, 0
        return is_new or self.count in _REPORTED_COUNTS


class PhaseLimiter:
    """Selects the changes of phase to log, because a mission may change its phase with each frame.

    A phase that lasted for a long row of frames may change at once. Otherwise the change is logged after 1, 2, 4 ...
    60 s, or when the new phase has lasted.
    """

    def __init__(self) -> None:
        self._phase, self._row = "", _LONG_ROW
        self._limiter = RepeatLimiter()

    def is_due(self, phase: str, now_us: int) -> bool:
        """Note the phase of a frame. Returns True if it may be logged."""
        if phase == self._phase:
            self._row += 1
            return self._row >= _LONG_ROW
        has_lasted, self._phase, self._row = self._row >= _LONG_ROW, phase, 1
        return has_lasted or self._limiter.due("", now_us) > 0


class DriverSession:
    """A session of a driver: the common data of its commands."""

    def __init__(self) -> None:
        self.session = secrets.token_hex(4)
        self.proofs = ProofChain(secrets.token_bytes)
        self.seq = self.twists = 0


class Service:
    """Serves one robot: its camera, its sessions, and its pipeline."""

    _looks_at: tuple[Channel, ...] = (FRAME,)

    def __init__(
        self, config: VisionConfig, link: Link, report: LogLine, detector: Detector | None = None, *,
        is_standby: bool = False,
    ) -> None:
        """Create the service. A standby receives no frames until `begin`."""
        self._config, self._link, self._report = config, link, report
        self._detector = detector or configured_detector(config)
        attach_detector(self._detector, link)
        self._cameras: LatestSlot[Message] = link.latest(CAMERA)
        self._frames = self._arrivals()
        self._ahead = LatestSlot[Message]()
        self._is_subscribed, self.is_standby, self._received = False, is_standby, 0
        if not is_standby:
            self.listen()
        self._camera: CameraModel | None = None
        self._assumed_camera: CameraModel | None = None
        self._pipeline: Pipeline | None = None
        self.sender = DriverSession()
        self._loss = FrameLoss()
        self._is_legacy = any(is_legacy(one) for one in config.connect)
        self._robot_session = ""
        self._sessions = SessionSelector()
        self._reported: dict[str, str] = {}
        self._changes = RepeatLimiter()
        if config.camera is not None:
            self._use(config.camera)
        self._received_s = self._waited_s = time.monotonic()
        self._blind_since_s = 0.0
        self._newest: tuple[int, int | None] = (0, None)
        self.answered = self.steered = 0
        self._arrived_us = self._busy_us = self._thread = 0
        self._queue_ages_us: deque[int] = deque(maxlen=_QUEUE_AGES)
        self.skipped: Counter[str] = Counter()
        self._skipped_images, self._phases = SkipCounter(), PhaseLimiter()
        self._mission_channel = MissionChannel(config, link, self._detector, self._log_change, self._reject)
        self._viewing = ViewPublisher(config, link, self._log_change)

    def _arrivals(self) -> LatestSlot[Message]:
        """Return the slot of the messages to answer."""
        return LatestSlot()

    def listen(self) -> None:
        """Receive frames from now on. A standby stores the newest frame for `begin`."""
        if not self._is_subscribed:
            self._is_subscribed, self._ahead = True, LatestSlot()
            for channel in self._looks_at:
                self._link.subscribe(channel, self._receive)

    def _receive(self, message: Message) -> None:
        if message.channel is FRAME:
            self._received += 1
            self._arrived_us = monotonic_us()
        (self._ahead if self.is_standby else self._frames).put(message)

    def begin(self) -> None:
        """Answer frames from now on, first the stored one. Earlier frames do not count as lost."""
        self._loss, self._received_s = FrameLoss(), time.monotonic()
        self.listen()
        if (newest := self._ahead.take()) is not None:
            self._frames.put(newest)
        self.is_standby = False

    def rest(self) -> None:
        """Receive only camera models and mission requests from now on, no frames."""
        self.is_standby = True
        if self._is_subscribed:
            self._is_subscribed = False
            for channel in self._looks_at:
                self._link.unsubscribe(channel)
            while self._frames.take() is not None:  # the next driver receives these frames, too
                pass

    def note_status(self, stamp: Stamp) -> None:
        """Apply a requested mission without a frame. The request cites a status about as old as this one."""
        if self._pipeline is not None:
            frame = FrameHeader(session=stamp.session, seq=stamp.seq, t_us=stamp.t_us)
            self._mission_channel.prepare(self._pipeline, frame)

    @property
    def has_request(self) -> bool:
        """Return True if the robot's mission was requested from this service, also after its end."""
        return self._pipeline is not None and self._pipeline.request is not None

    def turn(self, wait_s: float) -> None:
        """Wait up to `wait_s` for a frame and answer it."""
        message = self._frames.take(wait_s)
        started_ns = time.perf_counter_ns()
        if message is not None and self._pipeline is not None:
            self._frame(message, started_ns)
            self._look_at_camera()  # after the answer: the model repeats twice a second, and frames are urgent
            return
        self._look_at_camera()
        if message is not None:
            self._frame(message, started_ns)
        elif not self.is_standby:
            self._note_silence(time.monotonic())

    def _note_silence(self, now_s: float) -> None:
        # After a turn this late, e.g. of a suspended computer, frames may already wait. The silence starts now.
        if now_s - max(self._waited_s, self._received_s) > _SILENCE_S / 2:
            self._received_s = now_s
        self._waited_s = now_s
        if now_s - self._received_s > _NO_FRAMES_S:
            self._mission_channel.report(self._now_us() / 1e6, self._acknowledge(NO_FRAMES), None)
        if now_s - self._received_s > _SILENCE_S:
            self._robot_session = ""
            fix = "does its program send images?" if self._is_legacy else (
                "is `sightline robot` running there, with this robot id?")
            self._log_change(
                "link", f"no frames from robot {self._config.robot} at {endpoints_text(self._config)}; {fix}")

    def counts(self) -> ServiceCounts:
        """Return the counters. Safe from any thread."""
        receives, (compute_us, latency_us) = time.monotonic() - self._received_s <= _SILENCE_S, self._newest
        return ServiceCounts(self._config.robot, receives and self.answered > 0, self.answered, self.steered,
                      dict(self.skipped.copy()), self._frames.dropped, compute_us, latency_us,
                      received=self._received, busy_us=self._busy_us, thread=self._thread,
                      queue_p95_us=percentile_95(self._queue_ages_us))

    def _look_at_camera(self) -> None:
        """Receive the camera model; a new model needs a new pipeline."""
        message = self._cameras.take()
        if message is None or self._decoded(Stamp, message.header, MAX_HEADER_BYTES) is None:
            return
        camera = self._decoded(CameraModel, message.payload, CAMERA.max_payload_bytes)
        if camera is not None and camera != self._camera:
            self._use(camera)

    def _use(self, camera: CameraModel) -> None:
        self._camera, is_frequent = camera, self._pipeline is not None
        if self._pipeline is None:
            self._pipeline = Pipeline(self._config, camera, self._detector)
        else:
            self._pipeline.set_camera(camera)
        lens = "calibrated" if camera.calibrated else "not calibrated"
        self._log_change("camera", f"camera is {camera.width_px}x{camera.height_px}, fx {camera.fx_px:.1f} px, {lens}",
                         is_frequent=is_frequent)

    def _frame(self, message: Message, started_ns: int) -> None:
        """Answer a message. Measure how long a frame waited, and how long its answer took."""
        if message.channel is FRAME:
            arrived_us = self._arrived_us  # read before the clock: the next frame may arrive now
            self._queue_ages_us.append(monotonic_us() - arrived_us)
        self._answer(message, started_ns)
        self._busy_us += (time.perf_counter_ns() - started_ns) // 1000
        self._thread = threading.get_ident()

    def _answer(self, message: Message, started_ns: int) -> None:
        header = self._decoded(FrameHeader, message.header, MAX_HEADER_BYTES)
        if header is None:
            return
        if not self._is_of_robot(header, self._frames.dropped):
            return
        self._received_s = time.monotonic()
        self._note_session(header.session)
        if self._pipeline is None or not self._pipeline.fits(message.payload):
            self._find_camera(message.payload)
        if self._pipeline is None:
            self._publish(header, PipelineAnswer(None, Observation("no image", note="no camera model yet")), 0)
            return
        late_us = self._sessions.clock.age_us(header.session, header.t_us, self._now_us()) or 0
        self._mission_channel.prepare(self._pipeline, header, max(late_us, self._queue_ages_us[-1]))
        deadline_us = monotonic_us() + round(self._config.detector.deadline_s * 1e6)
        answer = self._pipeline.step(Frame(header, message.payload, deadline_us))
        if answer.skipped:
            self.skipped[answer.skipped] += 1
        self._publish(header, answer, (time.perf_counter_ns() - started_ns) // 1000)
        self._report_phase(answer)
        self._mission_channel.report(self._now_us() / 1e6, answer, header, self._pipeline.camera)
        if not self._is_legacy:
            self._viewing.publish_detections(header, answer, started_ns)
        self._viewing.show(header, answer, self._pipeline.camera, started_ns=started_ns, jpeg=message.payload)

    def _note_session(self, session: str) -> None:
        if session != self._robot_session:
            is_frequent, self._robot_session = bool(self._robot_session), session
            self._log_change("link", f"frames from robot {self._config.robot}, session {_shown(session)}",
                             is_frequent=is_frequent)

    def _is_of_robot(self, header: FrameHeader, replaced_frames: int = 0) -> bool:
        """Return True for a frame of the steered robot. Others are counted, and logged once.

        Args:
            header: header of the frame.
            replaced_frames: number of frames so far that arrived but did not reach this method.
        """
        replaced = self._sessions.clock.replaced
        try:
            self._sessions.check(header, self._now_us())
        except WireError as error:
            self.skipped[error.reason] += 1
            if error.reason is RejectReason.OTHER_SESSION:
                self._log_change("other", f"rejecting frames of session {_shown(header.session)}: robot "
                                          f"{self._config.robot} is steered in session "
                                          f"{_shown(self._sessions.current)}; give each robot its own with --robot",
                                 self._sessions.proven or "unproven")
            else:
                self._log_change("time", f"rejecting frames of robot {self._config.robot} whose time disagrees with "
                                         "this clock; does another client send frames?")
            return False
        self._loss.update(header, replaced_frames)
        if self._pipeline is not None and self._sessions.clock.replaced != replaced:
            self._pipeline.restart_clock()
        return True

    def _now_us(self) -> int:
        return monotonic_us()

    def _acknowledge(self, seen: Observation) -> PipelineAnswer:
        return self._pipeline.acknowledge(seen) if self._pipeline else PipelineAnswer(None, seen)

    def _find_camera(self, jpeg: bytes) -> None:
        """Find the model for an image without one. It comes twice a second, so only a longer wait is logged."""
        self._look_at_camera()  # the robot publishes the model of a new size before its first image
        if self._is_legacy and self._camera is self._assumed_camera:
            self._assume_camera(jpeg)
        elif self._camera is None:
            self._blind_since_s = self._blind_since_s or time.monotonic()
            if time.monotonic() - self._blind_since_s > _CAMERA_PATIENCE_S:
                self._log_change("camera", "frames come, but no camera model; is the robot of another version?")

    def _assume_camera(self, jpeg: bytes) -> None:
        """Assume a camera for the size of an image of a legacy robot, which publishes no model."""
        try:
            camera = assumed_camera(read_jpeg_size(jpeg, self._config.max_pixels))
        except WireError as error:
            self._log_change("camera", f"cannot assume a camera model: {error.detail}", "unknown")
            return
        if camera != self._camera:
            self._assumed_camera = camera
            self._report(f"vision: {camera_line(camera)}")
            self._use(camera)

    def _publish(self, header: FrameHeader, answer: PipelineAnswer, compute_us: int) -> None:
        """Publish the twist that cites the frame, or an acknowledgement.

        Next: `robot_side/pipe.py`: `NetworkEnd.forward`.
        """
        self.answered += 1
        self.steered += answer.twist is not None
        self._newest = (compute_us, header.latency_us)
        for _ in range(1 if answer.twist is None else self._loss.copies):
            self._send(header, answer, compute_us)
        if self._is_legacy and self._camera is not None:
            self._link.publish(DETECTIONS, b"", target_box(answer.seen.target, self._camera))

    def _send(self, header: FrameHeader, answer: PipelineAnswer, compute_us: int) -> None:
        sender = self.sender  # another thread may replace it
        sender.seq += 1
        sender.twists += answer.twist is not None
        proof = NO_PROOF if answer.twist is None else sender.proofs.next()
        stamp = encode(answer_header(header, sender.session, sender.seq, compute_us, answer, proof=proof))
        if answer.twist is None:
            self._link.publish(ACK, stamp, b"")
        else:
            self._link.publish(TWIST, stamp, format_twist(answer.twist))

    def _decoded(self, model: type[Model], data: bytes, max_bytes: int) -> Model | None:
        try:
            return decode(model, data, max_bytes)
        except WireError as error:
            self._reject(error)
            return None

    def _reject(self, error: WireError) -> None:
        self.skipped[error.reason] += 1
        if error.reason is RejectReason.UNSUPPORTED_VERSION:
            self._log_change("version", error.detail)

    def _report_phase(self, answer: PipelineAnswer) -> None:
        seen = answer.seen
        if answer.twist is None:
            if self._skipped_images.skip(answer.skipped, monotonic_us()):
                self._log_change("phase", f"skipped images: {self._skipped_images.count}; newest: {seen.note}")
            return
        self._skipped_images.use()
        if seen.phase == "coasting":
            return
        line, state = _phase_line(seen)
        if self._phases.is_due(state, self._now_us()):
            self._log_change("phase", line, state)

    def _log_change(self, about: str, line: str, state: str = "", *, is_frequent: bool = False) -> None:
        """Log `line` if the state of its subject has changed.

        A frequent change is logged immediately and then after 1, 2, 4 ... 60 s, because on a network without keys any
        client can cause it with each message.
        """
        if self._reported.get(about) == (state or line):
            return
        times = self._changes.due(about, self._now_us()) if is_frequent else 1
        if times:
            self._reported[about] = state or line
            self._report(f"vision: {line}" + (f" ({times} changes)" if times > 1 else ""))


def _phase_line(seen: Observation) -> tuple[str, str]:
    """Return the line that reports a phase, and its state, which a new distance or note does not change."""
    if seen.phase in _REPORTED_PHASES:
        return _REPORTED_PHASES[seen.phase], seen.phase
    if seen.phase == "tracking" and seen.distance_m is not None:
        return f"target seen at {seen.distance_m:.2f} m", "seen"
    return ": ".join(filter(None, (seen.phase, seen.note))), seen.phase


def _shown(session: str) -> str:
    return session_digest("robot", session)


def endpoints_text(config: VisionConfig) -> str:
    return ", ".join([*config.connect, *(f"{one} (listening)" for one in config.listen)]) or "nowhere"


# The vision service without its own detector: it steers by boxes that another service publishes. Shell.
#
# Every frame is acknowledged immediately, because no detector runs here. Boxes are answered with a twist that cites
# their frame at any age, because the robot validates the age. Without boxes there is no twist, and the robot holds.


_BOXES_SILENCE_S = 2.0
_MANY_RETURNS = 10
_NO_BOXES = Observation("no boxes")


class BoxesInbox(LatestSlot[Message]):
    """The newest frame and the newest boxes of one source. It also stores and counts headers of replaced frames."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self._source = source
        self._arrived = threading.Condition()
        self._newest: dict[str, Message] = {}
        self.headers: deque[bytes] = deque(maxlen=REMEMBERED)

    def put(self, item: Message) -> None:
        """Store the newest message of its channel; never blocks."""
        if item.channel is DETECTIONS and item.source != self._source:
            return
        with self._arrived:
            replaced = self._newest.get(item.channel.name)
            if replaced is not None and item.channel is FRAME:
                self.headers.append(replaced.header)
                self.dropped += 1
            self._newest[item.channel.name] = item
            self._arrived.notify()

    def take(self, timeout_s: float = 0.0) -> Message | None:
        """Take a frame before boxes, because credit bounds the number of frames. Returns None at `timeout_s`."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest, timeout_s)
            return self._newest.pop(FRAME.name, None) or self._newest.pop(DETECTIONS.name, None)


class BoxesService(Service):
    """A `Service` that uses the boxes of another service."""

    _looks_at = (FRAME, DETECTIONS)

    def __init__(
        self, config: VisionConfig, link: Link, report: LogLine, detector: Detector | None = None, *,
        is_standby: bool = False,
    ) -> None:
        self._inbox = BoxesInbox(config.boxes.source)
        self._reader = BoxReader(config.boxes)
        self._boxes_received_s = time.monotonic()
        self._rejected_boxes = SkipCounter()
        super().__init__(config, link, report, detector, is_standby=is_standby)

    def _arrivals(self) -> LatestSlot[Message]:
        return self._inbox

    def _answer(self, message: Message, started_ns: int) -> None:
        """Acknowledge a frame, or answer boxes."""
        if message.channel is DETECTIONS:
            self._boxes(message, started_ns)
            return
        self._remember_replaced()
        header = self._remember(message.header)
        if header is None:
            return
        self._received_s = time.monotonic()
        self._note_session(header.session)
        self._publish(header, PipelineAnswer(None, Observation("no image", note="another service detects")), 0)
        self._viewing.keep(header, message.payload)
        if self._pipeline is None or (self._is_legacy and not self._pipeline.fits(message.payload)):
            self._find_camera(message.payload)
        elif time.monotonic() - self._boxes_received_s > _BOXES_SILENCE_S:
            self._mission_channel.report(self._now_us() / 1e6, self._acknowledge(_NO_BOXES), header)
            source = self._config.boxes.source
            self._log_change("boxes", f"frames come, but no boxes from {source}; does its detector run?")

    def _boxes(self, message: Message, started_ns: int) -> None:
        self._remember_replaced()
        self._boxes_received_s = time.monotonic()
        if self._pipeline is None or self._camera is None:
            return
        try:
            frame, found = self._reader.read(message.header, message.payload, self._camera)
        except WireError as error:
            self.skipped[error.reason] += 1
            if self._rejected_boxes.skip(error.reason, monotonic_us()):
                self._log_change("boxes", f"rejecting boxes: {error.detail} ({self._rejected_boxes.count} so far)")
            return
        self._rejected_boxes.use()
        self._log_change("boxes", f"boxes from {self._config.boxes.source}")
        if self._reader.returns >= _MANY_RETURNS:  # while a robot changes services, both answer for a moment
            self._log_change("senders", f"several services send boxes as {self._config.boxes.source}; end all but one, "
                             "or start them with --share")
        waited_us = self._sessions.clock.age_us(frame.session, frame.t_us, self._now_us()) or 0
        self._mission_channel.prepare(self._pipeline, frame, waited_us)
        answer = self._pipeline.follow(frame, found)
        if answer.skipped:
            self.skipped[answer.skipped] += 1
            return
        self._publish(frame, answer, (time.perf_counter_ns() - started_ns) // 1000)
        self._report_phase(answer)
        self._mission_channel.report(self._now_us() / 1e6, answer, frame, self._camera)
        self._viewing.show(frame, answer, self._camera, started_ns=started_ns)

    def _remember_replaced(self) -> None:
        """Store the headers of the frames that newer frames replaced."""
        while self._inbox.headers:
            self._remember(self._inbox.headers.popleft())

    def _remember(self, data: bytes) -> FrameHeader | None:
        """Store the header of a frame of the steered robot, which boxes may name."""
        header = self._decoded(FrameHeader, data, MAX_HEADER_BYTES)
        if header is None or not self._is_of_robot(header):
            return None
        self._reader.remember(header)
        return header
