"""The banned patterns of the writing guide over the texts of the source: strings, docstrings, comments, test names.

Other files than Python: comments and strings of JavaScript, each line of the rest.

Text in backticks is not read. `python -m tests.repository.test_writing FOLDER` prints every place in a folder.
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent

# Pattern, replacement. A pattern with ^ applies only to the start of a docstring.
BANNED = {
    r"(?-i:\b(is|are|was|be) none\b)": "invalid, unknown, missing",
    r"(?<!there )\b(is|are|was) no (?!longer|more|less|older|newer|later)[a-z]": "is not a",
    r"\bwho(so)?ever\b|\b(for|of|to|by|than|lets) who\b": "the client that",
    r"\b(some|no|any|every)body\b": "no client, the holder",
    r"\b(says?|said|tells?|told)\b": "print, report, show",
    r"\b(hears?|heard)\b": "receive",
    r"\b(asks?|asked|asking)\b": "request",
    r"\bobey(s|ed)?\b": "apply",
    r"\bjudg(e[sd]?|ing)\b|\bverdicts?\b": "validate, score",
    r"(?<!onnection )\brefus(e[sd]?|als?)\b": "reject",
    r"\beyes?\b|(?<!line of )\bsight\b": "detector, frame age",
    r"\bmend(s|ed)?\b|\bstrangers?\b|\banew\b": "fix, third party, again",
    r"\b(kept to|goes by|taken up)\b": "use, apply",
    r"\b(a|each|every|second) vision\b(?! (service|process))|\bvisions\b": "vision service",
    r"\b(older )?dialects?\b|\bolder laws?\b|\bwrite-?ups?\b": "legacy",
    r"\b(a|the) person\b": "operator",
    r"^(What|Who|Whether|Where|How|Of|As)\b": "a verb",
    r"pip install .?sightline\[": "sightline-robot",
}

# (file, text of the hit in lower case) -> the reason why it stays.
EXCEPTIONS = {
    ("tests/repository/test_writing.py", None): "the patterns themselves",
    ("tests/conformance/test_codec.py", "refusal"): "a field of the kit's line protocol for codecs",
    ("compose.yaml", "refused"): "a field of the status",
}

FOLDERS = (
    "sightline", "protocol", "robot_side", "vision_side", "sim", "conformance", "operator_side", "evaluation",
    "training", "benchmarks", "examples", "docs/make",
)
# Where the reasons are not obvious, at least 4 % of the lines are comments.
COMMENTED = (
    "robot_side/safety", "robot_side/network", "protocol/transports", "vision_side/pipeline.py", "vision_side/tracking",
)
_BACKTICKS = re.compile(r"`[^`\n]*`")
_JAVASCRIPT = re.compile(r"""/\*.*?\*/|(?<!:)//[^\n]*|"(?:[^"\\\n]|\\.)*"|`(?:[^`\\]|\\.)*`""", re.DOTALL)
"""Comments and strings."""
_CODE = re.compile(r"^(old|new|before|after|where|place) = |\$\{[^}]*\}")
"""Quoted code in the tables of mutants, and in the strings of JavaScript."""
LINES = (
    ".toml", ".yaml", ".urdf", ".xacro", ".html", ".service", ".conf", "Makefile", "Dockerfile", "run", "engine",
    "other_python",
)


@cache
def patterns() -> dict[str, re.Pattern[str]]:
    return {source: re.compile(source, re.IGNORECASE) for source in BANNED}


@cache
def anything() -> re.Pattern[str]:
    """Return one pattern for all banned ones, to skip most texts quickly."""
    return re.compile("|".join(f"(?:{source})" for source in BANNED), re.IGNORECASE)


