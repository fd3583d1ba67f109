"""Serves one detector to many robots: a fair queue of newest frames in, boxes out. Shell."""

import logging
import secrets
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from pydantic import ValidationError

from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.config import first_problem
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import (
    LEAST_SIDE_PX,
    MOST_SIDE_PX,
    DetectedBox,
    DetectedCircle,
    Detections,
    DetectionsHeader,
    Echo,
    FrameHeader,
)
from sightline.protocol.transports.link import FleetLink, LatestSlot, Link, Message
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.per_robot import DecoderPool
from sightline.vision_side.detect.plugin_calls import checked_results, maker_of, notices_of
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Detector
from sightline.vision_side.serving.process import ends_on_signal

_log: Final = logging.getLogger(__name__)

Item = TypeVar("Item")

_BATCH_SHARE: Final = 0.5
"""Of a deadline, for one batch: what arrives while it is looked at must still have its own turn."""


@dataclass(frozen=True, slots=True)
class QueuedFrame(Generic[Item]):
    """One robot's newest frame, and when it came."""

    robot: str
    item: Item
    arrived_us: int


@dataclass(slots=True)
class FrameCounters:
    """What became of one robot's frames; the numbers only grow."""

    offered: int = 0
    served: int = 0
    overtaken: int = 0
    """A newer one took its place before its turn."""
    stale: int = 0
    """Not worth looking at any more when its turn came."""
    late: int = 0
    """Looked at, but not by its deadline: nobody was told."""
    refused: int = 0
    """No frame, or no picture."""

    @property
    def dropped(self) -> int:
        """All that was not answered."""
        return self.too_many + self.refused

    @property
    def too_many(self) -> int:
        """What was not answered for want of time; what is refused says nothing of the load."""
        return self.overtaken + self.stale + self.late


