"""One connected peer: its queue of newest messages, STOP first, and the thread that reads. Shell."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any, Final, Protocol

from sightline.protocol.channels import ACK, Channel
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import WireError
from sightline.protocol.transports.link import OVERSIZE, Message, OutgoingQueue
from sightline.protocol.transports.websocket.connection import CLOSE_S, Connection, Keepalive
from sightline.protocol.transports.websocket.framing import (
    BAD_FRAMING,
    BAD_HELLO,
    IncomingMessage,
    PeerCodec,
    PeerError,
    SightlineV1,
)

if TYPE_CHECKING:
    from websockets.exceptions import ConnectionClosed


class WireFormat(Protocol):
    """How a message is written for one kind of peer."""

    @property
    def form(self) -> Hashable:
        """Equal for peers that are sent the same bytes."""
        ...

    def write(self, message: Message) -> tuple[bytes, ...]:
        """The message as those bytes, in as many pieces as it is made of."""
        ...


class Publication:
    """One publication, written at most once for all peers that are sent the same bytes."""

    __slots__ = ("_written", "message")

    def __init__(self, message: Message) -> None:
        self.message = message
        self._written: dict[Hashable, tuple[bytes, ...]] = {}

    def written(self, dialect: WireFormat) -> tuple[bytes, ...]:
        """The bytes for a peer of `dialect`. Two threads may both write; they write the same."""
        data = self._written.get(dialect.form)
        if data is None:
            data = self._written[dialect.form] = dialect.write(self.message)
        return data


# One WebSocket peer: what waits for it is sent by whoever has something new; a thread of its own reads. Shell.


OPEN_S: Final = 2.0
"""Security limit: for connecting and the handshake, and once more for the hello."""
_LIBRARY_LOG: Final = logging.getLogger("websockets.sightline")
_LIBRARY_LOG.setLevel(logging.CRITICAL + 1)  # it has lines for every connection, which is what a flood is made of
PROTOCOL_OPTIONS: Final[dict[str, Any]] = {"extensions": None, "logger": _LIBRARY_LOG}
"""No compression: pictures do not shrink, and trying costs three times the CPU."""
SILENT: Final = "SILENT"
"""Counted for a peer that left a ping unanswered, or took nothing for long."""

NOT_GRANTED: Final = "NOT_GRANTED"
"""Counted for a message that the role of the sender's token may not publish."""

Promote = Callable[[str], None]
"""Gives a client of that role a place; raises PeerError if there is none."""

_TICK_US: Final = 250_000  # how late a ping may be, and silence be noticed
_COUNTED_FOR_CODE: Final = {1002: BAD_FRAMING, 1007: BAD_FRAMING, 1009: OVERSIZE}


