"""Limits of connections per address at the ports of the links: the kernel drops a flood, open sessions go on."""

import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, closing, suppress

import pytest

from sightline.protocol.transports.flood_limits import (
    BLOCKED_US,
    MAX_BLOCKED,
    MAX_OPEN,
    WINDOW_US,
    FloodDetector,
    _line,
    limit_floods,
)
from sightline.protocol.transports.open import open_link
from sightline.protocol.transports.websocket.link import open_websocket
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint, free_port, port_of

SAMPLE_US = 200_000


def ends(host, numbers):
    return {("port", f"{host}:{number}"): host for number in numbers}


def run(rate_hz, seconds, open_for=1):
    """Sample a host that opens connections at a rate and holds each for some samples; return all floods."""
    detector, found = FloodDetector(), []
    for number in range(round(seconds * 1e6 / SAMPLE_US)):
        last = round(number * SAMPLE_US * rate_hz / 1e6)
        first = round(max(0, number - open_for) * SAMPLE_US * rate_hz / 1e6)
        found += detector.sample(ends("10.0.0.9", range(first, last)), number * SAMPLE_US)
    return detector, found


def test_as_many_connections_as_zenoh_accepts_are_not_a_flood():
    detector = FloodDetector()
    for number in range(50):
        assert detector.sample(ends("10.0.0.9", range(MAX_OPEN)), number * SAMPLE_US) == []
    [flood] = detector.sample(ends("10.0.0.9", range(MAX_OPEN + 1)), 50 * SAMPLE_US)
    assert (flood.host, flood.open) == ("10.0.0.9", MAX_OPEN + 1)


def test_25_short_connections_a_second_are_a_flood_and_20_are_not():
    detector, floods = run(25, 6.0)
    assert floods and floods[0].open <= 10 and 20 <= floods[-1].new_per_s <= 27
    assert detector.blocked(6_000_000) == ["10.0.0.9"]
    assert run(20, 60.0)[1] == []


def test_connections_that_end_between_two_samples_count_where_they_are_accepted():
    detector = FloodDetector()
    assert detector.sample(ends("10.0.0.9", range(5)), 0, {"10.0.0.9": MAX_OPEN}) == []
    [flood] = detector.sample({}, SAMPLE_US, {"10.0.0.9": 1})
    assert (flood.host, flood.open) == ("10.0.0.9", 0)


def test_short_connections_to_a_websocket_are_reported_once():
    reported = []
    with ExitStack() as ending:
        endpoint = free_endpoint("ws://")
        ending.enter_context(open_websocket("r1", listen=[endpoint], role="robot"))
        ending.enter_context(limit_floods([endpoint], reported.append))
        for _ in range(MAX_OPEN + 1):
            connect(("127.0.0.1", port_of(endpoint)), "127.0.0.2").close()
        assert until(lambda: reported, 3.0)
        assert "connections from 127.0.0.2, 2" in reported[0] and len(reported) == 1


def test_many_hosts_together_are_not_a_flood_of_one():
    detector = FloodDetector()
    crowd = {end: host for number in range(200) for end, host in ends(f"10.0.1.{number}", range(2)).items()}
    assert detector.sample(crowd, 0) == [] and detector.blocked(0) == []


def test_a_block_ends_when_the_flood_does():
    detector, _ = run(100, 3.0)
    assert detector.blocked(3_000_000) == ["10.0.0.9"]
    assert [flood.begins for flood in run(100, 30.0)[1]].count(True) == 1
    assert detector.sample({}, 3_000_000 + WINDOW_US) == []
    assert detector.blocked(3_000_000 + BLOCKED_US + SAMPLE_US) == []


def test_this_machine_is_reported_and_not_blocked_and_the_list_is_bounded():
    detector = FloodDetector()
    assert detector.sample(ends("127.0.0.1", range(MAX_OPEN + 1)), 0) and detector.blocked(0) == []
    many = {end: host for number in range(MAX_BLOCKED + 5)
            for end, host in ends(f"10.0.2.{number}", range(MAX_OPEN + 1)).items()}
    detector.sample(many, 0)
    assert len(detector.blocked(0)) == MAX_BLOCKED


@pytest.mark.parametrize(("host", "text"), [
    ("10.0.0.9", "new ones are dropped for 10 s, open sessions go on; block that address or"),
    ("2a02:8109:9340:5a2c:d4f1:9c3b:7e21:aa0b", "new ones go on, because an IPv6 host has many addresses; block its"),
    ("::1", "end the program on this machine"),
])  # fmt: skip
def test_line_of_a_flood_states_what_is_dropped(host, text):
    [flood] = FloodDetector().sample(ends(host, range(MAX_OPEN + 1)), 0)
    assert f"65 connections from {host}, 22 new ones a second, more than the total limit of 64; {text}" in _line(flood)


def test_the_memory_of_a_fast_flood_is_bounded():
    detector, floods = run(5000, 4.0)
    assert len(detector._new["10.0.0.9"]) <= WINDOW_US // SAMPLE_US + 1
    assert floods[-1].new_per_s == pytest.approx(5000, rel=0.1)


def connect(address, source, timeout_s=0.3):
    one = socket.socket()
    one.settimeout(timeout_s)
    one.bind((source, free_port()))
    one.connect(address)
    return one


