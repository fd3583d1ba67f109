"""One WebSocket peer: newest-only slots towards it, a thread that sends from them, a loop that reads. Shell.

`websockets` writes to the socket under the lock that reading needs too. So nothing is given to it before the socket has
room: a peer that reads slowly or never keeps its own slots full, and is still heard.
"""

from __future__ import annotations

import logging
import select
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from protocol.channels import CHANNELS, Channel, Priority
from protocol.errors import WireError
from protocol.transports.link import Message
from protocol.transports.link_rules import OVERSIZE
from protocol.transports.websocket_dialects import BAD_FRAMING, V1, Dialect, PeerError
from protocol.transports.websocket_framing import Packet

if TYPE_CHECKING:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.connection import Connection

PIECE_BYTES: Final = 32_768
"""Fits into a 64 KiB send buffer whenever the kernel calls it writable, so that no write ever blocks."""
OPEN_S: Final = 2.0
"""Security limit: for connecting and the HTTP handshake, and once more for the hello."""
CONNECTION_OPTIONS: Final[dict[str, Any]] = {
    "compression": None,  # pictures do not shrink, and trying costs three times the CPU
    "ping_interval": 1,
    "ping_timeout": 1,
    "close_timeout": 1,
    "max_queue": 4,
    "logger": logging.getLogger("sightline.websocket"),
}
SILENT: Final = "SILENT"
"""Counted for a peer that left a ping unanswered."""

logging.getLogger("sightline.websocket").addHandler(logging.NullHandler())  # else Python prints to the terminal

_NAP_S: Final = 0.1  # how late the end of a connection may be noticed while waiting
_RANKS: Final = {priority: rank for rank, priority in enumerate(Priority)}
_COUNTED_FOR_CODE: Final = {1002: BAD_FRAMING, 1007: BAD_FRAMING, 1009: OVERSIZE, 1011: SILENT}
_MAX_REASON_BYTES: Final = 123  # RFC 6455, 5.5
_Item = Message | str


class Outbox:
    """A slot for each channel and source, and one for a hello; the most urgent is taken first."""

    def __init__(self) -> None:
        self._ready = threading.Condition()
        self._slots: dict[tuple[str, str], _Item] = {}
        self.dropped = Counter(dict.fromkeys(CHANNELS, 0))  # never grows, so that others may read it meanwhile
        """Publications replaced by a newer one before they were sent, by channel."""

    def put(self, message: Message) -> None:
        """Replace what is in the message's slot; never blocks."""
        name = (message.channel.name, message.source)
        with self._ready:
            self.dropped[name[0]] += name in self._slots
            self._slots[name] = message
            self._ready.notify()

    def put_hello(self, text: str) -> None:
        """A hello goes before everything else."""
        with self._ready:
            self._slots["", ""] = text
            self._ready.notify()

    def wait(self, timeout_s: float) -> bool:
        """Whether something is there, waiting up to `timeout_s`."""
        with self._ready:
            return bool(self._ready.wait_for(lambda: self._slots, timeout_s))

    def take(self) -> _Item | None:
        """Remove and return the most urgent; None if there is nothing."""
        with self._ready:
            name = min(self._slots, key=lambda name: _rank(self._slots[name]), default=None)
            return None if name is None else self._slots.pop(name)


def _rank(item: _Item) -> int:
    return -1 if isinstance(item, str) else _RANKS[item.channel.priority]


class Peer:
    """An open connection whose other end is known, and the dialect that it speaks."""

    def __init__(self, connection: Connection, dialect: Dialect) -> None:
        self.outbox = Outbox()
        self._connection, self._dialect = connection, dialect

    def hears(self, channel: Channel) -> bool:
        """Whether the peer wants `channel`."""
        return self._dialect.hears(channel)

    def offer(self, message: Message) -> None:
        """Send `message` if the peer wants it; never blocks."""
        if self.hears(message.channel):
            self.outbox.put(message)

    def tell(self, hello: str) -> None:
        """Say who this end is and what it wants now, in a dialect that has words for it."""
        if isinstance(self._dialect, V1):
            self.outbox.put_hello(hello)

    def limit(self, wanted_bytes: int) -> None:
        """Accept no larger messages than what this end wants makes necessary."""
        self._connection.protocol.max_message_size = self._dialect.bound(wanted_bytes)

    def run(self, deliver: Callable[[Packet], None], refuse: Callable[[str], None]) -> None:
        """Send and read until the connection ends; a peer that breaks the rules is dropped and told why."""
        from websockets.exceptions import ConnectionClosed

        sender = threading.Thread(target=self._send_all, name="websocket-send", daemon=True)
        sender.start()
        try:
            while True:
                self._read(self._connection.recv(), deliver, refuse)
        except PeerError as refusal:
            refuse(refusal.counted)
            drop(self._connection, refusal)
        except ConnectionClosed as closed:
            count_end(closed, refuse)
        finally:
            self._connection.close()
            sender.join()

    def _read(self, message: str | bytes, deliver: Callable[[Packet], None], refuse: Callable[[str], None]) -> None:
        try:
            packets = self._dialect.read(message)
        except WireError as error:
            refuse(error.reason)
            return
        for packet in packets:
            deliver(packet)

    def close(self, reason: str) -> None:
        """Say goodbye and wait, at most a second, until the peer is gone."""
        self._connection.close(1001, reason)

    @property
    def _open(self) -> bool:
        from websockets.protocol import State

        return self._connection.state is State.OPEN

    def _send_all(self) -> None:
        with suppress(Exception):  # whatever a broken connection raises: the reading end reports how it ended
            while self._open:
                # First room, then the choice: what is taken is the newest there is when it leaves.
                if self.outbox.wait(_NAP_S) and self._has_room():
                    self._send(self.outbox.take())

    def _send(self, item: _Item | None) -> None:
        if isinstance(item, str):
            self._connection.send(item)
        elif item is not None:
            data = self._dialect.write(item)
            self._connection.send(data if len(data) <= PIECE_BYTES else self._pieces(data), text=self._dialect.text)

    def _pieces(self, data: bytes) -> Iterator[memoryview]:
        for at in range(0, len(data), PIECE_BYTES):
            while at and self._open and not self._has_room():
                pass
            yield memoryview(data)[at : at + PIECE_BYTES]

    def _has_room(self) -> bool:
        """Whether the socket takes a piece without blocking; waits a little for it."""
        descriptor = self._connection.socket.fileno()
        if descriptor < 0:
            return True  # closed: sending says so
        poll = select.poll()
        poll.register(descriptor, select.POLLOUT)
        return bool(poll.poll(_NAP_S * 1000))


def drop(connection: Connection, refusal: PeerError) -> None:
    """Close with the refusal's code and reason."""
    reason = str(refusal).encode("utf-8", "replace")[:_MAX_REASON_BYTES].decode("utf-8", "ignore")
    connection.close(refusal.code, reason)


def count_end(closed: ConnectionClosed, refuse: Callable[[str], None]) -> None:
    """Count a connection that `websockets` ended because the peer broke a rule; one that the peer ended is no fault."""
    counted = _COUNTED_FOR_CODE.get(closed.sent.code) if closed.sent and not closed.rcvd_then_sent else None
    if counted is not None:
        refuse(counted)
