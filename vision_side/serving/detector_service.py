"""Serves one detector to many robots: their newest frames in, boxes out, waiting frames as one batch. Shell.

    sightline detector --serve onnx:ball.onnx --device cuda --connect tcp/192.168.1.20:7447

It sends no twists and returns no credit. The boxes name their frame. A vision service that steers by them
(`--detector zenoh`) answers that frame. `sightline robots` shows the detector service and its health.

The detector runs on the serving thread. Under load another thread takes and decodes the next batch meanwhile.
With `--share` several services divide the robots (`detector_sharing`).
"""

import logging
import os
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import blake2b
from typing import Final

import numpy as np
import simplejpeg
from pydantic import ValidationError

from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.config import first_problem
from sightline.protocol.errors import ConfigError, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import (
    LEAST_SIDE_PX,
    MOST_SIDE_PX,
    DetectionsHeader,
    Echo,
    FrameHeader,
)
from sightline.protocol.transports.link import FleetLink, LatestSlot, Link, Message
from sightline.protocol.transports.security import date_problem
from sightline.protocol.transports.tokens import DetectorToken, RobotToken, Token, parse_token
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.per_robot import DecoderPool
from sightline.vision_side.detect.plugin_calls import checked_results, maker_of, notices_of
from sightline.vision_side.detect.port import DetectFrame, DetectionResult, Detector, detections_payload
from sightline.vision_side.serving.detector_queue import BatchClock, FairQueue, FrameCounters, QueuedFrame
from sightline.vision_side.serving.detector_sharing import Assignment, Duty, RobotTokens
from sightline.vision_side.serving.process import ends_on_signal
from sightline.vision_side.serving.service import LIVE_S

_log: Final = logging.getLogger(__name__)

ROLE: Final = "detector"
_WAIT_S: Final = 0.2
_END_S: Final = 1.0
"""Longest wait for a detector at the end. The service does not wait longer for a detector that hangs."""
_MOST_DECODERS: Final = 4
"""Largest number of threads that decode a batch."""
_LOAD_PERIOD_S: Final = 5.0
_MAX_REASONS: Final = 8
"""Number of different reasons in the log. A plug-in may give a new text for each frame."""
_OVERLOAD: Final = 0.1
"""Share of unanswered frames above which an overload is reported."""
_LOOK_PERIOD_S, _LOOK_EACH_S = 0.02, 20e-6
"""Time between two updates of robots and services without a change, plus a time for each robot. An update takes 3 us
for each robot."""
_FOREIGN: Final = 10
"""Answers of a service that does not share, before they are reported. A service that joins may answer before its token
arrives."""
_JOIN_S: Final = 0.2
"""Wait for the tokens of the other services before the first robot is served."""
_WARM_UP_PX: Final = (320, 240)
_WARM_UP_US: Final = 60_000_000
LogLine = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ServingOptions:
    """Name and limits of the service."""

    name: str
    deadline_us: int = 100_000
    """Time from the arrival of a frame to its boxes. Later boxes are of no use and are not sent."""
    max_batch: int = 16
    max_pixels: int = 1920 * 1080
    weight: float | None = None
    """Weight of this service, if it shares the robots with other services of the same detector."""
    robots: str = "*"
    """Pattern of the robots that it shares."""


@dataclass(frozen=True, slots=True)
class ServiceHealth:
    """The current state of a service; `counters` are the sums over all robots so far."""

    robots: int
    services: int
    busy_ratio: float
    queue_p95_us: int
    answer_p95_us: int
    counters: FrameCounters


