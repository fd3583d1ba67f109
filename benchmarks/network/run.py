"""`sightline bench network`: robot and vision in two network namespaces, a shaped wire between. Shell (processes).

The robot plays recorded images through a camera that can change their quality and size; nothing is rendered.
"""

import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from sightline.benchmarks.loop.figures import WheelCommand, read_wheel_commands
from sightline.benchmarks.loop.pictures import write_pictures
from sightline.benchmarks.network.cases import ZENOH, NetworkCase, spans_s
from sightline.benchmarks.network.figures import (
    Stretch,
    figures_of,
    injected_checks,
    network_checks,
    on_old_sight,
)
from sightline.benchmarks.network.scenes import fleet, moved, router, standby, uplink
from sightline.benchmarks.network.sharing import loaded, shared
from sightline.benchmarks.network.stage import (
    NetworkRun,
    NetworkSetting,
    Scene,
    ShapedWire,
    Stage,
    Wiring,
    start_robot,
    start_vision,
)
from sightline.evaluation.checks import Check, at_most
from sightline.evaluation.processes import Processes, terminated_like_interrupted
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.sim.network_emulator import LinkShapes
from sightline.sim.tun_emulator import ADDRESS_A, why_impossible

WIDTH_PX, HEIGHT_PX, FPS = 640, 480, 30.0
SCENES: Final[Mapping[str, Scene]] = {
    "uplink": uplink, "standby": standby, "router": router, "moved": moved, "fleet": fleet, "shared": shared,
    "loaded": loaded,
}
_SETTLE_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class NetworkProgress:
    """Receives the start of each run, and its result."""

    begins: Callable[[str], None]
    ended: Callable[[NetworkRun], None]


def run_network(
    rows: Sequence[NetworkCase],
    setting: NetworkSetting,
    wiring: Wiring,
    telling: NetworkProgress,
    scenes: Mapping[str, Scene],
) -> list[NetworkRun]:
    """Run every row, rows with losses with every seed. `scenes` extend `SCENES`.

    Raises ConfigError without root; a process that does not run is a failed check.
    """
    why = why_impossible()
    if why:
        raise ConfigError(f"bench network {why}: it makes network namespaces; run it as root on Linux")
    turns = [(row, seed) for row in rows for seed in (setting.seeds if row.draws else setting.seeds[:1])]
    runs: list[NetworkRun] = []
    with terminated_like_interrupted(), tempfile.TemporaryDirectory(prefix="sightline-network-") as name:
        film = write_film(Path(name))
        for number, (row, seed) in enumerate(turns, start=1):
            telling.begins(f"{row.name}, seed {seed} ({number} of {len(turns)})")
            folder = Path(name) / str(number)
            folder.mkdir()
            stage = Stage(film, film.parent / "pictures", folder, wiring, setting, seed)
            runs.append(_run(row, stage, {**SCENES, **scenes}))
            telling.ended(runs[-1])
    return runs


def write_film(folder: Path) -> Path:
    """Write the recorded images as a film, because a camera that decodes may change quality and size."""
    pictures, path = folder / "pictures", folder / "film.avi"
    pictures.mkdir()
    write_pictures(pictures, WIDTH_PX, HEIGHT_PX)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (WIDTH_PX, HEIGHT_PX))
    for jpeg in sorted(pictures.iterdir()):
        writer.write(np.asarray(cv2.imread(str(jpeg))))
    writer.release()
    return path


def _run(row: NetworkCase, stage: Stage, scenes: Mapping[str, Scene]) -> NetworkRun:
    try:
        return scenes[row.scene](row, stage) if row.scene else _course(row, stage)
    except HardwareError as error:
        why = f"runs: {error}"[:160]
        return NetworkRun(row, stage.seed, 0, (), (Check(why, None, "", 1.0, ok=False),))


def _course(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Run one robot and one vision service, with the wire shaped phase by phase."""
    with stage.wire() as wire, stage.processes("processes") as processes:
        # From the first packet on. Otherwise the figures would depend on TCP's estimate of a better wire.
        before, counts_before = wire.shape(stage.seeded(row.phases[0].shapes)), wire.counts
        _start(row, wire, processes, stage)
        stretches = []
        for phase, seconds in zip(row.phases, spans_s(row, stage.setting.seconds), strict=True):
            wire.shape(stage.seeded(phase.shapes))
            begin_us = monotonic_us()
            settle_s = phase.settle_s or (0.0 if phase.seconds else _SETTLE_S)
            time.sleep(seconds if phase.seconds else seconds + settle_s)
            stretches.append(Stretch(begin_us, begin_us + round(settle_s * 1e6), monotonic_us()))
            processes.check()
        injected = wire.shape(LinkShapes()) - before
        counts = {leg: after - counts_before[leg] for leg, after in wire.counts.items()}
        processes.end()
    notes = json.loads((stage.folder / "notes.json").read_text("utf-8"))
    rows = read_wheel_commands(stage.wheels.read_text("ascii"))
    figures = tuple(figures_of(notes, rows, stretch) for stretch in stretches)
    checks = (*injected_checks(row, counts), *network_checks(row, figures),
              *wheel_checks(rows, notes["twists"], stage.setting.transport, stretches[-1].end_us))
    total = sum(counts.values(), Counter[str]())
    lost = {"lost_percent": 100 * total["lost"] / max(1, total["taken"])} if row.draws else {}
    return NetworkRun(row, stage.seed, injected, figures, checks, lost)


def wheel_checks(
    rows: Sequence[WheelCommand], twists: Sequence[Sequence[int]], transport: str, until_us: int
) -> Iterator[Check]:
    """Yield checks of the wheel commands, independent of the robot's reports. Only Zenoh shows twists."""
    if transport == ZENOH:
        lines = on_old_sight(rows, twists, until_us)
        yield at_most("moved on frames over 400 ms", float(lines), "lines", 0)


def _start(row: NetworkCase, wire: ShapedWire, processes: Processes, stage: Stage) -> None:
    """Start robot and recorder on one side and vision on the other, and wait until the robot drives."""
    start_robot(stage, processes, wire.robot_side, passes_through=row.passes_through)
    arguments = [stage.form.format("127.0.0.1"), str(stage.folder / "notes.json")]
    processes.start("watch", arguments, module="sightline.benchmarks.network.watch", namespace=wire.robot_side)
    processes.wait_line("watch", "watching")
    start_vision(stage, processes, wire.far_side, stage.form.format(ADDRESS_A))
