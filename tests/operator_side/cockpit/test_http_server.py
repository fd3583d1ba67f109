"""A small page on loopback: for this machine only, bounded, with one clear error for an invalid request."""

import http.client
import json
import socket
from contextlib import contextmanager

import pytest

from sightline.operator_side.cockpit.http_server import (
    MAX_BODY_BYTES,
    MAX_CONNECTIONS,
    HttpAnswer,
    as_json,
    page,
    served,
)
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.log import faults
from tests.fixtures.links import until


def _refuse(ask, body):
    raise ConfigError("not like this")


ROUTES = {
    "GET /": lambda ask, body: page("watch.html", robot="<b>r1</b>"),
    "GET /echo": lambda ask, body: as_json(dict(ask)),
    "POST /echo": lambda ask, body: HttpAnswer(body),
    "POST /reject": _refuse,
    "GET /broken": lambda ask, body: 1 / 0,
    "POST /number": lambda ask, body: as_json(int(json.loads(body)["number"])),
}


@pytest.fixture
def port():
    with served(ROUTES, 0) as address:
        yield int(address.rstrip("/").rpartition(":")[2])


@contextmanager
def asked(port, method, path, body=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    named = {"Host": f"127.0.0.1:{port}", **({"Content-Type": "application/json"} if body is not None else {})}
    given = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, {**named, **given})
    answer = connection.getresponse()
    yield answer, answer.read()
    connection.close()


def test_a_page_is_served_with_its_words_as_text(port):
    with asked(port, "GET", "/") as (answer, body):
        assert answer.status == 200 and b"&lt;b&gt;r1&lt;/b&gt;" in body and b"{{" not in body
        assert answer.getheader("Content-Security-Policy").startswith("default-src 'self'")
        assert answer.getheader("Cross-Origin-Resource-Policy") == "same-origin"


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:{port}", "[::1]:{port}", "localhost"])
def test_any_name_of_this_machine_is_accepted(port, host):
    with asked(port, "GET", "/echo?a=1", Host=host.format(port=port)) as (answer, body):
        assert answer.status == 200 and json.loads(body) == {"a": "1"}


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example:{port}", "", "192.168.1.7:1"]
)
def test_other_host_name_is_rejected(port, host):
    with asked(port, "GET", "/echo", Host=host.format(port=port)) as (answer, body):
        assert answer.status == 403 and b"this machine only" in body


@pytest.mark.parametrize("headers", [{}, {"Origin": "http://evil.example"}, {"Content_Type": "text/plain"}])
@pytest.mark.parametrize(("path", "status"), [("/", 405), ("/broken?a=1", 405), ("/echo", None)])
def test_post_to_an_address_for_get_is_answered_with_the_method(port, path, status, headers):
    with asked(port, "POST", path, b"{}", **headers) as (answer, body):
        assert (answer.status == 405) is (status == 405)
        if status:
            assert answer.getheader("Allow") == "GET, HEAD"
            assert json.loads(body) == {"error": f"{path.partition('?')[0]} is only for GET, not for POST"}


def test_only_posts_of_the_own_page_are_accepted(port):
    with asked(port, "POST", "/echo", b"{}", Origin=f"http://127.0.0.1:{port}") as (answer, body):
        assert (answer.status, body) == (200, b"{}")
    for wrong in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Content_Type": "text/plain"}):
        with asked(port, "POST", "/echo", b"{}", **wrong) as (answer, _):
            assert answer.status == 403


@pytest.mark.parametrize("length", [str(MAX_BODY_BYTES + 1), "-1", "9" * 30, "x"])
def test_a_body_has_a_bound(port, length):
    with asked(port, "POST", "/echo", b"{}", Content_Length=length) as (answer, _):
        assert answer.status == 413


