"""Rows of `bench network` with several vision services that share their robots: their harms and checks. Shell.

The robots have their real gates (`gated_robots.py`). They give the score: accepted commands, and times without motion.
"""

import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final

from sightline.benchmarks.loop.pictures import write_pictures
from sightline.benchmarks.network.cases import CUT_S, NetworkCase, both
from sightline.benchmarks.network.robots import Settings
from sightline.benchmarks.network.stage import DETECTOR, NetworkRun, ShapedWire, Stage
from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.processes import Processes
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError
from sightline.sim.network_emulator import LinkShapes
from sightline.sim.tun_emulator import ADDRESS_A, ADDRESS_B

WIDTH_PX, HEIGHT_PX = 320, 240
MOST_LOOKS: Final = 1.05
"""Most answers per frame, and most services that receive it. Two services that examine the same frames make
two.
"""
LOADED_FPS: Final[Mapping[int, float]] = {1: 0.0, 2: 8.0, 4: 14.5}
"""Number of services with a detector of 8 ms -> least answered frames of each robot. One service is for comparison."""
LOADED_ROBOTS: Final = 20
_LOADED_US: Final = 8_000
_SLOW_DETECTOR: Final = "sightline.benchmarks.detector:SlowDetector"
ENDS_S: Final = 1.0
JOINS_S: Final = 0.5
"""Longest time from the first image of a robot that joins to its first accepted command."""
_LAST_US: Final = 1_000_000
"""Last part of the run. All robots drive then, because each harm leaves them more time after it."""
_SETTLE_S: Final = 4.0
_PORTS: Final = (7447, 7450)
_FROZEN_S: Final = 3.0
_HEALED_S: Final = 5.0
_ROBOT_PROCESSES: Final = 5
"""With all robots in one process, its sessions wait for each other: 40 ms each when they lose a router."""
_RECEIVED: Final = "sightline_vision_frames_received_total{"
_READ_METRICS: Final = """import sys, time, urllib.request
pages = [urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics").read().decode() for port in sys.argv[1:]]
print(time.monotonic_ns() // 1000, *pages, sep="\\n")"""
Record = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class SharingBounds:
    """Bounds and site of a row. A bound that is None is not demanded."""

    services: int
    stands_s: float | None
    gap_ms: float | None = None
    """Longest time between two accepted commands of a robot, after the last harm of the row."""
    routers: int = 1
    beyond: tuple[str, ...] = ()
    """Processes beyond the shaped wire. All others are on the robots' side."""
    robots: int = 20
    fps: float = 15.0
    harm_s: float = 10.0
    """Longest time of a harm. The run must have as many harms as fit."""
    least_changes: int = 0
    """Least changes of the driver per harm, over all robots."""
    each_us: int = 0
    """Time of a slow detector for a frame; 0: the cheapest detector."""
    again_s: float | None = None
    """Longest time from the last harm to the next command of a robot."""


BOUNDS: Final[Mapping[str, SharingBounds]] = {
    "shared-killed": SharingBounds(3, 0.0, gap_ms=250, harm_s=6, least_changes=8),
    "shared-rolling": SharingBounds(3, 0.0, gap_ms=150, harm_s=6, least_changes=8),
    "shared-scaled": SharingBounds(3, 0.0, gap_ms=150, least_changes=8),
    "shared-frozen": SharingBounds(3, 0.5),
    "shared-cut": SharingBounds(2, 0.5, beyond=("v0",)),
    "shared-alone": SharingBounds(1, CUT_S + 0.5, beyond=("v0",), again_s=0.5),
    "shared-router": SharingBounds(3, 0.5, routers=2),
    "shared-router-frozen": SharingBounds(3, 3.0, routers=2),
    "shared-parted": SharingBounds(3, 0.6, gap_ms=150, routers=2, beyond=("v0", "router1")),
    "shared-joined": SharingBounds(3, 0.0),
    "shared-200": SharingBounds(3, None, gap_ms=3000, robots=200, fps=5.0),
}


