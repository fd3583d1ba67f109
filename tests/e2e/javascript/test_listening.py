"""Test which clients the JavaScript robot admits, their cost, and the errors of the programs for invalid options."""

import base64
import os
import socket
import urllib.error
import urllib.request
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

import pytest
import trustme
import websocket
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from sightline.protocol.transports.stop_datagram import STOPPED, Kind, StopDatagram, pack_stop, unpack_stop
from tests.fixtures.javascript import JsProcess, JsRobot, hello
from tests.fixtures.links import until
from tests.fixtures.ports import free_port


@pytest.fixture(scope="module")
def quiet_robot(tmp_path_factory):
    with JsRobot(tmp_path_factory.mktemp("robot")) as robot:
        yield robot


@pytest.mark.parametrize(
    ("first", "code", "reason"),
    [
        (hello("r2"), 1008, "this is robot js1, not r2"),
        ("0.2|0.1", 1008, "invalid hello"),
        (b"\x00\x02{}", 1003, "as text"),
        ("x" * 2000, 1009, "over"),
    ],
)
def test_peer_without_a_hello_receives_the_reason(quiet_robot, first, code, reason):
    with connect(quiet_robot.endpoint, subprotocols=["sightline.v1"]) as client:
        client.send(first)
        with pytest.raises(ConnectionClosed) as closed:
            client.recv(5)
    assert closed.value.rcvd.code == code and reason in closed.value.rcvd.reason


def test_stop_by_udp_latches_on_disk_before_its_answer(tmp_path):
    with JsRobot(tmp_path) as robot, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.settimeout(5)
        port = int(robot.endpoint.rpartition(":")[2]) + 1
        sender.sendto(pack_stop(StopDatagram(Kind.STOP, "js1", 7)), ("127.0.0.1", port))
        answer = unpack_stop(sender.recv(1000))
        assert (answer.kind, answer.robot, answer.counter, answer.state) == (Kind.ANSWER, "js1", 7, STOPPED)
        assert (answer.at_rest, answer.stored, answer.received, answer.applied) == (True, True, 1, 1)
        assert [*tmp_path.rglob("js1.stopped")]


def test_silent_client_is_dropped_after_two_seconds(quiet_robot):
    with (
        connect(quiet_robot.endpoint, subprotocols=["sightline.v1"]) as client,
        pytest.raises(ConnectionClosed) as closed,
    ):
        client.recv(4)
    assert closed.value.rcvd.code == 1008


@pytest.mark.parametrize(
    ("options", "status_code"),
    [
        ({"subprotocols": ["sightline.v1"], "origin": "http://evil.example"}, 403),
        ({"subprotocols": ["sightline.v9"]}, 400),
        ({}, 400),
    ],
)
def test_rejected_client_receives_the_reason_by_http(quiet_robot, options, status_code):
    with pytest.raises(InvalidStatus) as rejection:
        connect(quiet_robot.endpoint, **options)
    assert rejection.value.response.status_code == status_code


def test_seventeenth_client_is_rejected(tmp_path):
    with JsRobot(tmp_path) as robot, ExitStack() as clients:
        for _ in range(16):
            client = clients.enter_context(connect(robot.endpoint, subprotocols=["sightline.v1"]))
            client.send(hello("js1"))  # without it the client is dropped after two seconds
        with pytest.raises(InvalidStatus) as rejection:
            connect(robot.endpoint, subprotocols=["sightline.v1"])
        assert rejection.value.response.status_code == 503


def test_gateway_to_a_robot_that_does_not_answer_reports_it(tmp_path):
    with ExitStack() as ending, socket.socket() as full:  # a full queue: no further client connects
        full.bind(("127.0.0.1", free_port()))
        full.listen(0)
        robot, page_port = full.getsockname(), free_port()
        ending.enter_context(socket.create_connection(robot))
        options = ("--connect", f"ws://127.0.0.1:{robot[1]}", "--robot", "r1", "--port", str(page_port))
        assert ending.enter_context(JsProcess(tmp_path, "gateway.mjs", *options)).says("viewer of robot r1")
        with pytest.raises(InvalidStatus) as rejection:
            connect(f"ws://127.0.0.1:{page_port}", subprotocols=["sightline.v1"], open_timeout=5)
    assert rejection.value.response.status_code == 502


def test_silent_connections_take_the_places_of_a_gateway_for_seconds_only(tmp_path):
    options = ("--connect", f"ws://127.0.0.1:{free_port()}", "--robot", "r1", "--port", str(port := free_port()))
    with JsProcess(tmp_path, "gateway.mjs", *options) as gateway, ExitStack() as silent:
        assert gateway.says("viewer of robot r1")
        for _ in range(32):
            silent.enter_context(socket.create_connection(("127.0.0.1", port)))

        def is_served():
            with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=1) as page:
                return page.status == 200

        assert until(is_served, 8.0)


