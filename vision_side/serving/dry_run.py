"""Runs the pipeline on a robot's frames or a local camera and only prints. Shell.

The frames of a robot are acknowledged, so that it continues to send. No twist is published.
"""

import secrets
import time
from collections.abc import Callable
from typing import Protocol

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import CameraModel, FrameHeader
from sightline.protocol.transports.link import Link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.plugin_calls import notices_of
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.pipeline import SOURCE, Frame, Observation, Pipeline, PipelineAnswer
from sightline.vision_side.serving.mission_channel import MissionChannel
from sightline.vision_side.serving.service import Service

_PRINT_EVERY_S = 0.5
_WAIT_S = 0.2
_RETRY_S = 0.5
_DEGREES = 57.29577951308232
LogLine = Callable[[str], None]


class Capture(Protocol):
    """One JPEG and its capture time, in microseconds of a monotonic clock."""

    @property
    def jpeg(self) -> bytes: ...

    @property
    def t_us(self) -> int: ...


class LocalCamera(Protocol):
    """Any camera plug-in of the robot side."""

    model: CameraModel

    def read(self, timeout_s: float) -> Capture | None:
        """Wait for the next capture. Returns None if none comes in time. Raises HardwareError without a camera."""
        ...


def watch_robot(config: VisionConfig, report: LogLine, seconds: float | None = None) -> int:
    """Print the detections in the robot's frames until Ctrl-C or for `seconds`. Returns the exit code 0.

    Raises ConfigError for an invalid endpoint, LinkError if the link cannot be opened.
    """
    from sightline.protocol.transports.open import open_link

    opened = open_link(config.robot, listen=config.listen, connect=config.connect, role=SOURCE,
                       max_frame_bytes=config.max_frame_bytes, secure=config.secure)
    with opened as link:
        report(f"vision: dry run with robot {config.robot}; nothing is driven")
        service = AckingService(config, link, report)
        return _repeat(lambda: service.turn(_WAIT_S), seconds)


def watch_camera(config: VisionConfig, camera: LocalCamera, report: LogLine, seconds: float | None = None) -> int:
    """Print the detections of a local camera until Ctrl-C or for `seconds`. Returns the exit code 0."""
    model = camera.model
    lens = "calibrated" if model.calibrated else "not calibrated, so distances are a guess"
    watching = LocalRun(config, camera, report)
    report(f"vision: dry run, camera {model.width_px}x{model.height_px}, {lens}; nothing is driven")
    return _repeat(watching.turn, seconds)


def _repeat(turn: Callable[[], None], seconds: float | None) -> int:
    ends_s = time.monotonic() + seconds if seconds is not None else None
    try:
        while ends_s is None or time.monotonic() < ends_s:
            turn()
    except KeyboardInterrupt:
        return 0
    return 0


class AckingService(Service):
    """The vision service with an acknowledgement in place of each twist."""

    def __init__(self, config: VisionConfig, link: Link, report: LogLine) -> None:
        super().__init__(config, link, report)
        self._mission_channel = ScansOnly(config, link, self._detector, self._log_change, self._reject)
        self._mission_channel.log_notices()
        self._progress_printer = ProgressPrinter(report)

    def _publish(self, header: FrameHeader, answer: PipelineAnswer, compute_us: int) -> None:
        super()._publish(header, PipelineAnswer(None, answer.seen), compute_us)
        self._progress_printer.step(answer, time.monotonic())


class ScansOnly(MissionChannel):
    """Accepts no missions and publishes no reports, because this service does not drive the robot."""

    def prepare(self, pipeline: Pipeline, frame: FrameHeader, waited_us: int = 0) -> None:
        """Pass the newest scan to `pipeline`."""
        self._give_scan(pipeline, frame, waited_us)

    def report(self, *_given: object) -> None:
        """Log only the detector's notices."""
        self.log_notices()


class LocalRun:
    """Runs the pipeline on a local camera, as if its robot stood still."""

    def __init__(self, config: VisionConfig, camera: LocalCamera, report: LogLine) -> None:
        self._camera, self._report = camera, report
        self._patience_us = round(config.detector.deadline_s * 1e6)
        self._detector = configured_detector(config)
        self._pipeline = Pipeline(config, camera.model, self._detector)
        self._progress_printer = ProgressPrinter(report)
        self._log_notices()
        self._session = secrets.token_hex(4)
        self._seq = 0
        self._fault = ""

    def turn(self) -> None:
        """Process the next image. The loss of the camera is logged once. The next turn tries again."""
        try:
            picture = self._camera.read(_WAIT_S)
        except HardwareError as error:
            self._complain(str(error))
            time.sleep(_RETRY_S)
            return
        if picture is not None:
            self._complain("")
            self._seq += 1
            header = FrameHeader(session=self._session, seq=self._seq, t_us=picture.t_us)
            frame = Frame(header, picture.jpeg, monotonic_us() + self._patience_us)
            self._progress_printer.step(self._pipeline.step(frame), time.monotonic())
            self._log_notices()

    def _log_notices(self) -> None:
        for line in notices_of(self._detector):
            self._report(f"vision: detector: {line}")

    def _complain(self, fault: str) -> None:
        if fault != self._fault:
            self._report(f"camera: {fault or 'back'}")
        self._fault = fault


class ProgressPrinter:
    """Prints at most one line per half second, with the images per second since the last line."""

    def __init__(self, report: LogLine) -> None:
        self._report = report
        self._printed_s: float | None = None
        self._pictures = 0

    def step(self, answer: PipelineAnswer, now_s: float) -> None:
        """Count an image; print a line if it is time."""
        self._pictures += 1
        if self._printed_s is None:
            self._print(answer, "", now_s)
        elif now_s - self._printed_s >= _PRINT_EVERY_S:
            self._print(answer, f" ({self._pictures / (now_s - self._printed_s):.0f} images/s)", now_s)

    def _print(self, answer: PipelineAnswer, rate: str, now_s: float) -> None:
        self._report(f"{seen_text(answer.seen)}{_would_text(answer)}{rate}")
        self._printed_s, self._pictures = now_s, 0


def seen_text(seen: Observation) -> str:
    """Format one line for the operator: phase, bearing (left positive), distance."""
    if seen.bearing_rad is None or seen.distance_m is None:
        return f"{seen.phase}: {seen.note or 'no target'}"
    return f"{seen.phase}: bearing {seen.bearing_rad * _DEGREES:+.1f} degrees, distance {seen.distance_m:.2f} m"


def _would_text(answer: PipelineAnswer) -> str:
    twist = answer.twist
    if twist is None or answer.seen.bearing_rad is None:
        return ""
    return f"; would steer {twist.linear_mps:+.2f} m/s, {twist.angular_rad_s:+.2f} rad/s"
