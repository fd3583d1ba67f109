"""Run one WebSocket connection on a socket that never blocks: messages, keepalive, send path. Shell.

A pong waits behind data that its reader has not read yet. Silence alone therefore ends only a connection with an empty
send path. A full send path means a slow reader, which stays connected while it reads.
"""

from __future__ import annotations

import select
import socket
import ssl
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from typing import TYPE_CHECKING, Final, NamedTuple

from sightline.protocol.clock import heartbeat_us

if TYPE_CHECKING:
    from websockets.frames import Frame
    from websockets.http11 import Request, Response
    from websockets.protocol import Event, Protocol


# Interval of pings to a silent peer.
PING_EVERY_US: Final = 1_000_000
# One ping interval, and one second for the pong.
SILENCE_US: Final = 2_000_000
# Limit for a full send path without progress, e.g. to a stopped process. It costs one socket buffer and a place.
STALLED_LIMIT_US: Final = 30_000_000
# Silence after which the send path is checked.
_LOOK_AFTER_US: Final = 500_000
_LONG_AGO_US: Final = -(10**12)


@dataclass(frozen=True, slots=True)
class SendPath:
    """The state of the path to the other end."""

    full: bool
    """True if data waits here, or may wait unread at the other end, which reads slowly or not at all."""
    taken_bytes: int
    """Bytes that the other machine has acknowledged so far."""
    lost: bool
    """True if data is in flight and the other machine has acknowledged nothing for `SILENCE_US`."""


class Keepalive:
    """Decides about pings and the end of one connection. It reads the send path only of a silent peer."""

    def __init__(self, now_us: int) -> None:
        self._received_us = self._pinged_us = self._taken_us = now_us
        self._full_us = _LONG_AGO_US
        self._taken_bytes = -1

    def note_data(self, now_us: int) -> None:
        """Note that data arrived."""
        self._received_us = now_us

    def is_ping_due(self, now_us: int) -> bool:
        """Return True if a ping is due. The next one is due a second later."""
        due = now_us - max(self._pinged_us, self._received_us) >= PING_EVERY_US
        if due:
            self._pinged_us = now_us
        return due

    def is_over(self, now_us: int, look: Callable[[], SendPath]) -> bool:
        """Return True if the connection must end.

        Args:
            now_us: monotonic clock.
            look: reads the send path.
        """
        if now_us - self._received_us < _LOOK_AFTER_US:
            return False
        way = look()
        if way.taken_bytes != self._taken_bytes:
            self._taken_bytes, self._taken_us = way.taken_bytes, now_us
        if way.full:
            self._full_us = now_us
        if now_us - self._received_us < SILENCE_US:
            return False
        # A reader with a full send path cannot answer a ping in time. It is slow, not gone.
        is_slow = now_us - self._full_us < SILENCE_US
        return way.lost or not is_slow or now_us - max(self._received_us, self._taken_us) >= STALLED_LIMIT_US


# The kernel's state of a TCP send path (Linux; on other systems only the data that still waits here). Shell.


class _Fields(NamedTuple):
    """Fields of `struct tcp_info` in linux/tcp.h, whose positions never change."""

    probes: int
    unacked_packets: int
    last_ack_ms: int
    acked_bytes: int
    unsent_bytes: int


_LAYOUT: Final = struct.Struct("=3xB20xI28xI60xQ16xI")
_OPTION: Final = getattr(socket, "TCP_INFO", None)


def send_path(near: socket.socket, full: bool) -> SendPath:
    """Read the send path of a socket. `full` is True if data already waits at this end."""
    if _OPTION is None:
        return SendPath(full, 0, False)
    try:
        fields = _Fields(*_LAYOUT.unpack(near.getsockopt(socket.IPPROTO_TCP, _OPTION, _LAYOUT.size)))
    except (OSError, struct.error):  # the socket is closed, or the kernel is older
        return SendPath(full, 0, False)
    # A machine with a slow reader still answers a probe of its full window. Two probes without an answer mean a loss.
    is_requested = fields.unacked_packets > 0 or fields.probes >= 2
    lost = is_requested and fields.last_ack_ms * 1000 >= SILENCE_US
    return SendPath(full or fields.unsent_bytes > 0, fields.acked_bytes, lost)


# Messages from the bytes of a connection, and back. Shell (the library).
#
# `websockets` can read and write every kind of frame. Most messages arrive as one piece and one frame, or leave
# unmasked. A direct path for them avoids four copies of each image.


if TYPE_CHECKING:
    Received = str | bytes | Request | Response

