"""Cases on `sightline.v1` with raw sockets: handshake, hello, framing, tokens. Shell (sockets)."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from sightline.conformance.case import Bench, NotApplicableError, Suite, itself
from sightline.conformance.raw_peers import (
    BINARY,
    CONTINUED,
    LATE_PONG_S,
    PING,
    PONG,
    TEXT,
    RawWebSocket,
    split_url,
)
from sightline.conformance.robot.fixture import GOOD, Robot, Sender, as_json
from sightline.protocol.channels import CHANNELS, MAX_HEADER_BYTES, REPLY, STATUS
from sightline.protocol.errors import WireError
from sightline.protocol.transports.websocket.framing import (
    MAX_BLOCK_BYTES,
    MAX_HELLO_BYTES,
    SUBPROTOCOL,
    IncomingMessage,
    parse_hello,
    unpack,
)

SUITE: Final = Suite("R")
SWITCHED: Final = 101
SOON_S: Final = 2.5
PASSING_S: Final = 1.2
"""Long enough to receive a 10 Hz message several times."""
SESSION: Final = "5eed5eed"


def endpoint_of(bench: Bench) -> str:
    bench.need(bench.endpoint.startswith(("ws://", "wss://")), "the peer is not tested over WebSocket")
    return bench.endpoint


def hello(bench: Bench, *wants: str, **changes: Any) -> bytes:
    """Return a valid hello, or one with other fields."""
    fields = {"v": 1, "robot": bench.robot, "role": bench.access.watcher, "session": SESSION, "wants": list(wants)}
    return as_json({**fields, **changes})


@contextmanager
def spoken(bench: Bench, *wants: str, **changes: Any) -> Iterator[RawWebSocket]:
    """Open a connection on which both ends have sent hello."""
    with RawWebSocket(endpoint_of(bench), offered(bench, source=changes.get("role", ""))) as raw:
        bench.need(raw.status == SWITCHED, f"the handshake fails with {raw.status} (R-SOCK-01)")
        raw.send(TEXT, hello(bench, *wants, **changes))
        answer = raw.frame(SOON_S)
        bench.need(answer is not None and answer.opcode == TEXT, "hello is not answered (R-SOCK-07)")
        yield raw


def offered(bench: Bench, *others: str, source: str = "") -> tuple[str, ...]:
    """Return the sub-protocol entries of a permitted client, by default a watcher, after `others`."""
    token = bench.access.token_of(source or bench.access.watcher)
    return (*others, SUBPROTOCOL, *([entry_of(token)] if token else ()))


def entry_of(token: str) -> str:
    """Return the sub-protocol entry that shows `token`."""
    return f"sightline.token.{token}"


def put_over_websocket(bench: Bench, key: str, header: bytes, payload: bytes) -> None:
    """Send a message beyond the limits of a link. Raises NotApplicableError for keys that cannot be sent."""
    parts = key.split("/")
    if "*" in key or len(parts) != 4 or parts[1] != bench.robot:
        raise NotApplicableError("over WebSocket nothing is sent under a key")
    with spoken(bench, role=parts[3]) as raw:
        raw.send(BINARY, block(b'{"channel":"%b",' % parts[2].encode() + header[1:], payload))
        raw.end(0.2)


def block(fields: bytes, payload: bytes = b"") -> bytes:
    return len(fields).to_bytes(2) + fields + payload


def disarm_request(bench: Bench) -> bytes:
    """Return a request for `disarm` as one message. It changes nothing here and is answered."""
    header = {"channel": "request", "v": 1, "source": bench.access.watcher, "session": SESSION, "seq": 1}
    return block(as_json(header), as_json({"id": 4711, "verb": "disarm"}))


def packets_of(raw: RawWebSocket, bench: Bench, for_s: float) -> list[IncomingMessage]:
    """Unpack all whole messages. A message with broken framing has an empty key."""
    return [_packet(data, bench) for opcode, data in raw.messages(for_s) if opcode == BINARY]


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


def _answers(bench: Bench, status: int, what: str, **options: Any) -> None:
    """Fail the case unless a client that connects this way gets `status`."""
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
    _answers(bench, 400, "no sub-protocol", protocols=(), headers=shown)
    _answers(bench, 400, "another sub-protocol", protocols=("chat", "sightline.v9"), headers=shown)


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
    _answers(bench, 403, "Host: evil.example.com", host=f"evil.example.com:{port}")


@SUITE.must("R-SOCK-05", "14.2 Host and Origin", real=True)
def foreign_origin(bench: Bench) -> None:
    """A browser's Origin of another site fails with 403."""
    _answers(bench, 403, "Origin: http://evil.example.com", headers=(("Origin", "http://evil.example.com"),))
    _answers(bench, 403, "Origin: null", headers=(("Origin", "null"),))


