"""Cases on the messages of `sightline.v1` after hello: framing, pings, and how a bad one ends. Shell (sockets)."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from sightline.protocol.channels import CHANNELS, MAX_HEADER_BYTES, REPLY, STATUS
from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.raw_peers import BINARY, CONTINUED, PING, PONG, TEXT, Frame, RawWebSocket
from sightline.conformance.robot.fixture import Robot, Sender, as_json
from sightline.conformance.robot.websocket import (
    PASSING_S,
    SESSION,
    SOON_S,
    SWITCHED,
    block,
    disarm_request,
    endpoint_of,
    ends_with,
    hello,
    is_answered,
    offered,
    packets_of,
    spoken,
)
from sightline.protocol.transports.websocket.framing import MAX_BLOCK_BYTES

SUITE: Final = Suite("R")


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
        frame = _next(raw, PONG)
        bench.expect(frame is not None and frame.data == b"\0marco", f"the answer is {frame}")


def _next(raw: RawWebSocket, opcode: int) -> Frame | None:
    until_s = time.monotonic() + SOON_S
    while (left_s := until_s - time.monotonic()) > 0:
        frame = raw.frame(left_s)
        if frame is not None and frame.opcode == opcode:
            return frame
    return None


def _breaks(
    number: str, title: str, codes: tuple[int, ...], message: Callable[[RawWebSocket], None], within_s: float = SOON_S
) -> None:
    def run(bench: Bench) -> None:
        with spoken(bench) as raw:
            message(raw)
            ends_with(raw, bench, codes, title, within_s)

    run.__doc__ = title
    SUITE.must(number, "14.9 Ends", real=True)(run)


_breaks("R-SOCK-20", "A header block that is cut ends with 1007 or 1002.", (1002, 1007),
        lambda raw: raw.send(BINARY, b"\x02\x00" + b'{"channel":"twist"}'))  # fmt: skip
_breaks("R-SOCK-21", "A header block over 576 bytes ends with 1007, 1002 or 1009.", (1002, 1007, 1009),
        lambda raw: raw.send(BINARY, block(b'{"channel":"ack","x":"' + b"x" * MAX_BLOCK_BYTES + b'"}')))  # fmt: skip
_breaks("R-SOCK-22", "A header block that names no channel ends with 1007 or 1002.", (1002, 1007),
        lambda raw: raw.send(BINARY, block(b'{"v":1,"source":"viewer"}')))  # fmt: skip
_breaks("R-SOCK-23", "Text that is not UTF-8 ends with 1007.", (1007,),
        lambda raw: raw.send(TEXT, b'{"v":1,"robot":"\xff\xfe"}'))  # fmt: skip
_breaks("R-SOCK-24", "A message larger than the robot can want, 10 MB, ends with 1009.", (1009,),
        lambda raw: raw.send(BINARY, b"\0" * 10_000_000), 5.0)  # fmt: skip
_breaks("R-SOCK-25", "A frame of a client that is not masked ends with 1002.", (1002,),
        lambda raw: raw.send(PING, b"bare", masked=False))  # fmt: skip
_breaks("R-SOCK-26", "A reserved bit or opcode ends with 1002.", (1002,),
        lambda raw: raw.send(5, b"?"))  # fmt: skip
_breaks("R-SOCK-27", "A control frame over 125 bytes ends with 1002.", (1002,),
        lambda raw: raw.send(PING, b"x" * 200))  # fmt: skip


@SUITE.must("R-SOCK-28", "14.9 Ends", real=True)
def bad_messages_end_nothing(bench: Bench) -> None:
    """A message of an unknown channel or source, or whose header is no JSON, is dropped; the connection stays."""
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
def the_deaf_are_dropped(bench: Bench) -> None:
    """A peer that leaves pings unanswered is dropped within about two seconds."""
    with RawWebSocket(endpoint_of(bench), offered(bench), answers_pings=False) as raw:
        raw.send(TEXT, hello(bench))
        began_s = time.monotonic()
        end = raw.end(5.0)
        took_s = time.monotonic() - began_s
        bench.expect(end is not None and took_s < 4.0, f"after {took_s:.1f} s it is still connected")


@SUITE.must("R-SOCK-31", "13.2 Bounds", real=True)
def abrupt_ends(bench: Bench) -> None:
    """Connections that break off anywhere disturb nobody else."""
    endpoint_of(bench)
    for opening in (b"", b"GET / HTTP/1.1\r\nHost: x", b"\x16\x03\x01\x02\0\x01\0" * 9):
        with RawWebSocket(bench.endpoint, offered(bench)) as raw:
            raw.write(opening)
    with spoken(bench, "frame") as raw:
        raw.send(BINARY, disarm_request(bench)[:9], fin=False)
    mark = bench.mark()
    bench.rest(1_000_000)
    came = len(bench.heard(STATUS, mark))
    bench.expect(came >= 7, f"{came} status within a second after it")


@SUITE.should("R-SOCK-32", "14.4 Limits", real=True)
def sixteen_clients(bench: Bench) -> None:
    """After sixteen clients the next is refused with 503, and those before are served."""
    with ExitStack() as ending:
        statuses, opened = [], list[RawWebSocket]()
        for _ in range(17):
            raw = ending.enter_context(RawWebSocket(endpoint_of(bench), offered(bench)))
            statuses.append(raw.status)
            raw.send(TEXT, hello(bench, role="operator"))  # of those who only watch, fewer may come in
            opened.append(raw)
            for earlier in opened:
                earlier.frame(0.001)  # answers its pings: on a slow machine the first may wait for seconds
            if raw.status != SWITCHED:
                break
        bench.expect(statuses[-1] == 503, f"seventeen more clients: {statuses}")
        mark = bench.mark()
        bench.expect_within(lambda: len(bench.heard(STATUS, mark)) > 3, 1_500_000, "then nobody else is served")


@SUITE.must("R-SOCK-33", "14.6 Messages", real=True)
def says_hello_to_many_roles(bench: Bench) -> None:
    """The `role` of the hello is the source of messages that name none."""
    operator = Sender(Robot(bench), "operator", acks=False)
    with spoken(bench, "reply", role="operator") as raw:
        fields = {"channel": "request", "v": 1, "session": SESSION, "seq": 1}

        def send() -> None:
            raw.send(BINARY, block(as_json(fields), b'{"id":1,"verb":"disarm"}'))

        verdict = operator.verdict(send)
        last = operator.robot.status().last_refusal
        told = verdict == "MALFORMED" and last is not None and last.source == "operator"
        bench.expect(told, f"a header without source is {verdict or 'not counted'} as {last}")
        bench.expect(not bench.heard(REPLY)[1:], "it was answered")
