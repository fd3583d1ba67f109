"""Serves one detector to many robots: their newest frames in, boxes out, as one batch for whatever waits. Shell.

    sightline detector --serve onnx:ball.onnx --device cuda --connect tcp/192.168.1.20:7447

It drives nothing and returns no credit: boxes name the frame in which they were found, and a vision service that
steers by them (`--detector zenoh`) answers that frame. `sightline robots` shows it and its health.

One thread takes batches and decodes them, with others, while another thread detects in the batch before.
"""

import logging
import os
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

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
from sightline.vision_side.serving.detector_queue import BatchClock, FairQueue, FrameCounters, QueuedFrame
from sightline.vision_side.serving.process import ends_on_signal

_log: Final = logging.getLogger(__name__)

ROLE: Final = "detector"
_WAIT_S: Final = 0.2
_END_S: Final = 1.0
"""Longest wait for a detector at the end; one that hangs is left behind."""
_MOST_DECODERS: Final = 4
"""Threads that decode a batch, at most."""
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


@dataclass(frozen=True, slots=True)
class _Batch:
    """Frames that are ready for the detector, and when they were taken."""

    frames: list[QueuedFrame[DetectFrame]]
    taken_us: int


class DetectorService:
    """One detector, a place for the newest frame of each robot, and turns. Frames arrive on the link's threads."""

    def __init__(self, fleet_link: FleetLink, detector: Detector, options: ServingOptions, report: LogLine) -> None:
        self._fleet_link, self._detector, self._options, self._report = fleet_link, detector, options, report
        self._guard = threading.Lock()
        self._queue: FairQueue[Message] = FairQueue(options.max_batch, options.deadline_us)
        self._batch_clock = BatchClock(options.deadline_us, monotonic_us())
        self._bell: LatestSlot[bool] = LatestSlot()
        self._links: dict[str, Link] = {}
        self._pixels = _BatchDecoder(options.max_pixels)
        self._prepared: LatestSlot[_Batch | None] = LatestSlot()
        self._place = threading.Semaphore(1)
        """Free while no prepared batch waits for the detector."""
        self._detected = threading.Event()
        self._failure: Exception | None = None
        self._session = secrets.token_hex(4)
        self._seq = 0
        maker = maker_of(detector)
        self._maker = (maker.model_hash[:8], maker.device) if maker else ("", "")
        self._load_checked_s = time.monotonic()
        self._load_before = (0, 0)
        self._overloaded = False
        self._busy_ratio: float | None = None
        self._gone = FrameCounters()
        """Of the robots that have left."""
        self._reasons: set[str] = set()
        fleet_link.on_new_robot(lambda: self._bell.put(True))

    def serve(self, ending: threading.Event) -> None:
        """Serve until `ending` is set."""
        thread = threading.Thread(target=self._detect_prepared, name="detect", daemon=True)
        thread.start()
        while not ending.is_set() and self._failure is None:
            self._look_around()
            if not self._hand_over():
                self._bell.take(_WAIT_S)
            self._check_load(time.monotonic())
        self._prepared.put(None)
        thread.join(_END_S)
        self._pixels.close()
        if self._failure is not None:
            raise self._failure
        self._report(f"detector: ended; {self.about()}")

    def turn(self) -> bool:
        """Serve one batch in this thread; False if nothing waited."""
        self._look_around()
        batch = self._prepare()
        if batch is not None:
            self._detect(batch)
        return batch is not None

    def counters(self) -> dict[str, FrameCounters]:
        """Outcomes of each robot's frames."""
        with self._guard:
            return dict(self._queue.counters)

    def about(self) -> str:
        """Return model, device and health in one line, for `sightline robots`."""
        served, dropped = self._totals()
        with self._guard:
            age_us, queue_us = self._batch_clock.answer_p95_us(), self._batch_clock.queue_p95_us()
        age = f", p95 age {age_us / 1000:.0f} ms" if age_us is not None else ""
        age += f" ({queue_us / 1000:.0f} in the queue)" if age and queue_us is not None else ""
        busy = f", {self._busy_ratio:.0%} busy" if self._busy_ratio is not None else ""
        model, device = self._maker
        what = self._options.name + (f" {model}" if model else "") + (f" on {device}" if device else "")
        state = "overloaded, " if self._overloaded else ""
        return f"{what}: {state}{len(self._links)} robots, {served} frames answered, {dropped} dropped{age}{busy}"

    def _totals(self) -> tuple[int, int]:
        counters = [*self.counters().values(), self._gone]
        return sum(one.served for one in counters), sum(one.dropped for one in counters)

    def _look_around(self) -> None:
        """Report the detector's notices, drop robots that left, and add new ones."""
        for line in notices_of(self._detector):
            self._report(f"detector: {line}")
        present = self._fleet_link.robots()
        for robot in self._links.keys() - present:
            self._forget(robot)
        for robot in present:
            if robot not in self._links:
                self._add_robot(robot)

    def _forget(self, robot: str) -> None:
        self._links.pop(robot).close()
        with self._guard:
            self._gone += self._queue.forget(robot)
        self._report(f"detector: {robot} left")

    def _add_robot(self, robot: str) -> None:
        link = self._links[robot] = self._fleet_link.link(robot)

        def receive(message: Message) -> None:
            with self._guard:
                self._queue.offer(robot, message, monotonic_us())
            self._bell.put(True)

        link.subscribe(FRAME, receive)
        self._report(f"detector: receives the frames of {robot}")

    # --- batches: taken and decoded on one thread, detected on another ---

    def _hand_over(self) -> bool:
        """Prepare the next batch just in time for the detector. Returns False if no frame waits."""
        if not self._place.acquire(timeout=_WAIT_S):
            return True
        with self._guard:
            wait_us = self._batch_clock.wait_us(monotonic_us())
        if wait_us:
            self._detected.wait(wait_us / 1e6)
        batch = self._prepare()
        if batch is None or not batch.frames:
            self._place.release()
        else:
            self._prepared.put(batch)
        return batch is not None

    def _prepare(self) -> _Batch | None:
        """Take and decode the next batch; None if no frame waits. Frames without an image are counted."""
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
        """Return the detector's input; None, counted, for an invalid frame."""
        jpeg = turn.item.payload
        try:
            header = decode(FrameHeader, turn.item.header)
            size = read_jpeg_size(jpeg, self._options.max_pixels)
        except WireError:
            self._count(turn.robot, "rejected")
            return None
        sides = size.width_px, size.height_px
        if min(sides) < LEAST_SIDE_PX or max(sides) > MOST_SIDE_PX:  # the wire could not carry its boxes
            self._count(turn.robot, "rejected")
            return None
        return QueuedFrame(turn.robot, self._pixels.frame(turn.robot, header, jpeg, sides), turn.arrived_us)

    def _detect_prepared(self) -> None:
        """Detect in one prepared batch after the other, until None comes."""
        try:
            while (batch := self._next_prepared()) is not None:
                self._detect(batch)
        except Exception as error:
            self._failure = error
            self._bell.put(True)

    def _next_prepared(self) -> _Batch | None:
        batch = self._prepared.take(threading.TIMEOUT_MAX)
        self._detected.clear()
        self._place.release()
        return batch

    def _detect(self, batch: _Batch) -> None:
        with self._guard:
            fresh, deadline_us = self._batch_clock.begin(batch.frames, monotonic_us())
        examined = {turn.robot for turn in fresh}
        for turn in batch.frames:
            if turn.robot not in examined:
                self._count(turn.robot, "stale")
        if not fresh:
            return
        results = checked_results(self._detector, [turn.item for turn in fresh], deadline_us, monotonic_us)
        ended_us = monotonic_us()
        with self._guard:
            self._batch_clock.end(len(fresh), ended_us)
        self._detected.set()
        self._pixels.learn(fresh)
        for turn, result in zip(fresh, results, strict=True):
            if isinstance(result, str):
                self._reject(turn.robot, result, late=ended_us > deadline_us)
            else:
                self._answer(turn, result, ended_us - batch.taken_us)

    def _reject(self, robot: str, why: str, late: bool = False) -> None:
        """Count it, and report each reason once, as far as there are few."""
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
        if link := self._links.get(turn.robot):  # it may have left
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
        """Report an overload, and its end."""
        if now_s - self._load_checked_s < _LOAD_PERIOD_S:
            return
        counters, before = [*self.counters().values(), self._gone], self._load_before
        now = sum(one.served for one in counters), sum(one.too_many for one in counters)
        self._load_checked_s, self._load_before = now_s, now
        with self._guard:
            self._busy_ratio = self._batch_clock.busy_ratio(monotonic_us())
        served, dropped = now[0] - before[0], now[1] - before[1]
        overloaded = dropped > _OVERLOAD * (served + dropped)
        if overloaded != self._overloaded:
            self._overloaded = overloaded
            self._report(f"detector: {'overloaded' if overloaded else 'no longer overloaded'}: {served} "
                      f"answered, {dropped} dropped in {_LOAD_PERIOD_S:.0f} s")


