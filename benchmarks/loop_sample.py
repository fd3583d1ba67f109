"""One sample of one contestant: start it, let it settle, read the kernel's counters around its time, end it. Shell.

A sample during which others had the machine's time is marked and taken again, as often as the setting allows.
"""

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from sightline.benchmarks.loop_course import Course, Sample, course_of_tally
from sightline.benchmarks.loop.processes import BenchProcesses, free_port
from sightline.benchmarks.loop.counters import high_water_mb, read_machine, taken_percent
from sightline.benchmarks.loop.ours import running_services
from sightline.benchmarks.loop.figures import FLOOR, OUR_DETECTOR, OURS, OWN_DETECTOR, TAKEN_BOUND_PERCENT, LoopSetting
from sightline.benchmarks.loop_sockets import carried_between, carried_bytes
from sightline.protocol.clock import monotonic_us

_SETTLE_S: Final = 1.5
_DRAIN_S: Final = 0.3
_MODULE: Final = "sightline.benchmarks.peers"


class Contestant(Protocol):
    """Processes that run, and what they noted once they have ended."""

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by role."""
        ...

    @property
    def ports(self) -> Sequence[int]:
        """Where its processes listen."""
        ...

    def course(self, begin_us: int, end_us: int) -> Course:
        """What became of the pictures of that time."""
        ...


@dataclass(frozen=True, slots=True)
class Peer:
    """A peer, or the floor, running."""

    pids: dict[str, int]
    ports: Sequence[int]
    tally: Path

    def course(self, begin_us: int, end_us: int) -> Course:
        """By its own notes."""
        noted = json.loads(self.tally.read_text())
        return course_of_tally(noted["captured_us"], noted["judged_us"], begin_us, end_us)


def take_sample(name: str, setting: LoopSetting, folder: Path, say: Callable[[str], None]) -> Sample:
    """The least disturbed of up to `setting.tries` samples. Raises HardwareError if the contestant does not start."""
    taken: list[Sample] = []
    while len(taken) < setting.tries:
        number = len(taken) + 1
        taken.append(_take_one(name, setting, folder / f"{name}-{number}", number))
        others = taken[-1].taken_percent
        say(f"{name}: {len(taken[-1].course.ages_us)} answers; others had {others:.1f} % of the machine's time")
        if others <= TAKEN_BOUND_PERCENT:
            break
    return min(taken, key=lambda sample: sample.taken_percent)


def _take_one(name: str, setting: LoopSetting, folder: Path, number: int) -> Sample:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with BenchProcesses(folder) as crew, _running(name, setting, folder, crew) as contestant:
        time.sleep(_SETTLE_S)
        carried_before = carried_bytes(contestant.ports)
        before, begin_us = read_machine(contestant.pids), monotonic_us()
        time.sleep(setting.seconds)
        crew.check()
        after, end_us = read_machine(contestant.pids), monotonic_us()
        carried_after = carried_bytes(contestant.ports)
        memory_mb = {process: high_water_mb(pid) for process, pid in contestant.pids.items()}
        time.sleep(_DRAIN_S + (setting.detector_delay_ms + setting.busy_ms) / 1000)
        crew.end()
        cpu_s = {process: after.cpu_s[process] - before.cpu_s[process] for process in after.cpu_s}
        seconds = (end_us - begin_us) / 1e6
        return Sample(
            name, contestant.course(begin_us, end_us), seconds, cpu_s, memory_mb,
            carried_between(carried_before, carried_after), taken_percent(before, after, seconds),
            _hot_us(contestant), number,
        )


@contextmanager
def _running(name: str, setting: LoopSetting, folder: Path, crew: BenchProcesses) -> Iterator[Contestant]:
    if name == OURS:
        with running_services(setting, folder, crew) as ours:
            yield ours
        return
    tally, port = folder / "tally.json", free_port()
    settings = json.dumps({
        "width_px": setting.width_px, "height_px": setting.height_px, "delay_ms": setting.detector_delay_ms,
        "busy_ms": setting.busy_ms, "eyes": "classic" if name in OWN_DETECTOR else "ours",
        "fps": setting.fps, "pictures": str(setting.pictures), "tally": str(tally), "port": port,
    })
    peer = name.removesuffix(OUR_DETECTOR)
    if name == FLOOR:
        pids = {"vision": crew.start(FLOOR, _MODULE, peer, "alone", settings)}
        crew.wait_line(FLOOR, "first answer")
    else:
        pids = {"robot": crew.start("robot", _MODULE, peer, "robot", settings)}
        pids["vision"] = crew.start("vision", _MODULE, peer, "vision", settings)
        crew.wait_line("robot", "first answer")
    yield Peer(pids, (port, port + 1), tally)


def _hot_us(contestant: Contestant) -> float | None:
    return json.loads(contestant.tally.read_text())["hot_us"] if isinstance(contestant, Peer) else None