@SUITE.must("R-SOCK-06", "14.2 Host and Origin", real=True)
def own_origin(bench: Bench) -> None:
    """An Origin that is the Host itself is accepted."""
    tls, address, port = split_url(endpoint_of(bench))
    origin = f"http{'s' if tls else ''}://{address}:{port}"
    _answers(bench, SWITCHED, "Origin as the Host", headers=(("Origin", origin),))


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


def _ends_at(send: Callable[[RawWebSocket, Bench], None], codes: tuple[int, ...], title: str, bench: Bench) -> None:
    with RawWebSocket(endpoint_of(bench), offered(bench)) as raw:
        bench.need(raw.status == SWITCHED, f"the handshake fails with {raw.status} (R-SOCK-01)")
        send(raw, bench)
        reason = ends_with(raw, bench, codes, title, 4.0)
        bench.expect(reason, "the close frame gives no reason")


_NO_HELLO: Final[dict[str, tuple[str, tuple[int, ...], Callable[[RawWebSocket, Bench], None]]]] = {
    "R-SOCK-08": ("A hello for another robot ends with 1008 and the reason.", (1008,),
                  lambda raw, bench: raw.send(TEXT, hello(bench, robot="other"))),
    "R-SOCK-09": ("A first message that is not text ends with 1003 and the reason.", (1003,),
                  lambda raw, bench: raw.send(BINARY, disarm_request(bench))),
    "R-SOCK-10": ("A text that is not a hello ends with 1008 and the reason.", (1008,),
                  lambda raw, _bench: raw.send(TEXT, b'{"let": "me in"}')),
    "R-SOCK-11": ("A hello of another version ends with 1008 and the reason.", (1008,),
                  lambda raw, bench: raw.send(TEXT, hello(bench, v=2))),
    "R-SOCK-12": ("A client that sends no hello within two seconds is dropped with 1008 and the reason.", (1008,),
                  lambda _raw, _bench: None),
}
SUITE.must_all(itself, {
    number: ("14.5 Hello", title, partial(_ends_at, send, codes, title))
    for number, (title, codes, send) in _NO_HELLO.items()
}, real=True)


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


# Cases on the messages of `sightline.v1` after hello: framing, pings, and the end of an invalid one. Shell (sockets).


@SUITE.must("R-SOCK-16", "14.6 Messages", real=True)
def messages_can_be_taken_apart(bench: Bench) -> None:
    """Every message has a header block of at most 576 bytes that names its channel, and a header within 512."""
    with spoken(bench, *(name for name in CHANNELS)) as raw:
        packets = packets_of(raw, bench, PASSING_S)
        bench.expect(packets, "nothing came")
        for packet in packets:
            good = packet.key and len(packet.header) <= MAX_HEADER_BYTES
            bench.expect(good, f"{packet.key or 'no channel'}: {packet.payload[:60]!r}")


@SUITE.must("R-SOCK-17", "14.6 Messages", real=True)
def channel_anywhere(bench: Bench) -> None:
    """`channel` need not be the first field of the block."""
    with spoken(bench, "reply") as raw:
        fields = {"v": 1, "source": bench.access.watcher, "session": SESSION, "seq": 1, "channel": "request"}
        raw.send(BINARY, block(as_json(fields), b'{"id":1,"verb":"disarm"}'))
        bench.expect(is_answered(raw, bench), "a request whose block names its channel last is not answered")