def test_invalid_request_gets_an_error_and_the_next_is_served(port):
    for path, body, words in (("/reject", b"{}", "not like this"), ("/number", b"{", "invalid request"),
                              ("/number", b"[]", "invalid request"), ("/number", b'{"number":"x"}', "invalid request")):
        with asked(port, "POST", path, body) as (answer, said):
            assert answer.status == 400 and words in json.loads(said)["error"]
    with asked(port, "GET", "/nothing") as (answer, _):
        assert answer.status == 404
    with asked(port, "POST", "/number", b'{"number":3}') as (answer, said):
        assert (answer.status, said) == (200, b"3")


def test_invalid_requests_neither_end_the_server_nor_count_as_its_faults(port):
    before = faults()
    for noise in (b"\0" * 100 + b"\r\n\r\n", b"GET http://[ HTTP/1.1\r\nHost: localhost\r\n\r\n",
                  b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 300 + b"\r\n", b""):
        with socket.create_connection(("127.0.0.1", port), 5) as stranger:
            stranger.sendall(noise)
    with asked(port, "GET", "http://[") as (answer, _):
        assert answer.status == 404
    with asked(port, "GET", "/echo") as (answer, _):
        assert answer.status == 200
    assert faults() == before


@pytest.mark.waits
def test_excess_connections_are_closed_and_places_return(port):
    held = [socket.create_connection(("127.0.0.1", port), 5) for _ in range(MAX_CONNECTIONS)]
    assert until(lambda: b"32 connections" in _answer_unasked(port), 5.0)
    with asked(port, "GET", "/echo") as (answer, body):
        assert (answer.status, answer.getheader("Connection")) == (503, "close")
        assert "close other pages" in json.loads(body)["error"]
    for one in held:
        one.close()

    def serves():
        try:
            with asked(port, "GET", "/echo") as (answer, _):
                return answer.status == 200
        except OSError:
            return False

    assert until(serves, 5.0)


def _answer_unasked(port):
    """Return what a further connection receives if it is closed immediately."""
    with socket.create_connection(("127.0.0.1", port), 5) as one:
        one.settimeout(0.2)
        try:
            return b"".join(iter(lambda: one.recv(4096), b""))
        except TimeoutError:
            return b""


def test_port_in_use_is_one_line(port):
    with pytest.raises(LinkError, match=f"port {port} is in use") as why, served(ROUTES, port):
        pass
    assert "\n" not in str(why.value)


def test_address_of_another_machine_is_reported_with_a_fix():
    with pytest.raises(LinkError, match=r"cannot serve on 192\.0\.2\.1:0: .*; choose another port"), \
            served(ROUTES, 0, "192.0.2.1"):
        pass


def test_a_route_that_raises_is_logged_once_with_its_traceback_and_counted(port, caplog):
    for _ in range(2):
        with pytest.raises(http.client.RemoteDisconnected), asked(port, "GET", "/broken"):
            pass
    assert until(lambda: faults() == {"web page": 2})
    assert caplog.messages == ["web page raised ZeroDivisionError: division by zero"] and caplog.records[0].exc_info


@pytest.mark.parametrize(("request_line", "status", "words"), [
    ("PUT /echo HTTP/1.1", 501, "Unsupported method ('PUT')"),
    ("DELETE / HTTP/1.1", 501, "Unsupported method ('DELETE')"),
    ("GET / HTTP/9.9", 505, "Invalid HTTP version (9.9)"),
    ("GET / HTTP/x", 400, "Bad request version ('HTTP/x')"),
    (f"GET /{'a' * 70_000} HTTP/1.1", 414, "URI Too Long"),
])
def test_request_that_is_not_served_is_one_line_of_json(port, request_line, status, words):
    with socket.create_connection(("127.0.0.1", port), 5) as one, one.makefile("rb") as answer:
        one.sendall(f"{request_line}\r\nHost: 127.0.0.1\r\n\r\n".encode())
        head, _, body = answer.read().partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 %d " % status) and b"Content-Type: application/json" in head
    assert b"Connection: close" in head and b"Content-Length: %d" % len(body) in head
    assert list(json.loads(body)) == ["error"] and words.lower() in json.loads(body)["error"].lower()
