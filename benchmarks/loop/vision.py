"""The vision service with a tap, and a pipeline with a chosen detector time. Shell."""

import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Final

from sightline.benchmarks.loop.figures import MAX_ANGULAR_RAD_S, MAX_FPS, LoopSetting
from sightline.benchmarks.loop.pictures import camera_of
from sightline.protocol.channels import MAX_HEADER_BYTES
from sightline.protocol.codec import decode
from sightline.protocol.messages import FrameHeader
from sightline.protocol.text import format_twist
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import open_link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.port import DetectFrame, DetectionResult, Detector
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.pipeline import SOURCE, Frame, Pipeline, PipelineAnswer
from sightline.vision_side.serving.service import Service


class DelayedDetector:
    """A slowed detector. It waits `delay_s`, as for an accelerator, and then computes for at least `busy_s`.

    It repeats the detection, so that it acts like the same code on a slower processor.
    """

    def __init__(self, detector: Detector, delay_s: float, busy_s: float) -> None:
        self._detector, self._delay_s, self._busy_s = detector, delay_s, busy_s

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Return the detections of the inner detector after the delay."""
        if self._delay_s:
            time.sleep(self._delay_s)
        until_s = time.perf_counter() + self._busy_s
        results = self._detector.detect(frames, deadline_us)
        while time.perf_counter() < until_s:
            results = self._detector.detect(frames, deadline_us)
        return results


def contestant_config(**settings: object) -> VisionConfig:
    """Return the settings of detector and steering of all contestants: the service, the floor and the rivals."""
    steer = {"max_angular_rad_s": MAX_ANGULAR_RAD_S}
    return VisionConfig.model_validate({**settings, "detector": {"kind": "hsv"}, "steer": steer})


def delayed_detector(config: VisionConfig, delay_ms: float, busy_ms: float) -> Detector:
    """Return the detector of the services, slowed down if the setting requests it."""
    detector = configured_detector(config)
    return DelayedDetector(detector, delay_ms / 1000, busy_ms / 1000) if delay_ms or busy_ms else detector


class PipelineVision:
    """Converts images to `linear|angular`."""

    def __init__(self, width_px: int, height_px: int, delay_ms: float = 0.0, busy_ms: float = 0.0) -> None:
        config = contestant_config()
        detector = delayed_detector(config, delay_ms, busy_ms)
        self._pipeline = Pipeline(config, camera_of(width_px, height_px), detector)
        self._seq = 0

    def answer(self, t_us: int, jpeg: bytes) -> str:
        """Return the command for an image captured at `t_us`. Raises ValueError for an image without an answer."""
        self._seq += 1
        answer = self._pipeline.step(Frame(FrameHeader(session="00000001", seq=self._seq, t_us=t_us), jpeg))
        if answer.twist is None:
            raise ValueError(f"no command for the picture of {t_us} us: {answer.skipped}")
        return format_twist(answer.twist).decode()


# More images than can be detected, by a chosen factor: by their rate, otherwise by a slower detector. Shell (a clock).
# The robot service takes at most `MAX_FPS` images a second. If the pipeline is faster, the rate stays
# unchanged, and every contestant's detector works for the time that the factor requires.


_STEPS: Final = 60
_FRAME_US: Final = 33_333


def overloaded(setting: LoopSetting, show: Callable[[str], None]) -> LoopSetting:
    """Return `setting` with the rate or the detector time for its `overload`. Writes its images."""
    step_ms = _step_ms(PipelineVision(setting.width_px, setting.height_px), setting.pictures)
    found = with_overload(setting, step_ms)
    show(f"overload {setting.overload:g}: one step takes {step_ms:.2f} ms; {found.fps:g} pictures a second, "
        + (f"each detector works {found.busy_ms:.1f} ms" if found.busy_ms else "detectors as they are"))
    return found


def with_overload(setting: LoopSetting, step_ms: float) -> LoopSetting:
    """Return the setting for a pipeline that takes `step_ms`, decoding included."""
    fps = 1000 * setting.overload / step_ms
    if fps <= MAX_FPS:
        return replace(setting, fps=round(fps, 1))
    return replace(setting, busy_ms=1000 * setting.overload / setting.fps)


def _step_ms(vision: PipelineVision, pictures: Path) -> float:
    """Return the median time of a step without pauses, because an overloaded service never pauses."""
    jpegs = [path.read_bytes() for path in sorted(pictures.glob("*.jpg"))]
    took_ms = []
    for number in range(_STEPS):
        began_ns = time.perf_counter_ns()
        vision.answer((number + 1) * _FRAME_US, jpegs[number % len(jpegs)])
        took_ms.append((time.perf_counter_ns() - began_ns) / 1e6)
    return median(took_ms)


# The vision service with a tap: it records frame headers and commands, and may be slow. Shell.  `python -m
# sightline.benchmarks.loop.vision SETTINGS`. The service is `sightline.vision_side.serving.service.Service` unchanged;
# the tap costs an append per frame, and only a slowed detector is put into its pipeline.


_WAIT_S = 0.2


def _show(line: str) -> None:
    print(line, flush=True)


class TappedService(Service):
    """Stores the headers of all received frames, and its own commands."""

    def __init__(self, config: VisionConfig, link: Link, delay_ms: float, busy_ms: float) -> None:
        super().__init__(config, link, _show, delayed_detector(config, delay_ms, busy_ms))
        self.headers: list[bytes] = []
        self.commands: list[tuple[int, str]] = []

    def _frame(self, message: Message, started_ns: int) -> None:
        self.headers.append(message.header)
        super()._frame(message, started_ns)

    def _publish(self, header: FrameHeader, answer: PipelineAnswer, compute_us: int) -> None:
        super()._publish(header, answer, compute_us)
        if answer.twist is not None:
            self.commands.append((header.t_us, format_twist(answer.twist).decode()))


def main(settings: dict[str, object]) -> None:
    """Serve until SIGTERM. Then write headers as (seq, t_us, latency_us), commands as (time of the image, text), and
    the number of these that were sent per image."""
    config = contestant_config(robot=settings["robot"], connect=settings["connect"])
    ending = threading.Event()
    with open_link(config.robot, connect=config.connect, role=SOURCE) as link:
        signal.signal(signal.SIGTERM, lambda *_: ending.set())
        delay_ms, busy_ms = float(str(settings["delay_ms"])), float(str(settings["busy_ms"]))
        service = TappedService(config, link, delay_ms, busy_ms)
        while not ending.is_set():
            service.turn(_WAIT_S)
    headers = [decode(FrameHeader, header, MAX_HEADER_BYTES) for header in service.headers]
    rows = [(header.seq, header.t_us, header.latency_us) for header in headers]
    copies = max(1, service.sender.twists) / max(1, service.steered)
    noted = {"headers": rows, "copies": copies, "commands": service.commands}
    Path(str(settings["tally"])).write_text(json.dumps(noted))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
