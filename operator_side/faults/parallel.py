"""Runs rows side by side, each in a process of its own, and says how long the rest will take. Shell (processes)."""

import multiprocessing
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Final, NamedTuple

from sightline.evaluation.processes import terminated_like_interrupted
from sightline.operator_side.faults.bench import run_case
from sightline.evaluation.faults.runner import Case, Outcome

_FORK: Final = multiprocessing.get_context("fork")  # nothing is open here that a copy could spoil: no link, no thread
_END_S: Final = 30.0
"""A row that was interrupted ends its own processes within this."""


class Progress(NamedTuple):
    """How far the whole is; `left_s` is a guess from what has run."""

    done: int
    total: int
    left_s: float


@dataclass(frozen=True, slots=True)
class _Turn:
    """One run of one row; `index` is the row's place in the report."""

    index: int
    row: Case
    number: int


@dataclass(frozen=True, slots=True)
class _Running:
    turn: _Turn
    process: BaseProcess
    answer: connection.Connection


def run_cases(
    rows: Sequence[Case], repeat: int, folder: Path, jobs: int, say: Callable[[Outcome, Progress], None]
) -> list[list[Outcome]]:
    """Every row `repeat` times, `jobs` at once, those that want it alone last. What is skipped is not repeated."""
    results: list[list[Outcome]] = [[] for _ in rows]
    turns = [_Turn(index, row, number) for index, row in enumerate(rows) for number in range(1, repeat + 1)]
    turns.sort(key=lambda turn: turn.row.alone)  # stable: otherwise in the report's order
    began_s, done, total = time.monotonic(), 0, len(turns)
    with terminated_like_interrupted(), closing(_outcomes(turns, folder, jobs, results)) as outcomes:
        for turn, outcome in outcomes:
            results[turn.index].append(outcome)
            done += 1
            left_s = (time.monotonic() - began_s) / done * (total - done)
            say(outcome, Progress(done, total, left_s))
    return [[one for one in row if not one.skipped] or row[:1] for row in results]


def _outcomes(
    turns: list[_Turn], folder: Path, jobs: int, results: Sequence[Sequence[Outcome]]
) -> Generator[tuple[_Turn, Outcome], None, None]:
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


def _may_start(row: Case, running: Sequence[_Running], jobs: int) -> bool:
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
    """In the process of its own; whoever waits is told what became of the row, whatever did."""
    with suppress(KeyboardInterrupt), terminated_like_interrupted():
        outcome = run_case(turn.row, folder, turn.number)
        answer.send((outcome.checks, outcome.skipped, outcome.trouble))


def _collect(ended: _Running) -> Outcome:
    outcome = Outcome(ended.turn.row)
    try:
        checks, skipped, trouble = ended.answer.recv()
        outcome = replace(outcome, checks=checks, skipped=skipped, trouble=trouble)
    except EOFError:
        outcome = replace(outcome, trouble="the bench's own process for this row ended; it said why above")
    ended.answer.close()
    ended.process.join()
    return outcome

