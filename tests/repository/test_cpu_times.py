"""Runs of pytest in processes of their own: what the hook on CPU times fails, and what it only names."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fixtures.cpu_times import CpuTimes, slowness

ROOT = Path(__file__).parent.parent.parent
CONFTEST = """
from tests.fixtures import cpu_times

def pytest_configure(config):
    cpu_times.NOTED_S = 0.02
    cpu_times.slowness = lambda: 1.0  # the tests compute for a time, not for a piece of work
    config.addinivalue_line("markers", "slow: second tier")
    config.pluginmanager.register(cpu_times.CpuTimes(bound_s=0.05))
"""
TESTS = """
import subprocess, sys, time
import pytest

COMPUTE = "import time\\nend_s = time.process_time() + 0.15\\nwhile time.process_time() < end_s: pass"

def test_computes(): exec(COMPUTE)
def test_has_a_child_that_computes(): subprocess.run([sys.executable, "-S", "-c", COMPUTE], check=True)
def test_only_waits(): time.sleep(0.2)
@pytest.mark.slow
def test_of_the_second_tier_computes(): exec(COMPUTE)
def test_fails_by_itself(): exec(COMPUTE); assert False

@pytest.fixture(scope="session")
def shared_child():
    with subprocess.Popen([sys.executable, "-S", "-c", COMPUTE + "\\nprint(flush=True); input()"],
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        yield

@pytest.mark.slow
def test_of_the_second_tier_starts_a_shared_child_that_computes(shared_child): pass
def test_is_not_charged_for_a_shared_child_that_ends_with_it(): pass
"""


def run(folder: Path, demand: str, *options: str) -> subprocess.CompletedProcess:
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_it.py").write_text(TESTS)
    environment = os.environ | {
        "TESTS_DEMAND": demand, "PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
    }  # fmt: skip
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--rootdir={folder}", *options, "."]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("options", [(), pytest.param(("-p", "xdist", "--numprocesses=2"), marks=pytest.mark.slow)])
def test_where_cpu_is_demanded_a_test_of_the_first_tier_that_computes_fails(tmp_path, options):
    done = run(tmp_path, "node,cpu", *options)
    assert set(re.findall(r"^ERROR \S+::(\w+)", done.stdout, re.MULTILINE)) == {
        "test_computes", "test_has_a_child_that_computes", "test_fails_by_itself",
    }, done.stdout  # fmt: skip
    line = r"test_it\.py::test_computes computes for 0\.\d+ s, a test of `make test` for at most 0\.05 s .*mark it slow"
    assert re.search(line, done.stdout) and done.returncode == 1


def test_where_it_is_not_demanded_the_slowest_are_only_named(tmp_path):
    done = run(tmp_path, "node")
    assert "ERROR" not in done.stdout and "6 passed" in done.stdout
    slowest = re.search(r"^most CPU time: 0\.\d+ s .*", done.stdout, re.MULTILINE)[0]
    assert slowest.count("test_it.py::") == 5 and "waits" not in slowest and "charged" not in slowest


def _a_little():
    sum(range(100))


def _a_process():
    subprocess.run([sys.executable, "-S", "-c", "sum(range(100_000))"], check=True)


def test_a_slower_machine_has_a_higher_bound(monkeypatch):
    from tests.fixtures import cpu_times

    assert slowness() >= 1.0
    works = {_a_little: 60.0, _a_process: 0.0001}  # slow at one kind of work only, first or last
    for either in (works, dict(reversed(works.items()))):
        monkeypatch.setattr(cpu_times, "REFERENCE_S", either)
        assert slowness() > 10
    monkeypatch.setenv("TESTS_DEMAND", "cpu")
    item = type("Item", (), {"nodeid": "x", "get_closest_marker": lambda self, name: None})()
    monkeypatch.setattr(cpu_times, "slowness", lambda: 1.9)
    assert CpuTimes()._complaint(item, 2.8) == "" and "at most 1.5 s" in CpuTimes()._complaint(item, 2.9)


@pytest.mark.parametrize("error", [FileNotFoundError, ProcessLookupError])
def test_thread_may_end_while_children_are_counted(monkeypatch, error):
    from tests.fixtures.cpu_times import cpu_s

    read, ended = Path.read_text, []

    def ends_once(path):
        if path.name == "children" and not ended:
            ended.append(path)
            raise error
        return read(path)

    monkeypatch.setattr(Path, "read_text", ends_once)
    assert 0 < cpu_s() <= cpu_s() and len(ended) == 1
