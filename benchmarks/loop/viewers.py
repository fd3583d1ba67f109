"""Measure the cost of viewers for the driver of a robot: the bench, and the process of the viewers. Shell (processes).

Opens COUNT links, each with its own connection, and reads every frame. With NAP_S it sleeps that long for each one on
the transport's thread, so that its connection is read no faster.
"""

import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from sightline.benchmarks.loop.counters import high_water_mb, read_machine, taken_percent
from sightline.benchmarks.loop.figures import (
    ANSWERED_PERCENT,
    TAKEN_BOUND_PERCENT,
    Course,
    LoopSetting,
    percentile,
)
from sightline.benchmarks.loop.ours import ROBOT, Ours, running_services
from sightline.benchmarks.loop.pictures import write_pictures
from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.processes import Processes, terminated_like_interrupted
from sightline.protocol.channels import FRAME
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.open import open_link


def main(endpoint: str, count: int, nap_s: float) -> None:
    """Watch until killed. Prints `watching` when each viewer has received a frame."""

    def watch(seen: threading.Event, _message: Message) -> None:
        seen.set()
        time.sleep(nap_s)

    with ExitStack() as ending:
        viewers = [threading.Event() for _ in range(count)]
        for number, seen in enumerate(viewers):
            link = ending.enter_context(open_link(ROBOT, connect=[endpoint], role=f"viewer{number}"))
            link.subscribe(FRAME, partial(watch, seen))
        for seen in viewers:
            seen.wait()
        print("watching", flush=True)
        threading.Event().wait()


# `sightline bench watchers`: the cost of viewers for the driver; one never reads, one slowly. Shell (processes).
#
# First the loop alone, then with viewers that read the control stream itself, which is the worst case.


P95_GROWTH_MS: Final = 3.0
MEMORY_GROWTH_MB: Final = 5.0
_SLOW_NAP_S: Final = 1.0
_SETTLE_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class ViewedStretch:
    """Its time, the peak memory of the network process at its end, and the time that other programs took."""

    begin_us: int
    end_us: int
    memory_mb: float
    taken_percent: float


@dataclass(frozen=True, slots=True)
class Watch:
    """The same with viewers."""

    course: Course
    fps: float
    memory_mb: float
    taken_percent: float


def measure_watchers(setting: LoopSetting, viewers: int, show: Callable[[str], None]) -> list[Check]:
    """Run `setting.seconds` without viewers, then with `viewers` (2 to 12). Sets `setting.pictures`.

    Repeats disturbed samples, `setting.tries` times at most. Raises ConfigError for an unknown
    transport, HardwareError for a process that does not run.
    """
    with terminated_like_interrupted(), tempfile.TemporaryDirectory(prefix="sightline-watchers-") as name:
        ready = replace(setting, pictures=Path(name) / "pictures")
        ready.pictures.mkdir()
        write_pictures(ready.pictures, ready.width_px, ready.height_px)
        pairs = []
        for number in range(setting.tries):
            folder = Path(name) / str(number)
            folder.mkdir()
            pairs.append(_measure(ready, viewers, folder, show))
            if not any(map(_is_disturbed, pairs[-1])):
                break
        return _checks(ready.fps, *min(pairs, key=lambda pair: max(one.taken_percent for one in pair)))


def _measure(setting: LoopSetting, viewers: int, folder: Path, show: Callable[[str], None]) -> tuple[Watch, Watch]:
    with Processes(folder, oldest_first=True) as processes, running_services(setting, folder, processes) as ours:
        alone = _stretch(ours, {}, setting.seconds)
        show(f"without viewers: others had {alone.taken_percent:.1f} % of the machine's time")
        crowded = _stretch(ours, start_viewers(processes, ours.endpoint, viewers), setting.seconds)
        show(f"with {viewers} viewers: others had {crowded.taken_percent:.1f} %")
        processes.check()
        processes.end()
        return _watch(ours, alone), _watch(ours, crowded)


def start_viewers(processes: Processes, endpoint: str, viewers: int) -> dict[str, int]:
    """Start viewers until each receives: one stopped by the kernel, one slow, the rest fast. Returns process ids."""
    parts = {"stalled": (1, 0.0), "slow": (1, _SLOW_NAP_S), "quick": (viewers - 2, 0.0)}
    pids = {}
    for name, (count, nap_s) in parts.items():
        if count:
            arguments = [endpoint, str(count), str(nap_s)]
            pids[name] = processes.start(name, arguments, module="sightline.benchmarks.loop.viewers")
            processes.wait_line(name, "watching")
    os.kill(pids["stalled"], signal.SIGSTOP)
    return pids


def _stretch(ours: Ours, viewers: Mapping[str, int], seconds: float) -> ViewedStretch:
    time.sleep(_SETTLE_S)
    pids = {**ours.pids, **viewers}
    before, begin_ns = read_machine(pids), time.monotonic_ns()
    time.sleep(seconds)
    after, end_ns = read_machine(pids), time.monotonic_ns()
    taken = taken_percent(before, after, (end_ns - begin_ns) / 1e9)
    return ViewedStretch(begin_ns // 1000, end_ns // 1000, high_water_mb(ours.pids["network"]), taken)


def _watch(ours: Ours, stretch: ViewedStretch) -> Watch:
    course = ours.course(stretch.begin_us, stretch.end_us)
    fps = course.fps((stretch.end_us - stretch.begin_us) / 1e6)
    return Watch(course, fps, stretch.memory_mb, stretch.taken_percent)


def _is_disturbed(watch: Watch) -> bool:
    return watch.taken_percent > TAKEN_BOUND_PERCENT


def _checks(offered_fps: float, alone: Watch, crowded: Watch) -> list[Check]:
    ages_ms = [[age_us / 1000 for _, age_us in one.course.ages_us] for one in (alone, crowded)]
    first_ms, then_ms = (percentile(one, 95) for one in ages_ms)
    later_ms = None if first_ms is None or then_ms is None else then_ms - first_ms
    disturbed = sum(map(_is_disturbed, (alone, crowded)))
    return [
        at_most("p95 of age, more", later_ms, "ms", P95_GROWTH_MS),
        at_most("not accepted", 100 - crowded.course.answered_percent, "%", 100 - ANSWERED_PERCENT),
        at_least("answered per second", crowded.fps, "", ANSWERED_PERCENT / 100 * offered_fps),
        at_most("memory, more", crowded.memory_mb - alone.memory_mb, "MB", MEMORY_GROWTH_MB),
        at_most("samples disturbed by others", disturbed, "", 0.0),
    ]


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