@SUITE.must("R-SOCK-18", "14.6 Messages", real=True)
def fragments(bench: Bench) -> None:
    """A message may come in fragments, with pings between them."""
    with spoken(bench, "reply") as raw:
        message = disarm_request(bench)
        raw.send(BINARY, message[:20], fin=False)
        raw.send(PING, b"between")
        raw.send(CONTINUED, message[20:40], fin=False)
        raw.send(CONTINUED, message[40:])
        bench.expect(is_answered(raw, bench), "a request in three fragments is not answered")


@SUITE.must("R-SOCK-19", "14.8 Liveness", real=True)
def pings_are_answered(bench: Bench) -> None:
    """A ping is answered with its own data."""
    with spoken(bench) as raw:
        raw.send(PING, b"\0marco")
        frame = raw.frame_that(lambda one: one.opcode == PONG, SOON_S)
        bench.expect(frame is not None and frame.data == b"\0marco", f"the answer is {frame}")


def _breaks(send: Callable[[RawWebSocket], None], codes: tuple[int, ...], title: str, bench: Bench) -> None:
    with spoken(bench) as raw:
        send(raw)
        ends_with(raw, bench, codes, title)


_BREAKS: Final[dict[str, tuple[str, tuple[int, ...], Callable[[RawWebSocket], None]]]] = {
    "R-SOCK-20": ("A header block that is cut ends with 1007 or 1002.", (1002, 1007),
                  lambda raw: raw.send(BINARY, b"\x02\x00" + b'{"channel":"twist"}')),
    "R-SOCK-21": ("A header block over 576 bytes ends with 1007, 1002 or 1009.", (1002, 1007, 1009),
                  lambda raw: raw.send(BINARY, block(b'{"channel":"ack","x":"' + b"x" * MAX_BLOCK_BYTES + b'"}'))),
    "R-SOCK-22": ("A header block that names no channel ends with 1007 or 1002.", (1002, 1007),
                  lambda raw: raw.send(BINARY, block(b'{"v":1,"source":"viewer"}'))),
    "R-SOCK-23": ("Text that is not UTF-8 ends with 1007.", (1007,),
                  lambda raw: raw.send(TEXT, b'{"v":1,"robot":"\xff\xfe"}')),
    "R-SOCK-25": ("A frame of a client that is not masked ends with 1002.", (1002,),
                  lambda raw: raw.send(PING, b"bare", masked=False)),
    "R-SOCK-26": ("A reserved bit or opcode ends with 1002.", (1002,), lambda raw: raw.send(5, b"?")),
    "R-SOCK-27": ("A control frame over 125 bytes ends with 1002.", (1002,), lambda raw: raw.send(PING, b"x" * 200)),
}
SUITE.must_all(itself, {
    number: ("14.9 Ends", title, partial(_breaks, send, codes, title))
    for number, (title, codes, send) in _BREAKS.items()
}, real=True)


@SUITE.must("R-SOCK-24", "14.9 Ends", real=True)
def large_message(bench: Bench) -> None:
    """A message larger than the robot can want, 10 MB, ends with 1009."""
    with spoken(bench) as raw:
        raw.send(BINARY, b"\0" * 10_000_000)
        ends_with(raw, bench, (1009,), "10 MB", 2 * SOON_S)


@SUITE.must("R-SOCK-28", "14.9 Ends", real=True)
def bad_messages_end_nothing(bench: Bench) -> None:
    """A message of an unknown channel or source, or whose header is not JSON, is dropped; the connection stays."""
    with spoken(bench, "reply") as raw:
        bad = b'{"channel":"perfume"}', b'{"channel":"twist","source":"../x"}', b'{"channel":"twist","v":1,,}'
        for fields in bad:
            raw.send(BINARY, block(fields, b"1|1"))
        raw.send(BINARY, disarm_request(bench))
        bench.expect(is_answered(raw, bench), "after them a request is not answered")


