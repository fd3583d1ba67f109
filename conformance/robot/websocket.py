"""Cases that need sockets of their own: the handshake, hello and framing of `sightline.v1`. Shell (raw sockets)."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import NotApplicableError, Suite
from sightline.conformance.raw_peers import BINARY, CONTINUED, TEXT, RawWebSocket, split_url
from sightline.conformance.robot.fixture import as_json
from sightline.protocol.errors import WireError
from sightline.protocol.transports.websocket.framing import SUBPROTOCOL, IncomingMessage, parse_hello, unpack

SUITE: Final = Suite("R")
SWITCHED: Final = 101
SOON_S: Final = 2.5
PASSING_S: Final = 1.2
"""Long enough for what is published ten times a second to come several times."""
SESSION: Final = "5eed5eed"


def endpoint_of(bench: Bench) -> str:
    bench.need(bench.endpoint.startswith(("ws://", "wss://")), "the peer is not tested over WebSocket")
    return bench.endpoint


def hello(bench: Bench, *wants: str, **changes: Any) -> bytes:
    """A good hello, or one with other fields."""
    fields = {"v": 1, "robot": bench.robot, "role": bench.access.watcher, "session": SESSION, "wants": list(wants)}
    return as_json({**fields, **changes})


@contextmanager
def spoken(bench: Bench, *wants: str, **changes: Any) -> Iterator[RawWebSocket]:
    """A connection on which both have said hello."""
    with RawWebSocket(endpoint_of(bench), offered(bench, source=changes.get("role", ""))) as raw:
        bench.need(raw.status == SWITCHED, f"the handshake fails with {raw.status} (R-SOCK-01)")
        raw.send(TEXT, hello(bench, *wants, **changes))
        answer = raw.frame(SOON_S)
        bench.need(answer is not None and answer.opcode == TEXT, "hello is not answered (R-SOCK-07)")
        yield raw


def offered(bench: Bench, *others: str, source: str = "") -> tuple[str, ...]:
    """The sub-protocol entries of a client that may come in, as a watcher unless it says more, after `others`."""
    token = bench.access.token_of(source or bench.access.watcher)
    return (*others, SUBPROTOCOL, *([entry_of(token)] if token else ()))


def entry_of(token: str) -> str:
    """The sub-protocol entry that shows `token`."""
    return f"sightline.token.{token}"


def put_over_websocket(bench: Bench, key: str, header: bytes, payload: bytes) -> None:
    """Send a message past every bound of a well-behaved end. Raises NotApplicableError for keys that cannot be said."""
    parts = key.split("/")
    if "*" in key or len(parts) != 4 or parts[1] != bench.robot:
        raise NotApplicableError("over WebSocket nothing is sent under a key")
    with spoken(bench, role=parts[3]) as raw:
        raw.send(BINARY, block(b'{"channel":"%b",' % parts[2].encode() + header[1:], payload))
        raw.end(0.2)


def block(fields: bytes, payload: bytes = b"") -> bytes:
    return len(fields).to_bytes(2) + fields + payload


def disarm_request(bench: Bench) -> bytes:
    """A request for `disarm` as one message: it changes nothing here, and it is answered."""
    header = {"channel": "request", "v": 1, "source": bench.access.watcher, "session": SESSION, "seq": 1}
    return block(as_json(header), as_json({"id": 4711, "verb": "disarm"}))


def packets_of(raw: RawWebSocket, bench: Bench, for_s: float) -> list[IncomingMessage]:
    """What comes in whole messages, taken apart; what cannot be taken apart has an empty key."""
    until_s, whole, packets = time.monotonic() + for_s, b"", []
    while (left_s := until_s - time.monotonic()) > 0:
        frame = raw.frame(left_s)
        if frame is not None and frame.opcode in (BINARY, CONTINUED):
            whole += frame.data
            if frame.fin:
                packets.append(_packet(whole, bench))
                whole = b""
    return packets


def _packet(message: bytes, bench: Bench) -> IncomingMessage:
    try:
        return unpack(message, bench.robot, "")
    except WireError:
        return IncomingMessage("", b"", message)


def names_of(packets: list[IncomingMessage]) -> set[str]:
    return {packet.key.split("/")[2] for packet in packets if packet.key}


def is_answered(raw: RawWebSocket, bench: Bench, within_s: float = 1.0) -> bool:
    return "reply" in names_of(packets_of(raw, bench, within_s))


def ends_with(raw: RawWebSocket, bench: Bench, codes: tuple[int, ...], what: str, within_s: float = SOON_S) -> str:
    end = raw.end(within_s)
    bench.expect(end is not None, f"{what}: the connection stays open")
    assert end is not None
    bench.expect(end[0] in codes, f"{what}: it ends with {end[0]} {end[1]!r}, expected {' or '.join(map(str, codes))}")
    return end[1]


def _refused(bench: Bench, status: int, what: str, **options: Any) -> None:
    with RawWebSocket(endpoint_of(bench), **{"protocols": offered(bench), **options}) as raw:
        bench.expect(raw.status == status, f"{what}: HTTP {raw.status or 'nothing'}, expected {status}")


# --- handshake -------------------------------------------------------------------------------------------------------


@SUITE.must("R-SOCK-01", "14.1 Opening", real=True)
def selects_the_sub_protocol(bench: Bench) -> None:
    """The handshake selects `sightline.v1` among what is offered."""
    with RawWebSocket(endpoint_of(bench), offered(bench, "chat")) as raw:
        bench.expect(raw.status == SWITCHED, f"HTTP {raw.status}")
        selected = raw.headers.get("sec-websocket-protocol")
        bench.expect(selected == SUBPROTOCOL, f"it selects {selected!r}")


@SUITE.must("R-SOCK-02", "14.1 Opening", real=True)
def demands_the_sub_protocol(bench: Bench) -> None:
    """Without the sub-protocol the handshake fails with 400."""
    token = bench.access.token_of(bench.access.watcher)
    shown = (("Authorization", f"Bearer {token}"),) if token else ()
    _refused(bench, 400, "no sub-protocol", protocols=(), headers=shown)
    _refused(bench, 400, "another sub-protocol", protocols=("chat", "sightline.v9"), headers=shown)


@SUITE.must("R-SOCK-03", "14.1 Opening", real=True)
def no_compression(bench: Bench) -> None:
    """No extension is negotiated, though compression is offered."""
    offer = (("Sec-WebSocket-Extensions", "permessage-deflate; client_max_window_bits"),)
    with RawWebSocket(endpoint_of(bench), offered(bench), offer) as raw:
        agreed = raw.headers.get("sec-websocket-extensions", "")
        bench.expect(raw.status == SWITCHED and not agreed, f"HTTP {raw.status}, extensions {agreed!r}")


@SUITE.must("R-SOCK-04", "14.2 Host and Origin", real=True)
def foreign_host(bench: Bench) -> None:
    """A Host that a foreign site could own fails with 403."""
    port = split_url(endpoint_of(bench))[2]
    _refused(bench, 403, "Host: evil.example.com", host=f"evil.example.com:{port}")


@SUITE.must("R-SOCK-05", "14.2 Host and Origin", real=True)
def foreign_origin(bench: Bench) -> None:
    """A browser's Origin of another site fails with 403."""
    _refused(bench, 403, "Origin: http://evil.example.com", headers=(("Origin", "http://evil.example.com"),))
    _refused(bench, 403, "Origin: null", headers=(("Origin", "null"),))


