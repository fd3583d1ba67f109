"""Run and score fault cases, several side by side. Shell (processes)."""

import multiprocessing
import shutil
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.evidence import (
    DISTANCE_M,
    FALLS_MS,
    MEMORY_MB,
    OLD_US,
    ZERO_MS,
    Blind,
    Stop,
    held_rows,
    last_valid_us,
    measure_stop,
    moved_on_old_sight,
    stop_checks,
)
from sightline.evaluation.faults.fixture import RobotFixture
from sightline.evaluation.faults.sampler import STALL_US
from sightline.evaluation.processes import terminated_like_interrupted
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import SightlineError
from sightline.sim.tun_emulator import why_impossible

if TYPE_CHECKING:
    from sightline.evaluation.faults.fixture import RobotFixture, Setup


@dataclass(frozen=True, slots=True)
class Injected:
    """Record of an injection: count, start, and the time when frames or commands were valid again."""

    count: int
    at_us: int
    resumed_us: int | None = None
    again: bool | None = None
    """True if the robot drove again, where that is demanded."""
    checks: tuple[Check, ...] = ()
    """Checks of this row only."""
    from_us: int | None = None
    """Time of the first measurement of `checks`, if before `at_us`."""


@dataclass(frozen=True, slots=True)
class FaultCase:
    """One fault. `inject` receives a robot at speed and returns after the last observation."""

    id: str
    what: str
    inject: "Callable[[RobotFixture], Injected]"
    setup: "Setup"
    blind: bool = False
    """True if commands continue but must not be applied. None counts as good from the injection on."""
    by_frame: bool = False
    """True if images end, not commands. A frame in flight may still be answered."""
    stops: bool = True
    """True if a stop is demanded after the last valid command."""
    again: bool = False
    zero_ms: float = ZERO_MS
    distance_m: float = DISTANCE_M
    memory_mb: float = MEMORY_MB
    also: str = ""
    """Demand of `Injected.checks` in words."""
    short: bool = False
    """True for a row of the short set."""
    alone: bool = False
    """True if no other row may run next to it."""

    @property
    def demanded(self) -> str:
        """Describe the bounds in words."""
        stop = f"falls <= {min(FALLS_MS, self.zero_ms):g} ms, zero <= {self.zero_ms:g} ms, <= {self.distance_m:g} m"
        parts = [
            stop if self.stops else f"no motion on frames older than {OLD_US // 1000} ms",
            "drives again" if self.again else "",
            self.also,
        ]
        return "; ".join(part for part in parts if part)


@dataclass(frozen=True, slots=True)
class FaultOutcome:
    """The result of one run of a row. `skipped` is the reason if it could not run."""

    row: FaultCase
    checks: tuple[Check, ...] = ()
    skipped: str = ""
    trouble: str = ""
    """Reason for missing figures."""

    @property
    def ok(self) -> bool:
        """Return True if every check passed. A skipped row is not ok."""
        return bool(self.checks) and not self.trouble and all(check.ok for check in self.checks)


# The run and the score of one row. Shell (processes, files).


MOST_TRIES: Final = 3
_TO_THE_END_US: Final = 10**9
_WATCHED_US: Final = 1_000_000
"""Time after the injection in which a stop is measured and a stalled sampler spoils it."""


def run_case(row: FaultCase, folder: Path, run: int = 1) -> FaultOutcome:
    """Run a row, again if its sampler stalled. Its files stay in `folder` if it failed."""
    if row.setup.legacy is not None and find_spec(row.setup.fault) is None:
        return FaultOutcome(row, skipped=f"needs the package {row.setup.fault}; run `pip install {row.setup.fault}`")
    if row.setup.wired and (why := why_impossible()):
        return FaultOutcome(row, skipped=why)
    for number in range(1, MOST_TRIES + 1):
        place = folder / f"{row.id}-{run}-{number}"
        shutil.rmtree(place, ignore_errors=True)
        try:
            checks, stalled_us = _run_once(row, place)
        except (SightlineError, OSError) as error:  # OSError: the process to harm has ended
            return FaultOutcome(row, trouble=" ".join(str(error).split()))
        if stalled_us <= STALL_US:
            break
    else:
        return FaultOutcome(row, checks, trouble=f"inconclusive: sampler stalled {stalled_us / 1000:.0f} ms each time")
    outcome = FaultOutcome(row, checks)
    if outcome.ok:
        shutil.rmtree(place)
    return outcome


def _run_once(row: FaultCase, place: Path) -> tuple[tuple[Check, ...], int]:
    """Run a row once. Returns the checks, and the longest stall of the sampler."""
    with RobotFixture(place, row.setup) as rig:
        injected = row.inject(rig)
        grown_mb = rig.grown_mb()
        checks = (
            at_least("injected", injected.count, "times", 1),
            *_motion_checks(row, rig, injected),
            at_most("memory", grown_mb, "MB", row.memory_mb),
            *injected.checks,
        )
        return checks, rig.stalled_us(*watched_us(injected, checks))


