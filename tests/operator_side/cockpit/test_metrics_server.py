"""The small server of `/metrics` and the probes: silent or closed connections delay no other."""

import http.client
import re
import select
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from urllib.parse import urlsplit

import pytest

from sightline.operator_side.cockpit import http_server, vision_metrics
from sightline.operator_side.cockpit.http_server import MAX_CONNECTIONS
from sightline.operator_side.cockpit.metrics import serving
from sightline.operator_side.cockpit.vision_metrics import VisionMetrics, listening_address, served
from sightline.protocol.errors import LinkError
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.serving import fleet
from sightline.vision_side.serving.service import LIVE_S, ServiceCounts, ServingState
from tests.fixtures.commands import run
from tests.fixtures.links import until
from tests.fixtures.ports import free_port


class Nothing:
    """A source without metrics."""

    def __init__(self, live=True, ready=True):
        self.is_live, self.is_ready = (lambda: live), (lambda: ready)

    def collect(self):
        return iter(())


@contextmanager
def served_port(**state):
    with serving(Nothing(**state), "127.0.0.1", 0) as address:
        yield urlsplit(address).port


def _probe(port, path="ready"):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}", timeout=3) as answer:
        return answer.read()


def _status(port, path):
    try:
        _probe(port, path)
    except urllib.error.HTTPError as error:
        return error.code
    return 200


@pytest.mark.parametrize(("live", "ready"), [(True, True), (True, False), (False, False)])
def test_probes_of_a_supervisor(live, ready):
    codes = {True: 200, False: 503}
    with served_port(live=live, ready=ready) as port:
        found = [_status(port, path) for path in ("live", "ready", "health")]
    assert found == [codes[live], codes[ready], codes[ready]], "/health is the former name of /ready"


@pytest.mark.parametrize(("host", "shown", "reached"), [
    ("::1", "[::1]", ["::1"]), ("[::1]", "[::1]", ["::1"]), ("::", "[::]", ["::1", "127.0.0.1"]),
    ("0.0.0.0", "0.0.0.0", ["127.0.0.1"]), ("localhost", "localhost", ["127.0.0.1"]),
])  # fmt: skip
def test_metrics_are_served_over_ipv6_and_ipv4(host, shown, reached):
    with serving(Nothing(), host, 0) as address:
        port = urlsplit(address).port
        assert address == f"http://{shown}:{port}/"
        for one in reached:
            with socket.create_connection((one, port), 3) as connection:
                connection.sendall(b"GET /ready HTTP/1.0\r\n\r\n")
                assert connection.recv(12) == b"HTTP/1.1 200"
        with pytest.raises(LinkError, match=re.escape(f"cannot serve on {shown}:{port}: port {port} is in use by")), (
                serving(Nothing(), host, port)):
            pass


@pytest.mark.parametrize(("where", "address"), [
    ("[::1]:9465", ("[::1]", 9465)), ("[::]:1", ("[::]", 1)), ("0.0.0.0:9", ("0.0.0.0", 9)), ("h:9", ("h", 9)),
    ("65535", ("127.0.0.1", 65535)),
])  # fmt: skip
def test_address_of_metrics_is_read(where, address):
    assert listening_address(where) == address


def test_empty_host_of_metrics_is_rejected(capsys):
    """It would listen on every network."""
    code, _, err = run(capsys, "metrics", "--host", "")
    assert (code, err) == (2, "error: invalid --host '': expected an address of this machine, e.g. 127.0.0.1\n")


@pytest.mark.parametrize(("path", "code"), [("metrics", 200), ("ready", 503), ("live", 200), ("x", 404)])
def test_head_has_the_headers_of_get_without_its_body(path, code):
    with served_port(ready=False) as port, socket.create_connection(("127.0.0.1", port), 3) as connection:
        answers = {}
        for method in ("HEAD", "GET"):
            connection.sendall(f"{method} /{path} HTTP/1.1\r\nHost: h\r\n\r\n".encode())
            answer = http.client.HTTPResponse(connection, method=method)
            answer.begin()
            kept = {name: value for name, value in answer.getheaders() if name != "Date"}
            answers[method] = answer.status, kept, answer.read()
    assert answers["HEAD"] == (*answers["GET"][:2], b"") and answers["GET"][0] == code


def test_vision_service_is_live_while_its_loop_turns_and_ready_until_it_ends():
    metrics, ending = VisionMetrics(), threading.Event()
    assert (metrics.is_live(), metrics.is_ready()) == (True, False), "before the link is open"
    sessions = ["router"]
    state = ServingState(list, ending, time.monotonic(), lambda: bool(sessions))
    metrics.look_at(state)
    assert (metrics.is_live(), metrics.is_ready()) == (True, True), "without a robot"
    state.turned_s -= LIVE_S + 0.1
    assert (metrics.is_live(), metrics.is_ready()) == (False, False), "its loop hangs"
    assert state.turns() and metrics.is_ready()
    assert sessions.pop() and (metrics.is_live(), metrics.is_ready()) == (True, False), "its session ended"
    sessions.append("router")
    assert metrics.is_ready()
    ending.set()
    assert not state.turns() and (metrics.is_live(), metrics.is_ready()) == (True, False), "it ends"


class EmptySite:
    """A link to a site without a robot. Its loop hangs in `robots` while `hang` is set."""

    connected = True

    def __init__(self):
        self.hang, self.on_new_robot = threading.Event(), lambda callback: None

    def robots(self):
        while self.hang.is_set():
            time.sleep(0.005)
        return []