class _BatchDecoder:
    """Decodes the images of a batch on several threads, once the detector has shown that it uses pixels.

    The pixels of a batch stay valid while the next one is decoded.
    """

    def __init__(self, max_pixels: int) -> None:
        self._pools = (DecoderPool(max_pixels), DecoderPool(max_pixels))
        self._now = 0
        self._wanted = False
        self._threads = min(_MOST_DECODERS, os.cpu_count() or 1)
        self._executor = ThreadPoolExecutor(self._threads, "decode")

    def next_batch(self) -> None:
        """Use the pixels of the batch before the last one again."""
        self._now = 1 - self._now

    def frame(self, robot: str, header: FrameHeader, jpeg: bytes, size_px: tuple[int, int]) -> DetectFrame:
        """Return a frame of this batch, not decoded yet."""
        return self._pools[self._now].frame(robot, header, jpeg, size_px)

    def decode(self, frames: Sequence[QueuedFrame[DetectFrame]]) -> list[QueuedFrame[DetectFrame]]:
        """Decode all. Returns those whose image does not decode."""
        if not self._wanted or not frames:
            return []
        own, *others = (frames[index :: self._threads] for index in range(self._threads))
        waiting = [self._executor.submit(_broken, part) for part in others if part]
        return _broken(own) + [one for part in waiting for one in part.result()]

    def learn(self, frames: Sequence[QueuedFrame[DetectFrame]]) -> None:
        """Note whether the detector uses the pixels of these frames."""
        self._wanted = self._wanted or any(turn.item.decoded is not None for turn in frames)

    def close(self) -> None:
        """End the threads."""
        self._executor.shutdown(wait=False)


def _broken(frames: Sequence[QueuedFrame[DetectFrame]]) -> list[QueuedFrame[DetectFrame]]:
    """Decode frames on this thread. Returns those that do not decode."""
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
