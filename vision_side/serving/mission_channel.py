"""Mission requests, scans and reports of one robot. Shell (slots).

Times are those of the robot. A request must cite a status that is not much older than the current frame. So a message
that a network delayed starts nothing.
"""

import secrets
from collections.abc import Callable, Sequence
from typing import Any, Final

from pydantic import ValidationError

from sightline.protocol.channels import MISSION, REPORT, SCAN
from sightline.protocol.clock import AHEAD_US
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError, RejectReason, WireError
from sightline.protocol.log import faults
from sightline.protocol.messages import (
    CameraModel,
    DetectionsHeader,
    Echo,
    FrameHeader,
    MissionReport,
    MissionRequest,
    ReportedTarget,
    RequestHeader,
    RequestId,
)
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.detect.plugin_calls import labels_of, notices_of
from sightline.vision_side.detect.port import DetectionResult, Detector
from sightline.vision_side.detect.registry import check_mission_label
from sightline.vision_side.detect.shadow import ShadowDetector
from sightline.vision_side.missions.ranges import decode_scan
from sightline.vision_side.missions.registry import MissionSpec, configured_mission, requested_mission
from sightline.vision_side.pipeline import SOURCE, Observation, Pipeline, PipelineAnswer

MAX_AGE_US: Final = 2_000_000
"""Largest age of the cited status, as for a request to a robot."""
_LONGEST: Final = 200


class MissionRequests:
    """Applies each request once. `newest` is the last request, `rejection` the reason why it was not applied."""

    def __init__(self, config: VisionConfig, labels: Sequence[str] = ()) -> None:
        """Reject missions with a label that is not among the `labels` of the detector, if it lists any."""
        self._config, self._labels = config, labels
        self.newest: RequestId | None = None
        self.rejection = ""

    def take(self, message: Message, frame: FrameHeader, waited_us: int) -> MissionSpec | None:
        """Return the mission from `frame` on, or None for a repeated or rejected request.

        `waited_us` is the delay of the frame.

        Raises WireError for an invalid message; `rejection` then contains it too.
        """
        try:
            header = decode(RequestHeader, message.header)
            request = decode(MissionRequest, message.payload, MISSION.max_payload_bytes)
        except WireError as error:
            self.rejection = str(error)[:_LONGEST]
            raise
        request_id = RequestId(digest=header.digest, id=request.id)
        if request_id == self.newest:
            return None
        self.newest, self.rejection = request_id, ""
        try:
            _check(header, message.source, frame, waited_us)
            mission = requested_mission(request, self._config)
            check_mission_label(mission, self._config.detector.kind, self._labels)
            return mission
        except (WireError, ConfigError) as error:
            self.rejection = " ".join(str(error).split())[:_LONGEST]
            return None


def _check(header: RequestHeader, source: str, frame: FrameHeader, waited_us: int) -> None:
    """Raise WireError unless the source is permitted, the session is current and the status is recent."""
    if header.source != source:
        raise WireError(RejectReason.UNKNOWN_SOURCE, "key and header disagree on the source")
    if source not in MISSION.published_by:
        permitted = " and ".join(MISSION.published_by)
        raise WireError(RejectReason.UNKNOWN_SOURCE, f"{source} chooses no mission; {permitted} do")
    echo = header.echo
    if echo is None or echo.channel != "status":
        raise WireError(RejectReason.NOT_ALLOWED, "a mission cites the newest status of the robot")
    if echo.session != frame.session:
        raise WireError(RejectReason.OTHER_SESSION, f"requested in session {echo.session}, the robot is in "
                                               f"{frame.session}; repeat the request")
    age_us = frame.t_us - echo.t_us
    if age_us < -AHEAD_US - waited_us:  # while a frame waits for a slow detector, newer statuses arrive
        raise WireError(RejectReason.FROM_FUTURE,
                        f"cites a status {-age_us / 1e6:.1f} s newer than the newest frame here; repeat the request")
    if age_us > MAX_AGE_US:
        raise WireError(RejectReason.STALE, f"requested {age_us / 1e6:.1f} s ago; repeat the request")


