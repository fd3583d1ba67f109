"""The state that every test begins with: Python's own Ctrl-C, and no log of a command from an earlier test."""

import gc
import logging
import os
import signal
import threading
from pathlib import Path

import pytest
from hypothesis import settings

from sightline.protocol import log
from tests.fixtures import own_process
from tests.fixtures.cpu_times import CpuTimes, slowness

SECOND_TIER = Path(__file__).with_name("second_tier.txt")
_SLOW = 1.5
"""A machine that needs this many times the CPU time of the reference is slow."""

# A test that measures no time has no bound on it: other processes of the machine would decide.
settings.register_profile("tests", deadline=None)
settings.load_profile("tests")

# A shell that starts the tests in its background has Ctrl-C ignored, and every child would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


# No proxy of the machine stands between a test and its own servers.
os.environ["no_proxy"] = os.environ["NO_PROXY"] = "127.0.0.1,localhost"


def pytest_configure(config):
    """Measure the CPU time of each test; give some tests a process of their own."""
    config.pluginmanager.register(CpuTimes())
    config.pluginmanager.register(own_process)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Collect without garbage collection, a third of the time, and leave what was collected out of later ones."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
        gc.set_threshold(20_000, 20, 20)  # with 700, 10, 10 collections took 5 % of the CPU time


def pytest_xdist_auto_num_workers(config):
    """Three workers for each processor, since most tests wait; fewer where tests start several processes.

    On a slow machine two tests of several processes that share a processor make one another miss what is real time.
    """
    tier = config.option.markexpr.partition(" ")[0]
    of_each = {"slow": 1 if tier == "slow" and slowness() >= _SLOW else 2, "long": 1}.get(tier, 3)
    return of_each * len(os.sched_getaffinity(0))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(session, items):
    """Mark as slow what `second_tier.txt` lists, before tests are deselected; then order the rest."""
    _mark_second_tier(session, items)
    yield
    _spread_waits(items, session.config)


def _mark_second_tier(session, items):
    """It lists single cases of a parametrized test, and tests near the bound."""
    slow = set(SECOND_TIER.read_text(encoding="utf-8").splitlines())
    names = {item.nodeid for item in items}
    for item in items:
        if item.nodeid in slow:
            item.add_marker(pytest.mark.slow)
    files = {name.partition("::")[0] for name in names}
    unknown = sorted(name for name in slow - names if name.partition("::")[0] in files)
    if unknown and not any("::" in arg for arg in session.config.args):
        raise pytest.UsageError(f"{SECOND_TIER.name} lists tests that do not exist: {', '.join(unknown)}")


def _spread_waits(items, config):
    """Spread the tests that wait for seconds over the first halves of the workers' shares.

    So none is the last one, and the others compute meanwhile.
    """
    workers = getattr(config, "workerinput", {}).get("workercount", 1)
    waits = [item for item in items if item.get_closest_marker("waits")]
    others = [item for item in items if not item.get_closest_marker("waits")]
    share = len(others) // workers
    places = [(n % workers) * share + share * (n + 1) // (2 * len(waits) + 2) for n in range(len(waits))]
    for place, item in sorted(zip(places, waits, strict=True), key=lambda one: one[0], reverse=True):
        others.insert(place, item)
    items[:] = others


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """Escape what is not text in the output of a test, e.g. an odd file name: a worker could not send it on."""
    report = yield
    report.sections = [(name, text.encode(errors="backslashreplace").decode()) for name, text in report.sections]
    return report


@pytest.fixture(autouse=True)
def no_log_of_an_earlier_command():
    """A command that runs in this process sets up the log of the process."""
    hook = threading.excepthook
    log._faults.clear()
    log._kinds.clear()
    yield
    logging.getLogger().removeHandler(log._HANDLER)
    logging.getLogger("sightline").setLevel(logging.NOTSET)
    logging.captureWarnings(False)
    threading.excepthook = hook


@pytest.fixture
def no_gpu(monkeypatch):
    """Hide the GPU: messages about a missing device are the same on a machine that has one."""
    from tests.fixtures.vision.onnx import without_gpu

    without_gpu(monkeypatch)
