"""A row of `bench network`: twenty robots and one vision for all of them. Shell (processes)."""

import json
import time
from collections.abc import Mapping, Sequence
from typing import Final

from sightline.benchmarks.loop_figures import LoopCheck, at_most, percentile
from sightline.benchmarks.loop.pictures import write_pictures
from sightline.benchmarks.network.robots import Settings
from sightline.benchmarks.network.cases import Case
from sightline.benchmarks.network.stage import EVERYWHERE, NetworkRun, Stage
from sightline.protocol.clock import monotonic_us
from sightline.sim.network_emulator import LinkShapes
from sightline.sim.tun_emulator import ADDRESS_B

ROBOTS: Final = 20
WIDTH_PX, HEIGHT_PX, FPS = 320, 240, 15.0
FLEET_LEAST_FPS: Final = 14.0
MOST_P95_MS: Final = 80.0
_FLEET_SETTLE_S: Final = 3.0


def fleet(row: Case, stage: Stage) -> NetworkRun:
    """All of them for as long as there is time; judged by the robot that fared worst."""
    pictures = stage.folder / "small"
    pictures.mkdir()
    write_pictures(pictures, WIDTH_PX, HEIGHT_PX)
    settings = Settings(endpoint=f"tcp/{ADDRESS_B}:7447", robots=ROBOTS, fps=FPS, pictures=pictures,
                        notes=stage.folder / "notes.json", seed=stage.seed)
    with stage.wire() as wire, stage.crew("crew") as crew:
        before = wire.shape(stage.seeded(row.phases[0].shapes))
        crew.start("vision", "sightline.operator_side.cli.app", "vision", "--robot", "r*", "--listen", f"tcp/{EVERYWHERE}:7447",
                   namespace=wire.far_side)
        crew.wait_line("vision", "looking for robots")
        crew.start("robots", "sightline.benchmarks.network.robots", settings.model_dump_json(), namespace=wire.robot_side)
        crew.wait_line("robots", f"playing {ROBOTS} robots")
        time.sleep(_FLEET_SETTLE_S)
        begin_us = monotonic_us()
        time.sleep(stage.setting.seconds)
        end_us = monotonic_us()
        crew.check()
        injected = wire.shape(LinkShapes()) - before
        crew.end()
    answers = json.loads(settings.notes.read_text("utf-8"))
    harmed = LoopCheck("injected", float(injected), "", 1.0, injected >= 1)
    return NetworkRun(row, stage.seed, injected, (), (harmed, *fleet_checks(answers, begin_us, end_us)))


def fleet_checks(
    answers: Mapping[str, Sequence[Sequence[int]]], begin_us: int, end_us: int
) -> tuple[LoopCheck, LoopCheck, LoopCheck]:
    """The robot with the fewest answers, and the one with the oldest. `answers`: (captured_us, age_us) of each."""
    seconds = (end_us - begin_us) / 1e6
    ages_ms = [[age_us / 1000 for at_us, age_us in seen if begin_us <= at_us < end_us] for seen in answers.values()]
    least_fps = min((len(one) / seconds for one in ages_ms), default=0.0)
    p95_ms = [percentile(one, 95) for one in ages_ms]
    known = [one for one in p95_ms if one is not None]
    oldest_ms = max(known) if known and len(known) == len(p95_ms) else None
    return (
        LoopCheck("robots", float(len(answers)), "", float(ROBOTS), len(answers) >= ROBOTS),
        LoopCheck("answered, least", least_fps, "fps", FLEET_LEAST_FPS, least_fps >= FLEET_LEAST_FPS),
        at_most("age p95, worst robot", oldest_ms, "ms", MOST_P95_MS),
    )
