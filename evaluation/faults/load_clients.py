"""Floods: many viewers, abandoned connections, sessions, and invalid STOP datagrams. Shell.

    python -m sightline.evaluation.faults.load_clients KIND ENDPOINT LEDGER

It represents other machines, so it uses little of this processor. A client that is rejected or dropped connects again,
forever. The first viewers are operators, which have reserved places.
"""

import itertools
import os
import secrets
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sightline.evaluation.faults.evidence import INJECTED, EventLog
from sightline.protocol.channels import FRAME
from sightline.protocol.codec import encode
from sightline.protocol.errors import LinkError
from sightline.protocol.transports.endpoints import parse_websocket_endpoint, parse_zenoh_endpoint, stop_addresses
from sightline.protocol.transports.stop_datagram import CHALLENGE_BYTES, Kind, StopDatagram, pack_stop, unpack_stop
from sightline.protocol.transports.stop_port import read_secret, stop_secret_file
from sightline.protocol.transports.websocket.client import Client
from sightline.protocol.transports.websocket.framing import MAX_BLOCK_BYTES, Hello
from sightline.protocol.transports.websocket.peer import OPEN_S
from sightline.protocol.transports.websocket.server import RESERVED_SLOTS

if TYPE_CHECKING:
    from sightline.protocol.transports.websocket.connection import Connection

ADMITTED: Final = "admitted"
ANSWERED: Final = "answered"
SEEN: Final = "seen"
READY: Final = "all have knocked"
VIEWERS: Final = 100
HANDSHAKES: Final = 500
_NOT_READING_S: Final = 3.0
_POLITE: Final = 10
_AGAIN_S: Final = 0.25
_BEGUN: Final = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgr"


class LoadViewer:
    """One viewer. With `reads` False it reads only the hello from its connection."""

    def __init__(self, event_log: EventLog, role: str, *, reads: bool) -> None:
        self._event_log, self._reads = event_log, reads
        hello = Hello(robot="r1", role=role, session=secrets.token_hex(4), wants=(FRAME.name,))
        self._hello = encode(hello).decode("ascii")
        self.admitted = False

    def watch(self, wire: "Connection") -> None:
        """Send hello and receive frames until the robot closes the connection."""
        wire.protocol.max_message_size = MAX_BLOCK_BYTES + FRAME.max_payload_bytes
        wire.send_text(self._hello)
        wire.receive_one(time.monotonic() + OPEN_S)  # the robot's hello, which confirms a place
        self.admitted = True
        self._event_log.note(ADMITTED)
        if not self._reads:
            time.sleep(_NOT_READING_S)
            return
        while True:
            for message in wire.receive():
                if isinstance(message, bytes):
                    self._event_log.note(SEEN)
            wire.wait(_AGAIN_S)


def view(endpoint: str, event_log: EventLog) -> None:
    """Keep all viewers connected forever."""
    roles = ["operator"] * RESERVED_SLOTS + ["viewer"] * (VIEWERS - RESERVED_SLOTS)
    viewers = [LoadViewer(event_log, role, reads=number != RESERVED_SLOTS) for number, role in enumerate(roles)]
    dialers = [Client(parse_websocket_endpoint(endpoint), viewer.watch, lambda _reason: None) for viewer in viewers]
    waiting = list(zip(viewers, dialers, strict=True))
    while waiting:
        knocked = [pair for pair in waiting if pair[0].admitted or pair[1].trouble]
        for pair in knocked:
            event_log.note(INJECTED)
            waiting.remove(pair)
        time.sleep(_AGAIN_S)
    print(READY, flush=True)
    threading.Event().wait()


def leave_handshakes(endpoint: str, event_log: EventLog) -> None:
    """Open half-finished handshakes, and reopen those that the robot has closed."""
    end = parse_websocket_endpoint(endpoint)
    begun: list[socket.socket] = []
    logged = False
    while True:
        begun = [one for one in begun if _is_open(one)]
        while len(begun) < HANDSHAKES:
            begun.append(_begin(end.host, end.port))
            event_log.note(INJECTED)
        if not logged:
            logged = True
            print(READY, flush=True)
        time.sleep(_AGAIN_S)


def _begin(host: str, port: int) -> socket.socket:
    one = socket.create_connection((host, port), 5.0)
    one.setblocking(False)
    one.send(_BEGUN)
    return one


def _is_open(one: socket.socket, on_data: Callable[[], None] = lambda: None) -> bool:
    try:
        if one.recv(4096):
            on_data()
            return True
    except BlockingIOError:
        return True
    except OSError:
        pass
    one.close()
    return False


# Floods at the port of a Zenoh link, by a program that has no keys.


FEW_HZ: Final = 25
MANY_HZ: Final = 500
HALF_OPEN: Final = 700
SESSIONS: Final = 63


def _place(endpoint: str) -> tuple[str, int]:
    if "://" in endpoint:
        web = parse_websocket_endpoint(endpoint)
        return web.host, web.port
    _, host, port = parse_zenoh_endpoint(endpoint)
    return host, port


def connect_often(endpoint: str, event_log: EventLog, rate_hz: int) -> None:
    """Open connections at a rate and close them immediately."""
    print(READY, flush=True)
    started_s, count = time.monotonic(), 0
    while True:
        with suppress(OSError):  # e.g. the backlog of the port is full
            socket.create_connection(_place(endpoint), 1.0).close()
            event_log.note(INJECTED)
        count += 1
        time.sleep(max(0.0, started_s + count / rate_hz - time.monotonic()))


