"""The behaviors page as it lies in the repository: every row, every picture, every bound kept, what laws are like."""

import re
from pathlib import Path

from docs.make.behaviors import CHARACTER, LATENCY_MS, LOOKS, LOSS, NOT_MEASURED, ROWS, TABLES
from sightline.evaluation.checks import number
from sightline.sim.scenario import FIGURES, load_scenario

DOCS = Path(__file__).parent.parent.parent / "docs" / "reference" / "results"
PAGE = (DOCS / "behaviors.md").read_text()


def test_the_page_has_every_row_and_its_picture():
    assert re.findall(r"^## (.*)$", PAGE, re.MULTILINE) == [one.title for one in (*ROWS, *TABLES)]
    shown = re.findall(r"!\[[^]]*\]\(([^)]+)\)", PAGE)
    assert len(shown) == len(ROWS) + 1 and all((DOCS / name).is_file() for name in shown)
    assert {path.name for path in (DOCS / "behaviors").iterdir()} == {Path(name).name for name in shown}


NOT_KEPT = {"traffic-light: quality30"}
"""From one start of six the lit lamp is not read for 1.6 s at the line. All else is news."""


def part_of(title):
    return next(part for part in PAGE.split("\n## ") if part.startswith(f"{title}\n"))


def bound_text(name, bound):
    return f"{number(bound)} {FIGURES[name].unit}"


def test_page_has_every_figure_with_its_bound():
    for row in (row for row in ROWS if not row.baseline):
        line = r"^\| (\w+) \| [^|]+ \| [^|]+ \| ([^|]+) \| (?:ok|\*\*not kept\*\*) \|$"
        found = re.findall(line, part_of(row.title), re.MULTILINE)
        bounds = load_scenario(row.scenario).bounds
        assert found == [(name, bound_text(name, bound)) for name, bound in bounds.items()], row.title


def test_tables_have_every_line_with_the_bounds():
    for table in TABLES:
        lines = re.findall(r"^\| (\S+) \| (\S+) \| (.*) \| [^|]+ \|$", part_of(table.title), re.MULTILINE)
        lines = [line for line in lines if line[0] != "scenario"]
        assert [line[:2] for line in lines] == [*table.lines()]
        for scenario, _, cells in lines:
            bounds = load_scenario(scenario).bounds
            assert re.findall(r"\(bound ([^)]+)\)", cells) == [bound_text(name, bounds[name]) for name in table.figures]


def test_the_page_is_of_six_starts_and_bounds_were_kept_but_for_those_that_are_known():
    assert "on 6 starts" in PAGE and f"+{LATENCY_MS:g} ms latency" in PAGE and f"{LOSS:.0%} loss" in PAGE
    missed = set()
    for part in PAGE.split("\n## ")[1:]:
        title, rows = part.partition("\n")[0], part.splitlines()
        missed |= {f"{title}: {row.split('|')[1].strip()}" for row in rows if "**not kept**" in row}
    assert missed == NOT_KEPT
    assert NOT_MEASURED not in PAGE
    assert all(PAGE.count(f"\n| {look} | ") == 2 for look in LOOKS)


def test_page_describes_every_baseline_as_it_is_now():
    assert [text for text in CHARACTER.values() if text not in PAGE] == []


def test_links_within_the_page_lead_somewhere():
    headings = re.findall(r"^#+ (.*)$", PAGE, re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in headings}
    assert set(re.findall(r"\]\(#([^)]+)\)", PAGE)) <= anchors
