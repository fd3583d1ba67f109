"""Whole messages out of a connection's bytes, and into them; the usual kind without detours. Shell (the library).

`websockets` reads and writes any frame. A message in one frame that arrives in one piece, or leaves unmasked, is by far
the most common, and then a frame's picture need not be copied four times.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from websockets.frames import Frame
    from websockets.http11 import Request, Response
    from websockets.protocol import Event, Protocol

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
