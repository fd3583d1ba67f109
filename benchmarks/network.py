"""`sightline bench network`: robot and vision in two network namespaces, a shaped wire between. Shell (processes).

The robot plays recorded pictures through a camera that can change their quality and size; nothing is rendered.
"""

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import cv2
import numpy as np

from benchmarks.interrupted import terminated_like_interrupted
from benchmarks.loop_crew import Crew
from benchmarks.loop_figures import LoopCheck
from benchmarks.loop_ours import ROBOT
from benchmarks.loop_pictures import write_pictures
from benchmarks.network_figures import NetworkFigures, Stretch, figures_of, judge
from benchmarks.network_rows import Row, spans_s
from protocol.errors import ConfigError
from sim.wire import Shapes
from sim.wire_tun import ADDRESS_A, why_impossible

WIDTH_PX, HEIGHT_PX, FPS = 640, 480, 30.0
QUALITY: Final = 80
PORTS: Final = {"zenoh": "tcp/{}:7447", "websocket": "ws://{}:9090"}
TOKENED: Final = ("websocket",)
_SETTLE_S: Final = 2.0


class BenchWire(Protocol):
    """What shapes the packets between the two namespaces."""

    robot_side: str
    far_side: str

    def shape(self, shapes: Shapes) -> int:
        """Put `shapes` in force; returns how many packets were harmed so far."""
        ...


Wiring = Callable[[Path], AbstractContextManager[BenchWire]]


@dataclass(frozen=True, slots=True)
class NetworkSetting:
    """`seconds` are shared among a row's phases; `seed` draws what the wire loses."""

    transport: str = "zenoh"
    seconds: float = 20.0
    seeds: tuple[int, ...] = (1,)

    def __post_init__(self) -> None:
        """Raise ConfigError for what cannot be run."""
        if self.transport not in PORTS:
            raise ConfigError(f"--transport {self.transport!r}: {', '.join(PORTS)}")
        if not 4 <= self.seconds <= 600:
            raise ConfigError(f"--seconds {self.seconds:g}: 4 to 600")


@dataclass(frozen=True, slots=True)
class NetworkRun:
    """One row with one seed; `injected` packets were delayed, lost or cut."""

    row: Row
    seed: int
    injected: int
    figures: tuple[NetworkFigures, ...]
    checks: tuple[LoopCheck, ...]


def run_network(
    rows: Sequence[Row], setting: NetworkSetting, wiring: Wiring, say: Callable[[NetworkRun], None]
) -> list[NetworkRun]:
    """Every row with every seed. Raises ConfigError without root, HardwareError for a process that does not run."""
    why = why_impossible()
    if why:
        raise ConfigError(f"bench network {why}: it makes network namespaces; run it as root on Linux")
    runs: list[NetworkRun] = []
    with terminated_like_interrupted(), tempfile.TemporaryDirectory(prefix="sightline-network-") as name:
        film = write_film(Path(name))
        for number, (row, seed) in enumerate((row, seed) for row in rows for seed in setting.seeds):
            folder = Path(name) / str(number)
            folder.mkdir()
            runs.append(_run_row(row, seed, setting, Stage(film, folder, wiring)))
            say(runs[-1])
    return runs


def write_film(folder: Path) -> Path:
    """The recorded pictures as a film: a camera that decodes may change quality and size."""
    pictures, path = folder / "pictures", folder / "film.avi"
    pictures.mkdir()
    write_pictures(pictures, WIDTH_PX, HEIGHT_PX)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (WIDTH_PX, HEIGHT_PX))
    for jpeg in sorted(pictures.iterdir()):
        writer.write(np.asarray(cv2.imread(str(jpeg))))
    writer.release()
    return path


@dataclass(frozen=True, slots=True)
class Stage:
    """Where a row is run: what the camera plays, a folder of its own, what makes the wire."""

    film: Path
    folder: Path
    wiring: Wiring


def _run_row(row: Row, seed: int, setting: NetworkSetting, stage: Stage) -> NetworkRun:
    with stage.wiring(stage.folder / "wire.log") as wire, Crew(stage.folder) as crew:
        # From the first packet on: what TCP learned of a better wire would be what is measured.
        before = wire.shape(_seeded(row.phases[0].shapes, seed))
        _start(wire, crew, setting, stage)
        stretches = []
        for phase, seconds in zip(row.phases, spans_s(row, setting.seconds), strict=True):
            wire.shape(_seeded(phase.shapes, seed))
            begin_us = _now_us()
            settle_s = phase.settle_s or (0.0 if phase.seconds else _SETTLE_S)
            time.sleep(seconds if phase.seconds else seconds + settle_s)
            stretches.append(Stretch(begin_us, begin_us + round(settle_s * 1e6), _now_us()))
            crew.check()
        injected = wire.shape(Shapes()) - before
        crew.end()
    notes = json.loads((stage.folder / "notes.json").read_text("utf-8"))
    figures = tuple(figures_of(notes, stretch) for stretch in stretches)
    label = f"{row.name}.{seed}"
    harmed = LoopCheck(f"{label} injected", float(injected), "", 1.0, injected >= 1)
    return NetworkRun(row, seed, injected, figures, (harmed, *judge(row, figures, label)))


def _seeded(shapes: Shapes, seed: int) -> Shapes:
    return shapes.model_copy(update={"seed": seed})


def _start(wire: BenchWire, crew: Crew, setting: NetworkSetting, stage: Stage) -> None:
    """Robot and watcher on one side, vision on the other, seen driving over the wire as it is."""
    form = PORTS[setting.transport]
    config = _robot_toml(form.format("0.0.0.0"), stage)
    crew.start("robot", "operator_side.cli", "robot", "--config", str(config), namespace=wire.robot_side)
    crew.wait_line("robot", f"robot {ROBOT}: on")
    crew.start("watch", "benchmarks.network_watch", form.format("127.0.0.1"), str(stage.folder / "notes.json"),
               namespace=wire.robot_side)
    crew.wait_line("watch", "watching")
    crew.start("vision", "operator_side.cli", "vision", "--robot", ROBOT, "--connect", form.format(ADDRESS_A),
               *(("--secure", str(stage.folder)) if setting.transport in TOKENED else ()), namespace=wire.far_side)
    crew.wait_line("vision", "target seen")


def _robot_toml(endpoint: str, stage: Stage) -> Path:
    """JSON's strings and numbers are TOML's too."""
    folder, path = stage.folder, stage.folder / "robot.toml"
    camera = f"path = {json.dumps(str(stage.film))}, quality = {QUALITY}, hfov_deg = 80.0"
    secure = ""
    if endpoint.startswith("ws"):  # beyond loopback it asks for tokens
        secure = f"secure = {json.dumps(str(folder))}\n"
        for role in ("vision", "operator"):
            (folder / f"{role}.token").write_text(f"{role}-of-the-bench", "ascii")
    path.write_text(
        f"robot = {json.dumps(ROBOT)}\nlisten = [{json.dumps(endpoint)}]\nstate_dir = {json.dumps(str(folder))}\n"
        f"{secure}"
        f'[camera]\nkind = "video"\noptions = {{{camera}}}\n[drive]\nkind = "log"\n[safety]\nauto_arm = true\n',
        "utf-8",
    )
    return path


def _now_us() -> int:
    return time.monotonic_ns() // 1000
