"""What the WebSocket tests share: a robot with a healthy peer beside whoever misbehaves, and bare clients."""

import json
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from sightline.protocol.channels import FRAME, TWIST
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket_endpoints import parse_websocket_endpoint
from tests.link_rigs import free_endpoint, until

V1 = {"subprotocols": ["sightline.v1"], "compression": None, "legacy": True}
HELLO = {"robot": "r1", "session": "0000beef"}
TWIST_KEY = "sightline/r1/twist/vision"


def free_ws(scheme: str = "ws") -> str:
    return free_endpoint().replace("tcp/", f"{scheme}://")


def address_of(endpoint: str) -> tuple[str, int]:
    return parse_websocket_endpoint(endpoint).host, parse_websocket_endpoint(endpoint).port


class Robot:
    """A listening robot that hears twists, with a healthy peer beside whoever misbehaves."""

    def __init__(self) -> None:
        self.endpoint = free_ws()
        self.address = address_of(self.endpoint)
        self.link = open_websocket("r1", listen=self.endpoint)
        self.twists = self.link.latest(TWIST)
        self.peer = open_websocket("r1", connect=self.endpoint, role="vision")
        self.frames = self.peer.latest(FRAME)
        assert until(lambda: self.link.has_listener(FRAME) and self.peer.has_listener(TWIST))

    @property
    def refused(self):
        return self.link.refused

    def still_serves(self) -> None:
        """The healthy peer hears and is heard, on the connection that it had."""
        self.frames.take()
        assert self.link.publish(FRAME, b"{}", b"still here")
        assert self.frames.take(2).payload == b"still here"
        assert self.peer.publish(TWIST, b"", b"0.5|0")
        assert until(lambda: (got := self.twists.take()) and got.payload == b"0.5|0")
        assert not self.link.callback_errors

    def close(self) -> None:
        self.peer.close()
        self.link.close()


def closed_with(connection: ClientConnection) -> tuple[int, str]:
    """Read until the other end closes; its code and reason."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            connection.recv(5)
    return closed.value.rcvd.code, closed.value.rcvd.reason


def upgrade(host: str, more: str = "") -> bytes:
    """A request to speak `sightline.v1`, as text."""
    return (
        f"GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: sightline.v1\r\n{more}\r\n"
    ).encode("ascii")


def masked(opcode: int, data: bytes) -> bytes:
    """A frame as a client sends it, at most 65,535 bytes long, masked with zeros."""
    size = bytes([0x80 | len(data)]) if len(data) < 126 else bytes([0xFE]) + len(data).to_bytes(2)
    return bytes([0x80 | opcode]) + size + bytes(4) + data


@contextmanager
def bare_client(endpoint: str, receive_bytes: int = 0, **hello: object) -> Iterator[socket.socket]:
    """A socket that has asked to come in and said hello, and then does what the test does: nothing by itself."""
    with socket.socket() as near:
        if receive_bytes:
            near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        near.connect(address_of(endpoint))
        near.settimeout(5)
        near.sendall(upgrade("127.0.0.1"))
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            answer += near.recv(1)
        assert answer.startswith(b"HTTP/1.1 101 ")
        near.sendall(masked(1, json.dumps(HELLO | hello).encode()))
        yield near


@contextmanager
def never_reads(endpoint: str, **hello: object) -> Iterator[ClientConnection]:
    """A client whose application takes nothing: its library stops reading, and so leaves pings unanswered."""
    near = socket.socket()
    near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    near.connect(address_of(endpoint))
    connection = connect(endpoint, sock=near, max_queue=1, ping_interval=None, close_timeout=0.1, **V1)
    connection.send(json.dumps(HELLO | hello))
    yield connection
    connection.close()


def received(near: socket.socket, quiet_s: float = 0.3) -> bytes:
    """All that arrives until it is quiet."""
    near.settimeout(quiet_s)
    got = b""
    try:
        while piece := near.recv(65_536):
            got += piece
    except TimeoutError:
        pass
    return got


def resident_kib() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4


def pause_until(begin_s: float, seconds: float) -> None:
    time.sleep(max(0.0, seconds - (time.monotonic() - begin_s)))
