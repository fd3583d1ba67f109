"""A WebSocket server of a few lines that can do what no good one does: for cases about the connection. Shell.

It knows just enough of RFC 6455 to accept one client at a time, and leaves everything else to who uses it.
"""

import base64
import contextlib
import hashlib
import re
import secrets
import socket
import ssl
import struct
import time
from types import TracebackType
from typing import Final, Self

from sightline.protocol.errors import LinkError

TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
SESSION_BEGINS: Final = "5ca1"
"""So the tests' broken visions tell this server from the kit's own link."""
_GUID: Final = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
_SEND_S: Final = 2.0
_MAX_REQUEST_BYTES: Final = 16_384
_MAX_MESSAGE_BYTES: Final = 65_536
"""Security limit: no answer of a vision is near it."""
_HEADER: Final = re.compile(rb"^([!-9;-~]+):[ \t]*(.*?)[ \t]*$", re.MULTILINE)


class GoneError(Exception):
    """The client closed or lost the connection."""


class RawServer:
    """Listens on an address until left; use it in a `with`."""

    def __init__(self, host: str, port: int, tls: ssl.SSLContext | None = None) -> None:
        """Raises LinkError for an address that cannot be listened on."""
        self._tls = tls
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise LinkError(f"ws://{host}:{port} cannot be listened on: {error.strerror}") from None
        self._socket.listen(4)
        self._clients: list[RawClient] = []

    def accept(self, within_s: float) -> "RawClient | None":
        """The next client, after the opening handshake; None if none came in time."""
        deadline_s = time.monotonic() + within_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            self._socket.settimeout(left_s)
            try:
                connection, _ = self._socket.accept()
            except TimeoutError:
                return None
            try:
                connection.settimeout(_SEND_S)
                secured = connection if self._tls is None else self._tls.wrap_socket(connection, server_side=True)
                self._clients.append(RawClient(secured))
                return self._clients[-1]
            except (OSError, GoneError):
                connection.close()
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        for client in self._clients:
            client.close()


class RawClient:
    """One connection. `offered` are the sub-protocols that the client offered; `session` is of the robot played on it.

    `request` is the first line of what it asked, `headers` all that it said beside, names in lower case.
    Each connection is to a robot started anew: a vision may take an earlier session for over.
    """

    def __init__(self, connection: socket.socket) -> None:
        """Do the opening handshake. Raises OSError or GoneError for a client that does not."""
        self._socket = connection
        self._buffer = b""
        self.session = SESSION_BEGINS + secrets.token_hex(2)
        self.pings = 0
        self.answers_pings = True
        connection.settimeout(_SEND_S)
        while b"\r\n\r\n" not in self._buffer:
            self._more()
            if len(self._buffer) > _MAX_REQUEST_BYTES:
                raise GoneError("its request has no end")
        request, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
        said = request.replace(b"\r", b"")
        self.request = said.partition(b"\n")[0].decode("latin-1")
        self.headers = [(name.lower().decode(), value.decode("latin-1")) for name, value in _HEADER.findall(said)]
        fields = {name.lower(): value for name, value in _HEADER.findall(said)}
        self.offered = [one.strip().decode("latin-1") for one in fields.get(b"sec-websocket-protocol", b"").split(b",")]
        token = base64.b64encode(hashlib.sha1(fields.get(b"sec-websocket-key", b"") + _GUID).digest())
        chosen = b"Sec-WebSocket-Protocol: sightline.v1\r\n" if "sightline.v1" in self.offered else b""
        connection.sendall(b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                           b"Sec-WebSocket-Accept: " + token + b"\r\n" + chosen + b"\r\n")

    def send(self, kind: int, payload: bytes, *, last: bool = True) -> None:
        """One frame; a message in fragments continues with kind 0. A client that is gone is noticed in `receive`."""
        size = len(payload)
        length = (bytes((size,)) if size < 126
                  else struct.pack(">BH", 126, size) if size < 65_536 else struct.pack(">BQ", 127, size))
        with contextlib.suppress(OSError):
            self._socket.settimeout(_SEND_S)
            self._socket.sendall(bytes((kind | (0x80 if last else 0),)) + length + payload)

    def receive(self, within_s: float) -> tuple[int, bytes] | None:
        """The next frame but pings, which are answered and counted; None if none came. Raises GoneError at the end."""
        deadline_s = time.monotonic() + within_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            try:
                self._socket.settimeout(left_s)
                kind, payload = self._frame()
            except TimeoutError:
                return None
            except OSError as error:
                raise GoneError(str(error)) from None
            if kind == CLOSE:
                self.send(CLOSE, payload[:2])
                self.close()  # RFC 6455, 7.1.1: the server ends the TCP connection first
                raise GoneError("it closed the connection")
            if kind != PING:
                return kind, payload
            self.pings += 1
            if self.answers_pings:
                self.send(PONG, payload)
        return None

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def drop(self) -> None:
        """End the connection as a lost one: without a close frame, with a reset."""
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()

    def _frame(self) -> tuple[int, bytes]:
        while True:
            taken = _take(self._buffer)
            if taken is not None:
                kind, payload, self._buffer = taken
                return kind, payload
            if len(self._buffer) > _MAX_MESSAGE_BYTES:
                raise GoneError(f"it sent more than {_MAX_MESSAGE_BYTES} bytes at once")
            self._more()

    def _more(self) -> None:
        data = self._socket.recv(65_536)
        if not data:
            raise GoneError("it ended the connection")
        self._buffer += data


def _take(data: bytes) -> tuple[int, bytes, bytes] | None:
    """A client's first frame in `data`, unmasked, and what follows it; None while it is not complete."""
    if len(data) < 2:
        return None
    size, at = data[1] & 0x7F, 2
    if size > 125:
        at = 4 if size == 126 else 10
        size = int.from_bytes(data[2:at])
    mask = data[at : at + 4] if data[1] & 0x80 else b""
    at += len(mask)
    if len(data) < at + size or (data[1] & 0x80 and len(mask) < 4):
        return None
    payload = data[at : at + size]
    if mask:
        payload = bytes(one ^ mask[place % 4] for place, one in enumerate(payload))
    return data[0] & 0x0F, payload, data[at + size :]
