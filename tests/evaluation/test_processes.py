"""Processes that end together, and work on several processes that is interrupted."""

import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path

import pytest

from sightline.evaluation import reaper
from sightline.evaluation.processes import Processes, is_running, worker_pool
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
folder = processes.temporary_folder()
for name in ("oldest", "stopped", "stubborn"):
    processes.start(name, [name, *sys.argv[1:]], module="member", environment={"PYTHONPATH": sys.argv[1]})
    processes.wait_line(name, "runs", 20)
print(folder, flush=True)
time.sleep(60)
"""
_MEMBER = """
import os, signal, subprocess, sys, time
name, folder = sys.argv[1:]
def end(*_):
    open(folder + "/ended", "a").write(name + " ")
    time.sleep(0.2 if name == "stopped" else 0)
    sys.exit()
signal.signal(signal.SIGTERM, signal.SIG_IGN if name == "stubborn" else end)
if name == "stubborn":
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)", folder])
print("runs", flush=True)
if name == "stopped":
    os.kill(os.getpid(), signal.SIGSTOP)
while True:
    time.sleep(0.05)  # a signal just before a longer one would wait for its end
"""


def naming(text):
    """Process ids of living processes whose command line contains `text`."""
    found = []
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            if text in command.read_text():
                found.append(int(command.parent.name))
    return found


@pytest.mark.alone  # 0.8 s are left of the 2 s
def test_a_parent_that_is_killed_leaves_no_process_and_no_folder_after_2_s(tmp_path):
    """One is stopped, one ignores SIGTERM and has a child; the oldest, e.g. the simulation, ends after the others."""
    (tmp_path / "member.py").write_text(_MEMBER)
    with subprocess.Popen([sys.executable, "-c", _PARENT, str(tmp_path)], stdout=subprocess.PIPE, text=True) as parent:
        try:
            folder = Path(parent.stdout.readline().strip())
            assert folder.is_dir() and len(naming(str(tmp_path))) == 5
        finally:
            parent.kill()
            killed_s = time.monotonic()
    assert until(lambda: not naming(str(tmp_path)) and not folder.exists(), 5)
    assert time.monotonic() - killed_s < 2.0
    assert (tmp_path / "ended").read_text() == "stopped oldest "


def test_processes_that_do_not_end_are_killed_so_early_that_they_are_gone_after_2_s(monkeypatch):
    """The robot has the time to bring the wheels to zero, which the simulation logs until then."""
    now_s, sent = [100.0], []

    def select(_reading, _writing, _failed, wait_s):
        now_s[0] += wait_s
        return [], [], []

    def send(pid, number):
        sent.append((pid, number, now_s[0]))

    made = reaper.Reaper()
    made._running = {1: 1, 2: 2}
    with monkeypatch.context() as patch:
        patch.setattr(reaper.time, "monotonic", lambda: now_s[0])
        patch.setattr(reaper.select, "select", select)
        patch.setattr(reaper.signal, "pidfd_send_signal", send)
        patch.setattr(reaper.os, "killpg", send)
        made.end()
    at_s = {(pid, number): round(when_s - 100.0, 3) for pid, number, when_s in sent}
    assert at_s[2, signal.SIGTERM] == 0.0 and 0.7 <= at_s[1, signal.SIGTERM] <= 0.8
    assert at_s[1, signal.SIGKILL] == at_s[2, signal.SIGKILL] <= 1.2


def test_a_temporary_folder_is_removed_after_the_processes_ended(tmp_path):
    with Processes(tmp_path) as processes:
        folder = Path(processes.temporary_folder())
        (folder / "file").write_text("left")
    assert not folder.exists()


_POOL = """
import os, time
from sightline.evaluation.processes import worker_pool
if __name__ == "__main__":
    with worker_pool(2) as pool:
        print(*{pool.submit(os.getpid).result() for _ in range(9)}, flush=True)
        pool.submit(time.sleep, 60).result()
"""


def test_workers_end_when_their_parent_is_killed(tmp_path):
    (tmp_path / "pool.py").write_text(_POOL)
    command = [sys.executable, str(tmp_path / "pool.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        try:
            workers = [int(pid) for pid in parent.stdout.readline().split()]
            assert workers and all(is_running(pid) for pid in workers)
        finally:
            parent.kill()
            killed_s = time.monotonic()
    assert until(lambda: not any(is_running(pid) for pid in workers), 5)
    assert time.monotonic() - killed_s < 2.0


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
    # A handler in Python would wait for the end of a sleep that begins between the signal and the handler.
    (tmp_path / "notes.py").write_text(
        "import signal, sys\nsignal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])\nprint('ready')\n"
        "signal.sigwait([signal.SIGTERM])\nopen(sys.argv[1], 'a').write(sys.argv[2])\n"
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
