"""The small server of `/metrics` and `/health`: silent or closed connections delay no other."""

import select
import socket
import time
import urllib.request
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest

from sightline.operator_side.cockpit import http_server
from sightline.operator_side.cockpit.http_server import MAX_CONNECTIONS
from sightline.operator_side.cockpit.metrics import serving
from tests.fixtures.links import until


class Nothing:
    """A healthy source without metrics."""

    def collect(self):
        return iter(())

    def is_healthy(self):
        return True


@contextmanager
def served_port():
    with serving(Nothing(), "127.0.0.1", 0) as address:
        yield urlsplit(address).port


def _health(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=3) as answer:
        return answer.read()


@pytest.mark.parametrize("said", [b"", b"GET /hea"])
def test_silent_connection_delays_neither_others_nor_the_end(said):
    with served_port() as port:
        idle = [socket.create_connection(("127.0.0.1", port)) for _ in range(3)]
        for one in idle:
            one.sendall(said)
        assert _health(port) == b"ok\n"
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
        return _health(port) == b"ok\n"
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
        assert until(lambda: _health(port) == b"ok\n")
    assert capfd.readouterr().err == ""
