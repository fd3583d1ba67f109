"""Cases on a vision service's WebSocket, with a server that can misbehave. Shell (sockets).

It implements only the part of RFC 6455 that accepts one client at a time. The case does the rest.
"""

import base64
import hashlib
import json
import math
import secrets
import socket
import ssl
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Final, Self

from sightline.conformance.case import Bench, Suite, itself
from sightline.conformance.raw_peers import (
    BINARY,
    CLOSE,
    CONTINUED,
    LATE_PONG_S,
    PING,
    PONG,
    TEXT,
    RawConnection,
    RawFrame,
)
from sightline.conformance.vision.images import CAMERA as LENS
from sightline.conformance.vision.images import picture
from sightline.protocol.channels import CAMERA, FRAME, OVERLAY, PREVIEW, Channel
from sightline.protocol.codec import encode
from sightline.protocol.errors import LinkError, WireError
from sightline.protocol.messages import FrameHeader, Stamp
from sightline.protocol.transports.endpoints import parse_websocket_endpoint
from sightline.protocol.transports.websocket.framing import MAX_HELLO_BYTES, SUBPROTOCOL, pack, parse_hello
from sightline.protocol.transports.websocket.tls import server_tls_context

SESSION_BEGINS: Final = "5ca1"
"""Distinguishes this server from the kit's own link in the tests."""
_GUID: Final = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
_SEND_S: Final = 2.0
_REQUEST_BYTES: Final = 16_384
_LONG_BLOCK_BYTES: Final = 570
"""Without its channel more than the 512 bytes of a header, and within the 576 bytes of a block."""


