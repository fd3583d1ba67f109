"""Cases about a vision's WebSocket itself: opening, hello, liveness, ends; with a server that can misbehave. Shell."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from sightline.protocol.channels import CAMERA, FRAME, Channel
from sightline.protocol.codec import encode
from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.protocol.conformance.vision_pictures import CAMERA as LENS
from sightline.protocol.conformance.vision_pictures import picture
from sightline.conformance.vision.websocket import (
    BINARY,
    PING,
    PONG,
    TEXT,
    GoneError,
    RawClient,
    RawServer,
)
from sightline.protocol.errors import WireError
from sightline.protocol.messages import FrameHeader, Stamp
from sightline.protocol.transports.websocket_endpoints import parse_websocket_endpoint
from sightline.protocol.transports.websocket.framing import MAX_HELLO_BYTES, SUBPROTOCOL, pack, parse_hello
from sightline.protocol.transports.websocket_tls import server_tls_context

SUITE = Suite("V")
BACK_S: Final = 5.0
"""A second at most between two tries, two until a silent peer is given up."""
_HELLO_S: Final = 2.0
_END_S: Final = 3.0
_ANSWER_S: Final = 1.0
_TOO_LARGE_BYTES: Final = 3_000_000
"""Above what any peer can want: a frame has at most a million."""


def need_websocket(bench: Bench) -> None:
    there = bench.endpoint.startswith(("ws://", "wss://"))
    bench.need(there, "only for a vision that connects to a WebSocket endpoint")


@contextmanager
def server_of(bench: Bench) -> Iterator[RawServer]:
    """A server of our own in the place of the kit's."""
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


def client_of(bench: Bench, server: RawServer) -> RawClient:
    client = server.accept(BACK_S)
    bench.expect(client is not None, f"it did not connect within {BACK_S:g} s")
    assert client is not None
    return client


def _hello(client: RawClient) -> tuple[int, bytes]:
    """Its first message; (0, b"") if there was none."""
    try:
        return client.receive(_HELLO_S) or (0, b"")
    except GoneError:
        return 0, b""


def _fields(text: bytes) -> dict[str, Any]:
    try:
        fields = json.loads(text)
    except ValueError:
        return {}
    return fields if isinstance(fields, dict) else {}


def _greet(client: RawClient, robot: str) -> None:
    hello = {"v": 1, "robot": robot, "role": "robot", "session": client.session, "wants": ["twist", "ack"]}
    client.send(TEXT, json.dumps(hello).encode())


def _message(channel: Channel, header: Stamp, payload: bytes) -> bytes:
    return pack(channel, "", "robot", encode(header), payload)


def _frame(client: RawClient, seq: int) -> bytes:
    return _message(FRAME, FrameHeader(session=client.session, seq=seq, t_us=seq * 40_000), picture("left"))


def met(bench: Bench, server: RawServer) -> RawClient:
    """A client that has said hello, was greeted, and knows the camera."""
    client = client_of(bench, server)
    _hello(client)
    _greet(client, bench.robot)
    client.send(BINARY, _message(CAMERA, Stamp(session=client.session, seq=1, t_us=1), encode(LENS)))
    return client


def _answer(client: RawClient, within_s: float = _ANSWER_S) -> bytes | None:
    """The next binary message; None if there is none, or nobody."""
    deadline_s = time.monotonic() + within_s
    while (left_s := deadline_s - time.monotonic()) > 0:
        try:
            got = client.receive(left_s)
        except GoneError:
            return None
        if got is not None and got[0] == BINARY:
            return got[1]
    return None


def ends(client: RawClient, within_s: float = _END_S) -> bool:
    """Whether it ends the connection in time."""
    deadline_s = time.monotonic() + within_s
    while (left_s := deadline_s - time.monotonic()) > 0:
        try:
            client.receive(left_s)
        except GoneError:
            return True
    return False


# --- opening ---------------------------------------------------------------------------------------------------------


@SUITE.must("V-SOCK-01", "14.1 Opening", real=True)
def offers_the_sub_protocol(bench: Bench) -> None:
    """It offers the sub-protocol `sightline.v1`."""
    with server_of(bench) as server:
        offered = client_of(bench, server).offered
        bench.expect(SUBPROTOCOL in offered, f"it offered {offered}")


