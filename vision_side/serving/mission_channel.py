"""Mission requests, scans and reports of one robot. Shell (slots).

Times are the robot's: what was asked must cite a status not much older than the frame at hand, so that a message that
a network kept back does not start anything.
"""

import secrets
from collections.abc import Callable
from typing import Any, Final

from sightline.protocol.channels import MISSION, REPORT, SCAN
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError, RejectReason, WireError
from sightline.protocol.messages import (
    DetectionsHeader,
    Echo,
    FrameHeader,
    MissionReport,
    MissionRequest,
    RequestHeader,
    RequestId,
)
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.detect.plugin_calls import notices_of
from sightline.vision_side.detect.port import DetectionResult, Detector
from sightline.vision_side.detect.shadow import ShadowDetector
from sightline.vision_side.missions.ranges import decode_scan
from sightline.vision_side.missions.registry import MissionSpec, configured_mission, requested_mission
from sightline.vision_side.pipeline import SOURCE, Observation, Pipeline

MAX_AGE_US: Final = 2_000_000
"""As old as the status that a request to a robot may cite."""
_LONGEST: Final = 200


class MissionRequests:
    """Takes up what is asked for, each once. `asked` is the newest, `refused` why it was not taken up."""

    def __init__(self, config: VisionConfig) -> None:
        self._config = config
        self.asked: RequestId | None = None
        self.refused = ""

    def take(self, message: Message, frame: FrameHeader) -> MissionSpec | None:
        """What to do from `frame` on; None for what was said before and for what is refused.

        Raises WireError for what is no message of this channel; `refused` then says it too.
        """
        try:
            header = decode(RequestHeader, message.header)
            request = decode(MissionRequest, message.payload, MISSION.max_payload_bytes)
        except WireError as error:
            self.refused = str(error)[:_LONGEST]
            raise
        asked = RequestId(session=header.session, id=request.id)
        if asked == self.asked:
            return None
        self.asked, self.refused = asked, ""
        try:
            _check(header, message.source, frame)
            return requested_mission(request, self._config)
        except (WireError, ConfigError) as error:
            self.refused = " ".join(str(error).split())[:_LONGEST]
            return None


def _check(header: RequestHeader, source: str, frame: FrameHeader) -> None:
    """Raise WireError unless it is said by who may, of this session of the robot, and just now."""
    if header.source != source:
        raise WireError(RejectReason.UNKNOWN_SOURCE, "key and header disagree on the source")
    if source not in MISSION.said_by:
        raise WireError(RejectReason.UNKNOWN_SOURCE, f"{source} chooses no mission; {' and '.join(MISSION.said_by)} do")
    echo = header.echo
    if echo is None or echo.channel != "status":
        raise WireError(RejectReason.NOT_ALLOWED, "a mission cites the newest status of the robot")
    if echo.session != frame.session:
        raise WireError(RejectReason.OTHER_SESSION, f"it was asked of session {echo.session}, the robot is in "
                                               f"{frame.session}: say it again")
    age_us = frame.t_us - echo.t_us
    if age_us > MAX_AGE_US:
        raise WireError(RejectReason.STALE, f"it was asked {age_us / 1e6:.1f} s ago: say it again")


# What vision says of itself, and how often: twice a second, and at once when something changed. Pure.


PERIOD_S: Final = 0.5
LEAST_GAP_S: Final = 0.1
"""A target that comes and goes with every frame is no reason for more reports than this."""
_PHASE_LENGTH, _TEXT_LENGTH, _NAME_LENGTH, _DEVICE_LENGTH = 32, 200, 64, 32


class Reporter:
    """Makes the reports of one vision for one robot."""

    def __init__(self, detector: DetectorConfig) -> None:
        self._detector = detector.kind.partition(":")[0]  # until there is a result to say more
        self._device = "cpu" if detector.kind == "hsv" else ""
        self._said: tuple[object, ...] | None = None
        self._said_s = 0.0

    def due(
        self, now_s: float, mission: str, seen: Observation, asked: RequestId | None, refused: str, *,
        looked: DetectionResult | None = None, beside: str = "",
    ) -> MissionReport | None:
        """The report, if it is time for one. `looked` is the detector's newest result, `beside` who else looks."""
        state = (mission, seen.phase, seen.done, asked, refused)
        gap_s = LEAST_GAP_S if state != self._said else PERIOD_S
        if self._said is not None and now_s - self._said_s < gap_s:
            return None
        self._said, self._said_s = state, now_s
        return MissionReport(
            mission=mission[:_NAME_LENGTH], phase=_line(seen.phase, _PHASE_LENGTH),
            note=_line(seen.note, _TEXT_LENGTH), done=seen.done,
            asked=asked, refused=refused[:_TEXT_LENGTH], **self._detector_fields(looked, beside),
        )

    def _detector_fields(self, looked: DetectionResult | None, beside: str) -> dict[str, Any]:
        """Who looks, on what, how fast."""
        name = looked.detector if looked else self._detector
        more = f", {beside}" if beside else ""
        said = {"detector": _line(name[: _NAME_LENGTH - len(more)] + more, _NAME_LENGTH)}
        if looked is None:
            return {**said, "device": self._device}
        return {**said, "device": _line(looked.device, _DEVICE_LENGTH), "model": _line(looked.model_hash, _NAME_LENGTH),
                "inference_us": max(0, looked.compute_us)}