def run(
    config: VisionConfig, detector: Detector, options: ServingOptions,
    observe: "Callable[[DetectorService], None] | None" = None,
) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code 0. `observe` receives the service once it is ready.

    Raises ConfigError, LinkError as `open_fleet` does.
    """
    from sightline.protocol.transports.flood_limits import limit_floods
    from sightline.protocol.transports.zenoh.link import open_fleet

    ending, services = threading.Event(), list[DetectorService]()
    if problem := date_problem(config.secure, ROLE):
        _log.warning("detector: %s", problem)
    with limit_floods(config.listen, lambda line: _log.info("detector: %s", line)):
        opened = open_fleet(
            config.robot, listen=config.listen, connect=config.connect, role=ROLE, secure=config.secure,
            max_frame_bytes=config.max_frame_bytes, by_status=options.weight is None,
            about=lambda: services[0].about() if services else f"{options.name}: starts",
        )
        with opened as fleet_link, ends_on_signal(ending):
            services.append(DetectorService(fleet_link, detector, options, _log.info, bool(config.connect)))
            where = ", ".join([*config.connect, *(f"{one} (listening)" for one in config.listen)])
            _log.info("detector: %s for robots %s at %s", options.name, config.robot, where)
            if options.weight is None:
                services[0].warm_up()
            else:
                services[0].join(options.weight, options.robots)
            if observe is not None:
                observe(services[0])
            services[0].serve(ending)
    return 0


@dataclass(frozen=True, slots=True)
class _Batch:
    """Frames that are ready for the detector, the time when they were taken, and their earliest deadline."""

    frames: list[QueuedFrame[DetectFrame]]
    taken_us: int
    deadline_us: int = 0


class DetectorService:
    """One detector, a slot for the newest frame of each robot, and fair turns. Frames arrive on threads of the link."""

    def __init__(
        self, fleet_link: FleetLink, detector: Detector, options: ServingOptions, report: LogLine,
        needs_peer: bool = False,
    ) -> None:
        """Create the service. With `needs_peer` it is ready only with a session to a router or robot."""
        self._fleet_link, self._detector, self._options, self._report = fleet_link, detector, options, report
        self._needs_peer, self._is_warm, self._ending = needs_peer, False, threading.Event()
        self._session = secrets.token_hex(4)
        self._guard = threading.Lock()
        self._queue: FairQueue[Message] = FairQueue(options.max_batch, options.deadline_us)
        self._batch_clock = BatchClock(options.deadline_us, monotonic_us())
        self._bell: LatestSlot[bool] = LatestSlot()
        self._links: dict[str, Link] = {}
        self._sharing: _Sharing | None = None
        self._changed = threading.Event()
        """Set when robots or other services have changed."""
        self._pixels = _BatchDecoder(options.max_pixels)
        self._preparing = threading.Lock()
        self._prepared: _Batch | None = None
        """A batch that was decoded while the detector was busy."""
        self._ahead: LatestSlot[bool] = LatestSlot()
        """True requests the next batch while the detector is busy; False ends the thread."""
        self._detected = threading.Event()
        """Set while the detector is free."""
        self._failure: Exception | None = None
        self._seq = 0
        maker = maker_of(detector)
        self._maker = (maker.model_hash[:8], maker.device) if maker else ("", "")
        self._load_checked_s = time.monotonic()
        self._load_before = (0, 0)
        self._offered_before: Counter[str] = Counter()
        self._overloaded = False
        self._busy_ratio = 0.0
        self._duties: dict[str, Duty] = {}
        self._looked_s = time.monotonic()
        self._gone = FrameCounters()
        """Counters of the robots that have left."""
        self._reasons: set[str] = set()
        fleet_link.on_new_robot(self._on_change)

    def join(self, weight: float, robots: str) -> None:
        """Warm up the detector, then share the robots with the other services of the same model.

        Raises:
            ConfigError: other services would not accept the share.
        """
        self.warm_up()
        maker = maker_of(self._detector)
        what = maker.model_hash if maker is not None and maker.model_hash else self._options.name
        # A token has three decimals. All services must compute with the same weight.
        own = DetectorToken(blake2b(what.encode(), digest_size=4).hexdigest(), round(weight, 3), self._session, robots)
        if parse_token(own.key) != own:
            raise ConfigError(f"invalid share (weight {weight:g}, robots {robots!r}): expected a weight from 0.01 to "
                              "1000, and up to 32 letters, digits or '_.-*?'")
        self._sharing = _Sharing(own, self._options.deadline_us, self._fleet_link, self._report, self._on_change)

    def serve(self, ending: threading.Event) -> None:
        """Serve until `ending` is set."""
        self._ending = ending
        thread = threading.Thread(target=self._prepare_ahead, name="prepare", daemon=True)
        thread.start()
        try:
            while not ending.is_set() and self._failure is None:
                self._look_if_due(time.monotonic())
                if not self._serve_batch():
                    self._bell.take(_WAIT_S)
                self._check_load(time.monotonic())
        finally:
            self._ahead.put(False)
            if self._sharing is not None:
                self._sharing.leave()
            thread.join(_END_S)
            self._pixels.close()
        if self._failure is not None:
            raise self._failure
        self._report(f"detector: ended; {self.about()}")

    def counters(self) -> dict[str, FrameCounters]:
        """Outcomes of the frames of each robot."""
        with self._guard:
            return dict(self._queue.counters)

    def about(self) -> str:
        """Return model, device and health in one line, for `sightline robots`."""
        now = self.health()
        served, dropped = now.counters.served, now.counters.dropped
        age = f", p95 age {now.answer_p95_us / 1000:.0f} ms ({now.queue_p95_us / 1000:.0f} in the queue)"
        busy = f", {now.busy_ratio:.0%} busy"
        model, device = self._maker
        what = self._options.name + (f" {model}" if model else "") + (f" on {device}" if device else "")
        state = "overloaded, " if self._overloaded else ""
        shared = f" of {now.services} services" if self._sharing is not None else ""
        load = age + busy if served else ""
        return f"{what}: {state}{now.robots} robots{shared}, {served} frames answered, {dropped} dropped{load}"

    def health(self) -> ServiceHealth:
        """Return the current state, for a supervisor. Safe from any thread."""
        total = sum(self.counters().values(), self._gone)
        robots = list(self._duties.copy().values()).count(Duty.SERVE)
        services = self._sharing.services if self._sharing is not None else 1
        with self._guard:
            queue_us, answer_us = self._batch_clock.queue_p95_us(), self._batch_clock.answer_p95_us()
        return ServiceHealth(robots, services, self._busy_ratio, queue_us or 0, answer_us or 0, total)

    def is_live(self) -> bool:
        """Return True while the loop runs and the detector ends each batch."""
        with self._guard:
            busy_us = self._batch_clock.busy_us(monotonic_us())
        return busy_us < LIVE_S * 1e6 and time.monotonic() - self._looked_s <= LIVE_S

    def is_ready(self) -> bool:
        """Return True while frames are answered: detector and session are open, and the service does not end."""
        is_open = self._fleet_link.connected or not self._needs_peer
        return self._is_warm and is_open and not self._ending.is_set() and self.is_live()

    def _on_change(self) -> None:
        self._changed.set()
        self._bell.put(True)

    def _look_if_due(self, now_s: float) -> None:
        if self._changed.is_set() or now_s - self._looked_s >= _LOOK_PERIOD_S + _LOOK_EACH_S * len(self._duties):
            self._changed.clear()
            self._looked_s = now_s
            self._look_around()

    def _look_around(self) -> None:
        """Report the detector's notices, drop robots that left, add new ones, and change their duties."""
        for line in notices_of(self._detector):
            self._report(f"detector: {line}")
        if self._sharing is not None:
            self._sharing.update(monotonic_us())
        present = self._sharing.robots(monotonic_us()) if self._sharing is not None else self._fleet_link.robots()
        for robot in self._duties.keys() - present:
            self._forget(robot)
        for robot in present:
            duty = self._sharing.duty(robot, monotonic_us()) if self._sharing is not None else Duty.SERVE
            before = self._duties.get(robot, Duty.NOTHING)
            self._duties[robot] = duty
            if duty is not before:
                self._change_duty(robot, before, duty)

    def _forget(self, robot: str) -> None:
        if link := self._links.pop(robot, None):
            link.close()
        del self._duties[robot]
        with self._guard:
            self._gone += self._queue.forget(robot)
        if self._sharing is not None:
            self._sharing.forget(robot)
        self._report(f"detector: {robot} left")

    def _change_duty(self, robot: str, before: Duty, now: Duty) -> None:
        """Subscribe to the channels of the new duty, and unsubscribe from all others."""
        if now is Duty.NOTHING:
            self._links.pop(robot).close()
        elif robot not in self._links:
            self._links[robot] = self._fleet_link.link(robot)
            if self._sharing is not None:
                self._links[robot].subscribe(DETECTIONS, self._sharing.receiver(robot))
        had_frames, has_frames = (duty in (Duty.WATCH, Duty.SERVE) for duty in (before, now))
        if has_frames and not had_frames:
            self._links[robot].subscribe(FRAME, self._receiver(robot))
        elif had_frames and now is Duty.STAND_BY:
            self._links[robot].unsubscribe(FRAME)
        if now is Duty.SERVE:
            self._report(f"detector: receives the frames of {robot}")
        elif before is Duty.SERVE:
            self._report(f"detector: {robot} is served by another service")

    def _receiver(self, robot: str) -> Callable[[Message], None]:
        def receive(message: Message) -> None:
            now_us = monotonic_us()
            if self._sharing is not None and not self._sharing.serves(robot, now_us):
                return
            with self._guard:
                self._queue.offer(robot, message, now_us)
            self._bell.put(True)

        return receive

    def warm_up(self) -> None:
        """Detect in a gray image. The first detection takes seconds on some devices."""
        jpeg = simplejpeg.encode_jpeg(np.full((*reversed(_WARM_UP_PX), 3), 128, np.uint8))
        header = FrameHeader(session="00000000", seq=0, t_us=0)
        frame = self._pixels.frame("", header, jpeg, _WARM_UP_PX)
        checked_results(self._detector, [frame], monotonic_us() + _WARM_UP_US, monotonic_us)
        self._is_warm = True

    # --- batches: taken and decoded here or on another thread, then examined here ---

    def _serve_batch(self) -> bool:
        with self._preparing:
            batch, self._prepared = self._prepared or self._prepare(), None
        if batch is None:
            return False
        begun, is_more = self._begin(batch)
        if is_more:
            self._ahead.put(True)
        self._examine(begun)
        return True

    def _prepare_ahead(self) -> None:
        """Prepare each next batch just before the detector is free."""
        try:
            while self._ahead.take(threading.TIMEOUT_MAX):
                with self._guard:
                    wait_us = self._batch_clock.wait_us(monotonic_us())
                if self._detected.wait(wait_us / 1e6):
                    continue
                with self._preparing:
                    if self._prepared is None and not self._detected.is_set():
                        self._prepared = self._prepare()
        except Exception as error:
            self._failure = error
            self._bell.put(True)

    def _prepare(self) -> _Batch | None:
        """Take and decode the next batch. Returns None if no frame waits. Invalid images are counted."""
        taken_us = monotonic_us()
        with self._guard:
            turns = self._queue.take(taken_us, self._batch_clock.each_us)
        if not turns:
            return None
        self._pixels.next_batch()
        frames = [frame for turn in turns if (frame := self._frame(turn)) is not None]
        for broken in self._pixels.decode(frames):
            frames.remove(broken)
            self._count(broken.robot, "rejected")
        with self._guard:
            self._batch_clock.prepared(frames, taken_us, monotonic_us())
        return _Batch(frames, taken_us)

    def _frame(self, turn: QueuedFrame[Message]) -> QueuedFrame[DetectFrame] | None:
        """Return the input of the detector. Counts an invalid frame and returns None."""
        jpeg = turn.item.payload
        try:
            header = decode(FrameHeader, turn.item.header)
            size = read_jpeg_size(jpeg, self._options.max_pixels)
        except WireError:
            self._count(turn.robot, "rejected")
            return None
        sides = size.width_px, size.height_px
        if min(sides) < LEAST_SIDE_PX or max(sides) > MOST_SIDE_PX:  # the wire cannot carry boxes of this size
            self._count(turn.robot, "rejected")
            return None
        return QueuedFrame(turn.robot, self._pixels.frame(turn.robot, header, jpeg, sides), turn.arrived_us)

    def _begin(self, batch: _Batch) -> tuple[_Batch, bool]:
        """Begin a batch.

        Returns:
            The batch without the frames after their deadline, which are counted; and True if more frames wait.
        """
        with self._guard:
            fresh, deadline_us = self._batch_clock.begin(batch.frames, monotonic_us())
            is_more = len(batch.frames) > 1 or self._queue.waits
        if fresh:
            self._detected.clear()
        examined = {turn.robot for turn in fresh}
        for turn in batch.frames:
            if turn.robot not in examined:
                self._count(turn.robot, "stale")
        return _Batch(fresh, batch.taken_us, deadline_us), is_more

    def _examine(self, batch: _Batch) -> None:
        """Run the detector on a batch that has begun, and answer its frames."""
        if not batch.frames:
            return
        frames = [turn.item for turn in batch.frames]
        results = checked_results(self._detector, frames, batch.deadline_us, monotonic_us)
        ended_us = monotonic_us()
        with self._guard:
            self._batch_clock.end(len(frames), ended_us)
        self._detected.set()
        self._pixels.learn(batch.frames)
        for turn, result in zip(batch.frames, results, strict=True):
            if isinstance(result, str):
                self._reject(turn.robot, result, late=ended_us > batch.deadline_us)
            else:
                self._answer(turn, result, ended_us - batch.taken_us)

    def _reject(self, robot: str, why: str, late: bool = False) -> None:
        """Count a rejected frame, and report each new reason once, up to a limit."""
        self._count(robot, "late" if late else "rejected")
        if why not in self._reasons and len(self._reasons) < _MAX_REASONS:
            self._reasons.add(why)
            self._report(f"detector: {why}")

    def _answer(self, turn: QueuedFrame[DetectFrame], result: DetectionResult, took_us: int) -> None:
        age_us = monotonic_us() - turn.arrived_us
        if age_us > self._options.deadline_us:
            self._count(turn.robot, "late")
            return
        try:
            payload = detections_payload(result)
        except ValueError as error:
            self._reject(turn.robot, f"the result cannot be sent: {_first_line(error)}")
            return
        self._seq += 1
        stamp = _stamp(turn.item.header, self._session, self._seq, took_us)
        if link := self._links.get(turn.robot):  # the robot may have left
            link.publish(DETECTIONS, stamp, payload, ROLE)
        self._count(turn.robot, "served")
        with self._guard:
            self._batch_clock.answered(age_us)
        self._maker = (result.model_hash[:8], result.device)

    def _count(self, robot: str, outcome: str) -> None:
        """Count the outcome of a frame, also of a robot that has left meanwhile."""
        with self._guard:
            counters = self._queue.counters.get(robot, self._gone)
            setattr(counters, outcome, getattr(counters, outcome) + 1)

    def _check_load(self, now_s: float) -> None:
        """Report the begin and the end of an overload."""
        if now_s - self._load_checked_s < _LOAD_PERIOD_S:
            return
        robots, before = self.counters(), self._load_before
        offered = Counter({robot: one.offered for robot, one in robots.items()})
        most = (offered - self._offered_before).most_common(1)
        self._offered_before = offered
        counters = [*robots.values(), self._gone]
        now = sum(one.served for one in counters), sum(one.too_many for one in counters)
        self._load_checked_s, self._load_before = now_s, now
        with self._guard:
            self._busy_ratio = self._batch_clock.busy_ratio(monotonic_us())
        served, dropped = now[0] - before[0], now[1] - before[1]
        overloaded = dropped > _OVERLOAD * (served + dropped)
        if overloaded != self._overloaded:
            self._overloaded = overloaded
            sender = "".join(f", most frames from {robot} ({count})" for robot, count in most)
            self._report(f"detector: {'overloaded' if overloaded else 'no longer overloaded'}: {served} "
                         f"answered, {dropped} dropped in {_LOAD_PERIOD_S:.0f} s{sender}")


