"""Sightline's own eyes for contestants of `bench loop`: one `Pipeline`, with a detector as slow as was asked. Shell."""

import time

from sightline.benchmarks.loop.pictures import camera_of
from sightline.protocol.messages import CameraModel, FrameHeader
from sightline.protocol.text import format_twist
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Picture
from sightline.vision_side.detect.hsv import HsvDetector
from sightline.vision_side.detect.port import Detection, PictureDetector
from sightline.vision_side.pipeline import Frame, Pipeline


class SlowDetector:
    """A detector that takes longer: it waits `delay_s`, as for an accelerator, and then works for at least `busy_s`.

    It works by detecting the same again and again, as the same code on a slower processor.
    """

    def __init__(self, detector: PictureDetector, delay_s: float, busy_s: float) -> None:
        self._detector, self._delay_s, self._busy_s = detector, delay_s, busy_s

    def detect(self, picture: Picture) -> tuple[Detection, ...]:
        """As the detector inside, later."""
        if self._delay_s:
            time.sleep(self._delay_s)
        until_s = time.perf_counter() + self._busy_s
        found = self._detector.detect(picture)
        while time.perf_counter() < until_s:
            found = self._detector.detect(picture)
        return found


def build_pipeline(config: VisionConfig, camera: CameraModel, delay_ms: float, busy_ms: float) -> Pipeline:
    """The services' own pipeline; unless it is to be slow, its detector is the services' own too."""
    slow = SlowDetector(HsvDetector(config.hsv), delay_ms / 1000, busy_ms / 1000) if delay_ms or busy_ms else None
    return Pipeline(config, camera, slow)


class PipelineVision:
    """Pictures in, `linear|angular` out."""

    def __init__(self, width_px: int, height_px: int, delay_ms: float = 0.0, busy_ms: float = 0.0) -> None:
        self._pipeline = build_pipeline(VisionConfig(), camera_of(width_px, height_px), delay_ms, busy_ms)
        self._seq = 0

    def answer(self, t_us: int, jpeg: bytes) -> str:
        """The command for a picture captured at `t_us`. Raises ValueError for one that cannot be answered."""
        self._seq += 1
        twist = self._pipeline.step(Frame(FrameHeader(session="00000001", seq=self._seq, t_us=t_us), jpeg)).twist
        if twist is None:
            raise ValueError(f"no command for the picture of {t_us} us: {dict(self._pipeline.skipped)}")
        return format_twist(twist).decode()
