"""The pages of docs/ and the README: links, languages of blocks, commands that run, plain words, readability."""

import re
from pathlib import Path

import pytest
import yaml

from docs.make import reference
from tests.repository import test_writing

ROOT = Path(__file__).parent.parent.parent
DOCS = ROOT / "docs"
SOURCE = "https://github.com/sightline-robot/sightline/blob/main/"
RAW = "https://raw.githubusercontent.com/sightline-robot/sightline/main/"
TOP = [ROOT / name for name in ("README.md", "README.zh-CN.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")]
PAGES = sorted(DOCS.rglob("*.md"))
RESULTS = DOCS / "reference" / "results"
WRITTEN = [page for page in (*TOP, *PAGES)
           if page.parent != RESULTS and not page.read_text("utf-8").startswith(reference.NOTE)]
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
GUIDES = [page for page in sorted((DOCS / "how-to").glob("*.md")) if not page.name.startswith("add-")]
FENCE = re.compile(r"^[ ]*```([^\n]*)\n(.*?)^[ ]*```[ ]*$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
SHELL = ("sh", "bash", "console", "shell")
BANNED = [re.compile(pattern, re.IGNORECASE) for pattern in test_writing.BANNED if not pattern.startswith("^")]


def shown(page: Path) -> str:
    return str(page.relative_to(ROOT))


def without_code(text: str) -> str:
    """Return a page without blocks of code, comments and text in backticks."""
    return re.sub(r"`[^`\n]*`", "`x`", re.sub(r"<!--.*?-->", "", FENCE.sub("", text), flags=re.DOTALL))


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip()) for heading in headings}


def problem_with(page: Path, link: str) -> str:
    """Return why a link of a page does not resolve; empty if it does."""
    path, _, anchor = link.partition("#")
    for prefix in (SOURCE, RAW):
        if path.startswith(prefix):
            return "" if (ROOT / path.removeprefix(prefix)).exists() else "no such file in the repository"
    if re.match(r"[a-z]+:", path):
        return ""
    target = (page.parent / path).resolve() if path else page
    if not target.exists():
        return "no such file"
    if DOCS in page.parents and DOCS not in target.parents:
        return f"leaves docs/: write {SOURCE}..."
    return "" if not anchor or target.suffix != ".md" or anchor in anchors(target) else "no such heading"


def test_every_link_resolves():
    links = [(page, link) for page in (*TOP, *PAGES) for link in LINK.findall(without_code(page.read_text("utf-8")))]
    assert len(links) > 200
    assert [f"{shown(page)}: {link}: {why}" for page, link in links if (why := problem_with(page, link))] == []


def test_every_page_is_in_the_navigation_once():
    def leaves(entry):
        if isinstance(entry, dict):
            entry = list(entry.values())
        return [entry] if isinstance(entry, str) else [leaf for part in entry for leaf in leaves(part)]

    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text("utf-8"))
    assert sorted(leaves(config["nav"])) == sorted(str(page.relative_to(DOCS)) for page in PAGES)


def test_every_block_of_code_has_a_language():
    bare = [f"{shown(page)}: {code[:40]!r}" for page in (*TOP, *PAGES)
            for language, code in FENCE.findall(page.read_text("utf-8")) if not language.strip()]
    assert bare == []


@pytest.mark.parametrize("page", [ROOT / "README.md", *TUTORIALS], ids=shown)
def test_every_shell_block_of_a_tutorial_runs_or_states_why_not(page):
    text = page.read_text("utf-8")
    for block in FENCE.finditer(text):
        if block[1].strip() not in SHELL or "git clone" in block[2]:
            continue
        before = text[: block.start()].rstrip().rpartition("\n")[2]
        assert re.fullmatch(r"<!-- (run: \w+|not run: .{15,}) -->", before), (shown(page), block[2][:60])


@pytest.mark.parametrize("name", [
    "README.md", "README.zh-CN.md", "docs/how-to/cameras.md", "docs/tutorials/two-machines.md",
    "docs/tutorials/build-the-car.md",
])  # fmt: skip
def test_page_that_installs_creates_and_activates_an_environment_first(name):
    text = (ROOT / name).read_text("utf-8")
    blocks = "\n".join(body for language, body in FENCE.findall(text) if language.strip() in SHELL)
    blocks = re.sub(r"^(car\$|git clone) .*$", "", blocks, flags=re.MULTILINE)
    created = re.search(r"python3 -m venv \.venv && \. \.venv/bin/activate", blocks)
    assert created and not re.search(r"sightline|pip install", blocks[: created.start()])


