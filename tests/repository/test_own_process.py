"""Tests that count what belongs to a whole process run in one of their own, and no other test counts it."""

import os
import re
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parent.parent
COUNTS = re.compile(r"/proc/self/|\bru_maxrss\b|active_count\(|\bnum_fds\b|get_objects\(|tracemalloc|resident_kib\(\)")
CONFTEST = """
import os
from tests.fixtures import own_process

def pytest_configure(config):
    os.environ.setdefault("OUTER", str(os.getpid()))
    config.addinivalue_line("markers", "own_process: one of its own")
    config.pluginmanager.register(own_process)
"""
INNER = """
import os, pytest

@pytest.fixture
def pid(): return os.getpid()

@pytest.mark.own_process
def test_another_process(pid): assert str(pid) != os.environ["OUTER"]
@pytest.mark.own_process
def test_its_failure_is_reported(pid): assert pid == "never"
def test_names_this_process(pid): assert str(pid) == os.environ["OUTER"]
"""


def test_marked_test_runs_in_another_process_and_its_failure_is_reported(tmp_path):
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_it.py").write_text(INNER)
    environment = os.environ | {"PYTHONPATH": str(TESTS.parent), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--rootdir={tmp_path}", "test_it.py"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert "1 failed, 2 passed" in done.stdout, done.stdout
    assert "in a process of its own:" in done.stdout and "assert pid == " in done.stdout


def test_only_marked_tests_count_what_belongs_to_a_whole_process():
    found = []
    for path in sorted(TESTS.rglob("test_*.py")):
        parts = re.split(r"^(?=@pytest|def |class )", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        marked = False
        for part in parts:
            marked = marked or "own_process" in part
            if part.startswith("def "):
                if COUNTS.search(part) and not marked and path != Path(__file__):
                    found.append(f"{path.name}: {part.partition('(')[0]}")
                marked = False
    assert found == [], "mark them own_process"
