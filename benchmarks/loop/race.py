"""One race: each contestant is started, sampled with the kernel's counters, and ended. Shell (processes).

A sample that other programs disturbed is marked and repeated, as often as the setting and the time of the run
permit.
"""

import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol

from sightline.benchmarks.loop.counters import (
    carried_between,
    carried_bytes,
    high_water_mb,
    read_machine,
    taken_percent,
)
from sightline.benchmarks.loop.figures import (
    FLOOR,
    OLDER,
    OURS,
    TAKEN_BOUND_PERCENT,
    Course,
    LoopFigures,
    LoopSample,
    LoopSetting,
    course_of_tally,
    figures_of,
    joined,
    loop_checks,
)
from sightline.benchmarks.loop.ours import endpoint_of, running_services
from sightline.benchmarks.loop.pictures import write_pictures
from sightline.benchmarks.loop.vision import overloaded
from sightline.evaluation.checks import Check
from sightline.evaluation.processes import Processes, free_port, terminated_like_interrupted
from sightline.protocol.clock import monotonic_us

_SETTLE_S: Final = 1.5
_DRAIN_S: Final = 0.3
_LEAST_SAMPLE_S: Final = 2.0
_RUN_S: Final = 225.0
"""Time for the samples of a run of `_RUN_OF_S` per contestant, which ends within 240 s. A longer run gets more."""
_RUN_OF_S: Final = 10.0
_MODULE: Final = "sightline.benchmarks.peers"


class Contestant(Protocol):
    """Running processes, and their records once they have ended."""

    @property
    def pids(self) -> dict[str, int]:
        """Return the process ids by role."""
        ...

    @property
    def ports(self) -> Sequence[int]:
        """Return the ports of its processes."""
        ...

    def course(self, begin_us: int, end_us: int) -> Course:
        """Return the course of that time."""
        ...


@dataclass(frozen=True, slots=True)
class Contestants:
    """A running peer, or the floor."""

    pids: dict[str, int]
    ports: Sequence[int]
    tally: Path

    def course(self, begin_us: int, end_us: int) -> Course:
        """Return the course by its own tally."""
        noted = json.loads(self.tally.read_text())
        return course_of_tally(noted["captured_us"], noted["commands_us"], begin_us, end_us)


@dataclass(slots=True)
class Budget:
    """Time of a run: until `end_s`, for the remaining `samples`. On a busy machine samples get shorter."""

    end_s: float
    samples: int
    beside_s: float = _SETTLE_S + _DRAIN_S
    """Time of a sample in addition to its seconds: to start, settle and end."""

    def seconds(self) -> float:
        """Return the time that remains for each sample."""
        return (self.end_s - time.monotonic()) / self.samples - self.beside_s


def take_sample(
    name: str, setting: LoopSetting, folder: Path, budget: Budget, show: Callable[[str], None]
) -> LoopSample:
    """Return the least disturbed of up to `setting.tries` samples. Raises HardwareError without a start."""
    taken: list[LoopSample] = []
    while not taken or (len(taken) < setting.tries and budget.seconds() >= setting.seconds):
        began_s, number = time.monotonic(), len(taken) + 1
        part = replace(setting, seconds=max(_LEAST_SAMPLE_S, min(setting.seconds, budget.seconds())))
        taken.append(_take_one(name, part, folder / f"{name}-{number}", number))
        budget.beside_s = (budget.beside_s + time.monotonic() - began_s - taken[-1].seconds) / 2
        others = taken[-1].taken_percent
        show(f"{name}: {len(taken[-1].course.ages_us)} answers; others had {others:.1f} % of the machine's time")
        if others <= TAKEN_BOUND_PERCENT:
            break
    budget.samples -= 1
    return min(taken, key=lambda sample: sample.taken_percent)