@SUITE.must("R-SOCK-29", "14.8 Liveness", real=True)
def pings_every_second(bench: Bench) -> None:
    """The robot pings about every second."""
    with spoken(bench) as raw:
        packets_of(raw, bench, 3.2)
        bench.expect(raw.pings >= 2, f"{raw.pings} pings in 3.2 s")


@SUITE.must("R-SOCK-30", "14.8 Liveness", real=True)
def unanswered_pings_end(bench: Bench) -> None:
    """A peer that leaves pings unanswered is dropped within about two seconds."""
    with RawWebSocket(endpoint_of(bench), offered(bench), answers_pings=False) as raw:
        raw.send(TEXT, hello(bench))
        began_s = time.monotonic()
        end = raw.end(5.0)
        took_s = time.monotonic() - began_s
        bench.expect(end is not None and took_s < 4.0, f"after {took_s:.1f} s it is still connected")


@SUITE.must("R-SOCK-49", "14.8 Liveness", real=True)
def late_pongs_end_nothing(bench: Bench) -> None:
    """A peer that sends data is not silent: it stays, though its pongs come 1.3 s late."""
    with spoken(bench) as raw:
        raw.pongs_after_s = LATE_PONG_S
        for _ in range(20):
            raw.send(TEXT, hello(bench))
            end = raw.end(0.2)
            bench.expect(end is None, f"after {raw.pings} pings the connection ended: {end}")


@SUITE.must("R-SOCK-31", "13.2 Bounds", real=True)
def abrupt_ends(bench: Bench) -> None:
    """Connections that break off anywhere disturb no other client."""
    endpoint_of(bench)
    for opening in (b"", b"GET / HTTP/1.1\r\nHost: x", b"\x16\x03\x01\x02\0\x01\0" * 9):
        with RawWebSocket(bench.endpoint, offered(bench)) as raw:
            raw.write(opening)
    with spoken(bench, "frame") as raw:
        raw.send(BINARY, disarm_request(bench)[:9], fin=False)
    mark = bench.mark()
    bench.rest(1_000_000)
    came = len(bench.received(STATUS, mark))
    bench.expect(came >= 7, f"{came} status within a second after it")


@SUITE.should("R-SOCK-32", "14.4 Limits", real=True)
def sixteen_clients(bench: Bench) -> None:
    """After sixteen clients the next is rejected with 503, and those before are served."""
    with ExitStack() as ending:
        statuses, opened = [], list[RawWebSocket]()
        for _ in range(17):
            raw = ending.enter_context(RawWebSocket(endpoint_of(bench), offered(bench)))
            statuses.append(raw.status)
            raw.send(TEXT, hello(bench, role="operator"))  # fewer clients that only watch may be admitted
            opened.append(raw)
            for earlier in opened:
                earlier.frame(0.001)  # answers its pings: on a slow machine the first client may wait for seconds
            if raw.status != SWITCHED:
                break
        bench.expect(statuses[-1] == 503, f"seventeen more clients: {statuses}")
        mark = bench.mark()
        bench.expect_within(lambda: len(bench.received(STATUS, mark)) > 3, 1_500_000, "then no other client is served")


@SUITE.must("R-SOCK-33", "14.6 Messages", real=True)
def role_is_the_source(bench: Bench) -> None:
    """The `role` of the hello is the source of messages that name none."""
    operator = Sender(Robot(bench), "operator", acks=False)
    with spoken(bench, "reply", role="operator") as raw:
        fields = {"channel": "request", "v": 1, "session": SESSION, "seq": 1}

        def send() -> None:
            raw.send(BINARY, block(as_json(fields), b'{"id":1,"verb":"disarm"}'))

        result = operator.result_of(send)
        last = operator.robot.status().last_refusal
        reported = result == "MALFORMED" and last is not None and last.source == "operator"
        bench.expect(reported, f"a header without source is {result} as {last}")
        bench.expect(not bench.received(REPLY)[1:], "it was answered")


# Cases on reports of `sightline.v1` about blocks, hellos, late handshakes and detections. Shell (raw sockets).


_HANDSHAKE_S: Final = 4.0
"""Two seconds by the specification, and a margin for a slow machine."""