def watched_us(injected: Injected, checks: Sequence[Check]) -> tuple[int, int]:
    """Return the period that needs exact stamps: that of a stop, or of all measurements after a failure.

    The simulation stamps the motor log, and may have stalled between a command and its stamp.
    """
    if all(check.ok for check in checks):
        return injected.at_us, injected.at_us + _WATCHED_US
    return min(injected.at_us, injected.from_us or injected.at_us), injected.at_us + _TO_THE_END_US


def _motion_checks(row: FaultCase, rig: RobotFixture, injected: Injected) -> Iterable[Check]:
    rows, now_us, sent = rig.motors(), monotonic_us(), rig.sent()
    blind = Blind(injected.at_us, injected.resumed_us, row.by_frame) if row.blind else None
    if row.stops:
        until_us = injected.resumed_us or rows[-1].t_us
        since_us = last_valid_us(sent, blind or Blind(until_us))
        stop = measure_stop(rows, since_us, injected.resumed_us) if since_us else Stop(None, None, 0.0)
        yield from stop_checks(stop, row.zero_ms, row.distance_m)
    held = held_rows(rows, injected.at_us, now_us)
    yield at_most("on an old frame", moved_on_old_sight(held, sent, blind), "lines", 0)
    if row.again:
        yield at_least("drives again", bool(injected.again), "", 1)


# Rows in parallel, each in a separate process, with an estimate of the remaining time. Shell (processes).


_FORK: Final = multiprocessing.get_context("fork")  # safe to copy: no link or thread is open here
_END_S: Final = 30.0
"""Time in which an interrupted row ends its processes."""


class FaultProgress(NamedTuple):
    """Progress of all rows. `left_s` is an estimate from the finished ones."""

    done: int
    total: int
    left_s: float


@dataclass(frozen=True, slots=True)
class _Turn:
    """One run of one row; `index` is the row's place in the report."""

    index: int
    row: FaultCase
    number: int


@dataclass(frozen=True, slots=True)
class _Running:
    turn: _Turn
    process: BaseProcess
    answer: connection.Connection


def run_cases(
    rows: Sequence[FaultCase], repeat: int, folder: Path, jobs: int, show: Callable[[FaultOutcome, FaultProgress], None]
) -> list[list[FaultOutcome]]:
    """Run every row `repeat` times, `jobs` in parallel, rows with `alone` last. Skipped rows are not repeated."""
    results: list[list[FaultOutcome]] = [[] for _ in rows]
    turns = [_Turn(index, row, number) for index, row in enumerate(rows) for number in range(1, repeat + 1)]
    turns.sort(key=lambda turn: turn.row.alone)  # stable: otherwise in the order of the report
    began_s, done, total = time.monotonic(), 0, len(turns)
    with terminated_like_interrupted(), closing(_outcomes(turns, folder, jobs, results)) as outcomes:
        for turn, outcome in outcomes:
            results[turn.index].append(outcome)
            done += 1
            left_s = (time.monotonic() - began_s) / done * (total - done)
            show(outcome, FaultProgress(done, total, left_s))
    return [[one for one in row if not one.skipped] or row[:1] for row in results]


def _outcomes(
    turns: list[_Turn], folder: Path, jobs: int, results: Sequence[Sequence[FaultOutcome]]
) -> Generator[tuple[_Turn, FaultOutcome], None, None]:
    waiting, running = list(turns), list[_Running]()
    try:
        while waiting or running:
            while waiting and _may_start(waiting[0].row, running, jobs):
                turn = waiting.pop(0)
                skipped = next((one for one in results[turn.index] if one.skipped), None)
                if skipped is not None:
                    yield turn, skipped
                else:
                    running.append(_start(turn, folder))
            for ready in connection.wait([one.answer for one in running]) if running else ():
                ended = next(one for one in running if one.answer is ready)
                running.remove(ended)
                yield ended.turn, _collect(ended)
    finally:
        for one in running:
            one.process.terminate()
        for one in running:
            one.process.join(_END_S)


def _may_start(row: FaultCase, running: Sequence[_Running], jobs: int) -> bool:
    if not running:
        return True
    return len(running) < jobs and not row.alone and not running[0].turn.row.alone


def _start(turn: _Turn, folder: Path) -> _Running:
    ours, theirs = _FORK.Pipe(duplex=False)
    process = _FORK.Process(target=_run, args=(turn, folder, theirs))
    process.start()
    theirs.close()
    return _Running(turn, process, ours)


def _run(turn: _Turn, folder: Path, answer: connection.Connection) -> None:
    """Run a row in its process, and always send its result to the parent."""
    with suppress(KeyboardInterrupt), terminated_like_interrupted():
        outcome = run_case(turn.row, folder, turn.number)
        answer.send((outcome.checks, outcome.skipped, outcome.trouble))


def _collect(ended: _Running) -> FaultOutcome:
    outcome = FaultOutcome(ended.turn.row)
    try:
        checks, skipped, trouble = ended.answer.recv()
        outcome = replace(outcome, checks=checks, skipped=skipped, trouble=trouble)
    except EOFError:
        outcome = replace(outcome, trouble="the process of this row ended; see its lines above")
    ended.answer.close()
    ended.process.join()
    return outcome
