"""A row of `bench network`: one half-duplex medium, full of video, and a person beyond it who says STOP. Shell.

Judged from the simulated motors' own log, with the fault bench's robot and judge.
"""

from collections.abc import Sequence
from typing import Final

from sightline.benchmarks.loop_figures import LoopCheck, at_most, percentile
from sightline.benchmarks.network.cases import Case
from sightline.benchmarks.network.stage import NetworkRun, Stage
from sightline.evaluation.faults.evidence import MotorRow, measure_stop, moved_on_old_sight, wheel_mps
from sightline.operator_side.faults.ledger import REQUESTED
from sightline.operator_side.faults.rig import ROBOT, RobotFixture, Setup
from sightline.benchmarks.network.stop_client import RESET, STOPPED
from sightline.protocol.errors import HardwareError, SightlineError
from sightline.sim.network_emulator import LinkShapes

REACHES_MS: Final = 300.0
REPORTED_MS: Final = REACHES_MS + 100.0
"""By the robot's own status, ten times a second: as frames age, wheels slow down by themselves, before any STOP."""
ZERO_MS: Final = 700.0
"""Reached, and then the ramp from 0.5 m/s: as the fault bench demands of every STOP."""
_READY_S: Final = 30.0
_BESIDE_S: Final = 60.0


def medium(row: Case, stage: Stage) -> NetworkRun:
    """STOP, reset and so on for as long as there is time. Raises HardwareError if anything does not run."""
    try:
        with RobotFixture(stage.folder / "rig", Setup(wired=True, camera="heavy")) as rig:
            return _medium_run(row, stage, rig)
    except SightlineError as error:
        raise HardwareError(str(error)) from None


def _medium_run(row: Case, stage: Stage, rig: RobotFixture) -> NetworkRun:
    assert rig.wire is not None
    before = rig.wire.shape(stage.seeded(row.phases[0].shapes))
    ledger = rig.folder / "person.ledger"
    arguments = [rig.endpoint, ROBOT, str(ledger), str(stage.setting.seconds), str(stage.seed)]
    rig.fleet.run("person", "sightline.benchmarks.network.stop_client", arguments, namespace=rig.wire.far_side)
    rig.fleet.wait_line("person", "person ready", _READY_S)
    if rig.fleet.exit_code("person", stage.setting.seconds + _BESIDE_S) != 0:
        raise HardwareError(f"the person gave up: {rig.fleet.log('person').read_text('utf-8').strip()[-200:]}")
    injected = rig.wire.shape(LinkShapes()) - before
    told_us = [one.t_us for one in rig.noted("person", REQUESTED)]
    rows = rig.motors()
    checks = (
        LoopCheck("injected", float(injected), "", 1.0, injected >= 1),
        *stop_checks_of(rows, told_us, [one.t_us for one in rig.noted("person", RESET)]),
        reported_check(told_us, [one.frame_us for one in rig.noted("person", STOPPED)]),
        at_most("moved on frames over 400 ms", moved_on_old_sight(rows, rig.sent(), None), "lines", 0),
    )
    return NetworkRun(row, stage.seed, injected, (), checks, {"stops": len(told_us)})


def stop_checks_of(rows: Sequence[MotorRow], told_us: Sequence[int], reset_us: Sequence[int]) -> Sequence[LoopCheck]:
    """When each STOP, said at `told_us`, shows in what the motors were told, and when the wheels stood; each holds
    until the wheels turn after its reset.
    """
    ends_us = [_again_us(rows, at_us) for at_us in reset_us]
    pairs = list(zip(told_us, ends_us, strict=True))
    reached = [reached_ms(_window(rows, at_us, end_us), at_us) for at_us, end_us in pairs]
    zero = [measure_stop(rows, at_us, end_us).zero_ms for at_us, end_us in pairs]
    return (
        at_most(f"STOP reaches the wheels, p99 of {len(reached)}", _p99(reached), "ms", REACHES_MS),
        at_most(f"wheels at zero, p99 of {len(zero)}", _p99(zero), "ms", ZERO_MS),
    )


def reported_check(told_us: Sequence[int], stopped_us: Sequence[int]) -> LoopCheck:
    """When the robot itself said, in the status with that stamp, that it was stopped."""
    said = [(stop_us - at_us) / 1000 for at_us, stop_us in zip(told_us, stopped_us, strict=False)]
    value = percentile(said, 99) if len(stopped_us) == len(told_us) else None
    return at_most(f"robot says STOPPED, p99 of {len(said)}", value, "ms", REPORTED_MS)


def _again_us(rows: Sequence[MotorRow], reset_us: int) -> int:
    """Just before the wheels turn after the reset; the end of the log if they do not."""
    return next((row.t_us - 1 for row in rows if row.t_us > reset_us and wheel_mps(row) > 0), rows[-1].t_us)


def _window(rows: Sequence[MotorRow], begin_us: int, end_us: int) -> list[MotorRow]:
    """What they were told when it began, and all up to its end."""
    before = [row for row in rows if row.t_us <= begin_us]
    return [*before[-1:], *(row for row in rows if begin_us < row.t_us <= end_us)]


def reached_ms(window: Sequence[MotorRow], told_us: int) -> float | None:
    """From STOP to the first line of the fall after which the wheels stayed at zero; None if they turn to the end."""
    zero = 1 + max((index for index, row in enumerate(window) if wheel_mps(row) > 0), default=-1)
    if zero == len(window):
        return None
    first = zero
    while first > 1 and wheel_mps(window[first - 2]) > wheel_mps(window[first - 1]):
        first -= 1
    return max(0, window[first].t_us - told_us) / 1000


def _p99(values: Sequence[float | None]) -> float | None:
    known = [one for one in values if one is not None]
    return percentile(known, 99) if len(known) == len(values) else None