class RawServer:
    """Listens on an address; a context manager."""

    def __init__(self, host: str, port: int, tls: ssl.SSLContext | None = None) -> None:
        """Listen. Raises LinkError for an invalid or used address."""
        self._tls = tls
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise LinkError(f"ws://{host}:{port} cannot be listened on: {error.strerror}") from None
        self._socket.listen(4)
        self._answered_s = time.monotonic()
        self._clients: list[AcceptedClient] = []

    def accept(self, within_s: float) -> "AcceptedClient | None":
        """Return the next client after the opening handshake; None if none arrives in time."""
        deadline_s = time.monotonic() + within_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            self._socket.settimeout(left_s)
            try:
                connection, _ = self._socket.accept()
            except TimeoutError:
                return None
            try:
                connection.settimeout(_SEND_S)
                secured = connection if self._tls is None else self._tls.wrap_socket(connection, server_side=True)
                self._clients.append(AcceptedClient(secured))
                return self._clients[-1]
            except (OSError, LinkError):
                connection.close()
        return None

    def turn_away(self, within_s: float) -> float:
        """Answer the next request with 503. Returns the seconds since the last answer; infinite if none came."""
        self._socket.settimeout(within_s)
        try:
            connection, _ = self._socket.accept()
        except TimeoutError:
            return math.inf
        pause_s = time.monotonic() - self._answered_s
        # Without an answer some HTTP libraries repeat a request by themselves.
        with suppress(OSError), connection:
            connection.settimeout(_SEND_S)
            secured = connection if self._tls is None else self._tls.wrap_socket(connection, server_side=True)
            with secured:
                secured.recv(_REQUEST_BYTES)
                self._answered_s = time.monotonic()
                secured.sendall(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
        return pause_s

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self._socket.close()
        for client in self._clients:
            client.close()


class AcceptedClient(RawConnection):
    """The server's end. `offered` are the client's sub-protocols; `session` is that of the robot played on it.

    `request` is the first line of the client's head, `headers` are the others.
    Each connection is to a restarted robot, because a vision service may treat an earlier session as ended.
    """

    masks = False

    def __init__(self, connection: socket.socket) -> None:
        """Complete the opening handshake. Raises LinkError for a client that sends no request."""
        super().__init__(connection)
        self.session = SESSION_BEGINS + secrets.token_hex(2)
        self.request, self.headers = self.read_head()
        if not self.request:
            raise LinkError("the client sent no request")
        fields = dict(self.headers)
        self.offered = [one.strip() for one in fields.get("sec-websocket-protocol", "").split(",")]
        token = base64.b64encode(hashlib.sha1(fields.get("sec-websocket-key", "").encode("latin-1") + _GUID).digest())
        chosen = b"Sec-WebSocket-Protocol: sightline.v1\r\n" if SUBPROTOCOL in self.offered else b""
        self.write(b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                   b"Sec-WebSocket-Accept: " + token + b"\r\n" + chosen + b"\r\n")

    def frame(self, within_s: float) -> RawFrame | None:
        """Return the next frame except pings; a close frame is answered and ends the connection."""
        frame = super().frame(within_s)
        if frame is not None and frame.opcode == CLOSE:
            self.send(CLOSE, frame.data[:2])
            self.close()  # RFC 6455, 7.1.1: the server ends the TCP connection first
        return frame

    def drop(self) -> None:
        """Drop the connection without a close frame, with a reset."""
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()


# Cases on a vision service's WebSocket itself: opening, hello, liveness, ends; with a misbehaving server. Shell.


SUITE = Suite("V")
BACK_S: Final = 5.0
"""At most a second between two tries, and two until a silent peer is given up."""
_TRIES: Final = 5
_LEAST_PAUSE_S: Final = 0.15
"""Of 0.2 s; timers differ."""
_LATER_PAUSE_S: Final = 0.35
_HELLO_S: Final = 2.0
_END_S: Final = 3.0
_ANSWER_S: Final = 1.0
_DRAWN: Final = 8
_DRAWN_S: Final = 0.15
"""Number of frames, and the time to wait after the last message to each."""
Fields = dict[str, Any]
_TOO_LARGE_BYTES: Final = 3_000_000
"""Above the limit of any peer: a frame has at most a million."""


def need_websocket(bench: Bench) -> None:
    there = bench.endpoint.startswith(("ws://", "wss://"))
    bench.need(there, "only for a vision service that connects to a WebSocket endpoint")


@contextmanager
def server_of(bench: Bench) -> Iterator[RawServer]:
    """Run a raw server at the address of the kit's."""
    need_websocket(bench)
    secure = bench.endpoint.startswith("wss://")
    end = parse_websocket_endpoint(bench.endpoint)
    bench.leave()
    try:
        tls = server_tls_context(bench.access.folder, "robot") if secure else None
        with RawServer(end.host, end.port, tls) as server:
            yield server
    finally:
        bench.join()


def client_of(bench: Bench, server: RawServer) -> AcceptedClient:
    client = server.accept(BACK_S)
    bench.expect(client is not None, f"it did not connect within {BACK_S:g} s")
    assert client is not None
    return client


def _hello(client: AcceptedClient) -> tuple[int, bytes]:
    """Return its first message; (0, b"") without one."""
    frame = client.frame(_HELLO_S)
    return (frame.opcode, frame.data) if frame else (0, b"")


def _fields(text: bytes) -> dict[str, Any]:
    try:
        fields = json.loads(text)
    except ValueError:
        return {}
    return fields if isinstance(fields, dict) else {}


def _greet(client: AcceptedClient, robot: str, **fields: Any) -> None:
    """Send a hello as `robot`; `fields` replace those of a good one."""
    hello = {"v": 1, "robot": robot, "role": "robot", "session": client.session, "wants": ["twist", "ack"]}
    client.send(TEXT, json.dumps(hello | fields).encode())


def _message(channel: Channel, header: Stamp, payload: bytes) -> bytes:
    return pack(channel, "", "robot", encode(header), payload)


def _frame(client: AcceptedClient, seq: int) -> bytes:
    return _message(FRAME, FrameHeader(session=client.session, seq=seq, t_us=seq * 40_000), picture("left"))


def met(bench: Bench, server: RawServer) -> AcceptedClient:
    """Return a client that has sent hello, was greeted, and has the camera model."""
    client = client_of(bench, server)
    _hello(client)
    _greet(client, bench.robot)
    client.send(BINARY, _message(CAMERA, Stamp(session=client.session, seq=1, t_us=1), encode(LENS)))
    return client


def _answer(client: AcceptedClient) -> bytes | None:
    """Return the next binary message; None if none arrives."""
    frame = client.frame_that(lambda one: one.opcode == BINARY, _ANSWER_S)
    return frame.data if frame else None


def _is_no_hello(frame: RawFrame) -> bool:
    """Return True for a text that is not a hello, which may come at any time (14.5)."""
    return frame.opcode == TEXT and "robot" not in _fields(frame.data)


def _channel(data: bytes) -> object:
    """Return the channel that a binary message names, or None."""
    return _fields(data[2 : 2 + int.from_bytes(data[:2])]).get("channel")


def _echo(data: bytes) -> dict[str, Any]:
    """Return the echo of a binary message, or an empty object."""
    echo = _fields(data[2 : 2 + int.from_bytes(data[:2])]).get("echo")
    return echo if isinstance(echo, dict) else {}


# --- opening ---------------------------------------------------------------------------------------------------------


@SUITE.must("V-SOCK-01", "14.1 Opening", real=True)
def offers_the_sub_protocol(bench: Bench) -> None:
    """It offers the sub-protocol `sightline.v1`."""
    with server_of(bench) as server:
        offered = client_of(bench, server).offered
        bench.expect(SUBPROTOCOL in offered, f"it offered {offered}")


@SUITE.must("V-SOCK-02", "14.5 Hello", real=True)
def sends_hello_first(bench: Bench) -> None:
    """Its first message is a hello for this robot: JSON text of at most 1024 bytes, within two seconds."""
    with server_of(bench) as server:
        kind, text = _hello(client_of(bench, server))
        bench.expect(kind == TEXT and len(text) <= MAX_HELLO_BYTES, f"first came {kind}: {text[:80]!r}")
        try:
            hello = parse_hello(text.decode("utf-8", "replace"))
        except WireError as error:
            bench.expect(False, error.detail)
        else:
            bench.expect(hello.robot == bench.robot, f"it means robot {hello.robot}")


@SUITE.must("V-SOCK-03", "14.5 Hello", real=True)
def wants_frames(bench: Bench) -> None:
    """Its hello wants `frame`."""
    with server_of(bench) as server:
        wants = _fields(_hello(client_of(bench, server))[1]).get("wants", ["frame"])
        bench.expect("frame" in wants, f"it wants {wants}")


@SUITE.must("V-SOCK-04", "14.5 Hello", real=True)
def names_its_role(bench: Bench) -> None:
    """Its hello names the role that it drives as."""
    with server_of(bench) as server:
        role = _fields(_hello(client_of(bench, server))[1]).get("role")
        bench.expect(role == "vision", f"its role is {role!r}")


def _leaves(fields: Fields, whom: str, bench: Bench) -> None:
    with server_of(bench) as server:
        client = client_of(bench, server)
        _hello(client)
        _greet(client, **{"robot": bench.robot} | fields)
        client.send(BINARY, _message(CAMERA, Stamp(session=client.session, seq=1, t_us=1), encode(LENS)))
        client.send(BINARY, _frame(client, 1))
        bench.expect(_answer(client) is None, f"it answered a frame of {whom}")
        bench.expect(client.end(_END_S), f"it stayed with {whom}")


SUITE.must_all(itself, {
    "V-SOCK-05": ("14.5 Hello", "It ends the connection to a robot that sends hello as another robot, and drives "
                  "nothing there.", partial(_leaves, {"robot": "another"}, "another robot")),
    "V-SOCK-19": ("14.9 Ends", "It ends the connection to a robot whose hello is of another version.",
                  partial(_leaves, {"v": 2}, "a robot of version 2")),
    "V-SOCK-20": ("14.9 Ends", "It ends the connection to a robot whose hello has an invalid session.",
                  partial(_leaves, {"session": SESSION_BEGINS + "123"}, "a robot with a session of seven digits")),
}, real=True)


@SUITE.must("V-SOCK-21", "14.5 Hello", real=True)
def leaves_a_later_robot(bench: Bench) -> None:
    """It ends the connection to a robot whose later hello is of another robot."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.send(BINARY, _frame(client, 1))
        bench.need(_answer(client) is not None, "it answers nothing")
        _greet(client, "another")
        bench.expect(client.end(_END_S), "it stayed with another robot")


# --- messages --------------------------------------------------------------------------------------------------------


@SUITE.must("V-SOCK-06", "14.6 Messages", real=True)
def answers_in_binary(bench: Bench) -> None:
    """Its answer is one binary message whose header block names its channel."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.send(BINARY, _frame(client, 1))
        answer = client.frame_that(lambda one: one.opcode == BINARY or _is_no_hello(one), _ANSWER_S)
        bench.need(answer is not None, "it answers nothing")
        assert answer is not None
        bench.expect(answer.opcode == BINARY, f"its answer is a text: {answer.data[:120]!r}")
        bench.expect(_channel(answer.data) in ("twist", "ack"), f"its block is {answer.data[:120]!r}")


@SUITE.must("V-SOCK-07", "14.6 Messages", real=True)
def reads_fragments(bench: Bench) -> None:
    """A frame in fragments, with a ping between them, is read."""
    with server_of(bench) as server:
        client = met(bench, server)
        whole = _frame(client, 1)
        client.send(BINARY, whole[:100], fin=False)
        client.send(PING, b"between")
        client.send(CONTINUED, whole[100:2_000], fin=False)
        client.send(CONTINUED, whole[2_000:])
        bench.expect(_answer(client) is not None, "it did not answer")


@SUITE.must("V-SOCK-24", "1.4 Sizes", real=True)
def rejects_long_headers(bench: Bench) -> None:
    """A frame whose header has over 512 bytes, in a block within 576, drives nothing."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.send(BINARY, _frame(client, 1))
        bench.need(_answer(client) is not None, "it did not answer an ordinary frame (V-SOCK-06)")
        whole = _frame(client, 2)
        size = int.from_bytes(whole[:2])
        block = whole[2 : 2 + size].ljust(_LONG_BLOCK_BYTES)
        client.send(BINARY, len(block).to_bytes(2) + block + whole[2 + size :])
        drove = client.frame_that(lambda one: one.opcode == BINARY and _channel(one.data) == "twist"
                                  and _echo(one.data).get("seq") == 2, _ANSWER_S)
        bench.expect(drove is None, f"it drove by a frame with a header block of {len(block)} bytes")


@SUITE.should("V-SOCK-22", "19.2 Only while watched", real=True)
def draws_without_subscriber(bench: Bench) -> None:
    """To a robot whose hello does not want them it sends no overlay and no preview."""
    with server_of(bench) as server:
        client = met(bench, server)
        names = []
        for seq in range(1, _DRAWN):
            client.send(BINARY, _frame(client, seq))
            while (frame := client.frame_that(lambda one: one.opcode == BINARY, _DRAWN_S)) is not None:
                names.append(_channel(frame.data))
        bench.need(names, "it answers nothing")
        drawn = sorted({OVERLAY.name, PREVIEW.name} & set(names))
        bench.expect(not drawn, f"it sends {' and '.join(drawn)}")


# --- liveness and ends -----------------------------------------------------------------------------------------------


@SUITE.must("V-SOCK-08", "14.8 Liveness", real=True)
def answers_pings(bench: Bench) -> None:
    """A ping is answered within a second."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.send(PING, b"are you there")
        pong = RawFrame(True, PONG, b"are you there")
        bench.expect(client.frame_that(lambda one: one == pong, _ANSWER_S), "no pong came")


@SUITE.must("V-SOCK-09", "14.8 Liveness", real=True)
def pings(bench: Bench) -> None:
    """It pings: within two and a half seconds one comes."""
    with server_of(bench) as server:
        client = met(bench, server)
        deadline_s = time.monotonic() + 2.5
        while not client.pings and time.monotonic() < deadline_s:
            client.frame(0.1)
        bench.expect(client.pings, "no ping came")


def _ends_and_comes_back(bench: Bench, spoil: Callable[[AcceptedClient], None], what: str) -> None:
    with server_of(bench) as server:
        client = met(bench, server)
        spoil(client)
        bench.expect(client.end(_END_S), f"it stayed after {what}")
        bench.expect(server.accept(BACK_S), f"it did not connect again after {what}")


@SUITE.must("V-SOCK-10", "14.9 Ends", real=True)
def broken_block(bench: Bench) -> None:
    """A header block that is cut ends the connection, and it connects again."""
    _ends_and_comes_back(bench, lambda client: client.send(BINARY, b"\x02\x00{"), "a header block that is cut")


@SUITE.must("V-SOCK-11", "14.9 Ends", real=True)
def too_large(bench: Bench) -> None:
    """A message larger than anything it can want ends the connection, and it connects again."""
    _ends_and_comes_back(bench, lambda client: client.send(BINARY, bytes(_TOO_LARGE_BYTES)), "three megabytes")


@SUITE.must("V-SOCK-12", "14.9 Ends", real=True)
def no_hello(bench: Bench) -> None:
    """A first message that is not a hello ends the connection."""
    with server_of(bench) as server:
        client = client_of(bench, server)
        _hello(client)
        client.send(BINARY, _frame(client, 1))
        bench.expect(client.end(_END_S), "it stayed with a robot that sent no hello")


@SUITE.must("V-SOCK-13", "14.8 Liveness", real=True)
def comes_back_after_a_reset(bench: Bench) -> None:
    """A connection that is reset is made again."""
    with server_of(bench) as server:
        met(bench, server).drop()
        bench.expect(server.accept(BACK_S), f"it did not connect again within {BACK_S:g} s")


@SUITE.must("V-SOCK-23", "14.8 Liveness", real=True)
def tries_again_at_a_pace(bench: Bench) -> None:
    """A robot that closes each connection is tried again after 0.2 s, and after longer pauses from then on."""
    with server_of(bench) as server:
        bench.expect(server.turn_away(BACK_S) <= BACK_S, f"it did not connect within {BACK_S:g} s")
        pauses_s = [server.turn_away(BACK_S) for _ in range(_TRIES)]
        shown = ", ".join(f"{pause_s:.2f}" for pause_s in pauses_s)
        bench.expect(max(pauses_s) <= BACK_S, f"its pauses were {shown} s")
        bench.expect(min(pauses_s) >= _LEAST_PAUSE_S, f"its pauses were {shown} s, the first must be 0.2 s")
        bench.expect(pauses_s[-1] >= _LATER_PAUSE_S, f"its pauses were {shown} s, and must rise")


# Cases on opening a WebSocket: the vision service's token, its names, and a robot that falls silent. Shell (sockets).


_ENTRY: Final = "sightline.token."
_BEARER: Final = "bearer "


def _token(bench: Bench) -> str:
    need_websocket(bench)
    token = bench.access.token_of("vision")
    bench.need(token, "no token was named (--token, or --secure)")
    return token


def _shown(client: AcceptedClient) -> list[str]:
    """Return every token that the client showed, in either form."""
    bearers = (value for name, value in client.headers if name == "authorization")
    shown = [text[len(_BEARER) :].strip() for text in bearers if text.lower().startswith(_BEARER)]
    return shown + [entry[len(_ENTRY) :] for entry in client.offered if entry.startswith(_ENTRY)]


@SUITE.must("V-SOCK-14", "14.3 Token", real=True)
def shows_its_token(bench: Bench) -> None:
    """It shows its token, and shows it once: next to the sub-protocol, or as `Authorization: Bearer`."""
    token = _token(bench)
    with server_of(bench) as server:
        shown = _shown(client_of(bench, server))
        bench.expect(len(shown) == 1, f"it shows {len(shown)} tokens")
        bench.expect(shown == [token], "it shows another token than the one named")


@SUITE.must("V-SOCK-15", "14.3 Token", real=True)
def token_is_in_no_url(bench: Bench) -> None:
    """No token is in its URL, which is logged."""
    token = _token(bench)
    with server_of(bench) as server:
        bench.expect(token not in client_of(bench, server).request, "its URL holds the token")


@SUITE.must("V-SOCK-16", "14.2 Host and Origin", real=True)
def names_its_host(bench: Bench) -> None:
    """It names one Host, and no Origin but that Host."""
    with server_of(bench) as server:
        reported = client_of(bench, server).headers
        hosts = [value.lower() for name, value in reported if name == "host"]
        bench.expect(len(hosts) == 1, f"it names {len(hosts)} hosts")
        origins = [value.lower() for name, value in reported if name == "origin"]
        own = {f"http://{hosts[0]}", f"https://{hosts[0]}"}
        bench.expect(set(origins) <= own, f"Origin {origins}, Host {hosts[0]}")


@SUITE.must("V-SOCK-17", "14.8 Liveness", real=True)
def leaves_the_silent(bench: Bench) -> None:
    """A robot that sends nothing and answers no ping is given up, and connected to again."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.answers_pings = False
        bench.expect(client.end(BACK_S), f"after {BACK_S:g} s without a word it is still connected")
        bench.expect(server.accept(BACK_S), f"it did not connect again within {BACK_S:g} s")


@SUITE.must("V-SOCK-18", "14.8 Liveness", real=True)
def late_pongs_end_nothing(bench: Bench) -> None:
    """A robot that sends frames is not silent: it is not left, though its pongs come 1.3 s late."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.pongs_after_s = LATE_PONG_S
        for seq in range(1, 41):
            client.send(BINARY, _frame(client, seq))
            end = client.end(0.1)
            bench.expect(end is None, f"after {client.pings} pings it ended the connection: {end}")