def _reason_given(bench: Bench, send: Callable[[], None]) -> tuple[str, str]:
    """Return the result of a message by `send`, and the sender that the robot assumed."""
    watcher = Sender(Robot(bench), bench.access.watcher, acks=False)
    result = watcher.result_of(send)
    last = watcher.robot.status().last_refusal
    return result, last.source if last else ""


@SUITE.must("R-SOCK-41", "12.3 Passing on", real=True)
def passes_detections_on(bench: Bench) -> None:
    """Detections are passed on, header and payload as they came, to every other peer that wants them."""
    _passed_on(bench, "detections", "vision", b'{"width_px":640, "height_px":480, "boxes":[]}')


_MISSIONS: Final = (
    ("mission", "operator", b'{"id":4711, "name":"follow"}'),
    ("report", "vision", b'{"mission":"follow", "phase":"looking"}'),
)


@SUITE.should("R-SOCK-47", "18.5 Passing on", real=True)
def passes_missions_on(bench: Bench) -> None:
    """Missions and reports are passed on to every other peer that wants them."""
    for channel, role, payload in _MISSIONS:
        bench.expect(_relay(bench, channel, role, payload).received, f"another peer that wants `{channel}` gets none")


@SUITE.must("R-SOCK-48", "18.5 Passing on", real=True)
def passes_missions_on_as_they_came(bench: Bench) -> None:
    """Missions and reports that are passed on leave as they came, once, and not back to their sender."""
    for channel, role, payload in _MISSIONS:
        relayed = _relay(bench, channel, role, payload)
        bench.need(relayed.received or relayed.returned, f"this robot passes no `{channel}` on (R-SOCK-47)")
        relayed.expect_as_sent(bench)


def _passed_on(bench: Bench, channel: str, role: str, payload: bytes) -> None:
    """Fail the case unless a message of `role` reaches another client once, unchanged, and is not returned."""
    _relay(bench, channel, role, payload).expect_as_sent(bench)


@dataclass(frozen=True, slots=True)
class _Relayed:
    """One message of a peer, its copies at another peer, and those returned to the sender."""

    channel: str
    header: bytes
    payload: bytes
    received: list[IncomingMessage]
    returned: list[IncomingMessage]

    def expect_as_sent(self, bench: Bench) -> None:
        """Fail the case unless it arrived once and unchanged, and did not return."""
        count = len(self.received)
        bench.expect(count == 1, f"another peer that wants `{self.channel}` gets {count} of one sent")
        came = self.received[0]
        bench.expect(came.payload == self.payload, f"the payload came as {came.payload[:80]!r}")
        bench.expect(came.header == self.header, f"the header came as {came.header[:120]!r}")
        bench.expect(not self.returned, f"the client that sent `{self.channel}` gets it back")


def _relay(bench: Bench, channel: str, role: str, payload: bytes) -> _Relayed:
    """Send one message of `role` while another peer wants it."""
    header = as_json({"v": 1, "source": role, "session": SESSION, "seq": 7, "note": "as it came"})
    with spoken(bench, channel) as other, spoken(bench, channel, role=role) as speaker:
        speaker.send(BINARY, block(b'{"channel":"%b",' % channel.encode() + header[1:], payload))
        received, returned = _packets_on(channel, other, bench, 1.0), _packets_on(channel, speaker, bench, 0.3)
    return _Relayed(channel, header, payload, received, returned)


def _packets_on(channel: str, raw: RawWebSocket, bench: Bench, for_s: float) -> list[IncomingMessage]:
    return [one for one in packets_of(raw, bench, for_s) if f"/{channel}/" in one.key]


@SUITE.must("R-SOCK-42", "14.4 Limits", real=True)
def late_handshake(bench: Bench) -> None:
    """A client that connects and requests nothing is dropped after two seconds."""
    _tls, address, port = split_url(endpoint_of(bench))
    with socket.create_connection((address, port), _HANDSHAKE_S) as near:
        began_s = time.monotonic()
        near.settimeout(_HANDSHAKE_S)
        try:
            reported = near.recv(4096)
            while reported:
                reported = near.recv(4096)
        except TimeoutError:
            bench.expect(False, f"after {_HANDSHAKE_S:g} s without a word it is still connected")
        except ConnectionError:
            pass
        took_s = time.monotonic() - began_s
        bench.expect(took_s > 0.5, f"it had {took_s:.1f} s, and 2 s are its right")