def test_robot_serves_only_the_viewers_page(quiet_robot):
    base = quiet_robot.endpoint.replace("ws://", "http://")
    with urllib.request.urlopen(f"{base}/", timeout=5) as page:
        assert b"STOP" in page.read()
        assert "default-src 'none'" in page.headers["Content-Security-Policy"]
    for path in ("/robot_server.mjs", "/../../pyproject.toml", "/%2e%2e/x", "//"):
        with pytest.raises(urllib.error.HTTPError) as missing:
            urllib.request.urlopen(base + path, timeout=5)
        assert missing.value.code == 404
    request = urllib.request.Request(f"{base}/", headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError) as foreign:
        urllib.request.urlopen(request, timeout=5)
    assert foreign.value.code == 403


def test_client_that_never_reads_is_dropped(quiet_robot):
    with connect(quiet_robot.endpoint, subprotocols=["sightline.v1"]) as warm:  # the engine compiles as it goes
        warm.send(hello("js1", wants=["frame", "status"]))
        for _ in range(100):
            warm.recv()
    assert until(lambda: _open_sockets(quiet_robot) == 0, 5)
    before_kb = _resident_kb(quiet_robot)
    with socket.create_connection(("127.0.0.1", quiet_robot.port), 5) as silent:
        silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        key = base64.b64encode(os.urandom(16)).decode()
        silent.sendall(
            "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: sightline.v1\r\n\r\n".encode()
        )
        text = hello("js1", wants=["frame", "status"]).encode()
        silent.sendall(bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text)
        assert until(lambda: _open_sockets(quiet_robot) == 0, 5)
    assert _resident_kb(quiet_robot) - before_kb < 5_000


def _resident_kb(robot: JsRobot) -> int:
    lines = Path(f"/proc/{robot.process.pid}/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmRSS")))


def _open_sockets(robot: JsRobot) -> int:
    """Count the established TCP connections of the port of the robot, from /proc (state 01)."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()][1:]
    return sum(1 for row in rows if int(row[1].split(":")[1], 16) == robot.port and row[3] == "01")


@pytest.mark.parametrize(
    ("script", "arguments", "printed"),
    [
        ("robot_server.mjs", ["--port", "x"], "invalid --port"),
        ("robot_server.mjs", ["--host", "0.0.0.0"], "--token-file"),
        ("robot_server.mjs", ["--token-file", "/nowhere"], "--token-file /nowhere"),
        ("robot_server.mjs", ["--pictures", "/nowhere"], "--pictures /nowhere"),
        ("robot_server.mjs", ["--colour", "red"], "--colour"),
        ("vision_client.mjs", ["--connect", "tcp/1", "--robot", "r1"], "ws://HOST:PORT"),
        ("robot_server.mjs", ["--pictures", "{broken}"], "--pictures {broken}"),
        ("robot_server.mjs", ["--cert", "{broken}/0.jpg", "--key", "{broken}/0.jpg"], "--cert {broken}/0.jpg"),
        ("gateway.mjs", ["--connect", "ws://127.0.0.1:65536", "--robot", "r1"], "--connect"),
    ],
)
def test_a_bad_option_is_one_line_and_code_2(tmp_path, script, arguments, printed):
    (broken := tmp_path / "broken").mkdir()
    (broken / "0.jpg").write_text("no JPEG, no certificate")
    with JsProcess(tmp_path, script, *(one.format(broken=broken) for one in arguments)) as process:
        assert process.process.wait(10) == 2
        assert process.output().startswith("error: ") and printed.format(broken=broken) in process.output()
        assert process.output().count("\n") == 2 and "    at " not in process.output()


def test_a_robot_with_a_token_and_a_certificate(tmp_path):
    authority = trustme.CA()
    certificate = authority.issue_cert("localhost", "127.0.0.1")
    certificate.cert_chain_pems[0].write_to_path(str(tmp_path / "cert.pem"))
    certificate.private_key_pem.write_to_path(str(tmp_path / "key.pem"))
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    (tmp_path / "token").write_text("0123456789abcdef\n")
    keys = ("--token-file", str(tmp_path / "token"))
    tls = ("--cert", str(tmp_path / "cert.pem"), "--key", str(tmp_path / "key.pem"))
    with JsRobot(tmp_path, *keys, *tls) as robot:
        secure = robot.endpoint.replace("ws://", "wss://")
        # Not `websockets.sync`: its read thread next to a write makes one TLS connection of 750 hang.
        trusted = {"ca_certs": str(tmp_path / "ca.pem")}
        open_trusted = partial(websocket.create_connection, secure, timeout=10, sslopt=trusted)
        for shown in ([], ["sightline.token.0123456789abcdeX"]):
            with pytest.raises(websocket.WebSocketBadStatusException) as rejection:
                open_trusted(subprotocols=["sightline.v1", *shown])
            assert rejection.value.status_code == 401
        peer = open_trusted(subprotocols=["sightline.token.0123456789abcdef", "sightline.v1"])
        assert peer.subprotocol == "sightline.v1"
        peer.close()
        ca = ("--ca", str(tmp_path / "ca.pem"))
        with JsProcess(tmp_path, "vision_client.mjs", "--connect", secure, "--robot", "js1", *keys, *ca) as vision:
            assert vision.says("target seen"), vision.output()
