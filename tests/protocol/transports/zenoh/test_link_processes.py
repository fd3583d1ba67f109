"""Zenoh between real processes that die, stall and come back; nothing is left hanging and nothing is printed."""

import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from sightline.protocol.channels import FRAME, TWIST
from sightline.protocol.errors import LinkError
from sightline.protocol.transports.zenoh.link import open_zenoh
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.websocket import resident_kib

pytestmark = pytest.mark.waits

PRELUDE = """
import sys, time
from sightline.protocol.channels import *
from sightline.protocol.transports.zenoh.link import open_zenoh
endpoint = sys.argv[1]
"""
ROBOT = """
with open_zenoh("r1", listen=[endpoint]) as link:
    twists = link.latest(TWIST)
    print("ready", flush=True)
    while True:
        link.publish(FRAME, b"{}", b"x" * 50_000)
        message = twists.take(0.01)
        if message:
            print("twist", message.payload.decode(), flush=True)
"""
CONSUMER = """
with open_zenoh("r1", connect=[endpoint]) as link:
    frames = link.latest(FRAME)
    print("ready", flush=True)
    while True:
        message = frames.take(1.0)
"""


@pytest.fixture
def start(tmp_path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start Python code in a process of its own; whatever still runs at the end is killed."""
    started: list[subprocess.Popen[str]] = []

    def run(code: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", PRELUDE + textwrap.dedent(code), *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


def test_port_in_use_names_its_process(start):
    endpoint = free_endpoint()
    robot = start(ROBOT, endpoint)
    robot.stdout.readline()
    with pytest.raises(LinkError, match=rf"in use by python\S* \(pid {robot.pid}\)") as refusal:
        open_zenoh("r1", listen=[endpoint])
    assert endpoint in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_restarted_robot_uses_the_same_link(start):
    endpoint = free_endpoint()
    robot = start(ROBOT, endpoint)
    robot.stdout.readline()
    with open_zenoh("r1", connect=[endpoint], role="vision") as link:
        frames = link.latest(FRAME)
        for _ in range(2):
            assert frames.take(3) is not None
            robot.send_signal(signal.SIGKILL)
            assert until(lambda: not link.connected, 1)
            assert not link.publish(TWIST, b"", b"0|0")
            frames.take()
            robot = start(ROBOT, endpoint)
            robot.stdout.readline()
            assert frames.take(4) is not None
            assert until(lambda: link.has_listener(TWIST))
            assert link.publish(TWIST, b"", b"0.1|0")
            assert robot.stdout.readline() == "twist 0.1|0\n"


def test_a_client_reconnects_after_being_away_longer_than_its_timeout(start):
    endpoint = free_endpoint()
    robot = start(ROBOT, endpoint)
    robot.stdout.readline()
    with open_zenoh("r1", connect=[endpoint], timeout_s=0.5) as link:
        frames = link.latest(FRAME)
        assert frames.take(3) is not None
        robot.kill()
        robot.wait()
        assert until(lambda: not link.connected)
        time.sleep(1.5)
        frames.take()
        start(ROBOT, endpoint).stdout.readline()
        assert frames.take(4) is not None


def test_sessions_of_a_process_reach_the_next_router_when_one_hangs_with_data_on_its_way(start):
    """The close of such a connection waited for 10 s, in a thread that receives for every session of the process."""
    endpoints = [free_endpoint(), free_endpoint()]
    routers = [start("import zenoh\nfrom sightline.protocol.transports.zenoh.session import open_session\n"
                     "session = open_session([endpoint], (), 5.0)\nprint('ready', flush=True)\ntime.sleep(60)", one)
               for one in endpoints]
    assert all(router.stdout.readline() for router in routers)
    robots = [f"r{number}" for number in range(4)]
    with ExitStack() as closing:
        links = [closing.enter_context(open_zenoh(robot, connect=endpoints)) for robot in robots]
        for robot in robots:
            closing.enter_context(open_zenoh(robot, connect=endpoints)).latest(FRAME)
        first = set.union(*(link._peers.zids for link in links))
        assert until(lambda: all(link.has_listener(FRAME) for link in links))
        routers[0].send_signal(signal.SIGSTOP)

        def are_at_the_next():
            for link in links:
                link.publish(FRAME, b"{}", b"x" * 10_000)
            return all(not link._peers.zids & first and link.has_listener(FRAME) for link in links)

        assert until(are_at_the_next, 6.0)


def beside_a_stopped_peer(start, size=lambda: 0):
    """Publish 15 MB, more than any buffer on the way holds, beside a peer that is stopped.

    Returns the number of frames that another peer received, the growth of `size()`, and the time of each publication.
    """
    endpoint = free_endpoint()
    with open_zenoh("r1", listen=[endpoint]) as robot, open_zenoh("r1", connect=[endpoint]) as healthy:
        frames = healthy.latest(FRAME)
        stalled = start(CONSUMER, endpoint)
        stalled.stdout.readline()
        robot.publish(FRAME, b"", bytes(100_000))
        assert frames.take(2) is not None
        stalled.send_signal(signal.SIGSTOP)
        before, took_s, seen = size(), [], 0
        for number in range(150):
            begin_s = time.perf_counter()
            robot.publish(FRAME, b"", number.to_bytes(2) + bytes(100_000))
            took_s.append(time.perf_counter() - begin_s)
            while (message := frames.take(1.0)) is not None and message.payload[:2] != number.to_bytes(2):
                pass  # one before it that was late
            seen += message is not None
        growth = size() - before
        stalled.send_signal(signal.SIGCONT)
    return seen, growth, took_s


@pytest.mark.waits
@pytest.mark.own_process
def test_a_stopped_peer_costs_neither_memory_nor_others(start):
    seen, growth_kib, _ = beside_a_stopped_peer(start, resident_kib)
    assert seen > 140
    assert growth_kib < 8_000


@pytest.mark.alone
def test_a_stopped_peer_costs_no_time(start):
    *_, took_s = beside_a_stopped_peer(start)
    assert max(took_s) < 0.06


def test_process_ends_after_with(start):
    endpoint = free_endpoint()
    code = """
    with open_zenoh("r1", listen=[endpoint]) as link, open_zenoh("r1", connect=[endpoint]) as peer:
        frames = peer.latest(FRAME)
        while not link.has_listener(FRAME):
            time.sleep(0.01)
        if sys.argv[2] == "raise":
            raise SystemExit(7)
    """
    for how, exit_code in (("plain", 0), ("raise", 7)):
        process = start(code, endpoint, how)
        assert process.wait(10) == exit_code
        assert process.stdout.read() + process.stderr.read() == ""


def test_a_program_without_a_log_prints_the_traceback_of_its_callback_and_nothing_of_zenoh(start):
    code = """
    from sightline.protocol.errors import LinkError
    from sightline.protocol.log import faults
    with open_zenoh("r1", listen=[endpoint]) as robot, open_zenoh("r1", connect=[endpoint]) as peer:
        peer.subscribe(FRAME, lambda message: 1 / 0)
        while not robot.has_listener(FRAME):
            time.sleep(0.01)
        robot.publish(FRAME, b"", b"x")
        while not faults()["callback"]:
            time.sleep(0.01)
        for arguments in ({"listen": [endpoint]}, {"connect": ["tcp/127.0.0.1:1"], "timeout_s": 0.3}):
            try:
                open_zenoh("r1", **arguments)
            except LinkError:
                pass
    """
    process = start(code, free_endpoint())
    printed, errors = process.communicate(timeout=15)
    first, *trace, last = errors.splitlines()
    assert (printed, process.returncode) == ("", 0) and trace[0].startswith("Traceback ")
    assert (first, last) == ("callback frame raised ZeroDivisionError: division by zero",
                             "ZeroDivisionError: division by zero")