@SUITE.must("R-SOCK-43", "14.5 Hello", real=True)
def long_hello(bench: Bench) -> None:
    """A hello of more than 1024 bytes ends with 1009 or 1008."""
    with RawWebSocket(endpoint_of(bench), offered(bench)) as raw:
        bench.need(raw.status == SWITCHED, f"the handshake fails with {raw.status} (R-SOCK-01)")
        raw.send(TEXT, hello(bench, "status", note="x" * MAX_HELLO_BYTES))
        ends_with(raw, bench, (1008, 1009), "a hello of 1.1 kB")


@SUITE.must("R-SOCK-44", "14.5 Hello", real=True)
def hello_again_with_another_role(bench: Bench) -> None:
    """A later hello replaces the role too: messages that name no source are that one's from then on."""
    with spoken(bench, "reply", role="teleop") as raw:
        raw.send(TEXT, hello(bench, "reply", role="operator"))
        packets_of(raw, bench, 0.3)
        fields = {"channel": "request", "v": 1, "session": SESSION, "seq": 1}
        reported = _reason_given(bench, lambda: raw.send(BINARY, block(as_json(fields), b'{"id":1,"verb":"disarm"}')))
        bench.need(reported[0] == "MALFORMED", f"a header without source is {reported[0]} (R-SOCK-33)")
        bench.expect(reported[1] == "operator", f"after a hello as operator it is taken for {reported[1]}'s")


@SUITE.must("R-SOCK-51", "14.5 Hello", real=True)
def later_hello_that_is_none(bench: Bench) -> None:
    """A later hello is validated as the first: another robot, another version and no hello at all end with 1008."""
    for later in (hello(bench, robot="other"), hello(bench, v=2), b'{"let": "me in"}'):
        with spoken(bench) as raw:
            raw.send(TEXT, later)
            ends_with(raw, bench, (1008,), f"{later.decode()} after a good hello")


@SUITE.must("R-SOCK-50", "8.2 Requests and replies", real=True)
def replies_go_to_all(bench: Bench) -> None:
    """A reply goes to every peer that wants replies, not to the requester alone."""
    with spoken(bench, "reply") as raw, spoken(bench, "reply") as other:
        raw.send(BINARY, disarm_request(bench))
        bench.need(is_answered(raw, bench), "the requester gets no reply (R-REQ-01)")
        bench.expect(is_answered(other, bench), "another peer than the requester gets none")


@SUITE.must("R-SOCK-45", "14.6 Messages", real=True)
def block_without_header(bench: Bench) -> None:
    """A block of channel and source alone is a message without header: a guest's twist, or UNKNOWN_SOURCE."""
    bench.need(not bench.access.is_guarded, "where keys are required no guest is accepted")
    with spoken(bench, role="guest") as raw:
        result = _reason_given(
            bench, lambda: raw.send(BINARY, block(b'{"channel":"twist","source":"guest"}', b"0.1|0"))
        )[0]
        bench.expect(result in (GOOD, "UNKNOWN_SOURCE"), f"it was {result}")


@SUITE.must("R-SOCK-46", "14.6 Messages", real=True)
def header_that_is_no_json(bench: Bench) -> None:
    """A block that begins with its channel is of it, whatever follows: what is not JSON is counted as MALFORMED."""
    with spoken(bench, "reply", role="teleop") as raw:
        result, _source = _reason_given(bench, lambda: raw.send(BINARY, block(b'{"channel":"twist","v":1,,}', b"1|1")))
        bench.expect(result == "MALFORMED", f"it was {result}")
        bench.expect(raw.end(0.3) is None, "the connection ended")


# Cases on tokens: clients that may connect to a robot that demands one, and messages of a role. Shell (raw sockets).


_CLAUSE: Final = "14.3 Token"
_WRONG_TOKENS: Final = "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA"
"""A valid token that no role has."""


