"""Provide the rows of `bench network` with a setting, a folder, robots and vision services. Shell (files)."""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

from sightline.benchmarks.loop.ours import ROBOT
from sightline.benchmarks.network.cases import WEBSOCKET, ZENOH, NetworkCase
from sightline.benchmarks.network.figures import NetworkFigures
from sightline.evaluation.checks import Check
from sightline.evaluation.processes import Processes
from sightline.protocol.errors import ConfigError
from sightline.sim.network_emulator import LinkShapes

PORTS: Final = {ZENOH: "tcp/{}:7447", WEBSOCKET: "ws://{}:9090"}
EVERYWHERE: Final = "0.0.0.0"
QUALITY: Final = 80
DETECTOR: Final = "hsv"
"""The cheapest one: the rows measure links."""
_HFOV_DEG: Final = 80.0
_TOKENED: Final = (WEBSOCKET,)


class ShapedWire(Protocol):
    """Shapes the packets between the two namespaces."""

    robot_side: str
    far_side: str
    counts: dict[str, Counter[str]]

    def shape(self, shapes: LinkShapes) -> int:
        """Apply `shapes`. Returns how many packets were harmed so far."""
        ...


Wiring = Callable[[Path], AbstractContextManager[ShapedWire]]


@dataclass(frozen=True, slots=True)
class NetworkSetting:
    """`seconds` are shared among the phases of a row; `seeds` draw the losses of the wire."""

    transport: str = ZENOH
    seconds: float = 20.0
    seeds: tuple[int, ...] = (1,)

    def __post_init__(self) -> None:
        """Raise ConfigError for settings that cannot run."""
        if self.transport not in PORTS:
            raise ConfigError(f"--transport {self.transport!r}: {', '.join(PORTS)}")
        if not 4 <= self.seconds <= 600:
            raise ConfigError(f"--seconds {self.seconds:g}: 4 to 600")
        if not self.seeds:
            raise ConfigError("--seeds: at least one, e.g. 1,2,3")


@dataclass(frozen=True, slots=True)
class NetworkRun:
    """One row with one seed. `injected` counts harmed packets or processes; `facts` are further observations."""

    row: NetworkCase
    seed: int
    injected: int
    figures: tuple[NetworkFigures, ...]
    checks: tuple[Check, ...]
    facts: Mapping[str, float | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Stage:
    """One run of a row: the images of the camera, a folder, and the wire."""

    film: Path
    pictures: Path
    folder: Path
    wiring: Wiring
    setting: NetworkSetting
    seed: int

    def wire(self) -> AbstractContextManager[ShapedWire]:
        """Return the two namespaces with the wire between them."""
        return self.wiring(self.folder / "wire.log")

    def seeded(self, shapes: LinkShapes) -> LinkShapes:
        """Seed `shapes` from the seed of this run."""
        return shapes.model_copy(update={"seed": self.seed})

    def processes(self, name: str) -> Processes:
        """Return processes in a separate folder, because some may be killed while others continue."""
        folder = self.folder / name
        folder.mkdir()
        return Processes(folder, oldest_first=True)

    @property
    def form(self) -> str:
        """Return an endpoint with a placeholder for the host."""
        return PORTS[self.setting.transport]

    @property
    def wheels(self) -> Path:
        """Return the file of the wheel commands: t_us,left_rad_s,right_rad_s."""
        return self.folder / "wheels.csv"


Scene = Callable[[NetworkCase, Stage], NetworkRun]


def start_robot(
    stage: Stage, processes: Processes, namespace: str, *, connect: str = "", passes_through: bool = False
) -> int:
    """Start a robot that listens, or connects to a router. Returns its process id when it is ready."""
    config = _robot_toml(stage, connect, passes_through)
    pid = processes.start("robot", ["robot", "--config", str(config)], namespace=namespace)
    processes.wait_line("robot", f"robot {ROBOT}: on")
    return pid


def start_vision(stage: Stage, processes: Processes, namespace: str, endpoint: str) -> int:
    """Start a vision service and wait until it works. Returns its process id."""
    secure = ("--secure", str(stage.folder)) if stage.setting.transport in _TOKENED else ()
    arguments = ["vision", "--robot", ROBOT, "--detector", DETECTOR, "--connect", endpoint, *secure]
    pid = processes.start("vision", arguments, namespace=namespace)
    processes.wait_line("vision", "target seen")
    return pid


def _robot_toml(stage: Stage, connect: str, passes_through: bool) -> Path:
    """Write robot.toml; strings and numbers of JSON are valid TOML."""
    path = stage.folder / "robot.toml"
    where = {"connect": [connect]} if connect else {"listen": [stage.form.format(EVERYWHERE)]}
    top: dict[str, Any] = {"robot": ROBOT, **where, "state_dir": str(stage.folder)}
    if stage.setting.transport in _TOKENED:  # beyond loopback it requires tokens
        top["secure"] = str(stage.folder)
        for role in ("vision", "operator"):
            (stage.folder / f"{role}.token").write_text(f"{role}-of-the-bench", "ascii")
    path.write_text(
        "".join(f"{name} = {json.dumps(value)}\n" for name, value in top.items())
        + f"[camera]\n{_camera_toml(stage, passes_through)}"
        + f'[drive]\nkind = "log"\noptions = {{path = {json.dumps(str(stage.wheels))}}}\n[safety]\nauto_arm = true\n',
        "utf-8",
    )
    return path


def _camera_toml(stage: Stage, passes_through: bool) -> str:
    kind, path = ("folder", stage.pictures) if passes_through else ("video", stage.film)
    quality = "" if passes_through else f"quality = {QUALITY}, "
    return f'kind = "{kind}"\noptions = {{path = {json.dumps(str(path))}, {quality}hfov_deg = {_HFOV_DEG}}}\n'