# The mission reports and their rate: twice a second, ten times with a target, and immediately after a change. Pure.


PERIOD_S: Final = 0.5
LEAST_GAP_S: Final = 0.1
"""Shortest time between two reports, even if the target appears and disappears with every frame."""
_LEFT_OUT: Final = ("note", "target", "refused", "faults")
"""Fields that a report loses, one after the other, until the wire can carry it: a letter may take four bytes."""
_PHASE_LENGTH, _TEXT_LENGTH, _NAME_LENGTH, _DEVICE_LENGTH = 32, 200, 64, 32


def reported_target(seen: Observation, camera: CameraModel | None) -> ReportedTarget | None:
    """Return the target of a step for a report, or None without a target or if the wire cannot carry it."""
    one = seen.target
    if one is None or camera is None:
        return None
    circle = one.circle
    center_px = (circle.cx_px, circle.cy_px) if circle else one.center_px
    try:
        return ReportedTarget(
            label=one.label, score=one.score, track=seen.track, bearing_rad=seen.bearing_rad,
            distance_m=seen.distance_m, cx_px=center_px[0], cy_px=center_px[1],
            radius_px=circle.radius_px if circle else None, width_px=camera.width_px, height_px=camera.height_px,
        )
    except ValidationError:  # from a plug-in
        return None


class Reporter:
    """Creates the reports of one vision service for one robot."""

    def __init__(self, detector: DetectorConfig) -> None:
        self._detector = detector.kind.partition(":")[0]  # until the first result names the detector
        self._device = "cpu" if detector.kind == "hsv" else ""
        self._reported: tuple[object, ...] | None = None
        self._reported_s = 0.0

    def due(
        self, now_s: float, mission: str, seen: Observation, newest: RequestId | None, rejection: str, *,
        result: DetectionResult | None = None, beside: str = "", camera: CameraModel | None = None,
    ) -> MissionReport | None:
        """Return a report if one is due.

        `result` is the newest result of the detector, `beside` describes the shadow detector. `camera` is the model of
        the image of `seen`.
        """
        state = (mission, seen.phase, seen.done, newest, rejection)
        gap_s = LEAST_GAP_S if state != self._reported or seen.target is not None else PERIOD_S
        if self._reported is not None and now_s - self._reported_s < gap_s:
            return None
        self._reported, self._reported_s = state, now_s
        report = MissionReport(
            mission=mission[:_NAME_LENGTH], phase=_line(seen.phase, _PHASE_LENGTH),
            note=_line(seen.note, _TEXT_LENGTH), done=seen.done,
            asked=newest, refused=rejection[:_TEXT_LENGTH], faults=dict(faults()),
            target=reported_target(seen, camera),
            **self._detector_fields(result, beside),
        )
        for name in _LEFT_OUT:
            if len(encode(report)) <= REPORT.max_payload_bytes:
                break
            report = report.model_copy(update={name: MissionReport.model_fields[name].default})
        return report

    def _detector_fields(self, result: DetectionResult | None, beside: str) -> dict[str, Any]:
        """Return the detector, its device and its time."""
        name = result.detector if result else self._detector
        more = f", {beside}" if beside else ""
        fields = {"detector": _line(name[: _NAME_LENGTH - len(more)] + more, _NAME_LENGTH)}
        if result is None:
            return {**fields, "device": self._device}
        return {**fields, "device": _line(result.device, _DEVICE_LENGTH),
                "model": _line(result.model_hash, _NAME_LENGTH), "inference_us": max(0, result.compute_us)}


def _line(text: str, most: int) -> str:
    """Format the text of a mission on one line within the limit of the wire."""
    return " ".join(text.split())[:most]


# Mission requests, scans and reports on a link. Shell (slots; the clock is an argument).