def is_empty(server):
    """Return True if the server has no connection to accept now."""
    server.settimeout(0.3)
    try:
        server.accept()[0].close()
    except TimeoutError:
        return True
    return False


def is_deferred(server):
    return server.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT) > 0


@pytest.mark.parametrize("scheme", ["tcp/", "ws://"])
@pytest.mark.parametrize(("family", "host"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "[::]")])
def test_what_a_flooding_address_begins_is_dropped_and_all_others_go_on(family, host, scheme):
    reported = []
    with ExitStack() as ending:
        server = ending.enter_context(socket.create_server(
            (host.strip("[]"), free_port()), family=family, backlog=256, dualstack_ipv6=family is socket.AF_INET6,
        ))
        address = ("127.0.0.1", server.getsockname()[1])
        session = ending.enter_context(connect(address, "127.0.0.2"))
        session.sendall(b"hello")
        accepted = ending.enter_context(server.accept()[0])
        accepted.sendall(b"answer")
        ending.enter_context(limit_floods([f"{scheme}{host}:{address[1]}"], reported.append))
        assert until(lambda: is_deferred(server) or scheme == "ws://", 5.0)
        flood = [ending.enter_context(connect(address, "127.0.0.2")) for _ in range(MAX_OPEN + 1)]
        assert until(lambda: reported, 5.0)
        assert f"connections from 127.0.0.2, {(MAX_OPEN + 2) * 1e6 / WINDOW_US:.0f} new ones" in reported[0]
        with pytest.raises(TimeoutError), suppress(ConnectionError), closing(connect(address, "127.0.0.2")):
            pass
        while scheme == "ws://" and not is_empty(server):  # without waiting for a byte: those before the block
            pass
        with suppress(ConnectionError):
            flood[0].sendall(b"x")
        assert is_empty(server)
        with closing(connect(address, "127.0.0.3")) as other:
            other.sendall(b"x")
            assert not is_empty(server)
        session.sendall(b"x" * 100_000)
        assert accepted.recv(10, socket.MSG_WAITALL) == b"helloxxxxx"
        assert len(reported) == 1


@pytest.mark.waits
def test_a_listener_of_another_process_at_the_port_of_another_address_does_not_count():
    port = free_port()
    code = f"import socket; one = socket.create_server(('127.0.0.2', {port})); print(1, flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.read(1)
        with limit_floods([f"tcp/127.0.0.1:{port}"], lambda _line: None):
            time.sleep(0.5)  # two looks, which find the other listener alone
            with socket.create_server(("127.0.0.1", port)) as server:
                assert until(lambda: is_deferred(server), 5.0)
        other.kill()


def test_ports_without_tcp_are_not_watched():
    before = set(threading.enumerate())  # one of another test may still end
    with limit_floods(["udp/127.0.0.1:1", "quic/127.0.0.1:2"], lambda _line: None):
        assert "floods" not in {thread.name for thread in set(threading.enumerate()) - before}


def test_a_connection_is_accepted_with_its_first_byte():
    with ExitStack() as ending:
        server = ending.enter_context(socket.create_server(("127.0.0.1", free_port())))
        ending.enter_context(limit_floods([f"tcp/127.0.0.1:{server.getsockname()[1]}"], lambda _line: None))
        assert until(lambda: is_deferred(server), 5.0)
        silent = ending.enter_context(connect(server.getsockname(), "127.0.0.2"))
        assert is_empty(server)
        silent.sendall(b"x")
        assert not is_empty(server)


@pytest.mark.waits
def test_websocket_ends_a_silent_connection_after_two_seconds():
    endpoint = free_endpoint("ws://")
    with open_link("r1", listen=[endpoint], role="robot"), limit_floods([endpoint], lambda _line: None):
        time.sleep(1.0)  # by now a port of Zenoh holds silent connections back
        began_s = time.monotonic()
        with closing(connect(("127.0.0.1", port_of(endpoint)), "127.0.0.2", 5.0)) as silent:
            assert silent.recv(1) == b"" and time.monotonic() - began_s > 1.5


def test_connections_of_a_flood_that_got_no_answer_end_and_a_session_stays():
    with ExitStack() as ending:
        server = ending.enter_context(socket.create_server(("127.0.0.1", free_port()), backlog=256))
        address = server.getsockname()
        session = ending.enter_context(connect(address, "127.0.0.2"))
        session.sendall(b"x")
        accepted = [ending.enter_context(server.accept()[0])]
        accepted[0].sendall(b"answer")
        assert session.recv(6) == b"answer"
        flood = [ending.enter_context(connect(address, "127.0.0.2")) for _ in range(MAX_OPEN + 1)]
        for one in flood:
            one.sendall(b"x")
        accepted += [ending.enter_context(server.accept()[0]) for _ in flood]
        ending.enter_context(limit_floods([f"tcp/127.0.0.1:{address[1]}"], lambda _line: None))

        def ended(one):
            one.setblocking(False)
            try:
                return one.recv(1) == b""
            except BlockingIOError:
                return False
            except ConnectionError:  # closed with unread bytes
                return True

        assert until(lambda: all(map(ended, flood)), 5.0)
        session.setblocking(True)
        session.sendall(b"y")
        assert accepted[0].recv(2) == b"xy" and not ended(session)
