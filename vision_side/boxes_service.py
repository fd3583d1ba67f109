"""The vision service without eyes of its own: it steers by boxes that somebody publishes. Shell.

Every frame is acknowledged at once, since nothing here looks at it; boxes are answered with a twist that cites the
frame in which they were found, however old that is by now: the robot judges. No boxes, no twist: the robot holds.
"""

import threading
import time
from collections import deque

from sightline.protocol.channels import DETECTIONS, FRAME, MAX_HEADER_BYTES
from sightline.protocol.errors import WireError
from sightline.protocol.messages import FrameHeader
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.boxes import REMEMBERED, BoxReader
from sightline.vision_side.pipeline import Observation, PipelineAnswer
from sightline.vision_side.service import LogLine, Service

_BOXES_SILENCE_S = 2.0
_NO_BOXES = Observation("no boxes")


class BoxesInbox(LatestSlot[Message]):
    """The newest frame and the newest boxes of one source; also the last frames' headers, which boxes may name."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self._source = source
        self._arrived = threading.Condition()
        self._newest: dict[str, Message] = {}
        self.headers: deque[bytes] = deque(maxlen=REMEMBERED)

    def put(self, item: Message) -> None:
        """Replace what is there of that channel; never blocks."""
        if item.channel is DETECTIONS and item.source != self._source:
            return
        with self._arrived:
            if item.channel is FRAME:
                self.headers.append(item.header)
            self.dropped += item.channel.name in self._newest
            self._newest[item.channel.name] = item
            self._arrived.notify()

    def take(self, timeout_s: float = 0.0) -> Message | None:
        """A frame, of which credit bounds the number, before boxes; None if neither comes within `timeout_s`."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest, timeout_s)
            return self._newest.pop(FRAME.name, None) or self._newest.pop(DETECTIONS.name, None)


class BoxesService(Service):
    """A `Service` whose detector is elsewhere."""

    def __init__(self, config: VisionConfig, link: Link, say: LogLine) -> None:
        self._inbox = BoxesInbox(config.boxes.source)
        self._reader = BoxReader(config.boxes)
        self._boxes_heard_s = time.monotonic()
        super().__init__(config, link, say)

    def _arrivals(self, link: Link) -> LatestSlot[Message]:
        for channel in (FRAME, DETECTIONS):
            link.subscribe(channel, self._inbox.put)
        return self._inbox

    def _frame(self, message: Message, started_ns: int) -> None:
        """A frame is acknowledged, boxes are answered."""
        if message.channel is DETECTIONS:
            self._boxes(message, started_ns)
            return
        header = self._decoded(FrameHeader, message.header, MAX_HEADER_BYTES)
        if header is None:
            return
        self._heard_s = time.monotonic()
        self._tell("link", f"frames from robot {self._config.robot}, session {header.session}")
        self._publish(header, PipelineAnswer(None, Observation("no picture", note="somebody else looks")), 0)
        self._viewing.keep(header, message.payload)
        if self._pipeline is None:
            self._wait_for_camera()
        elif time.monotonic() - self._boxes_heard_s > _BOXES_SILENCE_S:
            self._dispatch.after(time.monotonic(), self._pipeline, header, _NO_BOXES)
            self._tell("boxes", f"frames come, but no boxes from {self._config.boxes.source}; does its detector run?")

    def _boxes(self, message: Message, started_ns: int) -> None:
        self._remember_frames()
        self._boxes_heard_s = time.monotonic()
        if self._pipeline is None or self._camera is None:
            return
        try:
            frame, found = self._reader.read(message.header, message.payload, self._camera)
        except WireError as error:
            self.skipped[error.reason] += 1
            self._tell("boxes", f"boxes are refused: {error.detail}", f"refused {error.reason}")
            return
        self._tell("boxes", f"boxes from {self._config.boxes.source}")
        self._dispatch.before(self._pipeline, frame)
        answer = self._pipeline.follow(frame, found)
        if answer.twist is None:
            self.skipped["OUT_OF_ORDER"] += 1
            return
        self._publish(frame, answer, (time.perf_counter_ns() - started_ns) // 1000)
        self._tell_phase(answer)
        self._dispatch.after(time.monotonic(), self._pipeline, frame, answer.seen)
        self._viewing.show(frame, answer, self._pipeline.mission.name, self._camera, started_ns=started_ns)

    def _remember_frames(self) -> None:
        """Also those that newer ones replaced before they were taken up."""
        while self._inbox.headers:
            header = self._decoded(FrameHeader, self._inbox.headers.popleft(), MAX_HEADER_BYTES)
            if header is not None:
                self._reader.remember(header)