def texts(path: Path) -> Iterator[tuple[str, int, str]]:
    """Yield (kind, line, text) of a module: docstrings, names of tests, strings with a space, and comments."""
    source = path.read_text(encoding="utf-8")
    seen: set[int] = set()
    nodes = list(ast.walk(ast.parse(source)))
    for node in nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
            first = node.body[0]
            doc = first.value if isinstance(first, ast.Expr) else None
            if isinstance(doc, ast.Constant) and isinstance(doc.value, str):
                seen.add(id(doc))
                yield "docstring", first.lineno, doc.value
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_"):
            yield "test", node.lineno, node.name.replace("_", " ")
        if isinstance(node, ast.JoinedStr):
            seen |= {id(part) for part in node.values}
            yield "string", node.lineno, "".join(
                str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values
            )
    for node in nodes:
        if not isinstance(node, ast.Constant) or id(node) in seen:
            continue
        if isinstance(node.value, str) and " " in node.value:
            yield "string", node.lineno, node.value
    # To read the tokens of a file is slow.
    if any("#" in line and anything().search(line.partition("#")[2]) for line in source.splitlines()):
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                yield "comment", token.start[0], token.string.lstrip("# ")


def other_texts(path: Path) -> Iterator[tuple[str, int, str]]:
    """Yield (kind, line, text) of a file that is not Python."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".mjs":
        for found in _JAVASCRIPT.finditer(source):
            if " " in found[0]:
                text = found[0][1:-1] if found[0][0] == "`" else found[0]
                yield "text", source.count("\n", 0, found.start()) + 1, _CODE.sub("", text)
    else:
        lines = enumerate(source.splitlines(), 1)
        yield from (("line", number, line) for number, line in lines if not _CODE.match(line))


def hits_in(path: Path) -> Iterator[str]:
    name = path.relative_to(ROOT).as_posix()
    for kind, line, text in texts(path) if path.suffix == ".py" else other_texts(path):
        plain = _BACKTICKS.sub("`x`", text).strip()
        if not anything().search(plain):
            continue
        for source, pattern in patterns().items():
            if source.startswith("^") and kind != "docstring":
                continue
            for match in pattern.finditer(plain):
                if (name, None) not in EXCEPTIONS and (name, match[0].lower()) not in EXCEPTIONS:
                    around = plain[max(0, match.start() - 40):][:90]
                    yield f"{name}:{line}: {kind}: {match[0]!r} -> {BANNED[source]}: {around!r}"


def folders() -> list[str]:
    """Return the packages, and the folders of tests."""
    tests = sorted(path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and path.name != "__pycache__")
    return [*FOLDERS, "tests", *(f"tests/{name}" for name in tests)]


def hits_of(folder: str) -> list[str]:
    """Return the hits of a folder; of `tests` without its subfolders."""
    paths = (ROOT / folder).glob("*.py") if folder == "tests" else (ROOT / folder).rglob("*.py")
    return [hit for path in sorted(paths) for hit in hits_in(path)]


@pytest.mark.parametrize("folder", folders())
def test_no_text_contains_a_banned_pattern(folder):
    hits = hits_of(folder)
    assert hits == [], "\n".join([f"{folder}: {len(hits)} hits", *hits[:40]])


def other_files() -> list[Path]:
    """Return the JavaScript, settings and scripts of the repository."""
    roots = [ROOT / name for name in (*FOLDERS, "tests", "deploy", ".ci")]
    paths = [*ROOT.iterdir(), *(path for root in roots for path in root.rglob("*"))]
    return sorted({path for path in paths if path.is_file() and path.name.endswith((".mjs", *LINES))})


def test_no_text_outside_python_contains_a_banned_pattern():
    files = other_files()
    assert {"compose.yaml", "gate.mjs", "Makefile", "circle.toml", "watch.html", "run"} <= {path.name for path in files}
    hits = [hit for path in files for hit in hits_in(path)]
    assert hits == [], "\n".join([f"{len(hits)} hits", *hits[:40]])


def sentences_without_a_figure(text: str) -> list[str]:
    """Return the sentences that call something safe or certified and state no figure."""
    sentences = re.split(r"(?<=[.!?|])\s", " ".join(text.split()))
    claim = re.compile(r"\b(safe|safely|certified)\b", re.IGNORECASE)
    return [one for one in sentences if claim.search(one) and not re.search(r"\d", one)]


def test_no_page_calls_anything_safe_or_certified_without_a_figure():
    assert len(sentences_without_a_figure("It is safe. It is certified. Safe within 0.25 m. A safety gate.")) == 2
    pages = [*ROOT.glob("*.md"), ROOT / "protocol/README.md", *(ROOT / "docs").rglob("*.md")]
    hits = {page.relative_to(ROOT).as_posix(): found for page in pages
            if (found := sentences_without_a_figure(page.read_text("utf-8")))}
    assert hits == {}


@pytest.mark.parametrize("place", COMMENTED)
def test_a_place_with_hidden_reasons_has_comment_lines(place):
    paths = sorted((ROOT / place).rglob("*.py")) or [ROOT / place]
    lines = [line.strip() for path in paths for line in path.read_text("utf-8").splitlines()]
    assert len(lines) > 200 and sum(line.startswith("#") for line in lines) >= 0.04 * len(lines)


def unknown_arguments(tree: ast.Module) -> Iterator[str]:
    """Yield each name under `Args:` that is not a parameter or field of its function or class."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        _, _, section = ("\n" + (ast.get_docstring(node) or "")).partition("\nArgs:\n")
        entries = re.findall(r"^    (\w+):", re.split(r"^\S", section, maxsplit=1, flags=re.MULTILINE)[0], re.MULTILINE)
        if not entries:
            continue
        parts = list(ast.walk(node))
        known = {one.arg for one in parts if isinstance(one, ast.arg)}
        known |= {one.target.id for one in parts if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)}
        yield from (f"{node.lineno} {node.name}: {name}" for name in entries if name not in known)


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_described_argument_exists(folder):
    assert [f"{path.relative_to(ROOT)}:{one}" for path in sorted((ROOT / folder).rglob("*.py"))
            for one in unknown_arguments(ast.parse(path.read_text("utf-8")))] == []


