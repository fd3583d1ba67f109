"""Rows of `bench network`: the driving vision, the router and the robot's address change. Shell (processes).

Judged from what the wheels were told: they stop, and turn again.
"""

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Final

from sightline.benchmarks.loop.processes import BenchProcesses
from sightline.benchmarks.loop_figures import LoopCheck, at_most
from sightline.benchmarks.network.cases import Case
from sightline.benchmarks.network.stage import EVERYWHERE, BenchWire, NetworkRun, Stage, start_robot, start_vision
from sightline.benchmarks.network.figures import WheelCommand, moves_again_s, read_wheel_commands
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError
from sightline.sim.tun_emulator import ADDRESS_A, ADDRESS_B, move_address

TAKES_OVER_S: Final = 1.5
BACK_S: Final = 3.0
"""A dead link is noticed by its lease of 2 s; then it is tried again every 0.2 to 1 s."""
DOWN_S: Final = 1.0
_STEADY_S: Final = 1.5
"""Before the next harm: whatever was to come back has come."""
_PATIENCE_S: Final = 10.0
_OTHER_ADDRESS: Final = "10.213.77.3"


def standby(row: Case, stage: Stage) -> NetworkRun:
    """Two visions; whoever drives is killed and a new one stands by, for as long as there is time."""
    endpoint = stage.form.format(ADDRESS_A)
    with _on_site(row, stage) as (wire, ending):
        start_robot(stage, ending.enter_context(stage.crew("robot")), wire.robot_side)
        visions: list[tuple[BenchProcesses, int]] = []

        def start() -> None:
            crew = ending.enter_context(stage.crew(f"vision{len(visions)}"))
            visions.append((crew, start_vision(stage, crew, wire.far_side, endpoint)))

        def harm() -> int:
            start()
            time.sleep(_STEADY_S)
            killed_us = monotonic_us()
            os.kill(visions[-2][1], signal.SIGKILL)
            return killed_us

        start()
        return _checks(row, stage, harm, "drives again after", TAKES_OVER_S)


def router(row: Case, stage: Stage) -> NetworkRun:
    """Everybody is a client of a router that is killed; counted from when there is one again."""
    with _on_site(row, stage) as (wire, ending):
        crews: list[tuple[BenchProcesses, int]] = []

        def start() -> None:
            crew = ending.enter_context(stage.crew(f"router{len(crews)}"))
            crews.append((crew, start_router(crew, wire)))

        def harm() -> int:
            time.sleep(_STEADY_S)
            os.kill(crews[-1][1], signal.SIGKILL)
            time.sleep(DOWN_S)
            start()
            return monotonic_us()

        start()
        _start_clients(stage, wire, ending)
        return _checks(row, stage, harm, "drives again after", BACK_S)


def moved(row: Case, stage: Stage) -> NetworkRun:
    """The robot's end of the wire gets another address, and the one before back the next time."""
    addresses = [ADDRESS_A, _OTHER_ADDRESS]
    with _on_site(row, stage) as (wire, ending):

        def harm() -> int:
            time.sleep(_STEADY_S)
            moved_us = monotonic_us()
            move_address(wire.robot_side, *addresses)
            addresses.reverse()
            return moved_us

        start_router(ending.enter_context(stage.crew("router")), wire)
        _start_clients(stage, wire, ending)
        return _checks(row, stage, harm, "drives again after", BACK_S)


def start_router(crew: BenchProcesses, wire: BenchWire) -> int:
    """`sightline router` beyond the radio; returns its process id."""
    pid = crew.start("router", "sightline.operator_side.cli.app", "router", "--listen", f"tcp/{EVERYWHERE}:7447",
                     namespace=wire.far_side)
    crew.wait_line("router", "router: on")
    return pid


@contextmanager
def _on_site(row: Case, stage: Stage) -> Iterator[tuple[BenchWire, ExitStack]]:
    with stage.wire() as wire, ExitStack() as ending:
        wire.shape(stage.seeded(row.phases[0].shapes))
        yield wire, ending


def _start_clients(stage: Stage, wire: BenchWire, ending: ExitStack) -> None:
    start_robot(stage, ending.enter_context(stage.crew("robot")), wire.robot_side, connect=f"tcp/{ADDRESS_B}:7447")
    start_vision(stage, ending.enter_context(stage.crew("vision")), wire.far_side, "tcp/127.0.0.1:7447")


def _checks(row: Case, stage: Stage, harm: Callable[[], int], what: str, bound_s: float) -> NetworkRun:
    """Do `harm` until the time is over; the worst of the times until the wheels turned again."""
    _wait_moving(stage)
    end_s = time.monotonic() + stage.setting.seconds
    took_s: list[float | None] = []
    while not took_s or time.monotonic() < end_s:
        harmed_us = harm()
        took_s.append(_wait_again(stage, harmed_us))
    checks = (
        LoopCheck("injected", float(len(took_s)), "times", 1.0, ok=True),
        at_most(f"{what}, worst", _worst(took_s), "s", bound_s),
    )
    return NetworkRun(row, stage.seed, len(took_s), (), checks, {f"time {n}": one for n, one in enumerate(took_s)})


def _worst(took_s: Sequence[float | None]) -> float | None:
    known = [one for one in took_s if one is not None]
    return max(known) if len(known) == len(took_s) else None


def _wait_moving(stage: Stage) -> None:
    deadline_s = time.monotonic() + _PATIENCE_S
    while not any(row.moves for row in _wheel_commands(stage)):
        if time.monotonic() > deadline_s:
            raise HardwareError(f"the wheels do not turn within {_PATIENCE_S:g} s of all being on")
        time.sleep(0.1)


def _wait_again(stage: Stage, harmed_us: int) -> float | None:
    """Until the wheels have stood and turned again, or it has taken too long."""
    deadline_s = time.monotonic() + _PATIENCE_S
    again_s = None
    while time.monotonic() < deadline_s and not again_s:
        time.sleep(0.1)
        again_s = moves_again_s(_wheel_commands(stage), harmed_us, monotonic_us())
    return again_s


def _wheel_commands(stage: Stage) -> list[WheelCommand]:
    return read_wheel_commands(stage.wheels.read_text("ascii")) if stage.wheels.exists() else []