def _token(bench: Bench) -> str:
    endpoint_of(bench)
    token = bench.access.token_of(bench.access.watcher)
    bench.need(token, "no token was named (--token, or --secure): a robot on loopback need not request one")
    return token


@SUITE.must("R-SOCK-34", _CLAUSE, real=True)
def no_token(bench: Bench) -> None:
    """A client that shows no token is rejected with 401."""
    _token(bench)
    _answers(bench, 401, "no token", protocols=(SUBPROTOCOL,))


@SUITE.must("R-SOCK-35", _CLAUSE, real=True)
def wrong_token(bench: Bench) -> None:
    """A token of no role, or a part of the right one, is rejected with 401."""
    token = _token(bench)
    for what, wrong in (
        ("a token of no role", _WRONG_TOKENS),
        ("all but its last letter", token[:-1]),
        ("an empty one", ""),
    ):
        _answers(bench, 401, what, protocols=(SUBPROTOCOL, entry_of(wrong)))


@SUITE.must("R-SOCK-36", _CLAUSE, real=True)
def two_tokens(bench: Bench) -> None:
    """Two tokens, though one of them be right, are rejected with 401."""
    token = _token(bench)
    _answers(bench, 401, "a second entry", protocols=(SUBPROTOCOL, entry_of(token), entry_of(_WRONG_TOKENS)))
    shown = (("Authorization", f"Bearer {_WRONG_TOKENS}"),)
    _answers(bench, 401, "a second one as bearer", protocols=(SUBPROTOCOL, entry_of(token)), headers=shown)


@SUITE.must("R-SOCK-37", _CLAUSE, real=True)
def token_in_the_url(bench: Bench) -> None:
    """A token in the URL, which is logged, opens nothing: 401."""
    token = _token(bench)
    _answers(bench, 401, "a token in the URL", protocols=(SUBPROTOCOL,), path=f"/?token={token}")


@SUITE.must("R-SOCK-38", _CLAUSE, real=True)
def token_as_bearer(bench: Bench) -> None:
    """The token is taken as `Authorization: Bearer` too, and HTTP has that word in any case."""
    token = _token(bench)
    for word in ("Bearer", "bearer"):
        shown = (("Authorization", f"{word} {token}"),)
        _answers(bench, SWITCHED, f"the token as {word}", protocols=(SUBPROTOCOL,), headers=shown)


@SUITE.must("R-SOCK-39", _CLAUSE, real=True)
def token_is_not_repeated(bench: Bench) -> None:
    """Next to a token `sightline.v1` is selected, wherever it stands, and the token is never repeated."""
    token = _token(bench)
    for protocols in ((entry_of(token), SUBPROTOCOL), (SUBPROTOCOL, entry_of(token))):
        with RawWebSocket(endpoint_of(bench), protocols) as raw:
            bench.expect(raw.status == SWITCHED, f"offered {len(protocols)} entries: HTTP {raw.status}")
            selected = raw.headers.get("sec-websocket-protocol")
            bench.expect(selected == SUBPROTOCOL, "it selects the token" if token in str(selected) else f"{selected!r}")
            bench.expect(not any(token in text for text in raw.headers.values()), "it repeats the token")


@SUITE.must("R-SOCK-40", _CLAUSE, real=True)
def roles_are_kept_apart(bench: Bench) -> None:
    """A message that the token's role does not permit is dropped, and the connection stays."""
    _token(bench)
    bench.need(len(set(bench.access.tokens.values())) > 1, "one token stands for every role here")
    with RawWebSocket(endpoint_of(bench), offered(bench, source="vision")) as raw:
        raw.send(TEXT, hello(bench, "reply"))
        bench.need(raw.frame(SOON_S), "hello is not answered (R-SOCK-07)")
        raw.send(BINARY, disarm_request(bench))
        bench.expect(not is_answered(raw, bench), "with a vision service's token an operator's request was granted")
        raw.send(BINARY, block(b'{"channel":"ack","source":"vision"}'))
        bench.expect(raw.end(0.5) is None, "the connection ended")
