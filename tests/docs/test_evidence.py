"""Each promise of the pages names the row or test that shows it, and each row, test and clause that is named exists."""

import ast
import re
from fnmatch import fnmatch

import pytest

from sightline.evaluation.faults.cases import CASES
from tests.docs.test_pages import PAGES, ROOT, SOURCE, TOP, shown

ROWS = [case.id for case in CASES]
SPECIFICATION = (ROOT / "protocol/README.md").read_text()
CLAUSES = set(re.findall(r"^(?:\*\*|## )(\d+(?:\.\d+)?)\.?[ *]", SPECIFICATION, re.M))
NAMED = re.compile(r"\[`([^`\]]+)`\]\(([^)\s]+)\)")
HAZARDS = ROOT / "docs/explanation/hazards.md"
PROMISING = {
    "README.md": ("How it works",),
    "README.zh-CN.md": ("工作原理",),
    "SECURITY.md": ("What counts",),
    "docs/explanation/safety.md": (
        "Safety: what stops the robot", "The bounds, with the default configuration", "The processes",
        "Arming and STOP", "One driver",
    ),
    "docs/explanation/security-model.md": (
        "A peer without keys", "What plain mode promises", "Proof of identity", "A peer with keys of another role",
        "Failures are visible", "No rule on rate",
    ),
}
NO_PROMISE = (
    # introductions, and what is stated to be not covered
    "The robot streams JPEG images.", "机器人发送 JPEG 图像流。", "### ",
    "Sightline makes two promises", "[Safety limits]", "STOP also comes by", "Without keys a peer can open",
    "These are security problems", "The [security model]", "Zenoh drops without a reply",
    # roles of the processes
    "| guardian | systemd", "| driver process | guardian", "| network process |", "| STOP receiver |",
    # introductions of tables, and the rows of a table whose introduction names the tests
    "| a frame that the robot did not issue", "| a frame of an earlier start", "| a frame over the age limit",
    "| a frame from the future", "| a frame correctly",
    # the promise of TLS, which Sightline does not test
    "| read the traffic |",
)


def problem_with_evidence(text: str, target: str) -> str:
    """Return why a row or test that a link names does not exist; empty if it does, or if it is another link."""
    if text.startswith("faults: "):
        pattern = text.removeprefix("faults: ")
        if not target.endswith("results/faults.md"):
            return "links to another page"
        return "" if any(fnmatch(row, pattern) for row in ROWS) else "no such row"
    file = target.removeprefix(SOURCE)
    if not file.startswith("tests/"):
        return ""
    if not (ROOT / file).exists():
        return "no such file"
    nodes = ast.walk(ast.parse((ROOT / file).read_text()))
    functions = {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
    return "" if text.endswith(".py") or text in functions else "no such test"


def evidence(text: str) -> list[tuple[str, str]]:
    """Return the rows and tests that a text links to."""
    return [(name, target) for name, target in NAMED.findall(text) if name.startswith("faults: ") or "tests/" in target]


def blocks(text: str) -> list[str]:
    """Return the paragraphs, items and rows of a section, without the heads of its tables."""
    text = re.sub(r"^```.*?^```$", "", re.sub(r"<!--.*?-->", "", text, flags=re.S), flags=re.S | re.M)
    text = re.sub(r"^\|.*\n\|[-|]+\n", "\n", text, flags=re.M)
    return [block.strip() for block in re.split(r"\n\s*\n|\n(?=[|-] ?|\d+\. )", text) if block.strip()]


def promises(page: str) -> list[str]:
    sections = re.split(r"^##? ", (ROOT / page).read_text(), flags=re.M)
    by_title = {title: body for title, _, body in (section.partition("\n") for section in sections)}
    return [block for title in PROMISING[page] for block in blocks(by_title[title]) if not block.startswith(NO_PROMISE)]


def test_every_row_and_test_that_a_page_links_to_exists():
    named = [(page, *found) for page in (*TOP, *PAGES) for found in evidence(page.read_text("utf-8"))]
    assert len(named) > 100
    assert [f"{shown(page)}: {text}: {why}" for page, text, target in named
            if (why := problem_with_evidence(text, target))] == []


@pytest.mark.parametrize("page", PROMISING)
def test_every_promise_links_to_the_row_or_test_that_shows_it(page):
    found = promises(page)
    assert len(found) >= 2
    assert [block for block in found if not evidence(block)] == []


def test_every_row_of_the_hazards_has_a_hazard_a_clause_that_exists_and_evidence():
    lines = [line for line in HAZARDS.read_text().splitlines() if line.startswith("| L")]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    assert len(rows) >= 20 and {len(row) for row in rows} == {8}
    known = set(re.findall(r"\*\*([LH]\d)\*\*", HAZARDS.read_text()))
    for loss, hazard, action, cause, clauses, tests, faults, rest in rows:
        assert {*loss.split(", "), hazard} <= known, action
        assert cause and rest and (evidence(tests + faults) or rest != "-"), action
        named = re.findall(r"\[([\d.]+)\]\(\.\./reference/protocol\.md\)", clauses)
        assert clauses == "-" or (named and set(named) <= CLAUSES), action
    assert {row[1] for row in rows} | {one for row in rows for one in row[0].split(", ")} == known


@pytest.mark.parametrize(("text", "target", "why"), [
    ("faults: driver.two", "results/faults.md", ""),
    ("faults: driver.*", "results/faults.md", ""),
    ("faults: driver.three", "results/faults.md", "no such row"),
    ("faults: driver.two", "results/performance.md", "links to another page"),
    ("test_lease.py", "tests/robot_side/safety/test_lease.py", ""),
    ("test_a_lease_lives_its_time", SOURCE + "tests/robot_side/safety/test_lease.py", ""),
    ("test_a_lease_never_ends", SOURCE + "tests/robot_side/safety/test_lease.py", "no such test"),
    ("test_gone.py", "tests/test_gone.py", "no such file"),
])
def test_evidence_that_does_not_exist_is_found(text, target, why):
    assert problem_with_evidence(text, target) == why


def test_a_block_without_evidence_is_found():
    table, row = "| a | b |\n|---|---|\n| 1 | 2 |\n", "[`faults: driver.two`](results/faults.md)"
    text = f"One [promise](x.md).\n\n- an item\n- {row}\n\n{table}"
    assert [one for one in blocks(text) if not evidence(one)] == ["One [promise](x.md).", "- an item", "| 1 | 2 |"]
