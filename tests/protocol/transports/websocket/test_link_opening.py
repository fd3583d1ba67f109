"""Opening `sightline.v1` over real sockets: endpoints, errors and their messages, and leaving nothing behind."""

import errno
import gc
import json
import os
import re
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from websockets.sync.server import serve

from sightline.operator_side.setup import keys
from sightline.protocol.channels import FRAME, TWIST
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.endpoints import parse_websocket_endpoint
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.websocket.framing import OTHER_ROBOT
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.server import listening_socket
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint, free_port

NO_ENDPOINTS = (
    "", "foo", "ws", "ws://", "ws://127.0.0.1", "ws://:9090", "ws://127.0.0.1:0", "ws://127.0.0.1:65536", "wss://h:0",
    "ws://127.0.0.1:-1", "ws://127.0.0.1:9090 ", "http://127.0.0.1:9090", "WS://127.0.0.1:9090", "ws://a b:9090",
    "ws://127.0.0.1:9090/x", "127.0.0.1:9090", "ws://::1:9090", "ws://127.0.0.1:٧", "ws://me@h:1", "tcp/127.0.0.1:7447",
    "ws://h:1?dashed", "wss://h:1?oneline", f"wss://h.{'a' * 64}:1", "ws://a..b:1",
    "ws://[fe80::1%]:1",
)  # fmt: skip


@pytest.mark.parametrize("endpoint", NO_ENDPOINTS)
@pytest.mark.parametrize("end", ["listen", "connect"])
def test_an_endpoint_that_is_invalid_is_rejected_with_the_right_form(endpoint, end):
    with pytest.raises(ConfigError, match=re.escape("e.g. ws://127.0.0.1:9090")) as refusal:
        open_websocket("r1", **{end: [endpoint]})
    assert repr(endpoint) in str(refusal.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"robot": "r/1", "listen": "ws://127.0.0.1:9090"}, "robot id 'r/1'"),
        ({"robot": "r1"}, "no endpoint"),
        ({"robot": "r1", "listen": "ws://127.0.0.1:9090", "max_frame_bytes": 0}, "max_frame_bytes 0"),
    ],
)
def test_bad_arguments_are_rejected_before_anything_is_opened(arguments, said):
    with pytest.raises(ConfigError, match=said):
        open_websocket(arguments.pop("robot"), **arguments)