class Peer:
    """An open connection whose other end is known, and the dialect that it speaks."""

    def __init__(self, wire: Connection, dialect: PeerCodec, on_change: Callable[[], None] = lambda: None) -> None:
        """`on_change` is called on the reading thread when the peer says that it wants something else."""
        self.queue: OutgoingQueue[Publication | str] = OutgoingQueue()
        self._on_change = on_change
        self._wire, self._dialect = wire, dialect
        self._reader = threading.current_thread()
        self._gone = threading.Event()
        self._look_us = 0

    def subscribes_to(self, channel: Channel) -> bool:
        """Whether the peer wants `channel`."""
        return self._dialect.subscribes_to(channel)

    def admits(self, key: str, refuse: Callable[[str], None], tell: Callable[[str], None]) -> bool:
        """Whether its token lets it publish on `key`; if not, that is counted and logged."""
        said = tuple(key.split("/")[2:])
        if self._wire.granted is None or said in self._wire.granted:
            return True
        refuse(NOT_GRANTED)
        if said[0] != ACK.name:  # a viewer that acknowledges
            who = self._wire.address[0] or "a client"
            tell(f"rejected {'/'.join(said)} from {who}: the role of its token does not permit it "
                 "(docs/how-to/secure-the-link.md)")
        return False

    def offer(self, post: Publication) -> None:
        """Send it if the peer wants it, now or when there is room and nothing newer; never blocks."""
        if self._dialect.subscribes_to(post.message.channel):
            self.queue.put(post.message, post)
            self._send()

    def tell(self, hello: str) -> None:
        """Say who this end is and what it wants now, in a dialect that has words for it."""
        if isinstance(self._dialect, SightlineV1):
            self.queue.put_first(hello)
            self._send()

    def limit(self, wanted_bytes: int) -> None:
        """Accept no larger messages than what this end wants makes necessary."""
        with self._wire.lock:
            self._wire.protocol.max_message_size = self._dialect.bound(wanted_bytes)
        self._send()  # whoever found the lock taken left it to this thread

    def run(self, deliver: Callable[[Peer, IncomingMessage], None], refuse: Callable[[str], None]) -> None:
        """Read until the connection ends; a peer that breaks the rules is dropped and told why."""
        from websockets.exceptions import ConnectionClosed

        keepalive = Keepalive(monotonic_us())
        try:
            while self._turn(keepalive, deliver, refuse):
                self._wire.wait(_TICK_US / 1e6)
            refuse(SILENT)
            self._wire.close(1011, "silent for too long")
        except PeerError as refusal:
            refuse(refusal.counted)
            self._wire.close(refusal.code, str(refusal))
            self._wire.linger()
        except ConnectionClosed as closed:
            count_close(closed, refuse)
        finally:
            self._wire.shut()
            self._gone.set()

    def _turn(
        self, keepalive: Keepalive, deliver: Callable[[Peer, IncomingMessage], None], refuse: Callable[[str], None]
    ) -> bool:
        """Read what there is, and send; False if the other end is to be given up."""
        now_us = monotonic_us()  # before reading: however long this end stood still, what came meanwhile counts
        for message in self._wire.receive():
            self._read(message, deliver, refuse)
        if now_us < self._look_us:  # whoever was given a message waits for this thread to rest
            self._send()
            return True
        self._look_us = now_us + _TICK_US
        keepalive.hear(self._wire.heard_us)
        if keepalive.is_ping_due(now_us):
            self._wire.ping()
        self._send()
        return not keepalive.is_over(now_us, self._wire.send_path)

    def _read(
        self, message: Any, deliver: Callable[[Peer, IncomingMessage], None], refuse: Callable[[str], None]
    ) -> None:
        before = self._dialect.wants
        try:
            packets = self._dialect.read(message)
        except WireError as error:
            refuse(error.reason)
            return
        if self._dialect.wants != before:
            self._on_change()
        for packet in packets:
            deliver(self, packet)

    def close(self, reason: str) -> None:
        """Begin to say goodbye."""
        self._wire.close(1001, reason)

    def wait_gone(self, timeout_s: float = CLOSE_S) -> None:
        """Until the peer is gone, but not for the thread that is about to see to that."""
        if threading.current_thread() is not self._reader:
            self._gone.wait(timeout_s)

    def _send(self) -> None:
        """Send while there is room. Who finds another thread at it leaves the rest to that one."""
        lock = self._wire.lock
        while len(self.queue) and lock.acquire(blocking=False):
            try:
                has_room = self._wire.fill(self._take)
            finally:
                lock.release()
            if not has_room:
                return

    def _take(self) -> tuple[Sequence[bytes], bool] | None:
        item = self.queue.take()
        if item is None:
            return None
        if isinstance(item, str):
            return (item.encode("utf-8"),), True
        pieces = item.written(self._dialect)
        self._dialect.note_sent(item.message)
        return pieces, self._dialect.text


def exchange_hellos(wire: Connection, dialect: SightlineV1, hello: str, settle: Promote | None) -> None:
    """Exchange hellos; who connects, and so gives no place, speaks first."""
    if settle is None:
        wire.send_text(hello)
    try:
        answer = wire.receive_one(time.monotonic() + OPEN_S)
    except TimeoutError:
        raise PeerError(BAD_HELLO, 1008, f"no hello within {OPEN_S:g} s") from None
    if not isinstance(answer, str):
        raise PeerError(BAD_HELLO, 1003, "the first message must be a hello, as text")
    dialect.accept(answer)
    if settle is not None:
        settle(dialect.peer_role)
        wire.send_text(hello)


def count_close(closed: ConnectionClosed, refuse: Callable[[str], None]) -> None:
    """Count a connection that this end closed because the peer broke a rule; one that the peer ended is no fault."""
    counted = _COUNTED_FOR_CODE.get(closed.sent.code) if closed.sent and not closed.rcvd_then_sent else None
    if counted is not None:
        refuse(counted)