class _Sharing:
    """The duties of this service among services that share robots. Tokens and answers arrive on threads of the link."""

    def __init__(
        self, own: DetectorToken, deadline_us: int, fleet_link: FleetLink, report: LogLine,
        on_change: Callable[[], None],
    ) -> None:
        """Watch the other services, and show that this one is ready. Each change calls `on_change`."""
        self._own, self._fleet_link, self._report, self._on_change = own, fleet_link, report, on_change
        self._guard = threading.Lock()
        self._assignment = Assignment(own, deadline_us)
        self._foreign = 0
        """Number of answers of services that do not share."""
        fleet_link.watch_detectors(own.group, self._note)
        self._end_recall: Callable[[], None] = lambda: None
        self._watch_robots(RobotTokens(own.robots))
        time.sleep(_JOIN_S)
        self.leave = fleet_link.declare_token(own)

    def _note(self, token: DetectorToken, is_present: bool) -> None:
        with self._guard:
            self._assignment.on_token(token, is_present)
        self._on_change()

    def _note_recalled(self, token: DetectorToken, is_present: bool) -> None:
        with self._guard:
            if is_present:
                self._assignment.on_recalled(token)
        self._on_change()

    def _watch_robots(self, robots: RobotTokens) -> None:
        """Pass robot tokens to `robots` from now on, also those that are present."""

        def note(token: Token, is_present: bool) -> None:
            if isinstance(token, RobotToken):
                with self._guard:
                    robots.on_token(token.robot, is_present, monotonic_us())
                self._on_change()

        self._robots = robots
        self._end_robots = self._fleet_link.watch_tokens(note)

    def robots(self, now_us: int) -> list[str]:
        """Return the present robots."""
        with self._guard:
            present, needs_tokens = self._robots.present(now_us), self._robots.needs_tokens(now_us)
        if needs_tokens:
            self._end_robots()
            self._watch_robots(RobotTokens(self._own.robots, present, now_us))
        return present

    @property
    def services(self) -> int:
        """Return the number of services that share."""
        return self._assignment.services

    def update(self, now_us: int) -> None:
        """Use the tokens so far. Watch them again if there is room."""
        with self._guard:
            needs_tokens = self._assignment.needs_tokens(now_us)
            was_shared, is_other = self._assignment.is_shared, self._assignment.update(now_us)
            is_shared, count = self._assignment.is_shared, self._assignment.services
        if needs_tokens:
            self._end_recall()
            self._end_recall = self._fleet_link.watch_detectors(self._own.group, self._note_recalled)
        if is_shared and is_other:
            self._report(f"detector: {count} services share the robots")
        elif was_shared and not is_shared:
            self._report("detector: more services than sharing supports; this one serves every robot until some end")

    def duty(self, robot: str, now_us: int) -> Duty:
        """Return the current duty of this service for a robot."""
        with self._guard:
            return self._assignment.duty(robot, now_us)

    def serves(self, robot: str, now_us: int) -> bool:
        """Note a frame. Returns True if this service answers it."""
        with self._guard:
            return self._assignment.on_frame(robot, now_us)

    def receiver(self, robot: str) -> Callable[[Message], None]:
        """Return the callback for answers of other services to a robot's frames."""

        def receive(message: Message) -> None:
            try:
                service = decode(DetectionsHeader, message.header).session
            except WireError:
                return
            if message.source != ROLE or service == self._own.session:
                return
            with self._guard:
                is_sharing = self._assignment.on_answer(robot, service, monotonic_us())
            if not is_sharing:
                self._note_foreign(robot)

        return receive

    def forget(self, robot: str) -> None:
        """Forget a robot that has left."""
        with self._guard:
            self._assignment.forget(robot)

    def _note_foreign(self, robot: str) -> None:
        self._foreign += 1
        if self._foreign == _FOREIGN:
            self._report(f"detector: another service also detects for {robot}; start it with --share and the same "
                         "detector")


