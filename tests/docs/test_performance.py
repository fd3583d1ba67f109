"""The performance page: written section by section, the others left as they are; commands are not run here."""

import json
import re
import subprocess

import pytest

from docs.make import performance as report
from docs.make.performance import SECTIONS, noted, sections_named, write_report
from sightline.evaluation.demo.report import HOLDS_A_MINUTE, HOLDS_LATENCY_MS, HOLDS_LOSS
from sightline.operator_side.cli.commands import app
from sightline.protocol.errors import ConfigError

NAMED = {section.name: section for section in SECTIONS}
CHECKS = {"checks": [{"name": "offer and step", "value": 13.2, "unit": "us", "bound": 20, "ok": True}], "ok": True}
RACER = {
    "name": "sightline", "answered_percent": 100.0, "fps": 30.0, "p50_ms": 3.5, "p95_ms": 4.2, "p99_ms": None,
    "validated_ms": 3.1, "hot_ms": 1.2, "is_disturbed": True,
    "bytes_per_picture": 47126.4, "cpu_ms": {"driver": 1.0, "vision": 2.5},
    "memory_mb": {"driver": 44.0, "vision": 80.0},
}


@pytest.fixture
def commands(monkeypatch):
    """The commands that were run; each prints what a gate or a loop would, and leaves its picture."""
    ran = []

    def run(arguments):
        ran.append(arguments)
        if "--out" not in arguments:
            return CHECKS
        (report.Path(arguments[-1]) / "loop.png").write_bytes(b"picture of " + arguments[1].encode())
        return {**CHECKS, "contestants": [RACER]}

    monkeypatch.setattr(report, "_run", run)
    return ran


def test_names_are_unique_and_every_section_is_a_command_that_exists():
    assert len(NAMED) == len(SECTIONS) == len({section.title for section in SECTIONS})
    for section in SECTIONS:
        command = app  # what it would run is understood, up to --help in place of the options' values
        with pytest.raises(SystemExit) as left:
            command([*section.arguments, "--help"], prog_name="sightline")
        assert left.value.code in (0, None), section.name


def test_page_counts_the_holds_of_a_minute_with_the_most_loss():
    command, *options = NAMED["demo-loss"].arguments
    assert command == "demo"
    assert dict(zip(options[::2], map(float, options[1::2]), strict=True)) == {
        "--loss": HOLDS_LOSS, "--latency-ms": HOLDS_LATENCY_MS, "--seconds": 60 / HOLDS_A_MINUTE}


def test_page_has_the_longest_wait_of_five_thousand_commands():
    wait = NAMED["loop-wait"].arguments
    assert wait[:2] == ("bench", "loop") and 30 * int(wait[wait.index("--seconds") + 1]) >= 5_000


def test_only_the_chosen_section_is_measured_and_the_rest_of_the_page_stays(tmp_path, commands):
    page = tmp_path / "performance.md"
    assert write_report(page, sections_named(["killed", "gate"]), lambda _: None)
    before = page.read_text()
    page.write_text(before.replace("| 13.2 |", "| 99.9 |"))
    commands.clear()
    assert write_report(page, sections_named(["gate"]), lambda _: None)
    assert commands == [NAMED["gate"].arguments]
    after = page.read_text()
    assert (after.count("| 99.9 |"), after.count("| 13.2 |")) == (1, 1)
    assert after.count("\nMeasured 20") == 2
    order = ("## Killed at speed", "| 99.9 |", "## Gate", "| 13.2 |")
    assert sorted(order, key=after.index) == list(order)
    assert after.count("# Performance") == 1


def test_sections_keep_the_order_of_the_page_in_any_measuring_order(tmp_path, commands):
    page = tmp_path / "performance.md"
    for name in ("vision", "messages", "following"):
        write_report(page, sections_named([name]), lambda _: None)
    titles = [line[3:] for line in page.read_text().splitlines() if line.startswith("## ")]
    assert titles == [NAMED[name].title for name in ("following", "messages", "vision")]


def test_a_section_that_is_no_longer_known_is_kept_at_the_end():
    page = noted("# Performance\n\nold\n\n## Once measured\n\nfigures\n\n## Gate\n\nnew")
    assert page.index("## Gate") < page.index("## Once measured")
    assert page.endswith("figures\n")


def test_section_of_an_earlier_instrument_is_marked_and_what_was_never_measured_is_listed(tmp_path, commands):
    page = tmp_path / "performance.md"
    write_report(page, sections_named(["gate", "loop"]), lambda _: None)
    text = page.read_text()
    assert report._EARLIER not in text and "Viewers, Viewers over WebSocket" in text.partition("\n## ")[0]
    assert "Gate" not in text.partition("\n## ")[0]
    old = re.sub("Measured 20..-..-..", "Measured 2026-11-22", text)
    once = noted(old)
    assert once.count(report._EARLIER) == 1 and once == noted(once)
    assert once.index("## The whole loop") < once.index(report._EARLIER), "the gate is as it was"
    assert noted(old.replace("`sightline bench gate`", "`sightline bench gates`")).count(report._EARLIER) == 2


def test_a_race_shows_its_contestants_and_its_picture(tmp_path, commands):
    page = tmp_path / "docs" / "performance.md"
    page.parent.mkdir()
    assert write_report(page, sections_named(["loop"]), lambda _: None)
    text = page.read_text()
    row = ("| sightline (disturbed) | 100 | 30 | 3.5 | 4.2 | none | 3.1 | 1.2 | 47126 | driver 1, vision 2.5 "
           "| driver 44, vision 80 |")
    assert row in text
    assert "(img/loop-zenoh.png)" in text
    assert (page.parent / "img" / "loop-zenoh.png").read_bytes() == b"picture of loop"


def test_results_before_a_failure_are_kept(tmp_path, monkeypatch):
    page = tmp_path / "performance.md"

    def run(command, **_):
        failed = "codec" in command
        said = ("", "error: no") if failed else (json.dumps(CHECKS), "")
        return subprocess.CompletedProcess(command, 2 if failed else 0, *said)

    monkeypatch.setattr(report.subprocess, "run", run)
    with pytest.raises(RuntimeError, match=r"bench codec.*error: no"):
        write_report(page, sections_named(["gate", "messages"]), lambda _: None)
    assert "| offer and step | 13.2 |" in page.read_text()


def test_unknown_section_is_rejected_with_the_known_names():
    assert sections_named([]) == SECTIONS
    with pytest.raises(ConfigError, match=r"'gates'.*gate.*loop-websocket"):
        sections_named(["gates"])
