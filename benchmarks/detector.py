"""Measure a remote detector, and services for many streams, with a deliberately slow detector. Shell."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import count
from math import inf
from pathlib import Path
from statistics import median
from typing import Annotated, Final

from pydantic import Field

from sightline.benchmarks.loop.counters import read_machine, resident_mb
from sightline.benchmarks.loop.pictures import write_pictures
from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.processes import Processes, terminated_like_interrupted
from sightline.protocol.channels import DETECTIONS, FRAME, STATUS
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import ConfigError, SightlineError, WireError
from sightline.protocol.messages import DetectionsHeader, FrameHeader, Stamp, State, Status
from sightline.protocol.transports.link import Link, LinkRules, Message
from sightline.protocol.transports.tokens import RobotToken
from sightline.protocol.transports.zenoh.link import ZenohLink, declare_token
from sightline.protocol.transports.zenoh.session import open_session
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.plugin_calls import checked_results
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Detector, Maker, result_of


class SlowDetector:
    """A detector with a chosen delay, for `--serve sightline.benchmarks.detector:SlowDetector`."""

    class Config(Settings):
        """Time per frame and per batch."""

        each_us: Annotated[int, Field(ge=0, le=1_000_000)] = 1_667
        """Time for one frame, in a batch or alone: 600 a second."""
        batch_us: Annotated[int, Field(ge=0, le=1_000_000)] = 0
        """Additional time for a batch, as on a GPU."""
        pixels: bool = False
        """True to decode each image first."""

    def __init__(self, config: Config) -> None:
        self._each_s, self._batch_s, self._pixels = config.each_us / 1e6, config.batch_us / 1e6, config.pixels
        self._found = (Detection(10, 10, 30, 30, 0.9, "thing"),)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """Return one box in each frame after the delay."""
        for frame in frames if self._pixels else ():
            frame.picture()
        time.sleep(self._batch_s + self._each_s * len(frames))
        return [result_of(frame, self._found, Maker("slow", device="cpu")) for frame in frames]


# The added cost of a remote detector, from frame to result, against the same one in this process. Shell (the clock).
#
# Both receive the same frames in turns, so that other load affects both. They run hot, one frame right after the other,
# and paced as a robot sends frames, with cold caches.


PACED_S: Final = 1 / 30
HOT_S: Final = 0.0
_WARM: Final = 30
_DEADLINE_US: Final = 500_000
_PRESENT_S: Final = 1.0
"""Time from one status of a robot to the next."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Medians for one answered frame, us. `unanswered` counts frames without a valid answer."""

    here_us: float | None
    there_us: float | None
    """None if no frame has an answer."""
    unanswered: int
    why: str = ""
    """Cause of the first missing answer, if known."""

    @property
    def added_us(self) -> float | None:
        """Return the additional time of the remote detector, us, or None if one of the two gives no answer."""
        return None if self.here_us is None or self.there_us is None else self.there_us - self.here_us


def measure_cost(here: Detector, there: Detector, jpeg: bytes, size_px: tuple[int, int], *, frames: int = 300,
                 period_s: float = HOT_S, robot: Link | None = None) -> Cost:
    """Send `frames` frames to both detectors. With `robot` they are also published, for a service that subscribes."""
    decoder, numbers, took = Decoder(*size_px, size_px[0] * size_px[1]), count(1), (list[float](), list[float]())
    unanswered, why = 0, ""
    next_s = status_s = time.monotonic()
    for index in range(_WARM + frames):
        if robot is not None and time.monotonic() >= status_s:
            publish_status(robot)
            status_s = time.monotonic() + _PRESENT_S
        next_s += period_s
        time.sleep(max(0.0, next_s - time.monotonic()))
        for which, one in enumerate((here, there)):
            frame = DetectFrame("r1", _header(next(numbers)), jpeg, decoder)
            us, result = _timed(one, frame, robot if which else None)
            if index < _WARM:
                continue
            if isinstance(result, str):
                unanswered, why = unanswered + 1, why or result
            else:
                took[which].append(us)
    here_us, there_us = (median(one) if one else None for one in took)
    return Cost(here_us, there_us, unanswered, why)


