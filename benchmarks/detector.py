"""Measure a remote detector, and one service for many streams, with a deliberately slow detector. Shell."""

import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from statistics import median
from typing import Annotated, Final

from pydantic import Field

from sightline.benchmarks.loop.pictures import write_pictures
from sightline.protocol.channels import DETECTIONS, FRAME, STATUS
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import SightlineError, WireError
from sightline.protocol.messages import DetectionsHeader, FrameHeader, Stamp, State, Status
from sightline.protocol.transports.link import Link, LinkRules, Message
from sightline.protocol.transports.zenoh.link import ZenohLink
from sightline.protocol.transports.zenoh.session import open_session
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Detector, Maker, result_of


class SlowDetector:
    """`--serve sightline.benchmarks.detector:SlowDetector`."""

    class Config(Settings):
        """Time per frame."""

        each_us: Annotated[int, Field(ge=0, le=1_000_000)] = 1_667
        """The time that one frame takes, in a batch or alone: 600 a second."""

    def __init__(self, config: Config) -> None:
        self._each_s = config.each_us / 1e6
        self._found = (Detection(10, 10, 30, 30, 0.9, "thing"),)

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """Return an empty result after the delay, without the pixels."""
        time.sleep(self._each_s * len(frames))
        return [result_of(frame, self._found, Maker("slow", device="cpu")) for frame in frames]


# The cost of a remote detector against the same one in this process: time from frame to result. Shell (the clock).
#
# Both receive the same frames in turns, so that other load on the machine affects both: hot, one frame after the other,
# and paced as a robot sends them, with cold caches.


PACED_S: Final = 1 / 30
HOT_S: Final = 0.0
_WARM: Final = 30
_DEADLINE_US: Final = 500_000


@dataclass(frozen=True, slots=True)
class Cost:
    """Microseconds for one frame, medians; `unanswered` counts frames without a remote answer."""

    here_us: float
    there_us: float
    unanswered: int

    @property
    def added_us(self) -> float:
        """Return the additional time of the remote detector, us."""
        return self.there_us - self.here_us


def measure_cost(here: Detector, there: Detector, jpeg: bytes, size_px: tuple[int, int], *, frames: int = 300,
                 period_s: float = HOT_S, robot: Link | None = None) -> Cost:
    """Send `frames` frames to both detectors. With `robot` they are also published, for a service that subscribes."""
    decoder, numbers, took = Decoder(*size_px, size_px[0] * size_px[1]), count(1), (list[float](), list[float]())
    unanswered = 0
    next_s = time.monotonic()
    for index in range(_WARM + frames):
        next_s += period_s
        time.sleep(max(0.0, next_s - time.monotonic()))
        for which, one in enumerate((here, there)):
            frame = DetectFrame("r1", _header(next(numbers)), jpeg, decoder)
            us, answered = _timed(one, frame, robot if which else None)
            if index >= _WARM:
                unanswered += not answered
                took[which].append(us)
    return Cost(median(took[0]), median(took[1]), unanswered)


def _timed(detector: Detector, frame: DetectFrame, robot: Link | None) -> tuple[float, bool]:
    began_ns = time.perf_counter_ns()
    if robot is not None:
        robot.publish(FRAME, encode(frame.header), frame.jpeg)
    result = detector.detect([frame], monotonic_us() + _DEADLINE_US)[0]
    return (time.perf_counter_ns() - began_ns) / 1000, result is not None


def _header(number: int) -> FrameHeader:
    return FrameHeader(session="0000abcd", seq=number, t_us=monotonic_us())


# Many streams at one detector service, more than it can look at: age, fairness, memory. Shell (processes, the clock).
#
# The service is the real one, in a process of its own; robots are links of this process, which is where they all meet.


DEADLINE_MS: Final = 100.0
FAIRNESS_PERCENT: Final = 10.0
MEMORY_MB: Final = 5.0
OVERLOAD: Final = 2.0
_FPS: Final = 30
_WARM_S: Final = 5.0
_STATUS_S: Final = 0.1
_READY_S: Final = 30.0


