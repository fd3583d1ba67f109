"""`sightline bench loop`: capture to the driver's verdict, against the floor and what others build. Shell."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.interrupted import terminated_like_interrupted
from benchmarks.loop_course import Sample
from benchmarks.loop_figures import Figures, LoopCheck, figures_of, judge
from benchmarks.loop_ours import endpoint_of
from benchmarks.loop_overload import overloaded
from benchmarks.loop_pictures import write_pictures
from benchmarks.loop_sample import take_sample
from benchmarks.loop_setting import LoopSetting


@dataclass(frozen=True, slots=True)
class Race:
    """Everything measured in one run; `figures` and `samples` by contestant."""

    setting: LoopSetting
    jpeg_bytes: float
    samples: dict[str, Sample]
    figures: dict[str, Figures]
    checks: list[LoopCheck]


def run_race(setting: LoopSetting, say: Callable[[str], None]) -> Race:
    """Measure every contestant, one after the other, on the same pictures; `setting.pictures` is filled in.

    Raises ConfigError for an unknown transport, HardwareError with its last words for a process that does not run.
    """
    endpoint_of(setting.transport, 1)
    with terminated_like_interrupted(), tempfile.TemporaryDirectory(prefix="sightline-loop-") as name:
        pictures = Path(name) / "pictures"
        pictures.mkdir()
        jpeg_bytes = write_pictures(pictures, setting.width_px, setting.height_px)
        ready = replace(setting, pictures=pictures)
        if setting.overload:
            ready = overloaded(ready, say)
        samples = {one: take_sample(one, ready, Path(name), say) for one in setting.contestants}
    figures = {one: figures_of(sample) for one, sample in samples.items()}
    return Race(ready, jpeg_bytes, samples, figures, judge(figures, ready))
