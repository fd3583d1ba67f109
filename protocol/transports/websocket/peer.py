"""Serve one connected peer: its queue of newest messages, STOP first, and the thread that reads. Shell."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any, Final, Protocol

from sightline.protocol.channels import ACK, Channel
from sightline.protocol.clock import heartbeat_us, monotonic_us
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
from sightline.protocol.transports.websocket.legacy import LegacyCommands

if TYPE_CHECKING:
    from websockets.exceptions import ConnectionClosed


class WireFormat(Protocol):
    """Writes messages for one kind of peer."""

    @property
    def form(self) -> Hashable:
        """Return a value that is equal for peers that receive the same bytes."""
        ...

    def write(self, message: Message) -> tuple[bytes, ...]:
        """Encode the message, in one or more pieces."""
        ...


class Publication:
    """One publication, encoded once for all peers that receive the same bytes."""

    __slots__ = ("_written", "message")

    def __init__(self, message: Message) -> None:
        self.message = message
        self._written: dict[Hashable, tuple[bytes, ...]] = {}

    def written(self, codec: WireFormat) -> tuple[bytes, ...]:
        """Return the bytes for a peer with `codec`."""
        # Without a lock: if two threads encode it, the results are equal.
        data = self._written.get(codec.form)
        if data is None:
            data = self._written[codec.form] = codec.write(self.message)
        return data


# One WebSocket peer. The thread that publishes also sends; a separate thread reads. Shell.


# Security limit for the handshake, and again for the hello.
OPEN_S: Final = 2.0
_LIBRARY_LOG: Final = logging.getLogger("websockets.sightline")
# The library logs every connection. A flood of connections must not become a flood of lines.
_LIBRARY_LOG.setLevel(logging.CRITICAL + 1)
# No compression: it does not reduce JPEG images, and costs three times the CPU time.
PROTOCOL_OPTIONS: Final[dict[str, Any]] = {"extensions": None, "logger": _LIBRARY_LOG}
# Counter of peers that did not answer a ping, or did not read for a long time.
SILENT: Final = "SILENT"

# Counter of messages that the sender's token does not permit.
NOT_GRANTED: Final = "NOT_GRANTED"

# Assigns a place to a client by its role. Raises PeerError without a free place.
Promote = Callable[[str], None]

# Longest delay of a ping and of the detection of silence.
_TICK_US: Final = 250_000
# Longest delay of a zero for a legacy robot.
_REST_TICK_US: Final = 50_000
_COUNTED_FOR_CODE: Final = {1002: BAD_FRAMING, 1007: BAD_FRAMING, 1009: OVERSIZE}


class Peer:
    """An open connection to a known peer, with its codec."""

    def __init__(
        self, wire: Connection, codec: PeerCodec, on_change: Callable[[], None] = lambda: None,
        commands: LegacyCommands | None = None,
    ) -> None:
        """Create a peer. The reading thread calls `on_change` when the peer changes its wants.

        `commands` are those of a legacy robot, which must not be left moving.
        """
        self.queue: OutgoingQueue[Publication | str] = OutgoingQueue()
        self._commands = commands
        self._ended = False
        self._on_change = on_change
        self._wire, self._codec = wire, codec
        self._reader = threading.current_thread()
        self._gone = threading.Event()
        self._look_us = 0

    def subscribes_to(self, channel: Channel) -> bool:
        """Return True if the peer wants `channel`."""
        return self._codec.subscribes_to(channel)

    def admits(self, key: str, reject: Callable[[str], None], log: Callable[[str], None]) -> bool:
        """Return True if the token of the peer permits `key`. Otherwise count and log the rejection."""
        named = tuple(key.split("/")[2:])
        if self._wire.granted is None or named in self._wire.granted:
            return True
        reject(NOT_GRANTED)
        # A viewer that acknowledges frames is harmless, and would fill the log.
        if named[0] != ACK.name:
            who = self._wire.address[0] or "a client"
            log(f"rejected {'/'.join(named)} from {who}: the role of its token does not permit it "
                "(docs/how-to/secure-the-link.md)")
        return False

    def offer(self, post: Publication) -> None:
        """Send a publication, now or later, if the peer wants it. A newer one replaces it. Never blocks."""
        if self._codec.subscribes_to(post.message.channel):
            self.queue.put(post.message, post)
            self._send()

    def send_hello(self, hello: str) -> None:
        """Send the hello of this end, except in the legacy protocol."""
        if isinstance(self._codec, SightlineV1):
            self.queue.put_first(hello)
            self._send()

    def limit(self, wanted_bytes: int) -> None:
        """Limit incoming messages to the largest payload that this end wants."""
        with self._wire.lock:
            self._wire.protocol.max_message_size = self._codec.bound(wanted_bytes)
        # Another thread that found the lock taken has left its message to this thread.
        self._send()

    def run(self, deliver: Callable[[Peer, IncomingMessage], None], reject: Callable[[str], None]) -> None:
        """Read until the connection ends. A peer that breaks the rules is closed with the reason."""
        from websockets.exceptions import ConnectionClosed

        keepalive = Keepalive(heartbeat_us())
        try:
            while self._turn(keepalive, deliver, reject):
                self._wire.wait((_TICK_US if self._commands is None else _REST_TICK_US) / 1e6)
            reject(SILENT)
            self._end(1011, "silent for too long")
        except PeerError as rejection:
            reject(rejection.counted)
            self._end(rejection.code, str(rejection))
            self._wire.linger()
        except ConnectionClosed as closed:
            count_close(closed, reject)
            if self._commands is not None and closed.sent is not None and closed.sent.code == 1009:
                self._commands.received(f"a message is too large: {closed.sent.reason}",
                                        "let it send smaller images, or raise max_frame_bytes")
        finally:
            self._wire.shut()
            self._gone.set()

    def _turn(
        self, keepalive: Keepalive, deliver: Callable[[Peer, IncomingMessage], None], reject: Callable[[str], None]
    ) -> bool:
        """Read all available messages, and send. Returns False if the connection must end."""
        # Before reading, so that data of a pause of this process counts.
        now_us = heartbeat_us()
        for message in self._wire.receive():
            self._read(message, deliver, reject)
        # The receiver of a message runs only while this thread waits, so this turn ends early.
        if now_us < self._look_us:
            self._send()
            return True
        self._look_us = now_us + _TICK_US
        keepalive.note_data(self._wire.received_us)
        if keepalive.is_ping_due(now_us):
            self._wire.ping()
        self._send()
        return not keepalive.is_over(now_us, self._wire.send_path)

    def _read(
        self, message: Any, deliver: Callable[[Peer, IncomingMessage], None], reject: Callable[[str], None]
    ) -> None:
        before = self._codec.wants
        try:
            packets = self._codec.read(message)
        except WireError as error:
            reject(error.reason)
            return
        if self._codec.wants != before:
            self._on_change()
        for packet in packets:
            deliver(self, packet)

    def close(self, reason: str) -> None:
        """Begin to close with a reason."""
        self._end(1001, reason)

    def _end(self, code: int, reason: str) -> None:
        # Before the zeros, because a command of another thread must not follow them.
        self._ended = True
        for text in self._commands.farewell() if self._commands else ():
            self._wire.send_text(text.decode("ascii"))
        self._wire.close(code, reason)

    def wait_gone(self, timeout_s: float = CLOSE_S) -> None:
        """Wait until the peer is gone. The reading thread itself does not wait."""
        if threading.current_thread() is not self._reader:
            self._gone.wait(timeout_s)

    def _send(self) -> None:
        """Send while the socket has room."""
        # A publisher never waits for the lock. The thread that holds it also sends the new message.
        lock = self._wire.lock
        while self._has_more() and lock.acquire(blocking=False):
            try:
                has_room = self._wire.fill(self._take)
            finally:
                lock.release()
            if not has_room:
                return

    def _has_more(self) -> bool:
        commands = self._commands
        return not self._ended and bool(len(self.queue) or (commands and commands.rest_due(monotonic_us())))

    def _take(self) -> tuple[Sequence[bytes], bool] | None:
        commands, now_us = self._commands, monotonic_us()
        if commands is not None and not self._ended and commands.rest_due(now_us):
            commands.sent(commands.zero, now_us)
            return (commands.zero,), True
        item = None if self._ended else self.queue.take()
        if item is None:
            return None
        if isinstance(item, str):
            return (item.encode("utf-8"),), True
        pieces = item.written(self._codec)
        self._codec.note_sent(item.message)
        return pieces, self._codec.text


def exchange_hellos(wire: Connection, codec: SightlineV1, hello: str, settle: Promote | None) -> None:
    """Exchange hellos. The connecting end, which assigns no places, sends first."""
    if settle is None:
        wire.send_text(hello)
    try:
        answer = wire.receive_one(time.monotonic() + OPEN_S)
    except TimeoutError:
        raise PeerError(BAD_HELLO, 1008, f"no hello within {OPEN_S:g} s") from None
    if not isinstance(answer, str):
        raise PeerError(BAD_HELLO, 1003, "the first message must be a hello, as text")
    codec.accept(answer)
    if settle is not None:
        settle(codec.peer_role)
        wire.send_text(hello)


def count_close(closed: ConnectionClosed, reject: Callable[[str], None]) -> None:
    """Count a connection that this end closed after a broken rule. A close by the peer does not count."""
    counted = _COUNTED_FOR_CODE.get(closed.sent.code) if closed.sent and not closed.rcvd_then_sent else None
    if counted is not None:
        reject(counted)