@dataclass
class Load:
    """The result of one run."""

    offered: int = 0
    answered: Counter[str] = field(default_factory=Counter)
    ages_ms: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    """Of the service, once a second."""

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


class _Streams:
    """The robots."""

    def __init__(self, links: list[ZenohLink], jpeg: bytes) -> None:
        self._links, self._jpeg, self.load = links, jpeg, Load()
        self._seq = 0
        self.counting = False
        for link in links:
            link.subscribe(DETECTIONS, self._heard(link.robot))

    def _heard(self, robot: str) -> Callable[[Message], None]:
        def note(message: Message) -> None:
            try:
                echo = decode(DetectionsHeader, message.header).echo
            except WireError:
                return
            if echo is not None and self.counting:
                self.load.answered[robot] += 1
                self.load.ages_ms.append((monotonic_us() - echo.t_us) / 1000)

        return note

    def say(self) -> None:
        stamp = encode(Stamp(session="0000abcd", seq=self._seq, t_us=monotonic_us()))
        for link in self._links:
            link.publish(STATUS, stamp, encode(Status(state=State.HOLD, reason="bench")))

    def frame(self, index: int) -> None:
        self._seq += 1
        header = FrameHeader(session="0000abcd", seq=self._seq, t_us=monotonic_us())
        self._links[index].publish(FRAME, encode(header), self._jpeg)
        self.load.offered += self.counting


def measure_streams(endpoint: str, folder: Path, streams: int = 40, seconds: float = 60.0) -> Load:
    """Offer `streams` streams at twice what the service can look at. Raises SightlineError if it does not start."""
    each_us = round(OVERLOAD * 1e6 / (streams * _FPS))
    write_pictures(folder, 320, 240)
    jpeg = sorted(folder.glob("*.jpg"))[0].read_bytes()
    with ExitStack() as ending:
        session = ending.enter_context(closing(open_session([endpoint], (), 5.0)))
        links = [ZenohLink(session, LinkRules(f"s{index}", "robot"), shared=True) for index in range(streams)]
        for link in links:
            ending.callback(link.close)
        service = _service(endpoint, each_us, folder / "detector.log")
        ending.callback(service.wait, 10)
        ending.callback(service.terminate)
        robots = _Streams(links, jpeg)
        _wait_ready(robots, folder / "detector.log", streams, service)
        _offer(robots, streams, _WARM_S, service.pid)
        robots.load.memory_mb.clear()
        robots.counting = True
        _offer(robots, streams, seconds, service.pid)
    return robots.load


def _service(endpoint: str, each_us: int, log: Path) -> "subprocess.Popen[bytes]":
    command = [
        sys.executable,
        "-u",
        "-P",
        "-m",
        "sightline.operator_side.cli.app",
        "detector",
        "--serve",
        "sightline.benchmarks.detector:SlowDetector",
        "--connect",
        endpoint,
        "--set",
        f"detector.options.each_us={each_us}",
    ]
    with log.open("wb") as out:
        return subprocess.Popen(command, stdout=out, stderr=out)


def _wait_ready(robots: _Streams, log: Path, streams: int, service: "subprocess.Popen[bytes]") -> None:
    deadline_s = time.monotonic() + _READY_S
    while log.read_text("utf-8", "replace").count("receives the frames") < streams:
        if time.monotonic() > deadline_s or service.poll() is not None:
            raise SightlineError(f"the detector service did not start: {log.read_text('utf-8', 'replace')[-300:]}")
        robots.say()
        time.sleep(_STATUS_S)


def _offer(robots: _Streams, streams: int, seconds: float, pid: int) -> None:
    """Frames of one stream after the other, evenly spaced; the newest of each, as robots send them."""
    began_s = time.monotonic()
    for index in range(round(seconds * streams * _FPS)):
        due_s = began_s + index / (streams * _FPS)
        left_s = due_s - time.monotonic()
        if left_s > 0:
            time.sleep(left_s)
        if index % (streams * _FPS) == 0:
            robots.load.memory_mb.append(_memory_mb(pid))
        robots.frame(index % streams)


def _memory_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("VmRSS:")[2].split()[0]) / 1024