def test_an_unknown_argument_is_found():
    docstring = "Do it.\n\n    Args:\n        a: known.\n        b: unknown.\n\n    Raises:\n        C: never."
    text = f"def f(a):\n    \"\"\"{docstring}\n    \"\"\"\n"
    assert list(unknown_arguments(ast.parse(text))) == ["1 f: b"]


def test_every_exception_is_needed():
    files = {name: (ROOT / name).read_text("utf-8").lower() for name, _ in EXCEPTIONS}
    assert [(name, text) for name, text in EXCEPTIONS if text is not None and text not in files[name]] == []


def test_a_text_with_each_pattern_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    module = tmp_path / "module.py"
    module.write_text(
        '"""What it is."""\n\n\ndef test_nobody_drives():\n    """Return `nobody`."""\n'
        '    return f"endpoint {1} is none"  # the robot obeyed\n', encoding="utf-8"
    )
    kinds = [hit.split(": ")[1] for hit in hits_in(module)]
    assert sorted(kinds) == ["comment", "docstring", "string", "test"]
    script = tmp_path / "script.mjs"
    script.write_text(
        '/** Who\n * nobody hears. */\nconst told = "obeyed";  // judged `told`\n'
        'log(`${told} refused ${x}`, "is none");\n', "utf-8",
    )
    assert [hit.split(":")[1] for hit in hits_in(script)] == ["1", "1", "3", "4", "4"]
    table = tmp_path / "mutants.toml"
    table.write_text('# whoever\nold = "refused"\nname = "it says no"\n', encoding="utf-8")
    assert [hit.split(":")[1] for hit in hits_in(table)] == ["1", "3"]


if __name__ == "__main__":
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    for name in folders():
        hits = hits_of(name)
        print(f"{name}: {len(hits)}")
        if wanted and name.startswith(wanted):
            print("\n".join(hits))
