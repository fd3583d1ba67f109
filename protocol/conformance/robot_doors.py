"""Cases on what `sightline.v1` says of blocks, hellos, late handshakes and detections. Shell (raw sockets)."""

import socket
import time
from collections.abc import Callable
from typing import Any, Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.raw_peers import BINARY, TEXT, RawWebSocket, split_url
from sightline.conformance.robot.fixture import GOOD, Robot, Sender, as_json
from sightline.conformance.robot.websocket import (
    SESSION,
    SWITCHED,
    block,
    endpoint_of,
    ends_with,
    hello,
    offered,
    packets_of,
    spoken,
)
from sightline.protocol.transports.websocket.framing import MAX_HELLO_BYTES, IncomingMessage

SUITE: Final = Suite("R")
_HANDSHAKE_S: Final = 4.0
"""Two seconds by the specification, and room for a slow machine."""


def _reason_given(bench: Bench, send: Callable[[], None]) -> tuple[str, str]:
    """What became of what `send` sends, and whom the robot took for its sender."""
    watcher = Sender(Robot(bench), bench.access.watcher, acks=False)
    verdict = watcher.verdict(send)
    last = watcher.robot.status().last_refusal
    return verdict, last.source if last else ""


@SUITE.must("R-SOCK-41", "12.3 Passing on", real=True)
def passes_detections_on(bench: Bench) -> None:
    """Detections are passed on, header and payload as they came, to every other peer that wants them."""
    _passed_on(bench, "detections", "vision", b'{"width_px":640, "height_px":480, "boxes":[]}')


@SUITE.must("R-SOCK-47", "18.5 Passing on", real=True)
def passes_missions_on(bench: Bench) -> None:
    """Missions and reports are passed on as detections are."""
    _passed_on(bench, "mission", "operator", b'{"id":4711, "name":"follow"}')
    _passed_on(bench, "report", "vision", b'{"mission":"follow", "phase":"looking"}')


def _passed_on(bench: Bench, channel: str, role: str, payload: bytes) -> None:
    """Fail the case unless what `role` says on `channel` comes to another, once and as it was, and not back."""
    fields: dict[str, Any] = {"v": 1, "source": role, "session": SESSION, "seq": 7, "note": "as it came"}
    with spoken(bench, channel) as other, spoken(bench, channel, role=role) as speaker:
        speaker.send(BINARY, block(b'{"channel":"%b",' % channel.encode() + as_json(fields)[1:], payload))
        heard = _said_on(channel, other, bench, 1.0)
        bench.expect(len(heard) == 1, f"another peer that wants `{channel}` gets {len(heard)} of one that was said")
        bench.expect(heard[0].payload == payload, f"the payload came as {heard[0].payload[:80]!r}")
        bench.expect(heard[0].header == as_json(fields), f"the header came as {heard[0].header[:120]!r}")
        bench.expect(not _said_on(channel, speaker, bench, 0.3), f"who said `{channel}` gets it back")


def _said_on(channel: str, raw: RawWebSocket, bench: Bench, for_s: float) -> list[IncomingMessage]:
    return [one for one in packets_of(raw, bench, for_s) if f"/{channel}/" in one.key]


@SUITE.must("R-SOCK-42", "14.4 Limits", real=True)
def late_handshake(bench: Bench) -> None:
    """Who connects and asks for nothing is dropped after two seconds."""
    _tls, address, port = split_url(endpoint_of(bench))
    with socket.create_connection((address, port), _HANDSHAKE_S) as near:
        began_s = time.monotonic()
        near.settimeout(_HANDSHAKE_S)
        try:
            said = near.recv(4096)
            while said:
                said = near.recv(4096)
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
        told = _reason_given(bench, lambda: raw.send(BINARY, block(as_json(fields), b'{"id":1,"verb":"disarm"}')))
        bench.need(told[0] == "MALFORMED", f"a header without source is {told[0] or 'not counted'} (R-SOCK-33)")
        bench.expect(told[1] == "operator", f"after a hello as operator it is taken for {told[1]}'s")


@SUITE.must("R-SOCK-45", "14.6 Messages", real=True)
def block_without_header(bench: Bench) -> None:
    """A block of channel and source alone is a message without header: a guest's twist, or UNKNOWN_SOURCE."""
    bench.need(not bench.access.is_guarded, "where keys are asked for no guest gets in")
    with spoken(bench, role="guest") as raw:
        verdict = _reason_given(bench, lambda: raw.send(BINARY, block(b'{"channel":"twist","source":"guest"}', b"0.1|0")))[0]
        bench.expect(verdict in (GOOD, "UNKNOWN_SOURCE"), f"it was {verdict or 'not counted'}")


@SUITE.must("R-SOCK-46", "14.6 Messages", real=True)
def header_that_is_no_json(bench: Bench) -> None:
    """A block that begins with its channel is of it, whatever follows: what is no JSON is counted as MALFORMED."""
    with spoken(bench, "reply", role="teleop") as raw:
        verdict, _source = _reason_given(bench, lambda: raw.send(BINARY, block(b'{"channel":"twist","v":1,,}', b"1|1")))
        bench.expect(verdict == "MALFORMED", f"it was {verdict or 'not counted'}")
        bench.expect(raw.end(0.3) is None, "the connection ended")
