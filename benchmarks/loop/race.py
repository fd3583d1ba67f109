"""`sightline bench loop`: capture to the driver's verdict, against the floor and what others build. Shell."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from sightline.evaluation.processes import terminated_like_interrupted
from sightline.benchmarks.loop_course import Sample, joined
from sightline.benchmarks.loop_figures import Figures, LoopCheck, figures_of, loop_checks
from sightline.benchmarks.loop.ours import endpoint_of
from sightline.benchmarks.loop_overload import overloaded
from sightline.benchmarks.loop.pictures import write_pictures
from sightline.benchmarks.loop_sample import take_sample
from sightline.benchmarks.loop.figures import FLOOR, OURS, LoopSetting

_TURNS: Final = 3
_LEAST_TURN_S: Final = 3.0


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
        samples = _samples(ready, Path(name), say)
    figures = {one: figures_of(sample) for one, sample in samples.items()}
    return Race(ready, jpeg_bytes, samples, figures, loop_checks(figures, ready))


def _samples(setting: LoopSetting, folder: Path, say: Callable[[str], None]) -> dict[str, Sample]:
    """One of each contestant.

    Floor and Sightline take turns, since what is judged is their difference and a shared machine's clock changes from
    minute to minute; under load there is one turn, for age is to be watched over the whole time.
    """
    turns = 1 if setting.is_loaded else max(1, min(_TURNS, int(setting.seconds // _LEAST_TURN_S)))
    part = replace(setting, seconds=setting.seconds / turns)
    judged = [[take_sample(one, part, folder / f"turn-{turn}", say) for one in (FLOOR, OURS)] for turn in range(turns)]
    samples = {FLOOR: joined([pair[0] for pair in judged]), OURS: joined([pair[1] for pair in judged])}
    return samples | {one: take_sample(one, setting, folder, say) for one in setting.contestants if one not in samples}