def publish_status(robot: Link, number: int = 1) -> None:
    """Publish the status of a robot, which counts as gone without one."""
    stamp = encode(Stamp(session="0000abcd", seq=number, t_us=monotonic_us()))
    robot.publish(STATUS, stamp, encode(Status(state=State.HOLD, reason="bench")))


def _timed(detector: Detector, frame: DetectFrame, robot: Link | None) -> tuple[float, DetectionResult | str]:
    began_ns = time.perf_counter_ns()
    if robot is not None:
        robot.publish(FRAME, encode(frame.header), frame.jpeg)
    (result,) = checked_results(detector, [frame], monotonic_us() + _DEADLINE_US)
    return (time.perf_counter_ns() - began_ns) / 1000, result


def _header(number: int) -> FrameHeader:
    return FrameHeader(session="0000abcd", seq=number, t_us=monotonic_us())


# Many streams at one or several detector services: rate, age, fairness, memory, repeated answers. Shell (processes, a
# clock).
#
# The services are real processes. The robots are links of this process, where all results arrive.


DEADLINE_MS: Final = 100.0
FAIRNESS_PERCENT: Final = 10.0
MEMORY_MB: Final = 5.0
OVERLOAD: Final = 2.0
ANSWERS_PER_FRAME: Final = 1.01
LONGEST_GAP_MS: Final = 250.0
LEAST_SHARE: Final = 0.75
"""Of the frames that the robots send."""
BATCH_P95_MS: Final = 60.0
"""Longer than two batches: a frame waits for the batch before its own."""
_FPS: Final = 30
_WARM_S: Final = 5.0
_STATUS_S: Final = 0.1
_READY_S: Final = 60.0
_REMEMBERED: Final = 64
"""Frames of a robot whose answers are counted; a second answer arrives within a deadline."""


@dataclass(frozen=True, slots=True)
class StreamPlan:
    """A run: robots with 30 frames per second each, and services that examine the same frames."""

    streams: int = 40
    seconds: float = 60.0
    services: int = 1
    batch_us: int = 0
    """The detector decodes and takes this time for a batch. With 0 it has time for half of the frames."""
    arguments: tuple[str, ...] = ()
    """Further arguments of each service."""
    kill: bool = False
    """True to kill the last service halfway through the run."""

    def __post_init__(self) -> None:
        """Raise ConfigError for a run without a service at its end."""
        if self.kill and self.services < 2:
            raise ConfigError("--kill needs a service that remains; add --services 2")

    def command(self, endpoint: str) -> list[str]:
        """Return the arguments of `sightline` for one service."""
        each_us = 0 if self.batch_us else round(OVERLOAD * 1e6 / (self.streams * _FPS))
        options = {"each_us": each_us, "batch_us": self.batch_us, "pixels": str(self.batch_us > 0).lower()}
        sets = [text for name, value in options.items() for text in ("--set", f"detector.options.{name}={value}")]
        serving = ["detector", "--serve", "sightline.benchmarks.detector:SlowDetector"]
        return [*serving, "--connect", endpoint, *sets, *self.arguments]


