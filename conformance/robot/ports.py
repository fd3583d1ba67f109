"""Cases on the ports next to that of a link: the legacy text protocol, and STOP. Shell (sockets)."""

import binascii
import hmac
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.raw_peers import BINARY, TEXT, RawStopPort, RawWebSocket, split_url
from sightline.conformance.robot.fixture import (
    GOOD,
    NOT_COUNTED,
    SETTLES_US,
    WATCHED_AT_REST_US,
    Robot,
    Sender,
    moving,
)
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import State
from sightline.protocol.transports.stop_datagram import (
    NO_CHALLENGE,
    Kind,
    StopDatagram,
    StopRequests,
    pack_stop,
    unpack_stop,
)
from sightline.protocol.transports.stop_port import STOP_SECRET_FILE, read_secret

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
    """A client that connects without a sub-protocol gets images: text, base64, a JPEG."""
    with _legacy(bench) as raw:
        bench.expect(raw.status == _SWITCHED, f"HTTP {raw.status}")
        pictures = list(raw.messages(1.5))
        bench.expect(pictures, "no image within 1.5 s")
        good = [opcode == TEXT and _picture(text) for opcode, text in pictures]
        bench.expect(all(good), f"{len(good) - sum(map(bool, good))} of {len(good)} messages are not images as text")


@SUITE.should("R-DIAL-12", "15.1 On WebSocket: the legacy protocol", real=True)
def newlines(bench: Bench) -> None:
    """The base64 has a newline after every 76 characters and at the end (robots with `?oneline` have none)."""
    with _legacy(bench) as raw:
        texts = [text for opcode, text in raw.messages(1.5) if opcode == TEXT and _picture(text)]
        bench.need(texts, "no image as text (R-DIAL-11)")
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
        bench.need(silent, "no image (R-DIAL-11)")
        counts = f"{answered} images in {_COMPARED_S} s to a client that answers each, {silent} to a silent one"
        bench.expect(answered >= 1.5 * silent, counts)


@SUITE.must("R-DIAL-19", "15.2 On WebSocket: the legacy protocol", real=True)
def origins(bench: Bench) -> None:
    """An Origin that is the Host, as older libraries send it, is accepted; another site's fails with 403."""
    bench.need(bench.legacy, "no port of the legacy protocol was named (--older)")
    _tls, address, port = split_url(bench.legacy)
    for origin, status in ((f"http://{address}:{port}", _SWITCHED), ("http://evil.example.com", 403)):
        with _legacy(bench, headers=(("Origin", origin),)) as raw:
            bench.expect(raw.status == status, f"Origin {origin}: HTTP {raw.status}, expected {status}")


@SUITE.must("R-DIAL-20", "15.3 On WebSocket: the legacy protocol", real=True)
def several_clients(bench: Bench) -> None:
    """Several clients each get images."""
    with _legacy(bench) as first, _legacy(bench) as second:
        first_came, second_came = list(first.messages(1.2)), list(second.messages(0.8))
        bench.need(first_came or second_came, "no images (R-DIAL-11)")
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


# Cases on the STOP port, which a robot may leave out. Shell (sockets).


_STOP_EVERY_US: Final = 20_000
_STOP_US: Final = 1_000_000
_IGNORED_US: Final = 150_000
_NO_PORT: Final = "no STOP port answers (R-STOP-22)"
_COUNTERS: Final = 2**62
_HEAD_BYTES: Final = 80