def _line(text: str, most: int) -> str:
    """Whatever a mission says, on one line and within the wire's bound."""
    return " ".join(text.split())[:most]


# What vision hears and says about missions on a link: requests, scans, reports. Shell (slots; the clock is given).


NO_FRAMES = Observation("no frames")
_ENDED = "the robot started anew, which ended it: say it again"


class MissionChannel:
    """One robot's missions. Scans are subscribed to only once a mission goes by them."""

    def __init__(
        self, config: VisionConfig, link: Link, tell: Callable[[str, str], None], refuse: Callable[[WireError], None]
    ) -> None:
        """`tell` prints a line (about what, the line) if it changed; `refuse` counts.

        Raises ConfigError for a configured mission that there is not.
        """
        self._link, self._tell, self._refuse = link, tell, refuse
        self._mission = configured_mission(config).name
        self._missions: LatestSlot[Message] = link.latest(MISSION)
        self._scans: LatestSlot[Message] | None = None
        self._desk = MissionRequests(config)
        self._reporter = Reporter(config.detector)
        self._session = secrets.token_hex(4)
        self._reports = 0

    def before(self, pipeline: Pipeline, frame: FrameHeader) -> None:
        """Give `pipeline` what it has to know before it answers `frame`."""
        message = self._missions.take()
        if message is not None:
            self._choose(message, pipeline, frame)
        if pipeline.mission.wants_scan:
            self._look(pipeline)

    def after(self, now_s: float, pipeline: Pipeline | None, frame: FrameHeader | None, seen: Observation) -> None:
        """Say what was done, if it is time; without a frame, that none comes."""
        if pipeline is not None:
            self._mission = pipeline.mission.name
        asked, refused = self._desk.asked, self._desk.refused
        if pipeline is not None and asked is not None and asked != pipeline.asked:
            refused = refused or _ENDED
        detector, looked = (pipeline.detector, pipeline.looked) if pipeline else (None, None)
        self.tell_news(detector)
        beside = ""
        if pipeline is not None and isinstance(detector, ShadowDetector):
            beside = detector.shadow_text(self._link.robot)
        report = self._reporter.due(now_s, self._mission, seen, asked, refused, looked=looked, beside=beside)
        if report is None:
            return
        self._reports += 1
        echo = None
        if frame is not None:
            echo = Echo(channel="frame", session=frame.session, seq=frame.seq, t_us=frame.t_us)
        header = DetectionsHeader(source=SOURCE, session=self._session, seq=self._reports, echo=echo)
        self._link.publish(REPORT, encode(header), encode(report), SOURCE)

    def tell_news(self, detector: Detector | None) -> None:
        """What the detector has to say."""
        for line in notices_of(detector):
            self._tell("detector", line)

    def _choose(self, message: Message, pipeline: Pipeline, frame: FrameHeader) -> None:
        try:
            chosen = self._desk.take(message, frame)
        except WireError as error:
            self._refuse(error)
            return
        if chosen is not None and self._desk.asked is not None:
            pipeline.meet(frame.session)
            pipeline.switch(chosen, self._desk.asked)
            self._tell("mission", f"mission {chosen.name}, asked for by {message.source}")
        elif self._desk.refused:
            self._tell("mission", f"a mission of {message.source} is refused: {self._desk.refused}")

    def _look(self, pipeline: Pipeline) -> None:
        if self._scans is None:
            self._scans = self._link.latest(SCAN)
        message = self._scans.take()
        if message is None:
            return
        try:
            pipeline.see_scan(*decode_scan(message.header, message.payload))
        except WireError as error:
            self._refuse(error)
            self._tell("scan", f"scans are refused: {error.detail}")
