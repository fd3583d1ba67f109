"""One WebSocket connection on a socket that never blocks: messages, keepalive, send path. Shell.

A pong waits behind what its reader has not read yet. So silence alone ends only a connection whose way out is clear;
while it is full, the reader is slow, and stays as long as it goes on taking.
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

from sightline.protocol.clock import monotonic_us

if TYPE_CHECKING:
    from websockets.frames import Frame
    from websockets.http11 import Request, Response
    from websockets.protocol import Event, Protocol


PING_EVERY_US: Final = 1_000_000
"""A peer that says nothing of its own is asked so often."""
SILENCE_US: Final = 2_000_000
"""A ping, and a second to answer it."""
STALLED_LIMIT_US: Final = 30_000_000
"""A full way out that nobody takes anything from, e.g. a stopped process: it costs one socket buffer and a place."""
_LOOK_AFTER_US: Final = 500_000
"""Silent for so long, the way out is watched."""
_LONG_AGO_US: Final = -(10**12)


@dataclass(frozen=True, slots=True)
class SendPath:
    """What is known of the way to the other end."""

    full: bool
    """Something waits, or may lie unread at the other end, which takes it slowly or not at all."""
    taken_bytes: int
    """What the other end's machine has acknowledged so far."""
    lost: bool
    """Something is under way, and that machine has acknowledged nothing for `SILENCE_US`."""


class Keepalive:
    """One connection's. `look` tells of the way out, and is asked only of who is silent."""

    def __init__(self, now_us: int) -> None:
        self._heard_us = self._pinged_us = self._taken_us = now_us
        self._full_us = _LONG_AGO_US
        self._taken_bytes = -1

    def hear(self, now_us: int) -> None:
        """Something arrived, whatever it was."""
        self._heard_us = now_us

    def is_ping_due(self, now_us: int) -> bool:
        """Whether to send a ping now; then the next is due a second later."""
        due = now_us - max(self._pinged_us, self._heard_us) >= PING_EVERY_US
        if due:
            self._pinged_us = now_us
        return due

    def is_over(self, now_us: int, look: Callable[[], SendPath]) -> bool:
        """Whether to give the other end up."""
        if now_us - self._heard_us < _LOOK_AFTER_US:
            return False
        way = look()
        if way.taken_bytes != self._taken_bytes:
            self._taken_bytes, self._taken_us = way.taken_bytes, now_us
        if way.full:
            self._full_us = now_us
        if now_us - self._heard_us < SILENCE_US:
            return False
        is_slow = now_us - self._full_us < SILENCE_US
        return way.lost or not is_slow or now_us - max(self._heard_us, self._taken_us) >= STALLED_LIMIT_US


# What the kernel knows of a TCP connection's way out (Linux; elsewhere only what this end still holds). Shell.


class _Fields(NamedTuple):
    """Of `struct tcp_info` in linux/tcp.h, whose fields never move."""

    probes: int
    unacked_packets: int
    last_ack_ms: int
    acked_bytes: int
    unsent_bytes: int


_LAYOUT: Final = struct.Struct("=3xB20xI28xI60xQ16xI")
_OPTION: Final = getattr(socket, "TCP_INFO", None)


def send_path(near: socket.socket, full: bool) -> SendPath:
    """The way out of `near`; `full` is what this end can tell of it by itself."""
    if _OPTION is None:
        return SendPath(full, 0, False)
    try:
        fields = _Fields(*_LAYOUT.unpack(near.getsockopt(socket.IPPROTO_TCP, _OPTION, _LAYOUT.size)))
    except (OSError, struct.error):  # closed, or a kernel that knows less
        return SendPath(full, 0, False)
    # A machine whose reader is slow still answers a probe of its full window: two unanswered are many.
    is_asked = fields.unacked_packets > 0 or fields.probes >= 2
    lost = is_asked and fields.last_ack_ms * 1000 >= SILENCE_US
    return SendPath(full or fields.unsent_bytes > 0, fields.acked_bytes, lost)


# Whole messages out of a connection's bytes, and into them; the usual kind without detours. Shell (the library).
# `websockets` reads and writes any frame. A message in one frame that arrives in one piece, or leaves unmasked, is by
# far the most common, and then a frame's picture need not be copied four times.


if TYPE_CHECKING:
    Received = str | bytes | Request | Response

MAX_FRAGMENTS: Final = 1024
"""Security limit: pieces of one message; their bytes are bounded by the protocol."""

_TEXT, _BINARY, _FIN, _MASK = 0x01, 0x02, 0x80, 0x80  # RFC 6455, 5.2
_SHORT, _LONG = 126, 127


