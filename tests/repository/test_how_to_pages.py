"""docs/how-to: at most ten steps a list, and every file and folder that a page names exists."""

import re
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted(page for kind in ("add-*.md", "write-*.md") for page in (ROOT / "docs" / "how-to").glob(kind))
NAMED = re.compile(r"`([a-z_]+/[\w/.-]*|pyproject\.toml)`")
SOURCE = "https://github.com/sightline-robot/sightline/blob/main/"
LINKED = re.compile(r"\]\(([^)]+)\)")


def test_how_to_folder_has_the_agreed_pages():
    assert {page.stem for page in PAGES} == {
        "add-a-device", "add-a-status-field", "add-a-command", "write-a-mission", "write-a-detector",
    }  # fmt: skip


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_has_at_most_ten_steps_and_names_what_exists(page):
    text = page.read_text()
    steps = [int(number) for number in re.findall(r"^(\d+)\. ", text, re.MULTILINE)]
    assert steps and max(steps) <= 10
    for path in NAMED.findall(text):
        assert (ROOT / path).exists(), path
    for target in LINKED.findall(text):
        link = target.partition("#")[0]
        assert (ROOT / link.removeprefix(SOURCE) if link.startswith(SOURCE) else page.parent / link).exists(), link


def test_watchdog_of_the_legacy_page_has_ten_lines_and_stops_a_robot_without_commands():
    page = (ROOT / "docs/how-to/legacy-robots.md").read_text()
    code = page.partition("<!-- watchdog -->\n```python\n")[2].partition("```")[0]
    assert len([line for line in code.splitlines() if line]) == 10
    names, stops = {}, []
    exec(code, names)  # the reader's own program runs it too
    feed = names["watchdog"](lambda: stops.append(time.monotonic()), 0.2)
    for _ in range(10):
        feed()
        time.sleep(0.03)
    fed_s = time.monotonic()
    assert stops == []
    while not stops:
        assert time.monotonic() - fed_s < 1
        time.sleep(0.01)
    feed()
