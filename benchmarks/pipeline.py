"""How long one `Pipeline.step` takes, hot. Shell (a clock)."""

import time
from dataclasses import dataclass
from statistics import median

import cv2
import numpy as np

from protocol.messages import CameraModel, FrameHeader
from vision_side.config import VisionConfig
from vision_side.pipeline import Frame, Pipeline

BOUNDS_US = {(320, 240): 350.0, (640, 480): 800.0}
_JPEG_BYTES = {(320, 240): 12_000, (640, 480): 46_000}
_WARM_UP = 20


@dataclass(frozen=True, slots=True)
class StepTime:
    """One size of picture; `phase` tells that the whole line ran."""

    width_px: int
    height_px: int
    jpeg_bytes: int
    median_us: float
    bound_us: float
    phase: str


def time_steps(frames: int = 300) -> list[StepTime]:
    """Medians over `frames` different frames of each size."""
    return [_time_size(size, frames) for size in BOUNDS_US]


def _time_size(size: tuple[int, int], frames: int) -> StepTime:
    camera, jpeg = _camera(*size), _jpeg(*size)
    pipeline = Pipeline(VisionConfig(), camera)
    took_us, phase = [], ""
    for number in range(frames + _WARM_UP):
        header = FrameHeader(session="00000001", seq=number, t_us=number * 33_333, latency_us=60_000)
        started_ns = time.perf_counter_ns()
        phase = pipeline.step(Frame(header, jpeg)).seen.phase
        took_us.append((time.perf_counter_ns() - started_ns) / 1000)
    return StepTime(*size, len(jpeg), median(took_us[_WARM_UP:]), BOUNDS_US[size], phase)


def _camera(width_px: int, height_px: int) -> CameraModel:
    focal_px = 0.596 * width_px  # 80 degrees
    return CameraModel(width_px=width_px, height_px=height_px, fx_px=focal_px, fy_px=focal_px, cx_px=width_px / 2,
                       cy_px=height_px / 2)


def _jpeg(width_px: int, height_px: int) -> bytes:
    """A textured room with the ball of the scenarios, of about the size that the bounds were set for."""
    rough = np.random.default_rng(1).normal(130, 22, (height_px, width_px, 1)).repeat(3, axis=2)
    picture = cv2.GaussianBlur(np.clip(rough, 0, 255).astype(np.uint8), (3, 3), 0)
    cv2.circle(picture, (width_px * 9 // 16, height_px // 2), width_px // 13, (13, 199, 242), -1, cv2.LINE_AA)
    qualities = (_encode(picture, quality) for quality in range(40, 96))
    return min(qualities, key=lambda jpeg: abs(len(jpeg) - _JPEG_BYTES[width_px, height_px]))


def _encode(picture: np.ndarray, quality: int) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