class FairQueue(Generic[Item]):
    """One place for each robot. Whoever waits for the longest time since its last turn is next."""

    def __init__(self, max_batch: int, deadline_us: int) -> None:
        self._max_batch, self._deadline_us = max_batch, deadline_us
        self._waiting: OrderedDict[str, QueuedFrame[Item] | None] = OrderedDict()
        self.tallies: dict[str, FrameCounters] = {}

    def offer(self, robot: str, item: Item, now_us: int) -> None:
        """The newest frame of `robot`, in place of the one before."""
        tally = self.tallies.setdefault(robot, FrameCounters())
        tally.offered += 1
        tally.overtaken += self._waiting.get(robot) is not None
        self._waiting[robot] = QueuedFrame(robot, item, now_us)

    def take(self, now_us: int, each_us: int = 0) -> list[QueuedFrame[Item]]:
        """What waits, as one batch that fits in half a deadline if a frame takes `each_us`; empty if nothing waits."""
        most, share_us = self._max_batch, int(self._deadline_us * _BATCH_SHARE)
        if each_us > 0:
            most = max(1, min(most, share_us // each_us))
        # One slow frame (a device that warms up) must not rule out all later ones: nothing would be measured again.
        each_us = min(each_us, share_us)
        batch: list[QueuedFrame[Item]] = []
        for robot in [name for name, turn in self._waiting.items() if turn is not None]:
            if len(batch) == most:
                break
            turn = self._waiting[robot]
            self._waiting[robot] = None
            if turn is None or now_us - turn.arrived_us + each_us > self._deadline_us:
                self.tallies[robot].stale += 1
                continue
            self._waiting.move_to_end(robot)
            batch.append(turn)
        return batch


# A detector for many robots: their newest frames in, boxes out, as one batch for whatever is waiting. Shell.
# sightline detector --serve onnx:ball.onnx --device cuda --connect tcp/192.168.1.20:7447  It drives nothing and
# returns no credit: boxes name the frame in which they were found, and a vision that steers by them (`--detector
# zenoh`) answers that frame. What it is and how it fares is told to whoever asks (`sightline robots`).


ROLE: Final = "detector"
_WAIT_S: Final = 0.2
_AGES: Final = 512
"""Ages kept for the percentile; some seconds of a busy service."""
_SMOOTHING: Final = 0.2
_LOOK_AT_LOAD_S: Final = 5.0
_MOST_WHYS: Final = 8
"""Reasons that are told: a plug-in's may be another each time."""
_OVERLOAD: Final = 0.1
"""Share of frames that go unanswered, from which on it is said that there are too many."""
LogLine = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ServingOptions:
    """How it serves."""

    name: str
    deadline_us: int = 100_000
    """From a frame's arrival to its boxes; later they are of no use, so they are not sent."""
    max_batch: int = 16
    max_pixels: int = 1920 * 1080


def run(config: VisionConfig, detector: Detector, serving: ServingOptions) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code 0. Raises ConfigError, LinkError as `open_fleet` does."""
    from sightline.protocol.transports.zenoh.link import open_fleet
    from sightline.protocol.transports.zenoh.session import report_floods

    ending, services = threading.Event(), list[DetectorService]()
    with report_floods(config.listen, lambda line: _log.info("detector: %s", line)):
        opened = open_fleet(
            config.robot, listen=config.listen, connect=config.connect, role=ROLE, secure=config.secure,
            max_frame_bytes=config.max_frame_bytes,
            about=lambda: services[0].about() if services else f"{serving.name}: starts",
        )
        with opened as fleet_link, ends_on_signal(ending):
            services.append(DetectorService(fleet_link, detector, serving, _log.info))
            where = ", ".join([*config.connect, *(f"{one} (listening)" for one in config.listen)])
            _log.info("detector: %s for robots %s at %s", serving.name, config.robot, where)
            services[0].serve(ending)
    return 0


class DetectorService:
    """One detector, a place for the newest frame of each robot, and turns. Frames arrive on the link's threads."""

    def __init__(self, fleet_link: FleetLink, detector: Detector, serving: ServingOptions, say: LogLine) -> None:
        self._fleet_link, self._detector, self._serving, self._say = fleet_link, detector, serving, say
        self._turns: FairQueue[Message] = FairQueue(serving.max_batch, serving.deadline_us)
        self._guard = threading.Lock()
        self._bell: LatestSlot[bool] = LatestSlot()
        self._links: dict[str, Link] = {}
        self._decoders = DecoderPool(serving.max_pixels)
        self._session = secrets.token_hex(4)
        self._said = 0
        self._each_us = 0.0
        self._ages_us: deque[int] = deque(maxlen=_AGES)
        maker = maker_of(detector)
        self._maker = (maker.model_hash[:8], maker.device) if maker else ("", "")
        self._looked_at_load_s = time.monotonic()
        self._load_before = (0, 0)
        self._overloaded = False
        self._whys: set[str] = set()
        fleet_link.on_new_robot(lambda: self._bell.put(True))

    def serve(self, ending: threading.Event) -> None:
        """Until `ending` is set."""
        while not ending.is_set():
            if not self.turn():
                self._bell.take(_WAIT_S)
            self._look_at_load(time.monotonic())
        self._say(f"detector: ended; {self.about()}")

    def turn(self) -> bool:
        """Tell the detector's news, welcome who is new, then look at one batch; False if nothing waited."""
        for line in notices_of(self._detector):
            self._say(f"detector: {line}")
        for robot in self._fleet_link.robots():
            if robot not in self._links:
                self._welcome(robot)
        with self._guard:
            batch = self._turns.take(monotonic_us(), int(self._each_us))
        if batch:
            self._look(batch)
        return bool(batch)

    def tallies(self) -> dict[str, FrameCounters]:
        """What became of each robot's frames."""
        with self._guard:
            return dict(self._turns.tallies)

    def about(self) -> str:
        """Model, device and health in one line, for whoever asks."""
        served, dropped = self._totals()
        ages = sorted(self._ages_us.copy())
        age = f", p95 age {ages[int(len(ages) * 0.95)] / 1000:.0f} ms" if ages else ""
        model, device = self._maker
        what = self._serving.name + (f" {model}" if model else "") + (f" on {device}" if device else "")
        state = "overloaded, " if self._overloaded else ""
        return f"{what}: {state}{len(self._links)} robots, {served} frames answered, {dropped} dropped{age}"

    def _totals(self) -> tuple[int, int]:
        tallies = self.tallies().values()
        return sum(one.served for one in tallies), sum(one.dropped for one in tallies)

    def _welcome(self, robot: str) -> None:
        link = self._links[robot] = self._fleet_link.link(robot)

        def heard(message: Message) -> None:
            with self._guard:
                self._turns.offer(robot, message, monotonic_us())
            self._bell.put(True)

        link.subscribe(FRAME, heard)
        self._say(f"detector: looks at the pictures of {robot}")

    def _look(self, batch: list[QueuedFrame[Message]]) -> None:
        began_us = monotonic_us()
        frames = [(turn, frame) for turn in batch if (frame := self._frame(turn)) is not None]
        if not frames:
            return
        deadline_us = min(turn.arrived_us for turn, _ in frames) + self._serving.deadline_us
        results = checked_results(self._detector, [frame for _, frame in frames], deadline_us, monotonic_us)
        ended_us = monotonic_us()
        each_us = (ended_us - began_us) / len(frames)
        self._each_us += (each_us - self._each_us) * (_SMOOTHING if self._each_us else 1.0)
        for (turn, frame), result in zip(frames, results, strict=True):
            if isinstance(result, str):
                self._refuse(turn, result, late=ended_us > deadline_us)
            else:
                self._answer(turn, frame, result, ended_us - began_us)

    def _frame(self, turn: QueuedFrame[Message]) -> DetectFrame | None:
        """What the detector is given; None, counted, for what is no frame."""
        jpeg = turn.item.payload
        try:
            header = decode(FrameHeader, turn.item.header)
            size = read_jpeg_size(jpeg, self._serving.max_pixels)
        except WireError:
            self._tally(turn).refused += 1
            return None
        sides = size.width_px, size.height_px
        if min(sides) < LEAST_SIDE_PX or max(sides) > MOST_SIDE_PX:  # whose boxes the wire could not say
            self._tally(turn).refused += 1
            return None
        return self._decoders.frame(turn.robot, header, jpeg, sides)

    def _refuse(self, turn: QueuedFrame[Message], why: str, late: bool = False) -> None:
        """Count it. Each reason is told once, as far as there are few; the rest is in the tallies."""
        tally = self._tally(turn)
        tally.late, tally.refused = tally.late + late, tally.refused + (not late)
        if why not in self._whys and len(self._whys) < _MOST_WHYS:
            self._whys.add(why)
            self._say(f"detector: {why}")

    def _answer(self, turn: QueuedFrame[Message], frame: DetectFrame, result: DetectionResult, took_us: int) -> None:
        tally, age_us = self._tally(turn), monotonic_us() - turn.arrived_us
        if age_us > self._serving.deadline_us:
            tally.late += 1
            return
        try:
            payload = _payload(result)
        except ValueError as error:
            self._refuse(turn, f"what the detector says cannot be sent: {_first_line(error)}")
            return
        self._said += 1
        stamp = _stamp(frame.header, self._session, self._said, took_us)
        self._links[turn.robot].publish(DETECTIONS, stamp, payload, ROLE)
        tally.served += 1
        self._ages_us.append(age_us)
        self._maker = (result.model_hash[:8], result.device)

    def _tally(self, turn: QueuedFrame[Message]) -> FrameCounters:
        return self._turns.tallies[turn.robot]

    def _look_at_load(self, now_s: float) -> None:
        """Say so when more comes than it can look at, and when that is over."""
        if now_s - self._looked_at_load_s < _LOOK_AT_LOAD_S:
            return
        tallies, before = self.tallies().values(), self._load_before
        now = sum(one.served for one in tallies), sum(one.too_many for one in tallies)
        self._looked_at_load_s, self._load_before = now_s, now
        served, dropped = now[0] - before[0], now[1] - before[1]
        overloaded = dropped > _OVERLOAD * (served + dropped)
        if overloaded != self._overloaded:
            self._overloaded = overloaded
            self._say(f"detector: {'more frames than it can look at' if overloaded else 'keeps up again'}: {served} "
                      f"answered, {dropped} dropped in {_LOOK_AT_LOAD_S:.0f} s")


def _payload(result: DetectionResult) -> bytes:
    """The boxes as the wire has them, the best first; the last are left out where all are too long for it.

    Raises ValueError for a plug-in's that cannot be said.
    """
    boxes = tuple(_box(one) for one in result.detections)
    said = Detections(width_px=result.width_px, height_px=result.height_px, boxes=boxes, detector=result.detector,
                      device=result.device, model=result.model_hash)
    while len(payload := encode(said)) > DETECTIONS.max_payload_bytes:
        said = said.model_copy(update={"boxes": said.boxes[:-1]})
    return payload


def _first_line(error: ValueError) -> str:
    """What is wrong with which field."""
    return first_problem(error) if isinstance(error, ValidationError) else str(error)


def _box(one: Detection) -> DetectedBox:
    circle = one.circle
    ring = DetectedCircle(cx_px=circle.cx_px, cy_px=circle.cy_px, radius_px=circle.radius_px) if circle else None
    return DetectedBox(label=one.label, score=one.score, x1_px=one.x1_px, y1_px=one.y1_px, x2_px=one.x2_px,
                       y2_px=one.y2_px, circle=ring, track=one.track_id)


def _stamp(frame: FrameHeader, session: str, seq: int, compute_us: int) -> bytes:
    echo = Echo(channel="frame", session=frame.session, seq=frame.seq, t_us=frame.t_us)
    return encode(DetectionsHeader(source=ROLE, session=session, seq=seq, echo=echo, compute_us=compute_us))
