"""Serves one detector to many robots: a fair queue of newest frames in, boxes out. Shell."""

import logging
import secrets
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import astuple, dataclass
from operator import add
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
    DetectionsHeader,
    Echo,
    FrameHeader,
)
from sightline.protocol.transports.link import FleetLink, LatestSlot, Link, Message
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.per_robot import DecoderPool
from sightline.vision_side.detect.plugin_calls import checked_results, maker_of, notices_of
from sightline.vision_side.detect.port import DetectFrame, DetectionResult, Detector, detections_payload
from sightline.vision_side.serving.process import ends_on_signal

_log: Final = logging.getLogger(__name__)

Item = TypeVar("Item")

_BATCH_SHARE: Final = 0.5
"""Share of a deadline for one batch: frames that arrive meanwhile must still have their own turn."""


@dataclass(frozen=True, slots=True)
class QueuedFrame(Generic[Item]):
    """One robot's newest frame, and when it came."""

    robot: str
    item: Item
    arrived_us: int


@dataclass(slots=True)
class FrameCounters:
    """Outcomes of one robot's frames; the numbers only grow."""

    offered: int = 0
    served: int = 0
    overtaken: int = 0
    """Replaced by a newer one before their turn."""
    stale: int = 0
    """Too old when their turn came."""
    late: int = 0
    """Detected, but not by their deadline: not published."""
    rejected: int = 0
    """Not a frame, not an image, or an invalid result."""

    def __add__(self, other: "FrameCounters") -> "FrameCounters":
        return FrameCounters(*map(add, astuple(self), astuple(other)))

    @property
    def dropped(self) -> int:
        """Return the number of frames without an answer."""
        return self.too_many + self.rejected

    @property
    def too_many(self) -> int:
        """Return the number of frames without an answer for lack of time. Rejected frames do not count as load."""
        return self.overtaken + self.stale + self.late


class FairQueue(Generic[Item]):
    """One place for each robot. The robot whose last turn is longest ago is next."""

    def __init__(self, max_batch: int, deadline_us: int) -> None:
        self._max_batch, self._deadline_us = max_batch, deadline_us
        self._waiting: OrderedDict[str, QueuedFrame[Item] | None] = OrderedDict()
        self.counters: dict[str, FrameCounters] = {}

    def offer(self, robot: str, item: Item, now_us: int) -> None:
        """Put the newest frame of `robot` in place of the one before."""
        counters = self.counters.setdefault(robot, FrameCounters())
        counters.offered += 1
        counters.overtaken += self._waiting.get(robot) is not None
        self._waiting[robot] = QueuedFrame(robot, item, now_us)

    def forget(self, robot: str) -> FrameCounters:
        """Forget a robot that has left. Returns the outcomes of its frames."""
        self._waiting.pop(robot, None)
        return self.counters.pop(robot, FrameCounters())

    def take(self, now_us: int, each_us: int = 0) -> list[QueuedFrame[Item]]:
        """Take waiting frames as one batch that fits in half a deadline if a frame takes `each_us`; may be empty."""
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
                self.counters[robot].stale += 1
                continue
            self._waiting.move_to_end(robot)
            batch.append(turn)
        return batch


# A detector for many robots: their newest frames in, boxes out, as one batch for whatever is waiting. Shell.
#
#     sightline detector --serve onnx:ball.onnx --device cuda --connect tcp/192.168.1.20:7447
#
# It drives nothing and returns no credit: boxes name the frame in which they were found, and a vision service that
# steers by them (`--detector zenoh`) answers that frame. `sightline robots` shows it and its health.


ROLE: Final = "detector"
_WAIT_S: Final = 0.2
_AGES: Final = 512
"""Ages kept for the percentile; some seconds of a busy service."""
_SMOOTHING: Final = 0.2
_LOAD_PERIOD_S: Final = 5.0
_MAX_REASONS: Final = 8
"""Reasons that are reported: a plug-in's may be another each time."""
_OVERLOAD: Final = 0.1
"""Share of unanswered frames, above which an overload is reported."""
LogLine = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ServingOptions:
    """Name and limits of the service."""

    name: str
    deadline_us: int = 100_000
    """From a frame's arrival to its boxes; later they are of no use, so they are not sent."""
    max_batch: int = 16
    max_pixels: int = 1920 * 1080