NO_FRAMES = Observation("no frames")
_ENDED = "a new session of the robot ended it; repeat the request"


class MissionChannel:
    """The missions of one robot. It subscribes to scans only for a mission that uses them."""

    def __init__(
        self, config: VisionConfig, link: Link, detector: Detector, log_change: Callable[[str, str], None],
        reject: Callable[[WireError], None],
    ) -> None:
        """Create the channel. `log_change(subject, line)` prints a changed line, `reject` counts.

        Raises ConfigError for an unknown configured mission.
        """
        self._link, self._detector, self._log_change, self._reject = link, detector, log_change, reject
        self._mission = configured_mission(config).name
        self._result: DetectionResult | None = None
        self._missions: LatestSlot[Message] = link.latest(MISSION)
        self._scans: LatestSlot[Message] | None = None
        self._requests = MissionRequests(config, labels_of(detector))
        self._reporter = Reporter(config.detector)
        self._session = secrets.token_hex(4)
        self._reports = 0

    def prepare(self, pipeline: Pipeline, frame: FrameHeader, waited_us: int = 0) -> None:
        """Pass a requested mission and the newest scan to `pipeline` before it answers `frame`.

        Args:
            pipeline: the pipeline of the robot.
            frame: header of the frame, or of a status.
            waited_us: delay of the frame on the network and here. Later messages may be newer by this time.
        """
        message = self._missions.take()
        if message is not None:
            self._apply(message, pipeline, frame, waited_us)
        self._give_scan(pipeline, frame, waited_us)

    def report(
        self, now_s: float, answer: PipelineAnswer, frame: FrameHeader | None, camera: CameraModel | None = None
    ) -> None:
        """Publish the report of an answer, if it is time. `frame` is None if no frame comes, `camera` is its model."""
        self._result = answer.result or self._result
        newest, rejection = self._requests.newest, self._requests.rejection
        if answer.mission and newest not in (None, answer.request):
            rejection = rejection or _ENDED
        self.log_notices()
        shadow = self._detector.shadow_text(self._link.robot) if isinstance(self._detector, ShadowDetector) else ""
        report = self._reporter.due(now_s, answer.mission or self._mission, answer.seen, newest, rejection,
                                    result=self._result, beside=shadow, camera=camera)
        if report is None:
            return
        self._reports += 1
        echo = None if frame is None else Echo.of(frame)
        header = DetectionsHeader(source=SOURCE, session=self._session, seq=self._reports, echo=echo)
        self._link.publish(REPORT, encode(header), encode(report), SOURCE)

    def log_notices(self) -> None:
        """Log the notices of the detector."""
        for line in notices_of(self._detector):
            self._log_change("detector", f"detector: {line}")

    def _apply(self, message: Message, pipeline: Pipeline, frame: FrameHeader, waited_us: int) -> None:
        try:
            chosen = self._requests.take(message, frame, waited_us)
        except WireError as error:
            self._reject(error)
            return
        if chosen is not None and self._requests.newest is not None:
            pipeline.switch(chosen, self._requests.newest, frame.session)
            self._log_change("mission", f"mission {chosen.name}, requested by {message.source}")
        elif self._requests.rejection:
            self._log_change("mission", f"rejected a mission of {message.source}: {self._requests.rejection}")

    def _give_scan(self, pipeline: Pipeline, frame: FrameHeader, waited_us: int) -> None:
        if not pipeline.mission.wants_scan:
            return
        if self._scans is None:
            self._scans = self._link.latest(SCAN)
        message = self._scans.take()
        if message is None:
            return
        try:
            stamp, scan = decode_scan(message.header, message.payload)
            if stamp.session == frame.session and stamp.t_us > frame.t_us + AHEAD_US + waited_us:
                raise WireError(RejectReason.FROM_FUTURE, "the time of the scan is ahead of the frames")
            pipeline.put_scan(stamp, scan)
        except WireError as error:
            self._reject(error)
            self._log_change("scan", f"rejected scans: {error.detail}")