def _take_one(name: str, setting: LoopSetting, folder: Path, number: int) -> LoopSample:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with Processes(folder, oldest_first=True) as processes, _running(name, setting, folder, processes) as contestant:
        time.sleep(_SETTLE_S)
        carried_before = carried_bytes(contestant.ports)
        before, begin_us = read_machine(contestant.pids), monotonic_us()
        time.sleep(setting.seconds)
        processes.check()
        after, end_us = read_machine(contestant.pids), monotonic_us()
        carried_after = carried_bytes(contestant.ports)
        memory_mb = {process: high_water_mb(pid) for process, pid in contestant.pids.items()}
        time.sleep(_DRAIN_S + (setting.detector_delay_ms + setting.busy_ms) / 1000)
        processes.end()
        cpu_s = {process: after.cpu_s[process] - before.cpu_s[process] for process in after.cpu_s}
        seconds = (end_us - begin_us) / 1e6
        return LoopSample(
            name, contestant.course(begin_us, end_us), seconds, cpu_s, memory_mb,
            carried_between(carried_before, carried_after), taken_percent(before, after, seconds),
            _hot_us(contestant), number,
        )


@contextmanager
def _running(name: str, setting: LoopSetting, folder: Path, processes: Processes) -> Iterator[Contestant]:
    if name == OURS:
        with running_services(setting, folder, processes) as ours:
            yield ours
        return
    tally, port = folder / "tally.json", free_port()
    settings = json.dumps({
        "width_px": setting.width_px, "height_px": setting.height_px, "delay_ms": setting.detector_delay_ms,
        "busy_ms": setting.busy_ms, "vision": "legacy" if name == OLDER else "ours",
        "fps": setting.fps, "pictures": str(setting.pictures), "tally": str(tally), "port": port,
    })
    if name == FLOOR:
        pids = {"vision": processes.start(FLOOR, [name, "alone", settings], module=_MODULE)}
        processes.wait_line(FLOOR, "first answer")
    else:
        pids = {"robot": processes.start("robot", [name, "robot", settings], module=_MODULE)}
        pids["vision"] = processes.start("vision", [name, "vision", settings], module=_MODULE)
        processes.wait_line("robot", "first answer")
    yield Contestants(pids, (port, port + 1), tally)


def _hot_us(contestant: Contestant) -> float | None:
    return json.loads(contestant.tally.read_text())["hot_us"] if isinstance(contestant, Contestants) else None


# `sightline bench loop`: capture to the driver's result, against the floor and other stacks. Shell.


_TURNS: Final = 3
_LEAST_TURN_S: Final = 3.0


@dataclass(frozen=True, slots=True)
class Race:
    """All measurements of one run; `figures` and `samples` by contestant."""

    setting: LoopSetting
    jpeg_bytes: float
    samples: dict[str, LoopSample]
    figures: dict[str, LoopFigures]
    checks: list[Check]


def run_race(setting: LoopSetting, show: Callable[[str], None]) -> Race:
    """Measure the contestants in turn on the same images. Sets `setting.pictures`.

    Raises ConfigError for an unknown transport, HardwareError with its last output for a process that does not run.
    """
    endpoint_of(setting.transport, 1)
    with terminated_like_interrupted(), tempfile.TemporaryDirectory(prefix="sightline-loop-") as name:
        pictures = Path(name) / "pictures"
        pictures.mkdir()
        jpeg_bytes = write_pictures(pictures, setting.width_px, setting.height_px)
        ready = replace(setting, pictures=pictures)
        if setting.overload:
            ready = overloaded(ready, show)
        samples = _samples(ready, Path(name), show)
    figures = {one: figures_of(sample, ready) for one, sample in samples.items()}
    return Race(ready, jpeg_bytes, samples, figures, loop_checks(figures, ready))


def _samples(setting: LoopSetting, folder: Path, show: Callable[[str], None]) -> dict[str, LoopSample]:
    """Take a sample of each contestant.

    They take turns, because the results are differences, and a shared machine changes its clock from minute to minute.
    Under load there is one turn, because the age must be observed over the whole time.
    """
    turns = 1 if setting.is_loaded else max(1, min(_TURNS, int(setting.seconds // _LEAST_TURN_S)))
    part = replace(setting, seconds=setting.seconds / turns)
    run_s = _RUN_S * max(1.0, setting.seconds / _RUN_OF_S)
    budget = Budget(time.monotonic() + run_s, turns * len(setting.contestants))
    taken: list[dict[str, LoopSample]] = []
    while len(taken) < turns and (not taken or budget.seconds() >= _LEAST_SAMPLE_S):
        turn = folder / f"turn-{len(taken)}"
        taken.append({one: take_sample(one, part, turn, budget, show) for one in setting.contestants})
    return {one: joined([samples[one] for samples in taken]) for one in setting.contestants}