class MessageReader:
    """What arrived on one connection and was not taken yet."""

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
        """Take what arrived; the protocol may have something to say afterwards."""
        if not self._is_masked and self._is_at_start() and (at := _start_of_only(data, self._bound())):
            self._put(data[at:], data[0] == _FIN | _TEXT)
            return
        self._protocol.receive_data(data)
        self._collect(self._protocol.events_received())

    def _is_at_start(self) -> bool:
        """Whether a frame begins here, and a message with it."""
        protocol = self._protocol
        return protocol.state is self._open and not protocol.reader.buffer and protocol.current_size is None

    def _bound(self) -> int:
        return self._protocol.max_message_size or 0

    def _collect(self, events: Sequence[Event]) -> None:
        for event in events:
            if not isinstance(event, self._frame_type):
                self.ready.append(event)  # of the handshake
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
            self._is_broken = True  # what came with it was taken apart already
            self._protocol.fail(1007, f"{error.reason} at position {error.start}")


def _start_of_only(data: bytes, bound: int) -> int:
    """Where the message begins if `data` is one whole unmasked message within `bound` and nothing else; 0 if not."""
    size = len(data)
    if size < 2 or data[0] not in (_FIN | _TEXT, _FIN | _BINARY) or data[1] & _MASK:
        return 0
    start = 2 if data[1] < _SHORT else 4 if data[1] == _SHORT else 10
    length = data[1] if start == 2 else int.from_bytes(data[2:start])
    return start if length == size - start <= bound else 0


def unmasked_head(size: int, is_text: bool) -> bytes:
    """What a server puts before a message of `size` bytes that it sends in one frame."""
    first = _FIN | (_TEXT if is_text else _BINARY)
    if size < _SHORT:
        return bytes((first, size))
    return struct.pack("!BBH", first, _SHORT, size) if size < 1 << 16 else struct.pack("!BBQ", first, _LONG, size)


# One WebSocket connection: a socket that never blocks, and the protocol of `websockets` on it. Shell (sockets).  One
# thread reads and waits; any may send. Nothing is given to the socket that it cannot take at once, but for the end of
# the message under way: so a slow reader is still heard, and what it is sent next can still be replaced by what is
# newer.


CLOSE_S: Final = 1.0
"""Security limit: a connection that is closing is cut off after this."""
_CHUNK_BYTES: Final = 65_536
_SMALL_CHUNK_BYTES: Final = 4_096  # where only small messages are due: each of a flood's becomes an object first
_MUCH_BYTES: Final = 32_768  # sent since the other end was last heard: so much may lie unread before our ping
_MAX_UNSENT: Final = 12  # Security limit: pieces that wait for room, e.g. pongs, before reading stops
_MAX_REASON_BYTES: Final = 123  # RFC 6455, 5.5
_NOT_NOW: Final = (BlockingIOError, InterruptedError, ssl.SSLWantReadError, ssl.SSLWantWriteError)