@SUITE.must("V-SOCK-02", "14.5 Hello", real=True)
def says_hello_first(bench: Bench) -> None:
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
def says_its_role(bench: Bench) -> None:
    """Its hello names the role that it drives as."""
    with server_of(bench) as server:
        role = _fields(_hello(client_of(bench, server))[1]).get("role")
        bench.expect(role == "vision", f"its role is {role!r}")


@SUITE.must("V-SOCK-05", "14.5 Hello", real=True)
def leaves_another_robot(bench: Bench) -> None:
    """It ends the connection to who says hello as another robot, and drives nothing there."""
    with server_of(bench) as server:
        client = client_of(bench, server)
        _hello(client)
        _greet(client, "another")
        client.send(BINARY, _message(CAMERA, Stamp(session=client.session, seq=1, t_us=1), encode(LENS)))
        client.send(BINARY, _frame(client, 1))
        bench.expect(_answer(client) is None, "it answered another robot's frame")
        bench.expect(ends(client), "it stayed with another robot")


# --- messages --------------------------------------------------------------------------------------------------------


@SUITE.must("V-SOCK-06", "14.6 Messages", real=True)
def answers_in_binary(bench: Bench) -> None:
    """Its answer is one binary message whose header block names its channel."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.send(BINARY, _frame(client, 1))
        data = _answer(client)
        bench.need(data is not None, "it answers nothing")
        assert data is not None
        size = int.from_bytes(data[:2])
        channel = _fields(data[2 : 2 + size]).get("channel")
        bench.expect(channel in ("twist", "ack"), f"its block is {data[: 2 + size][:120]!r}")


@SUITE.must("V-SOCK-07", "14.6 Messages", real=True)
def reads_fragments(bench: Bench) -> None:
    """A frame in fragments, with a ping between them, is read."""
    with server_of(bench) as server:
        client = met(bench, server)
        whole = _frame(client, 1)
        client.send(BINARY, whole[:100], last=False)
        client.send(PING, b"between")
        client.send(0, whole[100:2_000], last=False)
        client.send(0, whole[2_000:])
        bench.expect(_answer(client) is not None, "it did not answer")


# --- liveness and ends -----------------------------------------------------------------------------------------------


@SUITE.must("V-SOCK-08", "14.8 Liveness", real=True)
def answers_pings(bench: Bench) -> None:
    """A ping is answered within a second."""
    with server_of(bench) as server:
        client = met(bench, server)
        client.send(PING, b"are you there")
        deadline_s = time.monotonic() + _ANSWER_S
        got: tuple[int, bytes] | None = None
        while got != (PONG, b"are you there") and time.monotonic() < deadline_s:
            try:
                got = client.receive(deadline_s - time.monotonic())
            except GoneError:
                break
        bench.expect(got == (PONG, b"are you there"), "no pong came")


@SUITE.must("V-SOCK-09", "14.8 Liveness", real=True)
def pings(bench: Bench) -> None:
    """It pings: within two and a half seconds one comes."""
    with server_of(bench) as server:
        client = met(bench, server)
        deadline_s = time.monotonic() + 2.5
        while not client.pings and time.monotonic() < deadline_s:
            try:
                client.receive(0.1)
            except GoneError:
                break
        bench.expect(client.pings, "no ping came")


def _ends_and_comes_back(bench: Bench, spoil: Callable[[RawClient], None], what: str) -> None:
    with server_of(bench) as server:
        client = met(bench, server)
        spoil(client)
        bench.expect(ends(client), f"it stayed after {what}")
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
    """A first message that is no hello ends the connection."""
    with server_of(bench) as server:
        client = client_of(bench, server)
        _hello(client)
        client.send(BINARY, _frame(client, 1))
        bench.expect(ends(client), "it stayed with a robot that said no hello")


@SUITE.must("V-SOCK-13", "14.8 Liveness", real=True)
def comes_back_after_a_reset(bench: Bench) -> None:
    """A connection that is reset is made again."""
    with server_of(bench) as server:
        met(bench, server).drop()
        bench.expect(server.accept(BACK_S), f"it did not connect again within {BACK_S:g} s")