def test_websockets_that_is_not_installed_is_one_line_with_the_fix(monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(ConfigError, match=re.escape("pip install --editable '.[websocket]'")):
        open_websocket("r1", connect="ws://127.0.0.1:9090")


@pytest.mark.parametrize(("kind", "other"), [("ws", "wss"), ("wss", "ws")])
def test_client_retries_after_a_close_without_an_answer(kind, other, tmp_path):
    """Hang up like a listener with too many clients; over TLS the end may come before or after the client's hello."""
    keys.make(tmp_path / "keys", [])
    tried = []

    def hang_up():
        with suppress(OSError):
            while True:
                near, _ = door.accept()
                tried.append(near)
                near.close()

    with socket.create_server(("127.0.0.1", free_port())) as door:
        threading.Thread(target=hang_up, daemon=True).start()
        secure = {"secure": str(tmp_path / "keys")} if kind == "wss" else {}
        endpoint = f"{kind}://127.0.0.1:{door.getsockname()[1]}"
        with pytest.raises(LinkError, match=f"it closed without an answer: .* expects {other}://|no answer"):
            open_websocket("r1", connect=endpoint, timeout_s=1.5, **secure)
        door.shutdown(socket.SHUT_RDWR)
    assert len(tried) >= 3


def test_missing_answer_raises_in_time():
    endpoint, begin_s = free_endpoint("ws://"), time.monotonic()
    said = f"no answer from {endpoint} after 0.4 s; start the robot or check the address"
    with pytest.raises(LinkError, match=re.escape(said)):
        open_websocket("r1", connect=endpoint, timeout_s=0.4)
    assert 0.3 < time.monotonic() - begin_s < 2


def test_link_local_address_is_listened_on_at_its_interface(monkeypatch):
    def create(place, family):
        opened.append(place)
        raise OSError(errno.EADDRNOTAVAIL, "")

    opened, place = [], ("fe80::1", 9090, 0, 7)
    monkeypatch.setattr(socket, "getaddrinfo", lambda host, *_given: [(0, 0, 0, "", place)] * (host == "fe80::1%wlan0"))
    monkeypatch.setattr(socket, "create_server", create)
    with pytest.raises(LinkError, match="Cannot assign requested address"):
        listening_socket(parse_websocket_endpoint("ws://[fe80::1%wlan0]:9090"))
    assert opened == [place]


def test_an_address_of_another_machine_cannot_be_listened_on(tmp_path):
    (tmp_path / "vision.token").write_text("a" * 16)
    with pytest.raises(LinkError, match=r"cannot listen on ws://192\.0\.2\.1:9090: Cannot assign requested address;"):
        open_websocket("r1", listen="ws://192.0.2.1:9090", secure=str(tmp_path))


def test_port_in_use_names_its_owner(robot):
    said = rf"cannot listen on {robot.endpoint}: port \d+ is in use by .*\(pid {os.getpid()}\); end it or choose"
    with pytest.raises(LinkError, match=said):
        open_websocket("r1", listen=robot.endpoint)


def test_peer_that_is_not_a_websocket_is_reported():
    with socket.create_server(("127.0.0.1", free_port())) as door:
        threading.Thread(target=_answer_with, args=(door, b"SSH-2.0-something\r\n"), daemon=True).start()
        with pytest.raises(LinkError, match="the service there is not a Sightline WebSocket"):
            open_websocket("r1", connect=f"ws://127.0.0.1:{door.getsockname()[1]}", timeout_s=2)


def _answer_with(door: socket.socket, text: bytes) -> None:
    client = door.accept()[0]
    client.recv(4096)
    client.sendall(text)
    client.close()


def test_listener_of_another_robot_raises_for_the_opening_client(robot):
    with pytest.raises(LinkError, match=f"cannot connect to {robot.endpoint}: this is robot r1, not r2"):
        open_websocket("r2", connect=robot.endpoint)
    assert robot.rejected == {OTHER_ROBOT: 1}
    robot.still_serves()


def test_listener_that_answers_as_another_robot_is_named_as_what_it_is():
    def greet(client):
        client.recv()
        client.send(json.dumps({"v": 1, "robot": "zz", "session": "4e5f6071"}))
        client.recv()

    port = free_port()
    with serve(greet, "127.0.0.1", port, subprotocols=["sightline.v1"]) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with pytest.raises(LinkError, match="the robot there is zz, not r1"):
            open_websocket("r1", connect=f"ws://127.0.0.1:{port}", timeout_s=5)


def test_a_robot_may_connect_to_a_listening_vision():
    endpoint = free_endpoint("ws://")
    with open_websocket("r1", listen=endpoint, role="vision") as vision:
        frames = vision.latest(FRAME)
        with open_websocket("r1", connect=endpoint, role="robot") as robot:
            twists = robot.latest(TWIST)
            assert until(lambda: robot.has_listener(FRAME) and vision.has_listener(TWIST))
            for size in (0, 65_536, FRAME.max_payload_bytes):
                assert robot.publish(FRAME, b"{}", bytes(size))
                assert len(frames.take(2).payload) == size
            assert vision.publish(TWIST, b"{}", b"0|0")
            assert twists.take(2) == Message(TWIST, "vision", b"{}", b"0|0")


def _count(what: str) -> int:
    return len(list(Path("/proc/self", what).iterdir()))


@pytest.mark.own_process
def test_no_thread_or_descriptor_is_left_behind():
    endpoint = free_endpoint("ws://")

    def open_and_close() -> None:
        with open_websocket("r1", listen=endpoint) as robot, open_websocket("r1", connect=endpoint) as peer:
            peer.latest(FRAME)
            assert until(lambda: robot.has_listener(FRAME))

    open_and_close()
    gc.collect()
    before = _count("fd"), _count("task")
    for _ in range(5):
        open_and_close()
    # websockets leaves the selector of a closed server to the garbage collector.
    assert until(lambda: gc.collect() >= 0 and _count("fd") <= before[0], 3)
    assert until(lambda: _count("task") <= before[1], 3)