class Connection:
    """The connection. `lock` guards the protocol and what the socket has not taken yet."""

    def __init__(self, near: socket.socket, protocol: Protocol) -> None:
        from websockets.protocol import SERVER, State

        near.setblocking(False)
        near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.protocol = protocol
        self.lock = threading.Lock()
        self.granted: frozenset[tuple[str, ...]] | None = None
        """(channel, source) of what the other end may publish; None for all. Set by who checked its token."""
        self.heard_us = monotonic_us()
        """When the other end was last heard."""
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
        """Of the other end; empty if it is gone already."""
        try:
            name: tuple[str, int] = self._near.getpeername()[:2]
        except OSError:
            return "", 0
        return name

    # --- reading: one thread ----------------------------------------------------------------------------------------

    def wait(self, timeout_s: float) -> None:
        """Until there is something to read, room for what waits, or a bell; `timeout_s` at most."""
        events = select.POLLIN if len(self._unsent) < _MAX_UNSENT else 0
        if self._unsent or self._wants_room:
            events |= select.POLLOUT
        if events != self._awaited:
            self._readable.register(self._near, events)
            self._awaited = events
        if isinstance(self._near, ssl.SSLSocket) and self._near.pending():
            return
        for descriptor, event in self._readable.poll(timeout_s * 1000):
            if descriptor == self._alarm.fileno():
                with suppress(BlockingIOError):
                    self._alarm.recv(64, socket.MSG_DONTWAIT)
            elif event & ~select.POLLIN:
                self._wants_room = False

    def receive(self) -> list[Received]:
        """Whole messages that have arrived, the handshake's among them.

        Raises ConnectionClosed or InvalidHandshake once the connection has ended.
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
        """The next message, waited for. Raises TimeoutError at `deadline_s`, and what `receive` raises."""
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
        """Take one piece of what the socket has; False at the end."""
        if len(self._unsent) >= _MAX_UNSENT:
            return True
        try:
            data = self._near.recv(min(_CHUNK_BYTES, max(_SMALL_CHUNK_BYTES, self.protocol.max_message_size or 0)))
        except _NOT_NOW:
            return True
        except OSError:
            return False
        if data:
            self.heard_us, self._unheard_bytes = monotonic_us(), 0
            self._messages.feed(data)
        return bool(data)

    # --- sending: any thread ------------------------------------------------------------------------------------------

    def fill(self, take: Callable[[], tuple[Sequence[bytes], bool] | None]) -> bool:
        """Send what `take` gives, (pieces of a message, whether text), while there is room; False once there is none.

        With `lock` held. Without room `wait` also ends when there is some.
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
        """Send a text, or as much of it as there is room for now and the rest later."""
        with self.lock:
            self._frame((text.encode("utf-8"),), True)
            self._flush()

    def ping(self) -> None:
        """Ask for a sign of life, if there is room."""
        with self.lock:
            if self.protocol.state is self._open and self._has_room():
                self.protocol.send_ping(b"")
                self._flush()

    def close(self, code: int, reason: str) -> None:
        """Begin to close, telling why; the reading thread sees the end of it, within `CLOSE_S`."""
        with self.lock, suppress(OSError):
            if self.protocol.state is self._open:
                self.protocol.send_close(code, _bounded(reason))
                self._flush()
            elif not self.protocol.close_expected():  # there are no words yet
                self._near.shutdown(socket.SHUT_RDWR)
        self._ring()

    def flush(self) -> None:
        """Send what the protocol has to say, e.g. a handshake."""
        with self.lock:
            self._flush()

    def send_path(self) -> SendPath:
        """What is known of the way to the other end."""
        holds = bool(self._unsent) or self._wants_room
        return send_path(self._near, holds or self._unheard_bytes >= _MUCH_BYTES)

    def linger(self) -> None:
        """Discard what still comes until the connection has ended, so that the other end reads the reason."""
        from websockets.exceptions import ConnectionClosed, InvalidHandshake

        with suppress(ConnectionClosed, InvalidHandshake):
            while True:
                self.wait(CLOSE_S)
                self.receive()

    def shut(self) -> None:
        """Give back the sockets."""
        with self.lock:
            self._is_shut = True  # whoever gets the descriptor's number next must not be polled
            for end in (self._near, self._alarm, self._bell):
                end.close()

    def _frame(self, pieces: Sequence[bytes], is_text: bool) -> None:
        if self.protocol.state is not self._open:  # closing: the reading end reports how it ended
            return
        if self._is_server:
            whole = [unmasked_head(sum(map(len, pieces)), is_text), *(piece for piece in pieces if piece)]
            self._unsent.extend([b"".join(whole)] if isinstance(self._near, ssl.SSLSocket) else whole)
        else:
            (self.protocol.send_text if is_text else self.protocol.send_binary)(b"".join(pieces))

    def _has_room(self) -> bool:
        return not (self._unsent or self._wants_room or self._is_shut) and bool(self._room.poll(0))

    def _flush(self) -> None:
        """Give the socket what it takes of what the protocol has to say."""
        self._unsent.extend(_joined(self.protocol.data_to_send()))
        if self._cut_off_s is None and self.protocol.close_expected():
            self._cut_off_s = time.monotonic() + CLOSE_S
        try:
            while self._unsent and self._send_some():
                pass
        except _NOT_NOW:
            return
        except OSError:  # gone: the reading end sees it too
            self._unsent.clear()

    def _send_some(self) -> bool:
        """Whether the socket took all that it was given."""
        if not self._unsent[0]:  # the protocol's sign for the end
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
        with suppress(OSError):  # closed, or rung often enough
            self._bell.send(b"!", socket.MSG_DONTWAIT)


def _joined(writes: Sequence[bytes]) -> list[bytes]:
    """Few pieces of what may be many small ones; the end stays by itself."""
    if len(writes) < 2:
        return list(writes)
    text = b"".join(writes)
    return [piece for piece in (text, *writes[-1:]) if piece is text or not piece]


def _bounded(reason: str) -> str:
    return reason.encode("utf-8", "replace")[:_MAX_REASON_BYTES].decode("utf-8", "ignore")
