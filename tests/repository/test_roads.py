"""The page of the roads: every name in it exists, and the roads of a frame and of a STOP stay short."""

import ast
import re

import pytest

from tests.repository.test_layout import FILES, ROOT, none_of, shown, tree

PAGE = (ROOT / "docs/explanation/roads.md").read_text()
FRAME, STOP, PLACES = (PAGE.partition(f"## {title}\n")[2].partition("\n## ")[0]
                       for title in ("A frame", "A STOP", "Processes, threads, sockets and slots"))
STEP = re.compile(r"^\| [^`]*?(?:`[^|`]*(?:\\\|[^`]*)?`)?[^`|]* \| `([\w/]+\.py)` \| `([\w.]+)` \|$", re.M)
MAX_FILES = {"frame": 40, "STOP": 21}


def names_of(path: str) -> set[str]:
    """Functions, classes and constants of a file, methods as `Class.method`."""
    found = set()
    for node in tree(ROOT / path).body:
        if isinstance(node, ast.ClassDef):
            found |= {node.name} | {f"{node.name}.{part.name}" for part in node.body if hasattr(part, "name")}
        elif isinstance(node, ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.AnnAssign):
            found.add(ast.unparse(node.target))
        elif isinstance(node, ast.Assign):
            found |= {ast.unparse(target) for target in node.targets}
    return found


@pytest.mark.parametrize(("road", "text"), [("frame", FRAME), ("STOP", STOP)])
def test_a_road_names_what_exists_and_is_short(road, text):
    steps = STEP.findall(text)
    assert len(steps) == len(re.findall(r"^\| .*\.py`", text, re.M)) > 15, "a row has another form"
    none_of(f"{path}: {name}" for path, name in steps if not (ROOT / path).exists() or name not in names_of(path))
    assert len({path for path, _ in steps}) <= MAX_FILES[road]


def test_every_thread_and_slot_on_the_page_exists():
    rows = re.findall(r"^\| [^|]* \| ([^|]*) \| `([\w/]+\.py)` \| ([^|]*) \|", PLACES, re.M)
    assert len(rows) == len(re.findall(r"^\| .*\.py`", PLACES, re.M)) > 10
    wrong = []
    for where, path, holds in rows:
        text = (ROOT / path).read_text() if (ROOT / path).exists() else ""
        wrong += [f"{path}: {name}" for name in re.findall(r"`([^`]+)`", where + holds) if name not in text]
    none_of(wrong)


def test_every_next_line_names_a_function_that_exists():
    """At the border of a process a docstring names where the road continues: `Next: path.py: Class.method`."""
    following = [(shown(path), *found) for path in FILES
                 for found in re.findall(r"Next: `([\w/.]+)`: `([\w.]+)`", path.read_text())]
    assert len(following) >= 6
    none_of(f"{where}: {path}: {name}" for where, path, name in following if name not in names_of(path))