# Security limit: pieces of one message. The protocol limits their bytes.
MAX_FRAGMENTS: Final = 1024

_TEXT, _BINARY, _FIN, _MASK = 0x01, 0x02, 0x80, 0x80  # RFC 6455, 5.2
_SHORT, _LONG = 126, 127


class MessageReader:
    """Collects complete messages of one connection until the reader takes them."""

    def __init__(self, protocol: Protocol) -> None:
        from websockets.frames import Frame, Opcode
        from websockets.protocol import SERVER, State

        self.ready: deque[Received] = deque()
        self._protocol = protocol
        self._pieces: list[bytes] = []
        self._is_text = self._is_broken = False
        self._is_masked = protocol.side is SERVER
        self._frame_type, self._open = Frame, State.OPEN
        self._texts, self._continued = Opcode.TEXT, Opcode.CONT
        self._messages = (Opcode.TEXT, Opcode.BINARY, Opcode.CONT)

    def feed(self, data: bytes) -> None:
        """Process received bytes. Afterwards the protocol may have data to send."""
        if not self._is_masked and self._is_at_start() and (at := _start_of_only(data, self._bound())):
            self._put(data[at:], data[0] == _FIN | _TEXT)
            return
        self._protocol.receive_data(data)
        self._collect(self._protocol.events_received())

    def _is_at_start(self) -> bool:
        """Return True if the next byte begins a frame and a message."""
        protocol = self._protocol
        return protocol.state is self._open and not protocol.reader.buffer and protocol.current_size is None

    def _bound(self) -> int:
        return self._protocol.max_message_size or 0

    def _collect(self, events: Sequence[Event]) -> None:
        for event in events:
            if not isinstance(event, self._frame_type):
                # A request or response of the handshake.
                self.ready.append(event)
            elif event.opcode in self._messages:
                self._add(event, event.opcode is self._texts, event.opcode is self._continued)

    def _add(self, frame: Frame, is_text: bool, continues: bool) -> None:
        if not continues:
            self._is_text = is_text
        self._pieces.append(bytes(frame.data))
        if len(self._pieces) > MAX_FRAGMENTS:
            self._protocol.fail(1009, "too many fragments")
        if frame.fin:
            data, self._pieces = b"".join(self._pieces), []
            self._put(data, self._is_text)

    def _put(self, data: bytes, is_text: bool) -> None:
        if self._is_broken:
            return
        try:
            self.ready.append(data.decode() if is_text else data)
        except UnicodeDecodeError as error:
            # Later messages in the same bytes are already parsed, and must not be delivered.
            self._is_broken = True
            self._protocol.fail(1007, f"{error.reason} at position {error.start}")


def _start_of_only(data: bytes, bound: int) -> int:
    """Return the start of the payload if `data` is exactly one unmasked message within `bound`, otherwise 0."""
    size = len(data)
    if size < 2 or data[0] not in (_FIN | _TEXT, _FIN | _BINARY) or data[1] & _MASK:
        return 0
    start = 2 if data[1] < _SHORT else 4 if data[1] == _SHORT else 10
    length = data[1] if start == 2 else int.from_bytes(data[2:start])
    return start if length == size - start <= bound else 0


def unmasked_head(size: int, is_text: bool) -> bytes:
    """Return the frame header of a server for a message of `size` bytes in one frame."""
    first = _FIN | (_TEXT if is_text else _BINARY)
    if size < _SHORT:
        return bytes((first, size))
    return struct.pack("!BBH", first, _SHORT, size) if size < 1 << 16 else struct.pack("!BBQ", first, _LONG, size)


# The connection: a non-blocking socket with the protocol of `websockets`. Shell (sockets).
#
# One thread reads and waits; any thread may send. A new message goes to the socket only if it has room. Otherwise it
# waits in the queue of the peer, where a newer message can replace it, and the thread continues to read.


# Security limit: time after which a closing connection is cut off.
CLOSE_S: Final = 1.0
_CHUNK_BYTES: Final = 65_536
# For small messages, so that a flood of them does not become one large batch of objects.
_SMALL_CHUNK_BYTES: Final = 4_096
# Bytes sent since the last data from the other end. This amount may wait unread before the ping.
_MUCH_BYTES: Final = 32_768
# Security limit: waiting pieces, e.g. pongs, at which reading stops.
_MAX_UNSENT: Final = 12
_MAX_REASON_BYTES: Final = 123  # RFC 6455, 5.5
_NOT_NOW: Final = (BlockingIOError, InterruptedError, ssl.SSLWantReadError, ssl.SSLWantWriteError)


