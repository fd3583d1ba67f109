"""Runs a row of the fault bench and judges it. Shell (processes, files)."""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.evidence import (
    MEMORY_MB,
    Blind,
    Stop,
    last_valid_us,
    measure_stop,
    moved_on_old_sight,
    stop_checks,
)
from sightline.operator_side.faults.rig import RobotFixture
from sightline.evaluation.faults.runner import Case, Injected, Outcome
from sightline.evaluation.faults.sampler import STALL_US
from sightline.protocol.errors import SightlineError
from sightline.sim.tun_emulator import why_impossible

MOST_TRIES: Final = 3
_TO_THE_END_US: Final = 10**9
_WATCHED_US: Final = 1_000_000
"""After the injection: the time in which a stop is measured, and a stalled sampler spoils it."""


def run_case(row: Case, folder: Path, run: int = 1) -> Outcome:
    """Run a row, again while its sampler stalled; its files stay in `folder` unless all was well."""
    if row.setup.wired and (why := why_impossible()):
        return Outcome(row, skipped=why)
    for number in range(1, MOST_TRIES + 1):
        place = folder / f"{row.id}-{run}-{number}"
        shutil.rmtree(place, ignore_errors=True)
        try:
            checks, stalled_us = _run_once(row, place)
        except (SightlineError, OSError) as error:  # OSError: a process that was to be hurt is gone
            return Outcome(row, trouble=" ".join(str(error).split()))
        if stalled_us <= STALL_US:
            break
    else:
        return Outcome(row, checks, trouble=f"inconclusive: sampler stalled {stalled_us / 1000:.0f} ms each time")
    outcome = Outcome(row, checks)
    if outcome.ok:
        shutil.rmtree(place)
    return outcome


def _run_once(row: Case, place: Path) -> tuple[tuple[Check, ...], int]:
    """The checks, and for how long the sampler stalled."""
    with RobotFixture(place, row.setup) as rig:
        injected = row.inject(rig)
        grown_mb = rig.grown_mb()
        checks = (
            at_least("injected", injected.count, "times", 1),
            *_motion_checks(row, rig, injected),
            at_most("memory", grown_mb, "MB", MEMORY_MB),
            *injected.checks,
        )
        return checks, rig.stalled_us(injected.at_us, injected.at_us + watched_us(checks))


def watched_us(checks: Sequence[Check]) -> int:
    """How long after the injection stamps must be right: as long as a stop takes, or for good where something failed.

    A motor's log is stamped by the simulation, which may have stood still between a command and its stamp.
    """
    return _WATCHED_US if all(check.ok for check in checks) else _TO_THE_END_US


def _motion_checks(row: Case, rig: RobotFixture, injected: Injected) -> Iterable[Check]:
    rows, sent = rig.motors(), rig.sent()
    blind = Blind(injected.at_us, injected.resumed_us, row.by_frame) if row.blind else None
    if row.stops:
        until_us = injected.resumed_us or rows[-1].t_us
        since_us = last_valid_us(sent, blind or Blind(until_us))
        stop = measure_stop(rows, since_us, injected.resumed_us) if since_us else Stop(None, None, 0.0)
        yield from stop_checks(stop, row.zero_ms, row.distance_m)
    yield at_most("on old sight", moved_on_old_sight(rows, sent, blind), "lines", 0)
    if row.again:
        yield at_least("drives again", bool(injected.again), "", 1)