@dataclass
class Load:
    """The result of one run."""

    offered: int = 0
    answered: Counter[str] = field(default_factory=Counter)
    repeated: int = 0
    """Answers to frames that had an answer."""
    ages_ms: list[float] = field(default_factory=list)
    answered_us: dict[str, int] = field(default_factory=dict)
    """Time of the newest answer to a robot, initially the start of the run."""
    gap_us: int = 0
    """Longest time without an answer to a robot."""
    memory_mb: list[float] = field(default_factory=list)
    """Of the first service, once a second."""
    cpu_ms: float = 0.0
    """CPU time of all services for each answered frame, in the first half."""
    seconds: float = 0.0

    def begin(self, robots: Iterable[str], now_us: int) -> None:
        """Drop the earlier memory samples, and wait for the first answer to each robot."""
        self.memory_mb.clear()
        self.answered_us = dict.fromkeys(robots, now_us)

    def answer(self, robot: str, frame_us: int, now_us: int) -> None:
        """Count the first answer to a frame."""
        self._close_gap(robot, now_us)
        self.answered_us[robot] = now_us
        self.answered[robot] += 1
        self.ages_ms.append((now_us - frame_us) / 1000)

    def end(self, now_us: int) -> None:
        """Count the time since the newest answer to each robot."""
        for robot in self.answered_us:
            self._close_gap(robot, now_us)

    def _close_gap(self, robot: str, now_us: int) -> None:
        self.gap_us = max(self.gap_us, now_us - self.answered_us[robot])

    @property
    def p95_ms(self) -> float:
        """Return the 95th percentile from the publication of a frame to its boxes here, ms."""
        return sorted(self.ages_ms)[int(len(self.ages_ms) * 0.95)] if self.ages_ms else float("inf")

    @property
    def unfair_percent(self) -> float:
        """Return the largest deviation of a robot from the mean, in percent."""
        mean = sum(self.answered.values()) / len(self.answered) if self.answered else 0.0
        return max(abs(count - mean) for count in self.answered.values()) / mean * 100 if mean else 100.0

    @property
    def growth_mb(self) -> float:
        """Return the growth of the mean from the first half to the second, in MB."""
        half = len(self.memory_mb) // 2
        first, second = self.memory_mb[:half], self.memory_mb[half:]
        return sum(second) / len(second) - sum(first) / len(first) if first else float("inf")

    @property
    def overload(self) -> float:
        """Return the frames offered for each answered frame."""
        return self.offered / max(1, sum(self.answered.values()))

    @property
    def fps(self) -> float:
        """Return the frames answered per second, of all robots."""
        return sum(self.answered.values()) / self.seconds if self.seconds else 0.0

    @property
    def answers_per_frame(self) -> float:
        """Return the answers for each answered frame: 1 if no service repeats the work of another."""
        frames = sum(self.answered.values())
        return (frames + self.repeated) / frames if frames else float("inf")


def stream_checks(load: Load, plan: StreamPlan) -> list[Check]:
    """Check the result of a run: with a time per batch the rate, otherwise the overload."""
    checks = [
        at_most("furthest from an equal share", load.unfair_percent, "%", FAIRNESS_PERCENT),
        at_most("robots without an answer", plan.streams - len(load.answered), "", 0),
        at_most("memory of the service grew", load.growth_mb, "MB", MEMORY_MB),
    ]
    if plan.batch_us:
        checks += [
            at_least("answered per second", load.fps, "", LEAST_SHARE * _FPS * plan.streams),
            at_most("age of boxes, p95", load.p95_ms, "ms", BATCH_P95_MS + 2 * plan.batch_us / 1000),
            at_most("CPU time of the services for each answered frame", load.cpu_ms, "ms", inf),
        ]
    else:
        checks += [
            at_least("offered per answered frame, least", load.overload, "", 0.9 * OVERLOAD),
            at_most("offered per answered frame", load.overload, "", 1.2 * OVERLOAD),
            at_most("age of boxes, p95", load.p95_ms, "ms", DEADLINE_MS),
        ]
    return [
        *checks,
        at_most("answers per answered frame", load.answers_per_frame, "", ANSWERS_PER_FRAME),
        at_most("longest time without an answer", load.gap_us / 1000, "ms", LONGEST_GAP_MS),
    ]


