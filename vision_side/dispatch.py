"""What vision hears and says about missions on a link: requests, scans, reports. Shell (slots; the clock is given)."""

import secrets
from collections.abc import Callable

from sightline.protocol.channels import MISSION, REPORT, SCAN
from sightline.protocol.codec import encode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import DetectionsHeader, Echo, FrameHeader, RequestId
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.vision_side.serving.mission_channel import DetectorSwap, MissionRequests
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.around import notices_of
from sightline.vision_side.detect.port import Detector
from sightline.vision_side.detect.shadow import ShadowDetector
from sightline.vision_side.detect.timing import TimedDetector
from sightline.vision_side.missions.registry import configured_mission
from sightline.vision_side.pipeline import SOURCE, Observation, Pipeline
from sightline.vision_side.reporting import Reporter
from sightline.vision_side.missions.ranges import decode_scan

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
        self._swapped: RequestId | None = None

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
        if pipeline is not None and asked is not None and asked not in (pipeline.asked, self._swapped):
            refused = refused or _ENDED
        eyes, looked = (pipeline.eyes, pipeline.looked) if pipeline else (None, None)
        self.tell_news(eyes)
        beside = ""
        if pipeline is not None and isinstance(eyes, ShadowDetector):
            eyes.go_by(self._link.robot, pipeline.mission.goes_by)
            beside = eyes.shadow_text(self._link.robot)
        plain = pipeline.detector if pipeline else None
        took_us = plain.took_us if isinstance(plain, TimedDetector) else None
        report = self._reporter.due(now_s, self._mission, seen, asked, refused, looked=looked, beside=beside,
                                    took_us=took_us)
        if report is None:
            return
        self._reports += 1
        echo = None
        if frame is not None:
            echo = Echo(channel="frame", session=frame.session, seq=frame.seq, t_us=frame.t_us)
        header = DetectionsHeader(source=SOURCE, session=self._session, seq=self._reports, echo=echo)
        self._link.publish(REPORT, encode(header), encode(report), SOURCE)

    def tell_news(self, eyes: Detector | None) -> None:
        """What the detector has to say."""
        for line in notices_of(eyes):
            self._tell("detector", line)

    def _choose(self, message: Message, pipeline: Pipeline, frame: FrameHeader) -> None:
        try:
            chosen = self._desk.take(message, frame)
        except WireError as error:
            self._refuse(error)
            return
        if isinstance(chosen, DetectorSwap):
            self._swap(chosen, pipeline.eyes, message.source)
        elif chosen is not None and self._desk.asked is not None:
            pipeline.meet(frame.session)
            pipeline.switch(chosen, self._desk.asked)
            self._tell("mission", f"mission {chosen.name}, asked for by {message.source}")
        elif self._desk.refused:
            self._tell("mission", f"a mission of {message.source} is refused: {self._desk.refused}")

    def _swap(self, swap: DetectorSwap, eyes: Detector | None, source: str) -> None:
        """Let the other detector drive."""
        self._swapped = self._desk.asked
        refused = "no detector looks on; start vision with --shadow NAME"
        if isinstance(eyes, ShadowDetector):
            refused = eyes.promote(self._link.robot, swap.shadow)
        self._desk.refused = refused
        who = "the shadow drives" if swap.shadow else "the shadow looks on"
        self._tell("swap", f"{source}: {refused or who}")

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
