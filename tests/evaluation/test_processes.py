"""Processes that end together, and work on several processes that is interrupted."""

import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from sightline.evaluation.processes import Processes, worker_pool
from sightline.protocol.errors import HardwareError
from tests.fixtures.links import until


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_has_not_begun_is_dropped_when_it_is_over(error):
    with pytest.raises(error), worker_pool(1) as pool:
        waiting = [pool.submit(time.sleep, 0.05) for _ in range(100)]
        waiting[0].result()
        raise error
    done = [not one.cancelled() for one in waiting]
    assert done[0] and sum(done) < 20 and all(one.done() for one in waiting)


def test_ctrl_c_ends_what_has_begun_and_what_was_to_be_next():
    with worker_pool(1) as pool:
        for one in [pool.submit(signal.raise_signal, signal.SIGINT), pool.submit(time.sleep, 30)]:
            with pytest.raises(BrokenProcessPool):
                one.result(timeout=10)


def test_process_ended_from_outside_gives_one_line_with_the_fix():
    with pytest.raises(HardwareError, match=r"of 2\) was ended .*--jobs 1"), worker_pool(2) as pool:
        pool.submit(signal.raise_signal, signal.SIGTERM).result(timeout=10)


def test_all_is_done_when_nothing_happens():
    with worker_pool(2) as pool:
        waiting = [pool.submit(pow, 2, number) for number in range(20)]
    assert [one.result() for one in waiting] == [2**number for number in range(20)]


_PARENT = """
import sys, time
from pathlib import Path
from sightline.evaluation.processes import Processes
processes = Processes(Path(sys.argv[1]))
processes.start("sleeper", [], module="sleeper", environment={"PYTHONPATH": sys.argv[1]})
processes.wait_line("sleeper", "sleeps", 20)
print(processes.pid("sleeper"), flush=True)
time.sleep(60)
"""


def test_a_parent_that_is_killed_leaves_no_child(tmp_path):
    (tmp_path / "sleeper.py").write_text("import time\nprint('sleeps')\ntime.sleep(30)\n")
    with subprocess.Popen([sys.executable, "-c", _PARENT, str(tmp_path)], stdout=subprocess.PIPE) as parent:
        try:
            assert parent.stdout is not None
            child = Path(f"/proc/{int(parent.stdout.readline())}/cmdline")
            assert child.read_bytes()
        finally:
            parent.kill()
    assert until(lambda: not child.exists() or not child.read_bytes(), 5)


def test_a_child_sees_the_arguments_and_the_input_that_python_m_gives_it(tmp_path):
    (tmp_path / "shows.py").write_text(
        "import sys, time\nprint(sys.argv, __name__, __spec__.name, repr(sys.stdin.read()))\ntime.sleep(30)\n"
    )
    with Processes(tmp_path) as processes:
        processes.start("shows", ["a", "-b"], module="shows", environment={"PYTHONPATH": str(tmp_path)})
        processes.wait_line("shows", "\n")
        shown = processes.log("shows").read_text()
        assert shown == f"{[str(tmp_path / 'shows.py'), 'a', '-b']} __main__ shows ''\n"


@pytest.mark.parametrize(("oldest_first", "order"), [(False, "21"), (True, "12")])
def test_all_are_ended_one_after_the_other_even_those_that_are_stopped(tmp_path, oldest_first, order):
    (tmp_path / "notes.py").write_text(
        "import signal, sys, time\nsignal.signal(signal.SIGTERM, lambda *_: sys.exit())\nprint('ready')\n"
        "try:\n    time.sleep(30)\nfinally:\n    open(sys.argv[1], 'a').write(sys.argv[2])\n"
    )
    with Processes(tmp_path, oldest_first=oldest_first) as processes:
        for name in "12":
            environment = {"PYTHONPATH": str(tmp_path)}
            processes.start(name, [str(tmp_path / "order"), name], module="notes", environment=environment)
            processes.wait_line(name, "ready")
        processes.signal("1", signal.SIGSTOP)
        assert processes.end() == []
        assert processes.names == []
    assert (tmp_path / "order").read_text() == order
