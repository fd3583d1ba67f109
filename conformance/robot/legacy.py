"""Cases on the port of the legacy text protocol. Shell (sockets)."""

import binascii
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.raw_peers import BINARY, TEXT, RawWebSocket, split_url
from sightline.conformance.robot.fixture import GOOD, NOT_COUNTED, Robot, Sender
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size

SUITE: Final = Suite("R")
_LINE: Final = 76
_SWITCHED: Final = 101
_SILENT_S: Final = 1.5
_COMPARED_S: Final = 1.3


@contextmanager
def _legacy(bench: Bench, **options: Any) -> Iterator[RawWebSocket]:
    bench.need(bench.legacy, "no port of the legacy protocol was named (--older)")
    with RawWebSocket(bench.legacy, protocols=(), **options) as raw:
        yield raw


def _picture(text: bytes) -> bytes:
    """Return the JPEG in a message; empty without one."""
    try:
        data = binascii.a2b_base64(text)
        read_jpeg_size(data)
    except (ValueError, WireError):
        return b""
    return data


@SUITE.must("R-DIAL-11", "15.1 On WebSocket: the legacy protocol", real=True)
def pictures_as_text(bench: Bench) -> None:
    """A client that connects without a sub-protocol gets pictures: text, base64, a JPEG."""
    with _legacy(bench) as raw:
        bench.expect(raw.status == _SWITCHED, f"HTTP {raw.status}")
        pictures = list(raw.messages(1.5))
        bench.expect(pictures, "no picture within 1.5 s")
        good = [opcode == TEXT and _picture(text) for opcode, text in pictures]
        bench.expect(all(good), f"{len(good) - sum(map(bool, good))} of {len(good)} messages are not images as text")


@SUITE.should("R-DIAL-12", "15.1 On WebSocket: the legacy protocol", real=True)
def newlines(bench: Bench) -> None:
    """The base64 has a newline after every 76 characters and at the end (robots with `?oneline` have none)."""
    with _legacy(bench) as raw:
        texts = [text for opcode, text in raw.messages(1.5) if opcode == TEXT and _picture(text)]
        bench.need(texts, "no picture as text (R-DIAL-11)")
        for text in texts:
            *lines, last = text.split(b"\n")
            bench.expect(lines and last == b"", "there is no newline at the end")
            bench.expect(all(len(line) == _LINE for line in lines[:-1]), "its lines are not of 76 characters")


@SUITE.must("R-DIAL-13", "15.2 On WebSocket: the legacy protocol", real=True)
def commands_as_text(bench: Bench) -> None:
    """`linear|angular` is validated as a twist of `guest`."""
    watcher = Sender(Robot(bench), bench.access.watcher, acks=False)
    with _legacy(bench) as raw:
        result = watcher.result_of(lambda: raw.send(TEXT, b"0.1|0"))
        bench.expect(result in (GOOD, "UNKNOWN_SOURCE"), f"it was {result}")


@SUITE.must("R-DIAL-14", "15.2 On WebSocket: the legacy protocol", real=True)
def no_binary(bench: Bench) -> None:
    """A binary message ends the connection with 1003."""
    with _legacy(bench) as raw:
        raw.send(BINARY, b"0.1|0")
        end = raw.end(2.5)
        bench.expect(end is not None and end[0] == 1003, f"it ends with {end}")


@SUITE.must("R-DIAL-15", "15.2 On WebSocket: the legacy protocol", real=True)
def no_long_texts(bench: Bench) -> None:
    """A text over 256 bytes ends the connection."""
    with _legacy(bench) as raw:
        raw.send(TEXT, b"0" * 300 + b"|0")
        bench.expect(raw.end(2.5) is not None, "the connection stays open")