def test_two_machines_page_names_the_keys_of_each_machine():
    page = (DOCS / "tutorials" / "two-machines.md").read_text("utf-8")
    files = {machine: re.findall(r"`([^`]+)`", row)
             for machine, row in re.findall(r"^\| (robot|laptop) \| (.*) \|$", page, re.MULTILINE)}
    assert files == {
        "robot": ["ca.pem", "robot.*", "stop.secret"], "laptop": ["ca.pem", "vision.*", "operator.*", "stop.secret"],
    }  # fmt: skip


@pytest.mark.parametrize("page", [*TUTORIALS, *GUIDES], ids=shown)
def test_guide_states_its_result_and_how_to_continue(page):
    text = page.read_text("utf-8")
    lines = text.splitlines()
    assert lines[0].startswith("# ") and lines[2].startswith("You "), lines[:3]
    assert "## Before you start" in text
    assert "## Next" in text or page.stem == "troubleshooting"
    assert "## If it fails" in text or page.stem in ("write-a-mission", "troubleshooting")


@pytest.mark.parametrize("page", WRITTEN, ids=shown)
def test_page_is_short(page):
    text = page.read_text("utf-8")
    plain = without_code(text)
    prose = "\n".join(line for line in plain.splitlines() if not line.startswith("|"))
    if page.parent.name != "decisions":
        assert len(prose.split()) <= 1200
    long = [line for line in LINK.sub("", FENCE.sub("", text)).splitlines() if len(line) > 120 and line[:1] not in "|<"]
    assert long == []


@pytest.mark.parametrize("page", [*TOP, *PAGES, ROOT / "protocol" / "README.md"], ids=shown)
def test_page_has_no_banned_pattern(page):
    text = page.read_text("utf-8")
    prose = " ".join(without_code(text).split())  # the end of a line is a space, also within a pattern
    assert [hit[0] for pattern in BANNED for hit in pattern.finditer(prose)] == []
    [other_project] = [pattern for pattern in BANNED if pattern.pattern.startswith("pip ")]
    assert not other_project.search(text)  # in a block of code too


def syllables(word: str) -> int:
    """Return the number of syllables of an English word, by its groups of vowels."""
    word = re.sub(r"(?<=[^aeiouyl])e$|(?<=[^dt])ed$|(?<=[^scgxz])es$", "", word.lower())
    return max(1, len(re.findall(r"[aeiouy]+", word)))


def reading_ease(text: str) -> float:
    """Return the Flesch reading ease of a page without code, tables, headings and links.

    Source: Flesch, "A new readability yardstick", 1948.
    """
    lines = [line for line in LINK.sub("", without_code(text)).splitlines() if line[:1] not in "|#"]
    prose = re.sub(r"^\s*(?:-|\d+\.)\s+", "", "\n".join(lines), flags=re.MULTILINE)
    words = re.findall(r"[A-Za-z][A-Za-z'-]*", prose.replace("`x`", "it"))
    sentences = max(1, len(re.findall(r"[.!?:](?=\s)", prose)))
    return 206.835 - 1.015 * len(words) / sentences - 84.6 * sum(map(syllables, words)) / len(words)


@pytest.mark.parametrize("page", [ROOT / "README.md", *TUTORIALS], ids=shown)
def test_page_for_newcomers_reads_easily(page):
    assert reading_ease(page.read_text("utf-8")) >= 50


def test_reading_ease_separates_plain_from_heavy_text():
    assert reading_ease("The robot stops. You start it again. It drives to the ball.\n") > 90
    heavy = "Instantaneous synchronization considerations necessitate comprehensive authorization procedures.\n"
    assert reading_ease(heavy) < 0


def test_first_screen_of_the_readme_fits():
    first = (ROOT / "README.md").read_text("utf-8").partition("\n## ")[0]
    assert first.count("\n") <= 60
    assert "make demo" in first and "If an image is too old" in first and "![" in first


def test_generated_pages_are_current():
    assert reference.stale() == [], "run `python -m docs.make.reference`"


def test_every_setting_has_a_meaning():
    page = (DOCS / "reference" / "settings.md").read_text("utf-8")
    rows = [row for row in page.splitlines() if row.startswith("| `")]
    assert len(rows) > 100 and [row for row in rows if row.endswith("|  |")] == []


def test_every_reason_and_exit_code_is_described():
    assert set(reference.REMEDIES) == set(reference.RejectReason)
    page = (DOCS / "reference" / "exit-codes.md").read_text("utf-8")
    assert all(f"| {code} |" in page for code in reference.EXIT_CODES)


def test_a_link_that_does_not_resolve_is_found():
    page = DOCS / "how-to" / "cameras.md"
    assert problem_with(page, "gone.md") == "no such file"
    assert problem_with(page, "teleop.md#gone") == "no such heading"
    assert problem_with(page, SOURCE + "gone.py") == "no such file in the repository"
    assert problem_with(page, "../../README.md").startswith("leaves docs/")
    assert problem_with(page, "teleop.md#if-it-fails") == ""
