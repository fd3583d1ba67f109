"""The pages of the fault bench: made of the committed results alone; rows that ran again replace their own."""

import json
import subprocess

import pytest

from docs.make import faults
from docs.make.faults import DOCS, RESULTS, SAFETY, main, merged, report_page, safety_page
from sightline.evaluation.faults.cases import CASES

PAGE = "before\n<!-- worst values: x -->\nold\n<!-- /worst values -->\nafter\n"
USUAL = "falls <= 340 ms, zero <= 700 ms, <= 0.25 m"
UNITS = {"falls": "ms", "zero": "ms", "distance": "m", "memory": "MB", "injected": "times", "exit code": ""}


def row(what, demanded, ok=True, skipped="", trouble="", **values):
    """A row with the id of its words, and its checks."""
    name = what.replace(": ", ".")
    checks = [{"name": f"{name}: {key}", "value": value, "unit": UNITS[key], "bound": 1, "ok": ok}
              for key, value in values.items()]
    about = {"id": name, "what": what, "demanded": demanded, "runs": 2, "ok": ok, "skipped": skipped,
             "trouble": trouble}
    return about, checks


def record(*rows, command="sightline faults --repeat 2"):
    checks = [check for _, found in rows for check in found]
    return {"command": command, "machine": ["CPU: one"], "again": [], "ok": True, "checks": checks,
            "rows": [about for about, _ in rows]}


REPORT = record(
    row("vision: SIGKILL", USUAL, injected=1, falls=150.0, zero=560.0, distance=0.19, memory=0.1),
    row("vision: hangs", f"{USUAL}; drives again", ok=False, falls=170.0, zero=1234.0, distance=0.18),
    row("STOP: lossy", "falls <= 340 ms, zero <= 2000 ms, <= 1 m", ok=False, falls=30.0, zero=None, distance=0.2),
    row("network: lossy", "no motion on frames older than 400 ms; drives again", memory=0.2),
    row("network: cut", USUAL, skipped="needs root"),
)


def block(report):
    return safety_page(PAGE, report).splitlines()


def test_the_worst_of_each_kind_and_bound_is_shown():
    lines = [line for line in block(REPORT) if line.startswith("| ")][1:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [one[0] for one in rows] == ["vision", "STOP", "network"]
    assert rows[0][1] == "2" and rows[0][3:] == ["170", "1234", "0.19", "0.1", "1 of 2"]
    variants = record(row("legacy (a), x: 1", USUAL, falls=1), row("legacy (b), y: 2", USUAL, falls=2))
    assert sum(line.startswith("| legacy | 2 |") for line in block(variants)) == 1
    assert rows[1][4] == "never" and rows[1][2].startswith("falls <= 340 ms, zero <= 2000 ms, <= 1 m")
    assert rows[2][1:] == ["1", "-", "-", "-", "-", "0.2", "1 of 1"]


def test_text_around_the_marks_stays():
    lines = block(REPORT)
    assert lines[0] == "before" and lines[-1] == "after" and "old" not in lines
    assert "`sightline faults --repeat 2`" in lines[2]
    assert safety_page("no marks", REPORT) == "no marks"


def test_the_report_has_a_row_for_each_fault_and_counts_rows_that_ran():
    text = report_page(REPORT)
    assert "2 of 4 rows passed" in text and "| worst of 2 |" in text
    assert "| injected 1 times, falls 150 ms, zero 560 ms, distance 0.19 m, memory 0.1 MB | yes |" in text
    assert "zero never ms" in text and "| needs root | not run |" in text
    assert "| `vision.SIGKILL` | vision: SIGKILL |" in text and "| `network.cut` | network: cut |" in text
    assert "- not measured yet: `a.2`\n" in report_page(record(row("a: 1", USUAL)), ["a.1", "a.2"])
    assert "exit code" not in report_page(record(row("a: b", USUAL, **{"exit code": 0})))
    assert "inconclusive, exit code 1 | **no** |" in report_page(
        record(row("a: b", USUAL, ok=False, trouble="inconclusive", **{"exit code": 1})))


def test_committed_pages_are_made_of_the_committed_results():
    results = json.loads((DOCS / RESULTS / "faults.json").read_text())
    safety = (DOCS / SAFETY).read_text()
    assert report_page(results, (one.id for one in CASES)) == (DOCS / RESULTS / "faults.md").read_text()
    assert safety_page(safety, results) == safety and "| vision |" in safety


def test_rows_that_ran_again_replace_their_own_and_no_others():
    old = record(row("a: 1", "stop", falls=1), row("b: 1", "stop", ok=False, falls=9), row("c: 1", "stop", falls=1))
    report = report_page(merged(old, record(row("b: 1", "stop", falls=2), command="sightline faults --only b")))
    assert "3 of 3 rows passed" in report and "Written by `sightline faults --repeat 2`" in report
    before = "- by `sightline faults --only b` on one: `b.1` (did not pass before: falls 9 ms)\n\n| row | fault"
    assert before in report
    lines = [line for line in report.splitlines() if "stop" in line and line.startswith("| ")]
    assert [line.split(" | ")[1] for line in lines] == ["a: 1", "b: 1", "c: 1"]
    assert "| falls 2 ms | yes |" in report and report.count("falls 9 ms") == 1


def test_all_rows_pass_once_those_that_did_not_have_passed():
    old = {**record(row("a: 1", "stop", falls=1), row("b: 1", "stop", ok=False, falls=9)), "ok": False}
    newer = merged(old, record(row("b: 1", "stop", falls=2)))
    assert newer["ok"] and "(did not pass before: falls 9 ms)" in report_page(merged(newer, record(row("a: 1", USUAL))))
    assert not merged(newer, record(row("a: 1", "stop", ok=False, falls=1)))["ok"]


def test_a_row_that_fails_when_it_runs_again_is_shown():
    old = record(row("a: 1", "stop", falls=1), row("b: 1", "stop", falls=1))
    assert "1 of 2 rows passed" in report_page(merged(old, record(row("b: 1", "stop", ok=False, falls=1))))


def test_the_script_writes_results_and_both_pages(tmp_path, monkeypatch):
    printed = {key: REPORT[key] for key in ("ok", "checks", "rows")}
    ran = []

    def run(command, **_):
        ran.append(command)
        return subprocess.CompletedProcess(command, 5, json.dumps(printed))

    monkeypatch.setattr(faults.subprocess, "run", run)
    (tmp_path / RESULTS).mkdir(parents=True)
    (tmp_path / SAFETY).write_text(PAGE)
    assert main(["--repeat", "2"], tmp_path) == 5
    assert ran[0][-4:] == ["faults", "--repeat", "2", "--json"]
    assert "| vision | 2 |" in (tmp_path / SAFETY).read_text()
    assert "| vision: SIGKILL |" in (tmp_path / RESULTS / "faults.md").read_text()
    main(["--only", "vision"], tmp_path)
    results = json.loads((tmp_path / RESULTS / "faults.json").read_text())
    assert results["again"][0]["command"] == "sightline faults --only vision"


def test_a_command_without_a_result_changes_no_page(tmp_path, monkeypatch):
    monkeypatch.setattr(faults.subprocess, "run", lambda command, **_: subprocess.CompletedProcess(command, 2, ""))
    with pytest.raises(RuntimeError, match="ended with 2"):
        main([], tmp_path)
    assert list(tmp_path.iterdir()) == []