@SUITE.must("R-DIAL-16", "15.2 On WebSocket: the legacy protocol", real=True)
def ill_formed_stays(bench: Bench) -> None:
    """An ill-formed twist is rejected and counted; the connection stays."""
    watcher = Sender(Robot(bench), bench.access.watcher, acks=False)
    with _legacy(bench) as raw:
        counted = watcher.result_of(lambda: raw.send(TEXT, b"0.1|0")) != NOT_COUNTED
        bench.need(counted, "twists are not validated here (R-DIAL-13)")
        before = sum(watcher.robot.status().refused.values())
        raw.send(TEXT, b"1|2|3")
        counted = watcher.robot.reaches(lambda status: sum(status.refused.values()) > before, 1_000_000)
        bench.expect(raw.end(0.5) is None, "the connection ended")
        bench.expect(counted, "it was not counted")


@SUITE.must("R-DIAL-17", "15.3 On WebSocket: the legacy protocol", real=True)
def silent_clients_stay(bench: Bench) -> None:
    """A client that neither sends nor reads anything for a second and a half stays."""
    with _legacy(bench, answers_pings=True) as raw:
        time.sleep(_SILENT_S)
        bench.expect(raw.end(0.8) is None, "the connection ended")


@SUITE.must("R-DIAL-18", "15.3 On WebSocket: the legacy protocol", real=True)
def twists_return_credit(bench: Bench) -> None:
    """A twist after a frame returns the credit: a client that answers receives image after image."""
    with _legacy(bench) as raw:
        silent = len(list(raw.messages(_COMPARED_S)))
        answered = 0
        for _ in raw.messages(_COMPARED_S):
            answered += 1
            raw.send(TEXT, b"0|0")
        bench.need(silent, "no picture (R-DIAL-11)")
        counts = f"{answered} pictures in {_COMPARED_S} s to a client that answers each, {silent} to a silent one"
        bench.expect(answered >= 1.5 * silent, counts)


@SUITE.must("R-DIAL-19", "15.2 On WebSocket: the legacy protocol", real=True)
def origins(bench: Bench) -> None:
    """An Origin that is the Host, as older libraries send it, is let in; another site's fails with 403."""
    bench.need(bench.legacy, "no port of the legacy protocol was named (--older)")
    _tls, address, port = split_url(bench.legacy)
    for origin, status in ((f"http://{address}:{port}", _SWITCHED), ("http://evil.example.com", 403)):
        with _legacy(bench, headers=(("Origin", origin),)) as raw:
            bench.expect(raw.status == status, f"Origin {origin}: HTTP {raw.status}, expected {status}")


@SUITE.must("R-DIAL-20", "15.3 On WebSocket: the legacy protocol", real=True)
def several_clients(bench: Bench) -> None:
    """Several clients each get pictures."""
    with _legacy(bench) as first, _legacy(bench) as second:
        first_came, second_came = list(first.messages(1.2)), list(second.messages(0.8))
        bench.need(first_came or second_came, "no pictures (R-DIAL-11)")
        bench.expect(first_came and second_came, f"{len(first_came)} to the first, {len(second_came)} to the second")


@SUITE.must("R-DIAL-21", "15.3 On WebSocket: the legacy protocol", real=True)
def first_client_drives(bench: Bench) -> None:
    """The first of several clients with a valid twist drives; a twist of another client is NOT_HOLDER."""
    watcher = Sender(Robot(bench), bench.access.watcher, acks=False)
    with _legacy(bench) as first, _legacy(bench) as second:
        result = watcher.result_of(lambda: first.send(TEXT, b"0.1|0"))
        bench.need(result == GOOD, f"guests are not received here: {result}")
        first.send(TEXT, b"0.1|0")
        watcher.robot.next_status(2)
        watcher.expect_result("NOT_HOLDER", lambda: second.send(TEXT, b"0.1|0"), what="a second client's twist")


@SUITE.must("R-DIAL-22", "15.2 On WebSocket: the legacy protocol", real=True)
def hosts(bench: Bench) -> None:
    """A Host that a foreign site could own fails with 403 on this port too."""
    with _legacy(bench, host="evil.example.com:9091") as raw:
        bench.expect(raw.status == 403, f"HTTP {raw.status}, expected 403")