# --- checks, pure ------------------------------------------------------------------------------------------------


def worst_gap_ms(records: Mapping[str, Record], begin_us: int, end_us: int) -> float:
    """Return the longest time between two accepted commands of one robot that overlaps `begin_us` to `end_us`."""
    worst_us = 0
    for record in records.values():
        times = [begin_us, *(at_us for at_us, _, _ in record["accepted"]), end_us]
        worst_us = max(worst_us, *(later - before for before, later in pairwise(sorted(times))
                                   if later > begin_us and before < end_us))
    return worst_us / 1000


def longest_stand_s(records: Mapping[str, Record], begin_us: int, end_us: int) -> float:
    """Return the longest time without motion of one robot that overlaps `begin_us` to `end_us`, in full up to the end.

    A robot that stands since before the first harm must not pass, so its time counts from its own start.
    """
    holds = ((begin, min(end or end_us, end_us)) for record in records.values() for begin, end in record["holds"])
    return max((end - begin for begin, end in holds if begin < end_us and end > begin_us), default=0) / 1e6


def slowest_again_s(records: Mapping[str, Record], since_us: int) -> float:
    """Return the time from `since_us` to the first command of the last robot, or infinity."""
    firsts_us = (next((at_us for at_us, _, _ in record["accepted"] if at_us >= since_us), math.inf)
                 for record in records.values())
    return (max(firsts_us) - since_us) / 1e6


def drivers_that_return(records: Mapping[str, Record]) -> int:
    """Count the sessions that drove a robot again after another one had driven it: two drivers at one time."""
    count = 0
    for record in records.values():
        former: set[str] = set()
        driving = ""
        for _, session, _ in record["accepted"]:
            if session != driving:
                count += session in former
                former.add(driving)
                driving = session
    return count


def changes_of_driver(records: Mapping[str, Record]) -> int:
    """Count the changes of the driver over all robots."""
    return sum(before != after for record in records.values()
               for (_, before, _), (_, after, _) in pairwise(record["accepted"]))


def looks_per_frame(records: Mapping[str, Record]) -> float:
    """Return the number of answers of all services per frame of all robots."""
    sent = sum(len(record["sent_us"]) for record in records.values())
    return sum(int(record["answers"]) for record in records.values()) / max(1, sent)


def loaded_checks(
    records: Mapping[str, Record], services: int, begin_us: int, end_us: int, received: float
) -> Iterator[Check]:
    """Yield the checks of several services with a slow detector. They `received` frames from `begin_us` to `end_us`."""

    def within(times_us: Iterable[int]) -> int:
        return sum(begin_us <= at_us < end_us for at_us in set(times_us))

    answered = sum(within(captured_us for _, _, captured_us in one["accepted"]) for one in records.values())
    sent = sum(within(one["sent_us"]) for one in records.values())
    fps = answered * 1e6 / (end_us - begin_us) / LOADED_ROBOTS
    name = f"{services} service{'s' * (services > 1)}"
    yield at_least(f"{name}: answered for each robot", fps, "fps", LOADED_FPS[services])
    if services > 1:
        yield at_most(f"{name}: frames received over frames sent", received / max(1, sent), "", MOST_LOOKS)