@SUITE.must("R-SOCK-06", "14.2 Host and Origin", real=True)
def own_origin(bench: Bench) -> None:
    """An Origin that is the Host itself is let in."""
    tls, address, port = split_url(endpoint_of(bench))
    origin = f"http{'s' if tls else ''}://{address}:{port}"
    _refused(bench, SWITCHED, "Origin as the Host", headers=(("Origin", origin),))


# --- hello -----------------------------------------------------------------------------------------------------------


@SUITE.must("R-SOCK-07", "14.5 Hello", real=True)
def answers_hello(bench: Bench) -> None:
    """A hello is answered with the robot's own, as text, that names the robot."""
    with RawWebSocket(endpoint_of(bench), offered(bench)) as raw:
        raw.send(TEXT, hello(bench, "status"))
        frame = raw.frame(SOON_S)
        bench.expect(frame is not None and frame.opcode == TEXT, f"the answer is {frame}")
        assert frame is not None
        try:
            robot = parse_hello(frame.data.decode("utf-8", "replace")).robot
        except WireError as error:
            robot = f"no hello: {error.detail}"
        bench.expect(robot == bench.robot, f"it names {robot}")


def _no_hello(number: str, title: str, codes: tuple[int, ...], send: Callable[[RawWebSocket, Bench], None]) -> None:
    def run(bench: Bench) -> None:
        with RawWebSocket(endpoint_of(bench), offered(bench)) as raw:
            bench.need(raw.status == SWITCHED, f"the handshake fails with {raw.status} (R-SOCK-01)")
            send(raw, bench)
            reason = ends_with(raw, bench, codes, title, 4.0)
            bench.expect(reason, "the close frame gives no reason")

    run.__doc__ = title
    SUITE.must(number, "14.5 Hello", real=True)(run)


_no_hello("R-SOCK-08", "A hello for another robot ends with 1008 and the reason.", (1008,),
          lambda raw, bench: raw.send(TEXT, hello(bench, robot="other")))  # fmt: skip
_no_hello("R-SOCK-09", "A first message that is not text ends with 1003 and the reason.", (1003,),
          lambda raw, bench: raw.send(BINARY, disarm_request(bench)))  # fmt: skip
_no_hello("R-SOCK-10", "A text that is no hello ends with 1008 and the reason.", (1008,),
          lambda raw, _bench: raw.send(TEXT, b'{"let": "me in"}'))  # fmt: skip
_no_hello("R-SOCK-11", "A hello of another version ends with 1008 and the reason.", (1008,),
          lambda raw, bench: raw.send(TEXT, hello(bench, v=2)))  # fmt: skip
_no_hello("R-SOCK-12", "Who says no hello within two seconds is dropped with 1008 and the reason.", (1008,),
          lambda _raw, _bench: None)  # fmt: skip


@SUITE.must("R-SOCK-13", "14.5 Hello", real=True)
def only_what_is_wanted(bench: Bench) -> None:
    """Only the channels in `wants` come."""
    with spoken(bench, "status") as raw:
        names = names_of(packets_of(raw, bench, PASSING_S))
        bench.expect(names <= {"status"}, f"wanted was status, there came {sorted(names)}")


@SUITE.must("R-SOCK-14", "14.5 Hello", real=True)
def hello_again(bench: Bench) -> None:
    """A later hello replaces `wants`."""
    with spoken(bench, "status") as raw:
        raw.send(TEXT, hello(bench, "odometry", "camera"))
        packets_of(raw, bench, 0.3)
        names = names_of(packets_of(raw, bench, PASSING_S))
        bench.expect("status" not in names and names, f"wanted are odometry and camera, there come {sorted(names)}")


@SUITE.must("R-SOCK-15", "14.5 Hello", real=True)
def unknown_wants(bench: Bench) -> None:
    """Unknown names in `wants` and unknown fields of a hello are ignored."""
    with spoken(bench, "status", "perfume", mood="calm") as raw:
        names = names_of(packets_of(raw, bench, PASSING_S))
        bench.expect("status" in names, f"there came {sorted(names)}")
