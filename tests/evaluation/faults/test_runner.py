"""Rows of the fault bench side by side: order, turns alone, skips, a row whose process dies, an interrupt."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from sightline.evaluation.checks import Check
from sightline.evaluation.faults import runner as parallel
from sightline.evaluation.faults.fixture import Setup
from sightline.evaluation.faults.report import progress_line
from sightline.evaluation.faults.runner import FaultCase, FaultOutcome, run_cases

GOOD = (Check("zero", 1.0, "ms", 2.0, True),)


def row(name, **changes):
    return FaultCase(f"made.{name}", f"made up: {name}", lambda rig: None, Setup(), **changes)


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """Rows that run nothing but note when they did, in a process of their own as real ones."""

    def run(made, folder, number):
        began_s = time.monotonic()
        if made.id.endswith("dies"):
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.15)
        skipped = "needs root" if made.id.endswith("skips") else ""
        (folder / f"{made.id}-{number}").write_text(f"{began_s} {time.monotonic()}")
        return FaultOutcome(made, () if skipped else GOOD, skipped=skipped)

    monkeypatch.setattr(parallel, "run_case", run)
    return tmp_path


def spans(folder: Path, name: str):
    return [tuple(map(float, path.read_text().split())) for path in sorted(folder.glob(f"made.{name}-*"))]


def overlaps(one, other):
    return one[0] < other[1] and other[0] < one[1]


def test_results_have_the_order_of_the_rows_and_report_each_run(bench):
    told = []
    rows = [row("a"), row("b"), row("c")]
    results = run_cases(rows, 2, bench, 2, lambda outcome, progress: told.append((outcome.row.id, progress)))
    assert [[one.row.id for one in outcomes] for outcomes in results] == [[f"made.{name}"] * 2 for name in "abc"]
    assert [progress.done for _, progress in told] == [1, 2, 3, 4, 5, 6]
    assert told[-1][1].left_s == 0 and 0 < told[2][1].left_s < 5


def test_number_of_parallel_runs_equals_jobs(bench):
    run_cases([row("a"), row("b")], 2, bench, 2, lambda *_: None)
    everything = spans(bench, "a") + spans(bench, "b")
    beside = [sum(overlaps(one, other) for other in everything) - 1 for one in everything]
    assert max(beside) >= 1
    for moment in [(begin + end) / 2 for begin, end in everything]:
        assert sum(begin < moment < end for begin, end in everything) <= 2


def test_row_that_needs_the_whole_machine_runs_last_and_alone(bench):
    run_cases([row("alone", alone=True), row("a"), row("b")], 2, bench, 3, lambda *_: None)
    (first, second), others = spans(bench, "alone"), spans(bench, "a") + spans(bench, "b")
    assert not overlaps(first, second) and first[0] > max(end for _, end in others)


def test_skipped_frame_is_logged_once(bench):
    told = []
    (outcomes,) = run_cases([row("skips")], 5, bench, 1, lambda outcome, progress: told.append(progress.done))
    assert [one.skipped for one in outcomes] == ["needs root"] and len(spans(bench, "skips")) == 1
    assert told == [1, 2, 3, 4, 5]


def test_row_whose_process_dies_fails_without_ending_others(bench):
    died, well = run_cases([row("dies"), row("a")], 1, bench, 1, lambda *_: None)
    assert "ended" in died[0].trouble and not died[0].ok and well[0].ok


def test_interrupt_of_the_bench_interrupts_its_rows(bench):
    def interrupt(outcome, progress):
        raise KeyboardInterrupt

    began_s = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_cases([row("a"), row("b"), row("c")], 3, bench, 3, interrupt)
    assert time.monotonic() - began_s < 5 and not multiprocessing.active_children()


@pytest.mark.parametrize(
    ("left_s", "says"), [(0.0, "0 s left"), (89.0, "89 s left"), (90.0, "2 min left"), (3000.0, "50 min left")]
)
def test_finished_run_reports_the_remaining_time(left_s, says):
    line = progress_line(FaultOutcome(row("a"), GOOD), 3, 520, left_s)
    assert line.startswith("  3/520 (") and says in line and "made.a" in line