def least_harms(bounds: SharingBounds, seconds: float, each: int = 1) -> int:
    """Return the smallest number of harms in a run of this length, with `each` harms in turn."""
    return each * max(1, int(seconds // bounds.harm_s))


def sharing_checks(
    bounds: SharingBounds, records: Mapping[str, Record], spans_us: Sequence[tuple[int, int]], each: int = 1
) -> Iterator[Check]:
    """Yield the checks of a row. `spans_us` are the times from each harm to the next one, of `each` harms in turn."""
    begin_us, end_us = spans_us[0][0], spans_us[-1][1]
    driven = sum(any(end_us - _LAST_US <= at_us < end_us for at_us, _, _ in one["accepted"])
                 for one in records.values())
    yield at_least("robots that drive at the end", float(driven), "", bounds.robots)
    if bounds.stands_s is not None:
        stands = longest_stand_s(records, begin_us, end_us)
        yield at_most(f"a robot stands, worst of {len(spans_us)} times", stands, "s", bounds.stands_s)
    if bounds.gap_ms is not None:
        gap = max(worst_gap_ms(records, *span) for span in spans_us[each - 1 :: each])
        yield at_most("between two commands, worst robot", gap, "ms", bounds.gap_ms)
    if bounds.again_s is not None:
        again = max(slowest_again_s(records, begin) for begin, _ in spans_us[each - 1 :: each])
        yield at_most("drives again, worst robot", again if again < math.inf else None, "s", bounds.again_s)
    changed = changes_of_driver(records)
    if bounds.least_changes:
        yield at_least("changes of the driver", float(changed), "", bounds.least_changes * len(spans_us))
    yield at_most(f"two drivers at once, in {changed} changes", float(drivers_that_return(records)), "", 0)
    if bounds.services > 1:
        yield at_most("answers of all services over frames", looks_per_frame(records), "", MOST_LOOKS)


# --- scenes ------------------------------------------------------------------------------------------------------


@dataclass
class Site:
    """Robots, routers and services on the stage."""

    stage: Stage
    processes: Processes
    wire: ShapedWire
    bounds: SharingBounds
    settings: Settings
    running: dict[str, str] = field(default_factory=dict)
    """Name of each router and service -> name of its process."""
    ended_s: list[float] = field(default_factory=list)
    joined_s: list[float] = field(default_factory=list)
    """Time of each robot that joined, from its first image, connected or not, to its first accepted command."""
    _starts: int = 0

    def start_router(self, number: int) -> None:
        """Start a router that connects to the other one."""
        others = [endpoint for index, endpoint in enumerate(_endpoints(self.bounds)) if index != number]
        listen = f"tcp/0.0.0.0:{_PORTS[number]}"
        self._start(f"router{number}", "router: on", "router", "--listen", listen, *_connect(others))

    def start_service(self, name: str) -> None:
        """Start a service that shares. Its name is the same at the next start."""
        # First the router on its side.
        near = ADDRESS_B if name in self.bounds.beyond else ADDRESS_A
        endpoints = sorted(_endpoints(self.bounds), key=lambda endpoint: near not in endpoint)
        self._start(name, "shares robots", "vision", "--share", "--name", name, *self._detector(name),
                    *_connect(endpoints))

    def start_robots(self, first: int, robots: int, pause_s: float) -> str:
        """Start a process of robots. Returns its name."""
        name = f"robots-{first}"
        changes = {"first": first, "robots": robots, "pause_s": pause_s, "notes": self.stage.folder / f"{name}.json"}
        settings = self.settings.model_copy(update=changes)
        self.processes.start(name, [settings.model_dump_json()], namespace=self.wire.robot_side,
                             module="sightline.benchmarks.network.gated_robots")
        return name

    def records(self) -> dict[str, Record]:
        """Return the records of the robots that existed from the start."""
        records: dict[str, Record] = {}
        for notes in self.stage.folder.glob("robots-*.json"):
            records |= json.loads(notes.read_text("utf-8"))
        return {name: record for name, record in records.items() if int(name[1:]) <= self.bounds.robots}

    def received(self) -> tuple[int, float]:
        """Return the time, and the frames that the services on the robots' side received, by their own counters."""
        ports = [_metrics_port(name) for name in self.running if name.startswith("v")]
        command = ["ip", "netns", "exec", self.wire.robot_side, sys.executable, "-P", "-c", _READ_METRICS, *ports]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise HardwareError(f"the services show no metrics: {done.stderr[-160:]}")
        at_us, *lines = done.stdout.splitlines()
        return int(at_us), sum(float(line.split()[-1]) for line in lines if line.startswith(_RECEIVED))

    def join(self, number: int) -> None:
        """Let another robot join for a while."""
        name = self.start_robots(self.bounds.robots + 1 + number, 1, 0.0)
        self.processes.wait_line(name, "playing")
        time.sleep(3.0)
        self.processes.end_one(name)
        (record,) = json.loads((self.stage.folder / f"{name}.json").read_text("utf-8")).values()
        first_us = record["accepted"][0][0] if record["accepted"] else math.inf
        self.joined_s.append((first_us - record["began_us"]) / 1e6)

    def kill(self, name: str) -> None:
        """Kill a process with SIGKILL."""
        self.processes.kill(self.running.pop(name))

    def end(self, name: str) -> None:
        """End a process with SIGTERM, and record the time that it takes."""
        began_s = time.monotonic()
        self.processes.end_one(self.running.pop(name))
        self.ended_s.append(time.monotonic() - began_s)

    def freeze(self, name: str, seconds: float) -> None:
        """Suspend a process for a while."""
        self.processes.signal(self.running[name], signal.SIGSTOP)
        time.sleep(seconds)
        self.processes.signal(self.running[name], signal.SIGCONT)

    def _detector(self, name: str) -> tuple[str, ...]:
        """Return the detector of a service. One under load shows its counters."""
        if not self.bounds.each_us:
            return ("--detector", DETECTOR)
        return ("--detector", _SLOW_DETECTOR, "--set", f"detector.options.each_us={self.bounds.each_us}",
                "--metrics", _metrics_port(name))

    def _start(self, name: str, line: str, *arguments: str) -> None:
        # Each start has a separate log, because the start waits for its first line.
        self._starts += 1
        process = self.running[name] = f"{name}-{self._starts}"
        namespace = self.wire.far_side if name in self.bounds.beyond else self.wire.robot_side
        self.processes.start(process, list(arguments), namespace=namespace)
        self.processes.wait_line(process, line)


def _metrics_port(name: str) -> str:
    """Return the port of the counters of service `v0`, `v1` and so on."""
    return f"{9465 + int(name[1:])}"


def _endpoints(bounds: SharingBounds) -> list[str]:
    """Return the endpoint of each router."""
    return [f"tcp/{ADDRESS_B if f'router{number}' in bounds.beyond else ADDRESS_A}:{_PORTS[number]}"
            for number in range(bounds.routers)]


def _connect(endpoints: Sequence[str]) -> list[str]:
    return [word for endpoint in endpoints for word in ("--connect", endpoint)]


def _restarted(end: Callable[[Site, str], None]) -> Callable[[Site, int], None]:
    def harm(site: Site, number: int) -> None:
        name = f"v{number % site.bounds.services}"
        end(site, name)
        time.sleep(1.5)
        site.start_service(name)
        time.sleep(2.0)

    return harm


def _scaled(site: Site, _number: int) -> None:
    """Scale from three services to five and back to three."""
    for name in ("v3", "v4"):
        site.start_service(name)
        time.sleep(1.5)
    for name in ("v3", "v4"):
        site.end(name)
        time.sleep(1.5)


def _frozen(site: Site, number: int) -> None:
    site.freeze(f"v{number % site.bounds.services}", _FROZEN_S)
    time.sleep(4.0)


def _parted(site: Site, _number: int) -> None:
    site.wire.shape(site.stage.seeded(both(cut=True)))
    time.sleep(CUT_S)


def _healed(site: Site, _number: int) -> None:
    site.wire.shape(site.stage.seeded(both(delay_ms=1)))
    time.sleep(_HEALED_S)


def _cut(site: Site, number: int) -> None:
    _parted(site, number)
    _healed(site, number)


def _router_killed(site: Site, number: int) -> None:
    site.kill(f"router{number % 2}")
    time.sleep(3.0)
    site.start_router(number % 2)
    time.sleep(3.0)


def _router_frozen(site: Site, number: int) -> None:
    site.freeze(f"router{number % 2}", 5.0)
    time.sleep(4.0)


def _nothing(_site: Site, _number: int) -> None:
    time.sleep(5.0)


HARMS: Final[Mapping[str, Sequence[Callable[[Site, int], None]]]] = {
    "shared-killed": (_restarted(Site.kill),), "shared-rolling": (_restarted(Site.end),), "shared-scaled": (_scaled,),
    "shared-frozen": (_frozen,), "shared-cut": (_cut,), "shared-alone": (_parted, _healed),
    "shared-router": (_router_killed,), "shared-router-frozen": (_router_frozen,), "shared-parted": (_parted, _healed),
    "shared-joined": (Site.join,), "shared-200": (_nothing,),
}
"""Harms in turn."""


def shared(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Do the harms of the row, each as often as the others, until the end of the time."""
    bounds, harms = BOUNDS[row.name], HARMS[row.name]
    begins_us: list[int] = []
    with _site(row, stage, bounds) as site:
        end_s = time.monotonic() + stage.setting.seconds
        while not begins_us or time.monotonic() < end_s:
            for harm in harms:
                begins_us.append(monotonic_us())
                harm(site, len(begins_us) - 1)
        spans_us = list(pairwise([*begins_us, monotonic_us()]))
        site.processes.end()
    records = site.records()
    least = least_harms(bounds, stage.setting.seconds, len(harms))
    checks = [at_least("injected", float(len(spans_us)), "times", least),
              *sharing_checks(bounds, records, spans_us, len(harms))]
    if site.joined_s:
        slowest_s = max(site.joined_s)
        checks.append(at_most("a robot joins, slowest", slowest_s if slowest_s < math.inf else None, "s", JOINS_S))
    if site.ended_s:
        checks.append(at_most("a service ends, slowest", max(site.ended_s), "s", ENDS_S))
    return NetworkRun(row, stage.seed, len(spans_us), (), tuple(checks))


def loaded(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Load one, two and four services in turn with a detector that is too slow for one of them."""
    checks: list[Check] = []
    for services in LOADED_FPS:
        part = replace(stage, folder=stage.folder / f"services-{services}")
        part.folder.mkdir()
        with _site(row, part, SharingBounds(services, None, robots=LOADED_ROBOTS, each_us=_LOADED_US)) as site:
            begin_us, before = site.received()
            time.sleep(stage.setting.seconds / len(LOADED_FPS))
            end_us, after = site.received()
            site.processes.end()
        checks += loaded_checks(site.records(), services, begin_us, end_us, after - before)
    return NetworkRun(row, stage.seed, 0, (), tuple(checks))


@contextmanager
def _site(row: NetworkCase, stage: Stage, bounds: SharingBounds) -> Iterator[Site]:
    pictures = stage.folder / "small"
    pictures.mkdir()
    write_pictures(pictures, WIDTH_PX, HEIGHT_PX)
    settings = Settings(endpoint=",".join(_endpoints(bounds)), robots=bounds.robots, fps=bounds.fps, pictures=pictures,
                        notes=stage.folder / "notes.json", seed=stage.seed)
    with stage.wire() as wire, stage.processes("processes") as processes:
        wire.shape(stage.seeded(row.phases[0].shapes))
        site = Site(stage, processes, wire, bounds, settings)
        for number in range(bounds.routers):
            site.start_router(number)
        for number in range(bounds.services):
            site.start_service(f"v{number}")
        each = bounds.robots // _ROBOT_PROCESSES
        names = [site.start_robots(first, each, 1.0) for first in range(1, bounds.robots + 1, each)]
        for name in names:
            processes.wait_line(name, "playing")
        time.sleep(_SETTLE_S)
        yield site
        wire.shape(LinkShapes())
