"""Measure `Pipeline.step`, hot and paced, its decode, and the detectors `hsv` and `onnx`. Shell (a clock)."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import cycle, islice
from statistics import median
from typing import Any

import cv2
import numpy as np

from sightline.protocol.messages import CameraModel, FrameHeader
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.color.hsv import HsvDetector
from sightline.vision_side.detect.onnx.detector import OnnxDetector, read_onnx_model
from sightline.vision_side.detect.onnx.tensors import fit_picture
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.pipeline import Frame, Pipeline

BOUNDS_US = {(320, 240): 350.0, (640, 480): 800.0}
LEARNED_BOUND_US, TWO_LOOKS_BOUND_US = 1500.0, 3000.0
_JPEG_BYTES = {(320, 240): 12_000, (640, 480): 46_000}
_PICTURES = 24
_WARM_UP = 24
_ROUND = 12
_FRAME_US = 33_333


@dataclass(frozen=True, slots=True)
class StepTime:
    """Medians for one image size; the last `phase` shows that all steps ran.

    `median_us`: hot, one frame right after the other; it has a bound. `alone_us`: the best of its
    rounds. `paced_us`: 30 frames a second with sleep between, with cold caches and a low clock each time.
    `decode_us`: the decode alone, hot, of the same images (the floor), best round. `hsv_us`: the decode
    and the detector `hsv`, hot, also with a bound. `hsv_alone_us`: the best of its rounds.
    """

    width_px: int
    height_px: int
    jpeg_bytes: int
    median_us: float
    alone_us: float
    paced_us: float
    decode_us: float
    hsv_us: float
    hsv_alone_us: float
    bound_us: float
    phase: str


def time_steps(frames: int = 900, paced_frames: int = 60) -> list[StepTime]:
    """Return medians over `frames` frames of each size, and over `paced_frames` at 30 a second."""
    return [_time_size(size, frames, paced_frames) for size in BOUNDS_US]


@dataclass(frozen=True, slots=True)
class LearnedTime:
    """Medians of the shipped detector `onnx` on one thread at 320x240, hot.

    `network_us`: the network alone, with boxes decoded and overlaps removed; it has a bound. `alone_us`: the best
    of its rounds. `whole_us`: from JPEG to detections. `two_us`: the same for images without a ball where one is
    expected, which are examined twice; it has a bound. `decode_us`: the decode alone, best round. `missed`:
    images in which it found no ball. `false`: images without a ball in which it found one, examined once.
    """

    engine: str
    missed: int
    false: int
    network_us: float
    alone_us: float
    whole_us: float
    two_us: float
    decode_us: float


def time_learned(frames: int = 600) -> LearnedTime:
    """Measure the learned detector. Raises ConfigError without a model that runs here."""
    size = (320, 240)
    pictures, decoder = _pictures(*size), Decoder(*size, size[0] * size[1])
    config = OnnxDetector.Config(device="cpu")
    detector, model = OnnxDetector(config), read_onnx_model(config)
    requested = [DetectFrame("r1", one.header, one.jpeg, decoder) for one in islice(_frames(pictures), frames)]
    pixels = [fit_picture(decoder.decode(jpeg), model.form)[0].copy() for jpeg in pictures]
    seen = [detector.detect([one], NO_DEADLINE)[0] for one in requested[:_PICTURES]]
    network_us = _took_us(model.engine.run, islice(cycle(pixels), frames))
    whole_us = _took_us(lambda one: detector.detect([one], NO_DEADLINE), requested)
    decode_us = _took_us(decoder.decode, islice(cycle(pictures), frames))
    empty = [DetectFrame("r1", one.header, one.jpeg, decoder) for one in islice(_frames(_pictures(*size, 0)), frames)]
    for one in empty:
        one.expected_px = size[0] / 2, size[1] / 2
    false = sum(bool(one and one.detections) for one in detector.detect(empty[:_PICTURES], NO_DEADLINE))
    two_us = _took_us(lambda one: detector.detect([one], NO_DEADLINE), empty)
    missed = sum(one is None or not one.detections for one in seen)
    return LearnedTime(model.engine.name, missed, false, median(network_us), _alone(network_us), median(whole_us),
                       median(two_us), _alone(decode_us))


def _time_size(size: tuple[int, int], frames: int, paced_frames: int) -> StepTime:
    pictures = _pictures(*size)
    config = VisionConfig(detector=DetectorConfig(kind="hsv"))
    decoder = Decoder(*size, size[0] * size[1])
    pipeline = Pipeline(config, _camera(*size), configured_detector(config))
    source = _frames(pictures)
    for _ in range(_WARM_UP):
        pipeline.step(next(source))
    hot_us = _took_us(pipeline.step, (next(source) for _ in range(frames)))
    paced_us = median(_took_us(pipeline.step, _paced(source, paced_frames)))
    phase = pipeline.step(next(source)).seen.phase
    decode_us = _alone(_took_us(decoder.decode, islice(cycle(pictures), frames)))
    hsv = HsvDetector(config.hsv)
    hsv_us = _took_us(lambda jpeg: hsv.detect(decoder.decode(jpeg)), islice(cycle(pictures), frames))
    return StepTime(*size, len(pictures[0]), median(hot_us), _alone(hot_us), paced_us, decode_us, median(hsv_us),
                    _alone(hsv_us), BOUNDS_US[size], phase)


def _frames(pictures: list[bytes]) -> Iterator[Frame]:
    for number, jpeg in enumerate(cycle(pictures)):
        yield Frame(FrameHeader(session="00000001", seq=number, t_us=number * _FRAME_US, latency_us=60_000), jpeg)


def _paced(source: Iterator[Frame], frames: int) -> Iterator[Frame]:
    due_s = time.monotonic()
    for _ in range(frames):
        due_s += _FRAME_US / 1e6
        frame = next(source)
        time.sleep(max(0.0, due_s - time.monotonic()))
        yield frame


def _took_us(call: Callable[[Any], object], inputs: Iterable[Any]) -> list[float]:
    took_us = []
    for one in inputs:
        started_ns = time.perf_counter_ns()
        call(one)
        took_us.append((time.perf_counter_ns() - started_ns) / 1000)
    return took_us


def _alone(took_us: list[float]) -> float:
    """Return the smallest median of the rounds, from when the machine was least disturbed.

    On a shared machine the same work took a third longer in most half-seconds, and no counter showed why. Python's
    `timeit` also recommends the minimum.
    """
    return min(median(took_us[first : first + _ROUND]) for first in range(0, len(took_us), _ROUND))


def _camera(width_px: int, height_px: int) -> CameraModel:
    focal_px = 0.596 * width_px  # 80 degrees
    return CameraModel(width_px=width_px, height_px=height_px, fx_px=focal_px, fy_px=focal_px, cx_px=width_px / 2,
                       cy_px=height_px / 2)


def _pictures(width_px: int, height_px: int, balls: int = 1) -> list[bytes]:
    """Draw textured rooms with the ball of the scenarios, or without one, for image sizes like those of the bounds.

    Many images, since branch prediction learns a single repeated image, which saves 20 % of its decode.
    """
    drawn = [_drawn(width_px, height_px, seed, balls) for seed in range(_PICTURES)]
    quality = min(range(40, 96), key=lambda one: abs(len(_encode(drawn[0], one)) - _JPEG_BYTES[width_px, height_px]))
    return [_encode(picture, quality) for picture in drawn]


def _drawn(width_px: int, height_px: int, seed: int, balls: int) -> np.ndarray:
    rough = np.random.default_rng(seed).normal(130, 22, (height_px, width_px, 1)).repeat(3, axis=2)
    picture = cv2.GaussianBlur(np.clip(rough, 0, 255).astype(np.uint8), (3, 3), 0)
    for _ in range(balls):
        cv2.circle(picture, (width_px * 9 // 16, height_px // 2), width_px // 13, (13, 199, 242), -1, cv2.LINE_AA)
    return picture


def _encode(picture: np.ndarray, quality: int) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