def run(config: VisionConfig, detector: Detector, options: ServingOptions) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code 0. Raises ConfigError, LinkError as `open_fleet` does."""
    from sightline.protocol.transports.flood_limits import limit_floods
    from sightline.protocol.transports.zenoh.link import open_fleet

    ending, services = threading.Event(), list[DetectorService]()
    with limit_floods(config.listen, lambda line: _log.info("detector: %s", line)):
        opened = open_fleet(
            config.robot, listen=config.listen, connect=config.connect, role=ROLE, secure=config.secure,
            max_frame_bytes=config.max_frame_bytes,
            about=lambda: services[0].about() if services else f"{options.name}: starts",
        )
        with opened as fleet_link, ends_on_signal(ending):
            services.append(DetectorService(fleet_link, detector, options, _log.info))
            where = ", ".join([*config.connect, *(f"{one} (listening)" for one in config.listen)])
            _log.info("detector: %s for robots %s at %s", options.name, config.robot, where)
            services[0].serve(ending)
    return 0


class DetectorService:
    """One detector, a place for the newest frame of each robot, and turns. Frames arrive on the link's threads."""

    def __init__(self, fleet_link: FleetLink, detector: Detector, options: ServingOptions, report: LogLine) -> None:
        self._fleet_link, self._detector, self._options, self._report = fleet_link, detector, options, report
        self._queue: FairQueue[Message] = FairQueue(options.max_batch, options.deadline_us)
        self._guard = threading.Lock()
        self._bell: LatestSlot[bool] = LatestSlot()
        self._links: dict[str, Link] = {}
        self._decoders = DecoderPool(options.max_pixels)
        self._session = secrets.token_hex(4)
        self._seq = 0
        self._each_us = 0.0
        self._ages_us: deque[int] = deque(maxlen=_AGES)
        maker = maker_of(detector)
        self._maker = (maker.model_hash[:8], maker.device) if maker else ("", "")
        self._load_checked_s = time.monotonic()
        self._load_before = (0, 0)
        self._overloaded = False
        self._gone = FrameCounters()
        """Of the robots that have left."""
        self._reasons: set[str] = set()
        fleet_link.on_new_robot(lambda: self._bell.put(True))

    def serve(self, ending: threading.Event) -> None:
        """Serve until `ending` is set."""
        while not ending.is_set():
            if not self.turn():
                self._bell.take(_WAIT_S)
            self._check_load(time.monotonic())
        self._report(f"detector: ended; {self.about()}")

    def turn(self) -> bool:
        """Report the detector's notices, add new robots, then detect in one batch; False if nothing waited."""
        for line in notices_of(self._detector):
            self._report(f"detector: {line}")
        present = self._fleet_link.robots()
        for robot in self._links.keys() - present:
            self._forget(robot)
        for robot in present:
            if robot not in self._links:
                self._add_robot(robot)
        with self._guard:
            batch = self._queue.take(monotonic_us(), int(self._each_us))
        if batch:
            self._detect(batch)
        return bool(batch)

    def counters(self) -> dict[str, FrameCounters]:
        """Outcomes of each robot's frames."""
        with self._guard:
            return dict(self._queue.counters)

    def about(self) -> str:
        """Return model, device and health in one line, for `sightline robots`."""
        served, dropped = self._totals()
        ages = sorted(self._ages_us.copy())
        age = f", p95 age {ages[int(len(ages) * 0.95)] / 1000:.0f} ms" if ages else ""
        model, device = self._maker
        what = self._options.name + (f" {model}" if model else "") + (f" on {device}" if device else "")
        state = "overloaded, " if self._overloaded else ""
        return f"{what}: {state}{len(self._links)} robots, {served} frames answered, {dropped} dropped{age}"

    def _totals(self) -> tuple[int, int]:
        counters = [*self.counters().values(), self._gone]
        return sum(one.served for one in counters), sum(one.dropped for one in counters)

    def _forget(self, robot: str) -> None:
        self._links.pop(robot).close()
        with self._guard:
            gone = self._queue.forget(robot)
        self._gone += gone
        self._report(f"detector: {robot} left")

    def _add_robot(self, robot: str) -> None:
        link = self._links[robot] = self._fleet_link.link(robot)

        def receive(message: Message) -> None:
            with self._guard:
                self._queue.offer(robot, message, monotonic_us())
            self._bell.put(True)

        link.subscribe(FRAME, receive)
        self._report(f"detector: receives the frames of {robot}")

    def _detect(self, batch: list[QueuedFrame[Message]]) -> None:
        began_us = monotonic_us()
        frames = [(turn, frame) for turn in batch if (frame := self._frame(turn)) is not None]
        if not frames:
            return
        deadline_us = min(turn.arrived_us for turn, _ in frames) + self._options.deadline_us
        results = checked_results(self._detector, [frame for _, frame in frames], deadline_us, monotonic_us)
        ended_us = monotonic_us()
        each_us = (ended_us - began_us) / len(frames)
        self._each_us += (each_us - self._each_us) * (_SMOOTHING if self._each_us else 1.0)
        for (turn, frame), result in zip(frames, results, strict=True):
            if isinstance(result, str):
                self._reject(turn, result, late=ended_us > deadline_us)
            else:
                self._answer(turn, frame, result, ended_us - began_us)

    def _frame(self, turn: QueuedFrame[Message]) -> DetectFrame | None:
        """Return the detector's input; None, counted, for an invalid frame."""
        jpeg = turn.item.payload
        try:
            header = decode(FrameHeader, turn.item.header)
            size = read_jpeg_size(jpeg, self._options.max_pixels)
        except WireError:
            self._counters(turn).rejected += 1
            return None
        sides = size.width_px, size.height_px
        if min(sides) < LEAST_SIDE_PX or max(sides) > MOST_SIDE_PX:  # the wire could not carry its boxes
            self._counters(turn).rejected += 1
            return None
        return self._decoders.frame(turn.robot, header, jpeg, sides)

    def _reject(self, turn: QueuedFrame[Message], why: str, late: bool = False) -> None:
        """Count it, and report each reason once, as far as there are few."""
        counters = self._counters(turn)
        counters.late, counters.rejected = counters.late + late, counters.rejected + (not late)
        if why not in self._reasons and len(self._reasons) < _MAX_REASONS:
            self._reasons.add(why)
            self._report(f"detector: {why}")

    def _answer(self, turn: QueuedFrame[Message], frame: DetectFrame, result: DetectionResult, took_us: int) -> None:
        counters, age_us = self._counters(turn), monotonic_us() - turn.arrived_us
        if age_us > self._options.deadline_us:
            counters.late += 1
            return
        try:
            payload = detections_payload(result)
        except ValueError as error:
            self._reject(turn, f"the result cannot be sent: {_first_line(error)}")
            return
        self._seq += 1
        stamp = _stamp(frame.header, self._session, self._seq, took_us)
        if link := self._links.get(turn.robot):  # it may have left
            link.publish(DETECTIONS, stamp, payload, ROLE)
        counters.served += 1
        self._ages_us.append(age_us)
        self._maker = (result.model_hash[:8], result.device)

    def _counters(self, turn: QueuedFrame[Message]) -> FrameCounters:
        return self._queue.counters[turn.robot]

    def _check_load(self, now_s: float) -> None:
        """Report an overload, and its end."""
        if now_s - self._load_checked_s < _LOAD_PERIOD_S:
            return
        counters, before = [*self.counters().values(), self._gone], self._load_before
        now = sum(one.served for one in counters), sum(one.too_many for one in counters)
        self._load_checked_s, self._load_before = now_s, now
        served, dropped = now[0] - before[0], now[1] - before[1]
        overloaded = dropped > _OVERLOAD * (served + dropped)
        if overloaded != self._overloaded:
            self._overloaded = overloaded
            self._report(f"detector: {'overloaded' if overloaded else 'no longer overloaded'}: {served} "
                      f"answered, {dropped} dropped in {_LOAD_PERIOD_S:.0f} s")


def _first_line(error: ValueError) -> str:
    """Return the first problem, with its field."""
    return first_problem(error) if isinstance(error, ValidationError) else str(error)


def _stamp(frame: FrameHeader, session: str, seq: int, compute_us: int) -> bytes:
    return encode(DetectionsHeader(source=ROLE, session=session, seq=seq, echo=Echo.of(frame), compute_us=compute_us))