@pytest.fixture
def idle_fleet(monkeypatch):
    """Return the port of a fleet without a robot, its site, its end, and a function that starts its loop."""
    monkeypatch.setattr("sightline.vision_side.serving.service.LIVE_S", 0.3)
    monkeypatch.setattr(fleet, "_LONGEST_WAIT_S", 0.02)
    port, site, ending, states = free_port(), EmptySite(), threading.Event(), []

    def begin(connect=("tcp/127.0.0.1:1",)):
        running = fleet.Fleet(VisionConfig(robot="r*", connect=connect), site, lambda line: None)
        arguments = (ending, lambda one: (states.append(one), observe(one)))
        threading.Thread(target=running.serve, args=arguments, daemon=True).start()
        assert until(lambda: states, 3)
        return states[0]

    with served(f"127.0.0.1:{port}") as observe:
        yield port, site, ending, begin
        site.hang.clear()
        ending.set()


def test_fleet_without_a_robot_is_ready_until_it_ends_and_live_while_its_loop_turns(idle_fleet):
    port, site, ending, begin = idle_fleet

    def probes():
        return [_status(port, path) for path in ("live", "ready", "health")]

    assert probes() == [200, 503, 503], "the session is not open yet"
    begin()
    assert probes() == [200, 200, 200], "without a robot"
    site.hang.set()
    assert until(lambda: probes() == [503, 503, 503], 3), "its loop hangs"
    site.hang.clear()
    assert until(lambda: probes() == [200, 200, 200], 3)
    ending.set()
    assert probes() == [200, 503, 503]


@pytest.mark.parametrize(("connect", "ready"), [(("tcp/127.0.0.1:1",), 503), ((), 200)])
def test_fleet_that_connects_is_ready_only_with_a_session(idle_fleet, connect, ready):
    port, site, _, begin = idle_fleet
    begin(connect)
    assert [_status(port, path) for path in ("live", "ready")] == [200, 200]
    site.connected = False
    assert [_status(port, path) for path in ("live", "ready", "health")] == [200, ready, ready]
    site.connected = True
    assert _status(port, "ready") == 200


def samples(metrics):
    """Return the values of the metrics by name and robot."""
    return {(one.name, *one.labels.values()): one.value for family in metrics.collect() for one in family.samples}


def test_load_and_robots_of_a_vision_service(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(vision_metrics, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    rows = [ServiceCounts("r1", True, 1, 1, {}, 0, 0, None, thread=1, queue_p95_us=20_000),
            ServiceCounts("r2", True, 1, 1, {}, 0, 0, None, thread=1),
            ServiceCounts("r3", True, 1, 1, {}, 0, 0, None, thread=2, drives=False)]
    metrics = VisionMetrics()
    assert samples(metrics)["sightline_vision_busy_ratio",] == samples(metrics)["sightline_vision_robots",] == 0
    metrics.look_at(ServingState(lambda: rows, threading.Event(), 0.0, lambda: True))
    for seconds, busy_us, ratio in ((10, (2_000_000, 1_000_000, 400_000), 0.3),
                                    (5, (2_500_000, 1_000_000, 400_000), 0.1),
                                    (1, (300_000, 1_000_000, 400_000), 0.3),  # a new service of r1
                                    (1, (300_000, 1_000_000, 999_000), 0.599),
                                    (0, (900_000, 1_000_000, 999_000), 1.0)):
        clock[0] += seconds
        rows = [replace(one, busy_us=us) for one, us in zip(rows, busy_us, strict=True)]
        found = samples(metrics)
        assert found["sightline_vision_busy_ratio",] == pytest.approx(ratio)
    assert found["sightline_vision_robots",] == 2
    assert found["sightline_vision_queue_age_seconds", "r1"] == 0.02
    assert ("sightline_vision_queue_age_seconds", "r2") not in found


@pytest.mark.parametrize("said", [b"", b"GET /hea"])
def test_silent_connection_delays_neither_others_nor_the_end(said):
    with served_port() as port:
        idle = [socket.create_connection(("127.0.0.1", port)) for _ in range(3)]
        for one in idle:
            one.sendall(said)
        assert _probe(port) == b"ok\n"
        began_s = time.monotonic()
    assert time.monotonic() - began_s < 3
    for one in idle:
        one.close()


def test_connections_beyond_the_limit_are_closed_and_places_are_returned():
    """Each open connection is a thread of the process that steers."""
    with served_port() as port:
        held = [socket.create_connection(("127.0.0.1", port), 5) for _ in range(3 * MAX_CONNECTIONS)]
        assert until(lambda: len(_closed_by_server(held)) >= 2 * MAX_CONNECTIONS)
        assert len(_closed_by_server(held)) == 2 * MAX_CONNECTIONS
        for one in held:
            one.close()
        for _ in range(MAX_CONNECTIONS + 1):  # a request that kept its place would leave none for the last one
            assert until(lambda: _is_served(port))


def _closed_by_server(held):
    """The connections with an end of file to read: this server sends nothing unasked."""
    return select.select(held, [], [], 0)[0]


def _is_served(port):
    try:
        return _probe(port) == b"ok\n"
    except OSError:
        return False


def test_silent_connection_is_closed_without_a_message(monkeypatch, capfd):
    monkeypatch.setattr(http_server._Handler, "timeout", 0.1)
    with served_port() as port, socket.create_connection(("127.0.0.1", port)) as idle:
        idle.settimeout(5)
        assert idle.recv(1) == b""
        with socket.create_connection(("127.0.0.1", port)) as gone:
            gone.sendall(b"GET /metrics HTTP/1.1\r\n")
            gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        assert until(lambda: _probe(port) == b"ok\n")
    assert capfd.readouterr().err == ""
