"""The selection of files by what changed since a commit, in small repositories of their own."""

import subprocess
from pathlib import Path

import pytest

import tests.mutation.__main__ as gate
from tests.mutation.changes import select

ROW = '[[equivalent]]\nfile = "a.py"\nwhere = "f"\nbefore = "1"\nafter = "2"\nreason = "same"\n'
FILES = {
    "a.py": "A = 1\n",
    "b.py": "B = 1\n",
    "c.py": "C = 1\n",
    "tests/__init__.py": "",
    "tests/conftest.py": "",
    "tests/test_a.py": "from tests.helpers import near\n",
    "tests/test_b.py": "import tests.helpers.far\n",
    "tests/test_c.py": "import math\n",
    "tests/helpers/__init__.py": "",
    "tests/helpers/near.py": "from tests.helpers.far import X\n",
    "tests/helpers/far.py": "X = 1\n",
    "tests/mutation/mutants.py": "",
    "tests/mutation/test_mutants.py": "",
    "tests/mutation/equivalents.toml": ROW,
    "README.md": "",
}
TABLES = {f"{name}.py": (f"tests/test_{name}.py",) for name in "abc"}


def git(*arguments):
    identity = ("-c", "user.name=A", "-c", "user.email=a@example.com", "-c", "commit.gpgsign=false")
    ran = subprocess.run(["git", *identity, *arguments], capture_output=True, text=True, check=True)
    return ran.stdout.strip()


def write(path, text):
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text)


def commit(path, text):
    write(path, text)
    git("add", "--all")
    git("commit", "--quiet", "--message", path)


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository with two commits; the newer one touches no file with mutants. It is the current folder."""
    for variable in ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.chdir(tmp_path)
    git("init", "--quiet", "--initial-branch", "main")
    for path, text in FILES.items():
        write(path, text)
    commit("README.md", "first")
    commit("README.md", "second")
    return tmp_path


@pytest.mark.parametrize(
    ("path", "text", "selected"),
    [
        ("README.md", "third", []),
        ("tests/mutation/test_mutants.py", "Y = 1\n", []),
        ("a.py", "A = 2\n", ["a.py"]),
        ("a.py", '"""A text."""\n\nA = 1  # and a comment\n"""The first."""\n', []),
        ("a.py", "A = 1\nprint('a text')\n", ["a.py"]),
        ("tests/test_b.py", "Y = 1\n", ["b.py"]),
        ("tests/helpers/near.py", "Y = 1\n", ["a.py"]),
        ("tests/helpers/far.py", "X = 2\n", ["a.py", "b.py"]),
        ("tests/helpers/__init__.py", "Y = 1\n", ["a.py", "b.py"]),
        ("tests/__init__.py", "Y = 1\n", ["a.py", "b.py", "c.py"]),
        ("tests/conftest.py", "Y = 1\n", ["a.py", "b.py", "c.py"]),
        ("tests/mutation/mutants.py", "Y = 1\n", ["a.py", "b.py", "c.py"]),
        ("tests/mutation/equivalents.toml", ROW.replace("same", "equal"), []),
        ("tests/mutation/equivalents.toml", "", ["a.py"]),
        ("tests/mutation/equivalents.toml", ROW + ROW.replace("a.py", "c.py"), ["c.py"]),
        ("tests/mutation/equivalents.toml", ROW.replace('"a.py"', '"b.py"'), ["a.py", "b.py"]),
    ],
)
@pytest.mark.parametrize("committed", [False, True])
def test_a_change_selects_the_files_that_it_affects(repository, path, text, selected, committed):
    base = git("rev-parse", "HEAD")
    (commit if committed else write)(path, text)
    assert select(TABLES, base) == (selected, base)


def test_a_new_a_deleted_and_a_moved_file_are_changes(repository):
    git("mv", "c.py", "old.py")
    git("rm", "--quiet", "tests/test_b.py")
    assert select({**TABLES, "new.py": ("tests/test_new.py",)}, "HEAD")[0] == ["b.py", "c.py"]
    write("new.py", "N = 1\n")
    assert select({**TABLES, "new.py": ("tests/test_new.py",)}, "HEAD")[0] == ["b.py", "c.py", "new.py"]


def test_base_is_the_newest_tag_before_head(repository):
    git("tag", "v1", "HEAD~1")
    assert select(TABLES, "")[1] == "v1"
    commit("a.py", "A = 2\n")
    git("tag", "v2")
    assert select(TABLES, "") == (["a.py"], "v1"), "a release tests what changed since the release before it"
    commit("b.py", "B = 2\n")
    assert select(TABLES, "") == (["b.py"], "v2")


def test_base_without_a_tag_is_where_head_left_the_main_branch(repository):
    git("update-ref", "refs/remotes/origin/main", "HEAD")
    left = git("rev-parse", "HEAD")
    commit("a.py", "A = 2\n")
    commit("b.py", "B = 2\n")
    assert select(TABLES, "") == (["a.py", "b.py"], left)


def test_base_on_the_main_branch_is_the_commit_before(repository):
    commit("a.py", "A = 2\n")
    commit("b.py", "B = 2\n")
    git("update-ref", "refs/remotes/origin/main", "HEAD")
    assert select(TABLES, "")[0] == ["b.py"]


def test_history_that_is_missing_selects_every_file(repository, tmp_path_factory, monkeypatch):
    every = (list(TABLES), None)
    shallow = tmp_path_factory.mktemp("shallow") / "clone"
    git("clone", "--quiet", "--depth", "1", repository.as_uri(), str(shallow))
    monkeypatch.chdir(shallow)
    assert select(TABLES, "") == select(TABLES, "v9") == every
    monkeypatch.chdir(tmp_path_factory.mktemp("plain"))
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", "/")
    assert select(TABLES, "") == select(TABLES, "HEAD") == every
    monkeypatch.chdir(repository)
    monkeypatch.setenv("PATH", "")
    assert select(TABLES, "") == select(TABLES, "HEAD") == every


def test_the_first_commit_selects_every_file(repository):
    git("checkout", "--quiet", "HEAD~1")
    assert select(TABLES, "") == (list(TABLES), None)


def test_unknown_commit_in_a_complete_repository_is_an_error(repository):
    with pytest.raises(ValueError, match="unknown commit 'v9'"):
        select(TABLES, "v9")


def test_command_without_a_change_prints_one_line(repository, monkeypatch, capsys):
    monkeypatch.setattr(gate, "TABLES", TABLES)
    assert gate.main(["--changed", "HEAD"]) == 0
    assert capsys.readouterr() == ("", "no file of the mutation gate changed since HEAD\n")


def test_command_lists_the_mutants_of_changed_files_only(repository, monkeypatch, capsys):
    monkeypatch.setattr(gate, "TABLES", TABLES)
    write("b.py", "B = 1 < 2\n")
    assert gate.main(["--changed", "HEAD", "--list"]) == 0
    output = capsys.readouterr()
    assert output.out.startswith("b.py:1 : `1 < 2` -> `1 <= 2`\n") and "a.py" not in output.out
    assert output.err == "b.py changed since HEAD\n"


def test_command_with_an_unknown_commit_exits_with_one_line(repository, monkeypatch, capsys):
    monkeypatch.setattr(gate, "TABLES", TABLES)
    assert gate.main(["--changed", "v9"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