def client_hello() -> bytes:
    """Return the first message of a TLS handshake."""
    received, sent = ssl.MemoryBIO(), ssl.MemoryBIO()
    with suppress(ssl.SSLWantReadError):
        ssl.create_default_context().wrap_bio(received, sent, server_hostname="localhost").do_handshake()
    return sent.read()


def leave_half_open(endpoint: str, event_log: EventLog, first: bytes = b"") -> None:
    """Open connections, send no more than `first`, and reopen those that the other end closes."""
    begun: list[socket.socket] = []
    is_reported = False
    while True:
        begun = [one for one in begun if _is_open(one, partial(event_log.note, ANSWERED))]
        with suppress(OSError):
            while len(begun) < HALF_OPEN:
                one = socket.socket()
                one.setblocking(False)
                one.connect_ex(_place(endpoint))
                begun.append(one)
                if first:
                    one.send(first)
                event_log.note(INJECTED)
        if not is_reported:
            is_reported = True
            print(READY, flush=True)
        time.sleep(_AGAIN_S)


def open_sessions(endpoint: str, event_log: EventLog) -> None:
    """Open as many Zenoh sessions as the other end accepts."""
    from sightline.protocol.transports.zenoh.session import open_session

    sessions = []
    for number in range(SESSIONS):
        with suppress(LinkError):
            sessions.append(open_session((), [endpoint], 1.0))
            event_log.note(INJECTED)
        if number == SESSIONS // 2:
            print(READY, flush=True)
    threading.Event().wait()


HUGE_BYTES: Final = 1_000_000
PUBLISHED_HZ: Final = 10_000
PUBLISHED_EACH: Final = 1000
"""Small twists for each event in the event log."""
_PUBLISHED_AT_ONCE: Final = 50


def publish_much(endpoint: str, event_log: EventLog) -> None:
    """Publish small twists as often as possible, up to 10 kHz, and payloads of 1 MB; all attachments are malformed."""
    from sightline.protocol.transports.zenoh.session import open_session

    with open_session((), [endpoint], 5.0) as session:
        print(READY, flush=True)
        started_s = time.monotonic()
        for count in itertools.count(_PUBLISHED_AT_ONCE, _PUBLISHED_AT_ONCE):
            for _ in range(_PUBLISHED_AT_ONCE):
                session.put("sightline/r1/twist/vision", b"0.5|0.0", attachment=b"{" * 100)
            if count % PUBLISHED_EACH == 0:
                session.put("sightline/r1/twist/vision", bytes(HUGE_BYTES), attachment=b"{" * 100)
                event_log.note(INJECTED)
            time.sleep(max(0.0, started_s + count / PUBLISHED_HZ - time.monotonic()))


# Invalid STOP datagrams, as fast as this process can send.


LONGEST: Final = 2000
FLOOD_S: Final = 10.0


def send_garbage(endpoint: str, event_log: EventLog) -> None:
    """Send datagrams of every length, for another robot, with a wrong HMAC, and a returned answer. Prints the rate."""
    [place] = stop_addresses([endpoint])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.connect(place)
        one.send(pack_stop(StopDatagram(Kind.STOP, "r1", 1)))
        challenge = unpack_stop(answer := one.recv(LONGEST)).challenge
        others = [pack_stop(StopDatagram(Kind.STOP, robot, 7, challenge), b"foreign") for robot in ("r1", "r2")]
        others.append(answer)
        invalid = [*(os.urandom(length) for length in range(LONGEST + 1)), *others * LONGEST]
        print(READY, flush=True)
        event_log.note(INJECTED)
        started_s, sent = time.monotonic(), 0
        while time.monotonic() - started_s < FLOOD_S:
            for data in invalid:
                with suppress(OSError):  # e.g. its queue is full
                    sent += one.send(data) == len(data)
    print(f"{sent / FLOOD_S:.0f} datagrams a second", flush=True)
    threading.Event().wait()


def replay_stops(endpoint: str, event_log: EventLog) -> None:
    """Repeat the recorded datagrams of an earlier STOP, and some for another robot with the same keys."""
    [place] = stop_addresses([endpoint])
    folder = Path(sys.argv[3]).parent
    datagrams = [bytes.fromhex(line) for line in (folder / STOPS).read_text("ascii").splitlines()]
    secret, challenge = read_secret(stop_secret_file(str(folder / "keys"))), os.urandom(CHALLENGE_BYTES)
    of_other = pack_stop(StopDatagram(Kind.STOP, "r2", 7, challenge), secret)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        print(READY, flush=True)
        # Unchanged, and under the name of this robot.
        for data in itertools.cycle([*datagrams, of_other, of_other.replace(b"r2", b"r1", 1)]):
            one.sendto(data, place)
            event_log.note(INJECTED)
            time.sleep(0.005)


STOPS: Final = "stops.txt"
"""The recording, in the folder of the event log."""
_KINDS: Final[dict[str, Callable[[str, EventLog], None]]] = {
    "viewers": view,
    "handshakes": leave_handshakes,
    "connect_25": partial(connect_often, rate_hz=FEW_HZ),
    "connect_500": partial(connect_often, rate_hz=MANY_HZ),
    "half_open": leave_half_open,
    "handshake": lambda endpoint, event_log: leave_half_open(endpoint, event_log, client_hello()),
    "sessions": open_sessions,
    "publisher": publish_much,
    "garbage": send_garbage,
    "replayed": replay_stops,
}


def main(kind: str, endpoint: str, event_log: str) -> None:
    """Run one kind of load until killed."""
    os.nice(_POLITE)
    _KINDS[kind](endpoint, EventLog(Path(event_log)))


if __name__ == "__main__":
    main(*sys.argv[1:4])
