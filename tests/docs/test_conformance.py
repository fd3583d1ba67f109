"""The conformance page: each run is a new one, with its date."""

import json
import subprocess

import pytest

from docs.make import conformance as page

RUN = {"peer": "codec, Python", "side": "codec", "ok": True, "counts": {"passed": 0}, "checks": []}


def kit(monkeypatch, tmp_path, writes):
    """Replace the kit; the result of an earlier run exists."""

    def run(command, **_):
        if writes:
            page.Path(command[command.index("--save") + 1]).write_text(json.dumps(RUN))
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(page, "KEPT", tmp_path)
    monkeypatch.setattr(page.subprocess, "run", run)
    page.file_of("codec, Python").write_text("{}")


def test_run_without_a_result_is_an_error_and_leaves_no_earlier_one(monkeypatch, tmp_path):
    kit(monkeypatch, tmp_path, writes=False)
    with pytest.raises(RuntimeError, match="codec, Python: the kit ended with 1"):
        page.conform("codec, Python", "codec")
    assert not page.file_of("codec, Python").exists()


def test_page_shows_the_date_of_a_run(monkeypatch, tmp_path):
    kit(monkeypatch, tmp_path, writes=True)
    page.conform("codec, Python", "codec")
    new = json.loads(page.file_of("codec, Python").read_text())
    rows = [line for line in page.to_page([new, RUN]).splitlines() if line.startswith("| codec, Python")]
    assert rows[0].endswith(f"| 0 | {new['measured']} |") and new["measured"].startswith("20")
    assert rows[1].endswith("| 0 |  |"), "a result from before has no date"