class _BatchDecoder:
    """Decodes the images of a batch on several threads, if the detector uses pixels.

    The pixels of a batch stay valid while the next batch is decoded.
    """

    def __init__(self, max_pixels: int) -> None:
        self._pools = (DecoderPool(max_pixels), DecoderPool(max_pixels))
        self._now = 0
        self._wanted = False
        self._threads = min(_MOST_DECODERS, os.cpu_count() or 1)
        self._executor = ThreadPoolExecutor(self._threads, "decode")

    def next_batch(self) -> None:
        """Reuse the pixels of the batch before the last one."""
        self._now = 1 - self._now

    def frame(self, robot: str, header: FrameHeader, jpeg: bytes, size_px: tuple[int, int]) -> DetectFrame:
        """Return a frame of this batch, not yet decoded."""
        frame = self._pools[self._now].frame(robot, header, jpeg, size_px)
        frame.looks_once = True
        return frame

    def decode(self, frames: Sequence[QueuedFrame[DetectFrame]]) -> list[QueuedFrame[DetectFrame]]:
        """Decode all frames. Returns the frames whose image is invalid."""
        if not self._wanted or not frames:
            return []
        own, *others = (frames[index :: self._threads] for index in range(self._threads))
        waiting = [self._executor.submit(_broken, part) for part in others if part]
        return _broken(own) + [one for part in waiting for one in part.result()]

    def learn(self, frames: Sequence[QueuedFrame[DetectFrame]]) -> None:
        """Note if the detector used the pixels of these frames."""
        self._wanted = self._wanted or any(turn.item.decoded is not None for turn in frames)

    def close(self) -> None:
        """End the threads."""
        self._executor.shutdown(wait=False)


def _broken(frames: Sequence[QueuedFrame[DetectFrame]]) -> list[QueuedFrame[DetectFrame]]:
    """Decode frames on this thread. Returns the frames whose image is invalid."""
    broken = []
    for turn in frames:
        try:
            turn.item.picture()
        except WireError:
            broken.append(turn)
    return broken


def _first_line(error: ValueError) -> str:
    """Return the first problem, with its field."""
    return first_problem(error) if isinstance(error, ValidationError) else str(error)


def _stamp(frame: FrameHeader, session: str, seq: int, compute_us: int) -> bytes:
    return encode(DetectionsHeader(source=ROLE, session=session, seq=seq, echo=Echo.of(frame), compute_us=compute_us))