class _StopPort:
    """The STOP port of the robot under test, and what it has answered."""

    def __init__(self, bench: Bench, port: RawStopPort) -> None:
        self.bench, self.port, self.robot = bench, port, Robot(bench)
        file = Path(bench.access.folder) / STOP_SECRET_FILE
        self.secret = read_secret(str(file)) if bench.access.folder and file.is_file() else b""
        self.challenge = NO_CHALLENGE
        self.answers: list[bytes] = []

    def send(self, data: bytes, within_us: int = _STOP_EVERY_US) -> list[bytes]:
        """Send a datagram. Returns the answers within that time, with a STOP secret those with its HMAC."""
        self.port.send(data)
        self.bench.rest(within_us)
        # A router answers a STOP without an HMAC itself, in the same way (20.6).
        answers = [one for one in self.port.received() if not self.secret or one == self.signed(one[:_HEAD_BYTES])]
        self.answers += answers
        return answers

    def stop_until_proven(self) -> StopRequests:
        """Repeat STOP as a sender does, until an answer proves that the robot has stopped, at most for a second."""
        requests = StopRequests(self.bench.robot, self.secret, self._counter())
        for _ in range(_STOP_US // _STOP_EVERY_US):  # counted, because the kit may have no processor for a while
            if requests.is_stopped:
                break
            for data in requests.datagrams():
                for answer in self.send(data):
                    requests.on_datagram(answer)
        self.bench.need(not requests.lacks_secret, "its STOP port requires a STOP secret; none was named (--secure)")
        return requests

    def need_answers(self) -> None:
        """Leave the case as not applicable if the STOP port has not answered."""
        self.bench.need(self.answers, _NO_PORT)

    def datagram(self, secret: bytes | None = None, **fields: Any) -> bytes:
        """Return a STOP that this robot accepts, or one with other fields or another secret."""
        usual = StopDatagram(Kind.STOP, self.bench.robot, self._counter(), self.challenge)
        return pack_stop(usual._replace(**fields), self.secret if secret is None else secret)

    def signed(self, head: bytes) -> bytes:
        """Return any datagram with the HMAC of its first 80 bytes, or zeros without a secret."""
        return head + (hmac.digest(self.secret, head, "sha256") if self.secret else bytes(32))

    def learn_challenge(self) -> None:
        """Request the challenge of a robot with a STOP secret, once, so that no answer comes later."""
        if self.secret:
            answers = self.send(self.datagram(challenge=NO_CHALLENGE), _STOP_US)
            self.bench.need(answers, _NO_PORT)
            self.challenge = unpack_stop(answers[0]).challenge

    def expect_ignored(self, data: bytes, what: str) -> None:
        """Fail the case if this datagram is answered or stops the robot."""
        self.bench.expect(not self.send(data, _IGNORED_US), f"{what} is answered")
        self.bench.expect(self.robot.next_status(2).state is not State.STOPPED, f"{what} stops the robot")

    @staticmethod
    def _counter() -> int:
        return secrets.randbelow(_COUNTERS)


@contextmanager
def _stop_port(bench: Bench) -> Iterator[_StopPort]:
    with RawStopPort(bench.endpoint) as port:
        yield _StopPort(bench, port)


@SUITE.should("R-STOP-22", "20.1 Port", real=True)
def has_a_stop_port(bench: Bench) -> None:
    """A STOP by UDP at the next higher port than that of the link is answered."""
    with _stop_port(bench) as port:
        answered = any(port.send(port.datagram()) for _ in range(_STOP_US // _STOP_EVERY_US))
        bench.expect(answered, "no answer within a second")


@SUITE.must("R-STOP-23", "20.3 Answer", moving, real=True)
def stops_by_datagram(bench: Bench, driver: Sender) -> None:
    """STOP by UDP while driving: STOPPED is reported within 300 ms, and the wheels are at zero within 700 ms."""
    robot = driver.robot
    with _stop_port(bench) as port:
        port.learn_challenge()
        requested_us = robot.clock_us()
        port.send(port.datagram())
        port.stop_until_proven()
        stopped = robot.becomes(State.STOPPED, within_us=300_000)
        bench.need(port.answers or stopped, _NO_PORT)
        bench.expect(stopped, f"after its answer it is {robot.status().state}: {robot.status().reason}")
        bench.rest(700_000 + SETTLES_US + WATCHED_AT_REST_US)
        robot.expect_unmoved("a second after STOP", requested_us + 700_000 + SETTLES_US)


@SUITE.must("R-STOP-24", "20.3 Answer", real=True)
def answers_prove_the_stop(bench: Bench) -> None:
    """Answers have 112 bytes, the id of the robot, the counter of the STOP, and its proof: STOPPED, at zero, number."""
    with _stop_port(bench) as port:
        requests = port.stop_until_proven()
        port.need_answers()
        one = requests.answer
        bench.expect(one is not None, "no answer has 112 bytes, the robot's id and the counter of a STOP")
        assert one is not None
        bench.expect(requests.is_stopped, f"the last answer has state {one.state}, wheels at zero: {one.at_rest}, and "
                     f"applied {one.applied} of {one.received} STOPs")


@SUITE.must("R-STOP-25", "20.2 Datagram", real=True)
def other_datagrams_stop_nothing(bench: Bench) -> None:
    """A datagram of another length, version, kind or robot stops nothing and gets no answer."""
    with _stop_port(bench) as port:
        port.learn_challenge()
        good = port.datagram()
        head = good[:_HEAD_BYTES]
        for data, what in (
            (good[:-1], "a datagram of 111 bytes"), (good + b"\0", "a datagram of 113 bytes"),
            (port.signed(b"HALT" + head[4:]), "a datagram that begins with HALT"),
            (port.signed(head[:4] + b"\2" + head[5:]), "a datagram of version 2"),
            (port.datagram(kind=Kind.ANSWER), "an answer"), (port.datagram(robot="another"), "a STOP of another robot"),
        ):  # fmt: skip
            port.expect_ignored(data, what)
        port.answers.clear()
        port.stop_until_proven()
        port.need_answers()


@SUITE.must("R-STOP-26", "20.5 Keys", real=True)
def stops_need_the_secret(bench: Bench) -> None:
    """With a STOP secret, a STOP without its HMAC or of another challenge stops nothing and gets no signed answer."""
    with _stop_port(bench) as port:
        bench.need(port.secret, "no STOP secret was named (--secure)")
        port.learn_challenge()
        for data, what in (
            (port.datagram(secret=b""), "a STOP without an HMAC"),
            (port.datagram(secret=port.secret[::-1] + b"x"), "a STOP with the HMAC of another secret"),
            (port.datagram(challenge=bytes(range(16))), "a STOP with another challenge"),
        ):
            port.expect_ignored(data, what)
        port.answers.clear()
        port.stop_until_proven()
        port.need_answers()