class Connection:
    """One connection. `lock` guards the protocol and the data that the socket has not accepted yet."""

    def __init__(self, near: socket.socket, protocol: Protocol) -> None:
        from websockets.protocol import SERVER, State

        near.setblocking(False)
        # With Nagle's algorithm, a small packet such as a twist would wait for the last acknowledgment.
        near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.protocol = protocol
        self.lock = threading.Lock()
        self.granted: frozenset[tuple[str, ...]] | None = None
        """(channel, source) pairs that the other end may publish, None for all. Set by the check of its token."""
        self.received_us = heartbeat_us()
        """Time of the last data from the other end."""
        self._unheard_bytes = 0
        self._near = near
        self._unsent: deque[bytes | memoryview] = deque()
        self._wants_room = False
        self._messages = MessageReader(protocol)
        self._cut_off_s: float | None = None
        self._over = self._is_shut = False
        self._alarm, self._bell = socket.socketpair()
        self._readable, self._room = select.poll(), select.poll()
        self._readable.register(self._alarm, select.POLLIN)
        self._room.register(near, select.POLLOUT)
        self._awaited = 0
        self._open, self._is_server = State.OPEN, protocol.side is SERVER

    @property
    def address(self) -> tuple[str, int]:
        """Return address and port of the other end, empty if it is already gone."""
        try:
            name: tuple[str, int] = self._near.getpeername()[:2]
        except OSError:
            return "", 0
        return name

    # --- reading: one thread ----------------------------------------------------------------------------------------

    def wait(self, timeout_s: float) -> None:
        """Wait for data to read, room for waiting data, or a bell, for `timeout_s` at most."""
        events = select.POLLIN if len(self._unsent) < _MAX_UNSENT else 0
        if self._unsent or self._wants_room:
            events |= select.POLLOUT
        if events != self._awaited:
            self._readable.register(self._near, events)
            self._awaited = events
        # TLS decrypts whole records, so data can wait in this process while `poll` sees none in the socket. While
        # reading is stopped it stays there, and only room for waiting data ends the wait.
        if events & select.POLLIN and isinstance(self._near, ssl.SSLSocket) and self._near.pending():
            return
        for descriptor, event in self._readable.poll(timeout_s * 1000):
            if descriptor == self._alarm.fileno():
                with suppress(BlockingIOError):
                    self._alarm.recv(64, socket.MSG_DONTWAIT)
            elif event & ~select.POLLIN:
                self._wants_room = False

    def receive(self) -> list[Received]:
        """Return the messages that have arrived, including those of the handshake.

        Raises:
            ConnectionClosed: the connection has ended.
            InvalidHandshake: it ended during the handshake.
        """
        with self.lock:
            self._over = self._over or not self._read() or self._is_late()
            if self._over:
                self.protocol.receive_eof()
            self._flush()
            if self._over and not self._messages.ready:
                raise self.protocol.handshake_exc or self.protocol.close_exc
        ready = list(self._messages.ready)
        self._messages.ready.clear()
        return ready

    def receive_one(self, deadline_s: float) -> Received:
        """Wait for the next message. Raises TimeoutError at `deadline_s`, and the errors of `receive`."""
        ready = self.receive()
        while not ready:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise TimeoutError
            self.wait(left_s)
            ready = self.receive()
        self._messages.ready.extendleft(reversed(ready[1:]))
        return ready[0]

    def _is_late(self) -> bool:
        return self._cut_off_s is not None and time.monotonic() > self._cut_off_s

    def _read(self) -> bool:
        """Read one chunk from the socket. Returns False at its end."""
        if len(self._unsent) >= _MAX_UNSENT:
            return True
        try:
            data = self._near.recv(min(_CHUNK_BYTES, max(_SMALL_CHUNK_BYTES, self.protocol.max_message_size or 0)))
        except _NOT_NOW:
            return True
        except OSError:
            return False
        if data:
            self.received_us, self._unheard_bytes = heartbeat_us(), 0
            self._messages.feed(data)
        return bool(data)

    # --- sending: any thread ------------------------------------------------------------------------------------------

    def fill(self, take: Callable[[], tuple[Sequence[bytes], bool] | None]) -> bool:
        """Send messages while the socket has room. Call it with `lock` held.

        Args:
            take: returns the next message as (pieces, True for text), or None.

        Returns:
            False without room. `wait` then also ends when there is room again.
        """
        has_room = self._has_room()
        while has_room:
            item = take()
            if item is None:
                return True
            self._frame(*item)
            self._flush()
            has_room = not self._unsent
        if not self._wants_room:
            self._wants_room = True
            self._ring()
        return False

    def send_text(self, text: str) -> None:
        """Send a text. The part without room follows later."""
        with self.lock:
            self._frame((text.encode("utf-8"),), True)
            self._flush()

    def ping(self) -> None:
        """Send a ping, if the socket has room."""
        with self.lock:
            if self.protocol.state is self._open and self._has_room():
                self.protocol.send_ping(b"")
                self._flush()

    def close(self, code: int, reason: str) -> None:
        """Begin to close with a reason. The reading thread ends within `CLOSE_S`."""
        with self.lock, suppress(OSError):
            if self.protocol.state is self._open:
                self.protocol.send_close(code, _bounded(reason))
                self._flush()
            elif not self.protocol.close_expected():  # before the handshake there is no close frame
                self._near.shutdown(socket.SHUT_RDWR)
        self._ring()

    def flush(self) -> None:
        """Send the pending data of the protocol, e.g. a handshake."""
        with self.lock:
            self._flush()

    def send_path(self) -> SendPath:
        """Return the state of the path to the other end."""
        holds = bool(self._unsent) or self._wants_room
        return send_path(self._near, holds or self._unheard_bytes >= _MUCH_BYTES)

    def linger(self) -> None:
        """Discard further data until the connection has ended."""
        # Closing with unread data sends a reset, and the other end would lose the reason.
        from websockets.exceptions import ConnectionClosed, InvalidHandshake

        with suppress(ConnectionClosed, InvalidHandshake):
            while True:
                self.wait(CLOSE_S)
                self.receive()

    def shut(self) -> None:
        """Close the sockets."""
        with self.lock:
            # Another socket may get the same descriptor number, which this connection must not poll.
            self._is_shut = True
            for end in (self._near, self._alarm, self._bell):
                end.close()

    def _frame(self, pieces: Sequence[bytes], is_text: bool) -> None:
        # The reading thread reports how a closing connection ended.
        if self.protocol.state is not self._open:
            return
        if self._is_server:
            whole = [unmasked_head(sum(map(len, pieces)), is_text), *(piece for piece in pieces if piece)]
            self._unsent.extend([b"".join(whole)] if isinstance(self._near, ssl.SSLSocket) else whole)
        else:
            (self.protocol.send_text if is_text else self.protocol.send_binary)(b"".join(pieces))

    def _has_room(self) -> bool:
        return not (self._unsent or self._wants_room or self._is_shut) and bool(self._room.poll(0))

    def _flush(self) -> None:
        """Pass pending data of the protocol to the socket, while it has room."""
        self._unsent.extend(_joined(self.protocol.data_to_send()))
        if self._cut_off_s is None and self.protocol.close_expected():
            self._cut_off_s = time.monotonic() + CLOSE_S
        try:
            while self._unsent and self._send_some():
                pass
        except _NOT_NOW:
            return
        except OSError:  # the connection is gone; the reading thread detects it, too
            self._unsent.clear()

    def _send_some(self) -> bool:
        """Send one batch. Returns True if the socket accepted all of it."""
        if not self._unsent[0]:  # an empty piece marks the end of the data
            self._near.shutdown(socket.SHUT_WR)
            self._unsent.popleft()
            return True
        if isinstance(self._near, ssl.SSLSocket):
            given = [self._unsent[0]]
            sent = self._near.send(given[0])
        else:
            given = list(takewhile(len, self._unsent))
            sent = self._near.sendmsg(given)
        self._unheard_bytes += sent
        for piece in given:
            if sent < len(piece):
                self._unsent[0] = memoryview(piece)[sent:]
                return False
            self._unsent.popleft()
            sent -= len(piece)
        return True

    def _ring(self) -> None:
        with suppress(OSError):  # the bell is closed, or its buffer is full
            self._bell.send(b"!", socket.MSG_DONTWAIT)


def _joined(writes: Sequence[bytes]) -> list[bytes]:
    """Join small pieces into one. An empty piece, which marks the end, stays separate."""
    if len(writes) < 2:
        return list(writes)
    text = b"".join(writes)
    return [piece for piece in (text, *writes[-1:]) if piece is text or not piece]


def _bounded(reason: str) -> str:
    return reason.encode("utf-8", "replace")[:_MAX_REASON_BYTES].decode("utf-8", "ignore")