class _Streams:
    """The robots of a run."""

    def __init__(self, links: list[ZenohLink], jpeg: bytes) -> None:
        self._links, self._jpeg, self.load = links, jpeg, Load()
        self._sent_us: dict[tuple[str, int], int] = {}
        """Send time of each frame of each robot. Answers may cite another time or no frame at all."""
        self._seq = 0
        self._published_s = 0.0
        self.counting = False
        for link in links:
            link.subscribe(DETECTIONS, self._on_answer(link.robot))

    def _on_answer(self, robot: str) -> Callable[[Message], None]:
        seen: deque[int] = deque(maxlen=_REMEMBERED)

        def note(message: Message) -> None:
            now_us = monotonic_us()
            try:
                echo = decode(DetectionsHeader, message.header).echo
            except WireError:
                return
            sent_us = self._sent_us.get((robot, echo.seq)) if echo is not None else None
            if echo is None or sent_us is None or not self.counting:
                return
            if echo.seq in seen:
                self.load.repeated += 1
                return
            seen.append(echo.seq)
            self.load.answer(robot, sent_us, now_us)

        return note

    def publish_status(self) -> None:
        """Publish the status of each robot once a second, and more often until the run begins."""
        if time.monotonic() - self._published_s < _STATUS_S:
            return
        self._published_s = time.monotonic() + _PRESENT_S - _STATUS_S if self.counting else time.monotonic()
        for link in self._links:
            publish_status(link, self._seq)

    def frame(self, index: int) -> None:
        self._seq += 1
        header = FrameHeader(session="0000abcd", seq=self._seq, t_us=monotonic_us())
        self._sent_us[self._links[index].robot, self._seq] = header.t_us
        self._links[index].publish(FRAME, encode(header), self._jpeg)
        self.load.offered += self.counting


def measure_streams(endpoint: str, folder: Path, plan: StreamPlan) -> Load:
    """Run the planned streams and services. Raises SightlineError if a service does not start or ends by itself."""
    write_pictures(folder, 320, 240)
    jpeg = sorted(folder.glob("*.jpg"))[0].read_bytes()
    with terminated_like_interrupted(), ExitStack() as ending:
        session = ending.enter_context(closing(open_session([endpoint], (), 5.0)))
        links = [ZenohLink(session, LinkRules(f"s{index}", "robot"), shared=True) for index in range(plan.streams)]
        for link in links:
            ending.callback(link.close)
            ending.callback(declare_token(session, RobotToken(link.robot)))  # services that share find it by this token
        services = ending.enter_context(Processes(folder))
        for index in range(plan.services):
            services.start(f"detector-{index}", plan.command(endpoint))
        robots = _Streams(links, jpeg)
        _wait_ready(robots, plan, services)
        _offer(robots, plan.streams, _WARM_S, services)
        robots.load.begin((link.robot for link in links), monotonic_us())
        robots.counting = True
        before_s = _cpu_s(services)
        began_s = time.monotonic()
        _offer(robots, plan.streams, plan.seconds / 2, services)
        took_s = _cpu_s(services) - before_s
        robots.load.cpu_ms = took_s * 1000 / max(1, sum(robots.load.answered.values()))
        if plan.kill:
            services.kill(services.names[-1])
        _offer(robots, plan.streams, plan.seconds / 2, services)
        robots.load.seconds = time.monotonic() - began_s
        robots.load.end(monotonic_us())
    return robots.load


def _cpu_s(services: Processes) -> float:
    """Return the CPU time of all services so far, s."""
    return sum(read_machine({name: services.pid(name) for name in services.names}).cpu_s.values())


def _receives(services: Processes, name: str) -> int:
    """Count the robots whose frames a service has received."""
    return services.log(name).read_text("utf-8", "replace").count("receives the frames")


def _wait_ready(robots: _Streams, plan: StreamPlan, services: Processes) -> None:
    """Wait until each service has started, and each robot's frames are received."""
    deadline_s = time.monotonic() + _READY_S
    while not (all(counts := [_receives(services, name) for name in services.names]) and sum(counts) >= plan.streams):
        if time.monotonic() > deadline_s:
            raise SightlineError(f"the detector services did not start: they receive the frames of {counts} robots")
        robots.publish_status()
        services.check(_STATUS_S)


def _offer(robots: _Streams, streams: int, seconds: float, services: Processes) -> None:
    """Publish the newest frame of each stream in turn, evenly spaced, as robots send them."""
    began_s = time.monotonic()
    for index in range(round(seconds * streams * _FPS)):
        due_s = began_s + index / (streams * _FPS)
        left_s = due_s - time.monotonic()
        if left_s > 0:
            time.sleep(left_s)
        if index % (streams * _FPS) == 0:
            services.check()
            robots.load.memory_mb.append(resident_mb(services.pid(services.names[0])))
        robots.publish_status()
        robots.frame(index % streams)
