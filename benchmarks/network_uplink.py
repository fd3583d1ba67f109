"""A row of `bench network`: what crosses the radio when many look at what one robot sees. Shell (processes).

Vision and all others are at a router beyond the radio. First vision alone, then a standby, a second reader and a
viewer.
"""

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Final

from sightline.benchmarks.loop.processes import BenchProcesses
from sightline.benchmarks.loop_figures import LoopCheck, at_most
from sightline.benchmarks.network_figures import sent_between
from sightline.benchmarks.network.cases import Case
from sightline.benchmarks.network.stage import BenchWire, NetworkRun, Stage, start_robot, start_vision
from sightline.benchmarks.network.scenes import start_router
from sightline.protocol.clock import monotonic_us
from sightline.sim.network_emulator import LinkShapes
from sightline.sim.tun_emulator import ADDRESS_B

MOST_SHARE: Final = 1.05
UPLINK_LEAST_FPS: Final = 25.0
"""With fewer, what is sent besides frames would weigh more on each."""
READERS: Final = 2
_AT_ROUTER: Final = "tcp/127.0.0.1:7447"
_UPLINK_SETTLE_S: Final = 2.0


def uplink(row: Case, stage: Stage) -> NetworkRun:
    """Bytes from the robot for each frame it sent, crowded over alone."""
    shapes = stage.seeded(row.phases[0].shapes)
    with stage.wire() as wire, ExitStack() as ending:
        before = wire.shape(shapes)
        crews = {name: ending.enter_context(stage.crew(name)) for name in ("site", "standby")}
        start_router(crews["site"], wire)
        # The camera's own JPEGs: none is smaller than another because the machine had more to do.
        start_robot(stage, crews["site"], wire.robot_side, connect=f"tcp/{ADDRESS_B}:7447", passes_through=True)
        start_vision(stage, crews["site"], wire.far_side, _AT_ROUTER)
        _start_notes(crews["site"], wire, stage)
        alone = _stretch(wire, shapes, stage.setting.seconds / 2)
        start_vision(stage, crews["standby"], wire.far_side, _AT_ROUTER)
        crews["site"].start("watcher", "sightline.benchmarks.loop.viewers", _AT_ROUTER, str(READERS), "0", namespace=wire.far_side)
        crews["site"].wait_line("watcher", "watching")
        crowded = _stretch(wire, shapes, stage.setting.seconds / 2)
        for crew in crews.values():
            crew.check()
        injected = wire.shape(LinkShapes()) - before
        crews["site"].end()
    notes = json.loads((stage.folder / "notes.json").read_text("utf-8"))
    return _uplink_run(row, stage, injected, [_stream_of(notes, one) for one in (alone, crowded)])


def _start_notes(crew: BenchProcesses, wire: BenchWire, stage: Stage) -> None:
    crew.start("notes", "sightline.benchmarks.network.watch", _AT_ROUTER, str(stage.folder / "notes.json"), "statuses",
               namespace=wire.far_side)
    crew.wait_line("notes", "watching")


def _stretch(wire: BenchWire, shapes: LinkShapes, seconds: float) -> tuple[int, int, int]:
    """(from, until, bytes that came from the robot in between)."""
    time.sleep(_UPLINK_SETTLE_S)
    wire.shape(shapes)
    begin_us, begin_bytes = monotonic_us(), wire.carried_bytes["ab"]
    time.sleep(seconds)
    wire.shape(shapes)
    return begin_us, monotonic_us(), wire.carried_bytes["ab"] - begin_bytes


def _stream_of(notes: Mapping[str, Sequence[Sequence[Any]]], stretch: tuple[int, int, int]) -> tuple[float, float]:
    """(bytes that crossed for each frame, frames per second)."""
    begin_us, end_us, carried = stretch
    sent = sent_between(notes["statuses"], begin_us, end_us)
    return carried / max(1.0, sent), sent * 1e6 / (end_us - begin_us)


def _uplink_run(row: Case, stage: Stage, injected: int, streams: Sequence[tuple[float, float]]) -> NetworkRun:
    (alone_bytes, alone_fps), (crowded_bytes, crowded_fps) = streams
    checks = (
        LoopCheck("injected", float(injected), "", 1.0, injected >= 1),
        at_most("bytes from the robot, over one stream", crowded_bytes / max(1.0, alone_bytes), "times", MOST_SHARE),
        LoopCheck("frames while crowded", crowded_fps, "fps", UPLINK_LEAST_FPS, crowded_fps >= UPLINK_LEAST_FPS),
    )
    facts = {"alone_bytes_per_frame": alone_bytes, "crowded_bytes_per_frame": crowded_bytes, "alone_fps": alone_fps}
    return NetworkRun(row, stage.seed, injected, (), checks, facts)
