"""Select the files whose mutants can end in another way than at an earlier commit. Shell."""

import ast
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath

from tests.mutation.mutants import equivalents

GATE = "tests/mutation"
EQUIVALENTS = f"{GATE}/equivalents.toml"
_OF_A_FOLDER = ("conftest.py", "__init__.py")


def select(tables: Mapping[str, tuple[str, ...]], commit: str) -> tuple[list[str], str | None]:
    """Select the files whose code changed, or that of their tests or helpers of tests, or their equivalents.

    Comments and docstrings are not code. A change to the gate selects every file. So does a missing history: no git, no
    repository, a shallow clone.

    Args:
        tables: each file with its test tables, relative to the current folder.
        commit: the commit to compare the working tree with; "" for the newest tag before HEAD, else the commit where
            HEAD left origin/main, else the commit before HEAD.

    Returns:
        The files and the commit, which is None if the history is missing.

    Raises:
        ValueError: the history is complete and `commit` is not in it.
    """
    base = _base(commit)
    paths = _changed_paths(base) if base else None
    if base is None or paths is None:
        return list(tables), None
    paths = {path for path in paths if not path.endswith(".py") or _code_at(base, path) != _code_of(path)}
    if any(path.startswith(f"{GATE}/") and _is_code(path) for path in paths):
        return list(tables), base
    rows = {name[0] for name in _changed_rows(base)} if EQUIVALENTS in paths else set()
    changed = {file for file in tables if file in rows or file in paths or paths & _read_by(tables[file])}
    return [file for file in tables if file in changed], base


def _is_code(path: str) -> bool:
    return path.endswith(".py") and not PurePosixPath(path).name.startswith("test_")


def _git(*arguments: str) -> str | None:
    """Run git in the current folder; return its output, or None if it fails or is not installed."""
    try:
        ran = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False)
    except OSError:
        return None
    return ran.stdout.strip() if ran.returncode == 0 else None


def _base(commit: str) -> str | None:
    complete = _git("rev-parse", "--is-shallow-repository") == "false"
    if commit:
        if complete and _identity(commit) is None:
            raise ValueError(f"unknown commit {commit!r}: not in this repository; run `git fetch --tags`")
        return commit if _identity(commit) else None
    if not complete:
        return None
    candidates = (
        _git("describe", "--tags", "--abbrev=0", "HEAD~1"),
        _git("merge-base", "HEAD", "origin/main"),
        _git("rev-parse", "--short", "--verify", "HEAD~1"),
    )
    # On the main branch itself HEAD never left it, and nothing would be selected.
    return next((base for base in candidates if base and _identity(base) != _identity("HEAD")), None)


def _identity(commit: str) -> str | None:
    return _git("rev-parse", "--verify", "--quiet", "--end-of-options", commit + "^{commit}")


def _changed_paths(base: str) -> set[str] | None:
    """List what differs between `base` and the working tree, with what is new and not ignored."""
    tracked = _git("diff", "--name-only", "--no-renames", "--relative", "-z", base, "--")
    untracked = _git("ls-files", "--others", "--exclude-standard", "-z")
    return None if tracked is None or untracked is None else set(f"{tracked}\0{untracked}".split("\0")) - {""}


def _code_at(base: str, path: str) -> str | None:
    return _code(_git("show", f"{base}:./{path}"))


def _code_of(path: str) -> str | None:
    return _code(Path(path).read_text()) if Path(path).is_file() else None


def _code(source: str | None) -> str | None:
    """Return the code without comments and docstrings, None without a file."""
    if source is None:
        return None
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(getattr(node, "body", None), list):
            node.body = [one for one in node.body if not isinstance(getattr(one, "value", None), ast.Constant)
                         or not isinstance(one, ast.Expr)]
    return ast.dump(tree)


def _changed_rows(base: str) -> set[tuple[str, str, str, str, int]]:
    before = equivalents(_git("show", f"{base}:./{EQUIVALENTS}") or "")
    return before.keys() ^ equivalents(Path(EQUIVALENTS).read_text()).keys()


def _read_by(suites: Iterable[str]) -> set[str]:
    """List the test files that `suites` load: themselves, those of their folders, what these import, and so on."""
    folders = {parent for suite in suites for parent in PurePosixPath(suite).parents}
    found, todo = set(suites), [*suites, *(f"{folder}/{name}" for folder in folders for name in _OF_A_FOLDER)]
    while todo:
        path = todo.pop()
        found.add(path)
        if Path(path).is_file():
            todo += set(_imports(ast.parse(Path(path).read_text()))) - found
    return found


def _imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for path in (name.replace(".", "/") for name in names if name.startswith("tests.")):
            yield from (f"{path}.py", f"{path}/__init__.py", f"{PurePosixPath(path).parent}/__init__.py")
