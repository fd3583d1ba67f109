"""More pictures than can be detected, by a chosen factor: by their rate, else by a slower detector. Shell (a clock).

The robot service takes at most `MAX_FPS` pictures a second. Where the pipeline is quicker than that, the rate stays as
it was asked and every contestant's detector is made to work for as long as the factor demands.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Final

from sightline.benchmarks.loop.vision import PipelineVision
from sightline.benchmarks.loop.figures import MAX_FPS, LoopSetting

_STEPS: Final = 60
_FRAME_US: Final = 33_333


def overloaded(setting: LoopSetting, say: Callable[[str], None]) -> LoopSetting:
    """`setting` with the rate, or the detector's time, that its `overload` asks for. Its pictures are written."""
    step_ms = _step_ms(PipelineVision(setting.width_px, setting.height_px), setting.pictures)
    found = with_overload(setting, step_ms)
    say(f"overload {setting.overload:g}: one step takes {step_ms:.2f} ms; {found.fps:g} pictures a second, "
        + (f"each detector works {found.busy_ms:.1f} ms" if found.busy_ms else "detectors as they are"))
    return found


def with_overload(setting: LoopSetting, step_ms: float) -> LoopSetting:
    """For a pipeline that takes `step_ms`, decoding included."""
    fps = 1000 * setting.overload / step_ms
    if fps <= MAX_FPS:
        return replace(setting, fps=round(fps, 1))
    return replace(setting, busy_ms=1000 * setting.overload / setting.fps)


def _step_ms(eyes: PipelineVision, pictures: Path) -> float:
    """Median, without pauses: who is overloaded never pauses."""
    jpegs = [path.read_bytes() for path in sorted(pictures.glob("*.jpg"))]
    took_ms = []
    for number in range(_STEPS):
        began_ns = time.perf_counter_ns()
        eyes.answer((number + 1) * _FRAME_US, jpegs[number % len(jpegs)])
        took_ms.append((time.perf_counter_ns() - began_ns) / 1e6)
    return median(took_ms)
