"""Figures of the fault bench beside the stop: ticks told from gaps, and the worst values that docs/safety.md shows."""

from pathlib import Path

import pytest
import typer

from sightline.evaluation.faults.cases import _tick_checks, permille_us, undisturbed_gaps_us
from sightline.evaluation.faults.evidence import MotorRow
from sightline.evaluation.faults.report import page_with_summary, with_rows_of
from sightline.evaluation.faults.sampler import Hole
from sightline.operator_side.cli import evaluate as cli_faults

DOCS = Path(__file__).parent.parent.parent.parent / "docs"
PAGE = "before\n<!-- worst values: x -->\nold\n<!-- /worst values -->\nafter\n"


def motors(times_us):
    return [MotorRow(t_us, 0.0, 0.0, 0.0, 0.0) for t_us in times_us]


# --- ticks -------------------------------------------------------------------------------------------------------


def test_gaps_are_those_between_motor_commands():
    assert undisturbed_gaps_us(motors([0, 20_000, 41_000]), []) == [20_000, 21_000]


@pytest.mark.parametrize(
    ("hole", "left"),
    [
        (Hole(19_000, 20_000), [20_000, 20_000]),
        (Hole(20_001, 20_002), [20_000, 20_000]),
        (Hole(39_999, 40_001), [20_000]),
        (Hole(0, 100_000), []),
    ],
)
def test_a_gap_in_which_the_machine_stood_still_is_left_out(hole, left):
    assert undisturbed_gaps_us(motors([0, 20_000, 40_000, 60_000]), [hole])[: len(left)] == left
    assert len(undisturbed_gaps_us(motors([0, 20_000, 40_000, 60_000]), [hole])) == {0: 0, 1: 1, 2: 2}[len(left)]


@pytest.mark.parametrize(("late", "worst_us"), [(0, 20_000), (1, 20_000), (2, 50_000)])
def test_one_tick_in_a_thousand_may_be_later(late, worst_us):
    gaps_us = [50_000] * late + [20_000] * 1000
    assert permille_us(gaps_us, 1000) == worst_us


def test_commands_that_arrive_do_not_dilute_the_ticks():
    gaps_us = [50_000] * 2 + [20_000] * 1000 + [10_000] * 100_000
    assert permille_us(gaps_us, 1000) == 50_000


def checks(rows, holes=(), published_us=0):
    return {check.name: check for check in _tick_checks(rows, holes, published_us)}


def test_a_lateness_that_the_robot_does_not_publish_fails():
    rows = motors([*range(0, 21_000_000, 20_000), 21_060_000])
    assert not checks(rows)["unpublished lateness"].ok
    honest = checks(rows, published_us=60_000)
    assert honest["unpublished lateness"].ok and honest["tick p99.9"].ok and honest["ticks"].ok


def test_too_few_ticks_are_no_measurement():
    assert not checks(motors(range(0, 10_000_000, 20_000)))["ticks"].ok
    assert not checks([])["ticks"].ok


# --- the worst of a report ---------------------------------------------------------------------------------------


REPORT = """Written by `sightline faults --repeat 2`; do not edit.

| fault | demanded | worst of 2 | pass |
|---|---|---|---|
| vision: SIGKILL | USUAL | injected 1 times, falls 150 ms, zero 560 ms, distance 0.19 m, memory 0.1 MB | yes |
| vision: hangs | USUAL; drives again | falls 170 ms, zero 1234 ms, distance 0.18 m | **no** |
| STOP: lossy | falls <= 340 ms, zero <= 2000 ms, <= 1 m | falls 30 ms, zero never ms, distance 0.2 m | **no** |
| network: lossy | no motion on frames older than 400 ms; drives again | memory 0.2 MB | yes |
| network: cut | USUAL | needs root | not run |
""".replace("USUAL", "falls <= 340 ms, zero <= 700 ms, <= 0.25 m")


def block(report):
    return page_with_summary(PAGE, report).splitlines()


def test_the_worst_of_each_kind_and_bound_is_shown():
    lines = [line for line in block(REPORT) if line.startswith("| ")][1:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [row[0] for row in rows] == ["vision", "STOP", "network"]
    assert rows[0][1] == "2" and rows[0][3:] == ["170", "1234", "0.19", "0.1", "1 of 2"]
    assert rows[1][4] == "never" and rows[1][2].startswith("falls <= 340 ms, zero <= 2000 ms, <= 1 m")
    assert rows[2][1:] == ["1", "-", "-", "-", "-", "0.2", "1 of 1"]


def test_what_stands_around_the_marks_stays():
    lines = block(REPORT)
    assert lines[0] == "before" and lines[-1] == "after" and "old" not in lines
    assert "`sightline faults --repeat 2`" in lines[2]
    assert page_with_summary("no marks", REPORT) == "no marks"


def test_the_page_of_promises_shows_the_report_that_is_committed():
    page = (DOCS / "safety.md").read_text()
    assert page_with_summary(page, (DOCS / "faults.md").read_text()) == page and "| vision |" in page


def test_the_command_writes_both_pages(tmp_path, monkeypatch):
    from sightline.evaluation.faults import runner as parallel

    (tmp_path / "safety.md").write_text(PAGE)
    monkeypatch.setattr(parallel, "run_cases", lambda rows, *_: [[_measured(row)] for row in rows])
    app = typer.Typer()
    cli_faults.register(app)
    app.callback()(lambda: None)
    assert app(["faults", "--only", "vision.kill", "--out", str(tmp_path / "faults.md")], standalone_mode=False) == 0
    assert "| vision | 1 |" in (tmp_path / "safety.md").read_text()
    assert "| vision: SIGKILL |" in (tmp_path / "faults.md").read_text()


def _measured(row):
    from sightline.evaluation.faults.evidence import Stop, stop_checks
    from sightline.evaluation.faults.runner import Outcome

    return Outcome(row, tuple(stop_checks(Stop(150.0, 560.0, 0.19))))


# --- a report of which some rows ran again -----------------------------------------------------------------------


def _report(command, **rows):
    lines = [f"| {fault} | stop | falls 1 ms | {verdict} |" for fault, verdict in rows.items()]
    good = sum(verdict == "yes" for verdict in rows.values())
    return "\n".join([f"Written by `{command}`; do not edit. {good} of {len(rows)} rows passed.", "", "- CPU: one", "",
                      "| fault | demanded | worst of 2 | pass |", "|---|---|---|---|", *lines, ""])


def test_rows_that_ran_again_replace_their_own_and_no_others():
    old = _report("faults --repeat 2", a="yes", b="**no**", c="yes")
    report = with_rows_of(old, _report("faults --only b", b="yes"))
    assert "3 of 3 rows passed" in report and "Written by `faults --repeat 2`" in report
    assert "- run again by `faults --only b`: b\n\n| fault" in report
    assert [line.split(" | ")[0] for line in report.splitlines() if "stop" in line] == ["| a", "| b", "| c"]


def test_a_row_that_fails_when_run_again_is_told():
    report = with_rows_of(_report("x", a="yes", b="yes"), _report("y", b="**no**"))
    assert "1 of 2 rows passed" in report
