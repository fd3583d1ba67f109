"""Clients without the limits of a library: raw WebSocket bytes, any Zenoh key. Shell (sockets).

    with RawWebSocket("ws://127.0.0.1:9090") as raw:
        raw.send(TEXT, hello)
        raw.end(2.0)  # (1008, "this is robot r1, not r2")
"""

import os
import socket
import ssl
import time
from base64 import b64encode
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from typing import Any, Final, NamedTuple, Self

from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.endpoints import stop_addresses
from sightline.protocol.transports.security import load_role_keys
from sightline.protocol.transports.tokens import Token
from sightline.protocol.transports.websocket.framing import SUBPROTOCOL
from sightline.protocol.transports.zenoh.link import declare_token
from sightline.protocol.transports.zenoh.session import open_session

TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
CONTINUED: Final = 0
LATE_PONG_S: Final = 1.3
"""Later than a ping interval, but within two seconds."""
LOST: Final = (1006, "")
"""The end of a connection without a close frame: RFC 6455, 7.1.5."""
_SIZES: Final = {126: 2, 127: 8}
_MAX_HEAD_BYTES: Final = 16_384
_MAX_BUFFERED_BYTES: Final = 2_000_000
"""Security limit: the largest message of the protocol is a frame of a million bytes."""
_PATIENCE_S: Final = 3.0


class RawFrame(NamedTuple):
    """One received WebSocket frame, unmasked."""

    fin: bool
    opcode: int
    data: bytes


def frame_bytes(opcode: int, data: bytes, *, fin: bool = True, masked: bool = True) -> bytes:
    """Return one frame in the layout of RFC 6455, 5.2."""
    size = len(data)
    short = size if size < 126 else 126 if size < 65_536 else 127
    head = bytes([(0x80 if fin else 0) | opcode, (0x80 if masked else 0) | short])
    head += size.to_bytes(_SIZES[short]) if short in _SIZES else b""
    mask = os.urandom(4)
    return head + (mask + xor(data, mask) if masked else data)


def take_frame(data: bytes) -> tuple[RawFrame, bytes] | None:
    """Return the first frame in `data` and the rest; None while the frame is not complete."""
    if len(data) < 2:
        return None
    size, at = data[1] & 0x7F, 2
    if size in _SIZES:
        at += _SIZES[size]
        size = int.from_bytes(data[2:at]) if len(data) >= at else len(data)
    masked = 4 if data[1] & 0x80 else 0
    end = at + masked + size
    if len(data) < end:
        return None
    body = data[at + masked : end]
    return RawFrame(bool(data[0] & 0x80), data[0] & 0x0F, xor(body, data[at : at + 4]) if masked else body), data[end:]


def xor(data: bytes, mask: bytes) -> bytes:
    """Mask or unmask `data` by RFC 6455, 5.3."""
    pad = mask * (len(data) // 4 + 1)
    return (int.from_bytes(data) ^ int.from_bytes(pad[: len(data)])).to_bytes(len(data))


class RawConnection:
    """Either end of a WebSocket, as a context manager. It answers pings unless `answers_pings` is false."""

    masks = True

    def __init__(self, connection: socket.socket, *, answers_pings: bool = True) -> None:
        self._socket = connection
        self.answers_pings = answers_pings
        self.pongs_after_s = 0.0
        self._pongs: deque[tuple[float, bytes]] = deque()
        self.pings = 0
        self._data = b""
        self._ended = False

    def read_head(self) -> tuple[str, list[tuple[str, str]]]:
        """Read the other end's HTTP head: its first line, and its headers with names in lower case; "" without one."""
        deadline_s = time.monotonic() + _PATIENCE_S
        while b"\r\n\r\n" not in self._data:
            if len(self._data) > _MAX_HEAD_BYTES or not self._read(deadline_s - time.monotonic()):
                return "", []
        head, _, self._data = self._data.partition(b"\r\n\r\n")
        first, *lines = head.decode("latin-1").split("\r\n")
        pairs = (line.partition(":") for line in lines)
        return first, [(name.lower(), value.strip()) for name, _, value in pairs]

    # --- sending -------------------------------------------------------------------------------------------------

    def send(self, opcode: int, data: bytes, *, fin: bool = True, masked: bool | None = None) -> None:
        """Send one frame. An ended connection is not an error."""
        self.write(frame_bytes(opcode, data, fin=fin, masked=self.masks if masked is None else masked))

    def write(self, data: bytes) -> None:
        """Send raw bytes."""
        with suppress(OSError):
            self._socket.settimeout(_PATIENCE_S)
            self._socket.sendall(data)

    # --- receiving -----------------------------------------------------------------------------------------------

    def frame(self, within_s: float) -> RawFrame | None:
        """Return the next frame except pings; None when none comes, or the connection has ended."""
        deadline_s = time.monotonic() + within_s
        while True:
            while self._pongs and self._pongs[0][0] <= time.monotonic():
                self.send(PONG, self._pongs.popleft()[1])
            taken = take_frame(self._data)
            if taken is None:
                if not self._read(deadline_s - time.monotonic()):
                    return None
                continue
            frame, self._data = taken
            if frame.opcode != PING:
                return frame
            self.pings += 1
            if self.answers_pings:
                self._pongs.append((time.monotonic() + self.pongs_after_s, frame.data))

    def frame_that(self, wanted: Callable[[RawFrame], bool], within_s: float) -> RawFrame | None:
        """Return the next frame for which `wanted` is true; None without one."""
        deadline_s = time.monotonic() + within_s
        while (left_s := deadline_s - time.monotonic()) > 0 and not self._ended:
            frame = self.frame(left_s)
            if frame is not None and wanted(frame):
                return frame
        return None

    def messages(self, for_s: float) -> Iterator[tuple[int, bytes]]:
        """Yield the opcode and data of each whole message within `for_s`."""
        whole, opcode = b"", 0
        deadline_s = time.monotonic() + for_s
        while frame := self.frame_that(lambda one: one.opcode <= BINARY, deadline_s - time.monotonic()):
            whole, opcode = whole + frame.data, frame.opcode or opcode
            if frame.fin:
                yield opcode, whole
                whole = b""

    def end(self, within_s: float) -> tuple[int, str] | None:
        """Return close code and reason, LOST without a close frame; None if the connection stays open."""
        frame = self.frame_that(lambda one: one.opcode == CLOSE, within_s)
        if frame is not None:
            return int.from_bytes(frame.data[:2]), frame.data[2:].decode("utf-8", "replace")
        return LOST if self._ended else None

    def _read(self, within_s: float) -> bool:
        try:
            self._socket.settimeout(max(0.001, within_s))
            data = self._socket.recv(65_536)
        except TimeoutError:
            return False
        except OSError:
            data = b""
        self._data += data
        self._ended = not data or len(self._data) > _MAX_BUFFERED_BYTES
        return not self._ended

    def close(self) -> None:
        """Close the socket without a close frame."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self.close()


class RawWebSocket(RawConnection):
    """The client's end: an opened connection, or the rejection in `status`."""

    def __init__(
        self,
        url: str,
        protocols: Sequence[str] = (SUBPROTOCOL,),
        headers: Sequence[tuple[str, str]] = (),
        *,
        host: str = "",
        answers_pings: bool = True,
        path: str = "/",
    ) -> None:
        """Connect and shake hands; `host` replaces the Host header. Raises LinkError without an answer."""
        secure, address, port = split_url(url)
        try:
            connection = socket.create_connection((address, port), _PATIENCE_S)
            if secure:
                connection = _unverified().wrap_socket(connection, server_hostname=address)
        except OSError as error:
            raise LinkError(f"no answer from {url}: {error}; start the peer or check the address") from None
        super().__init__(connection, answers_pings=answers_pings)
        lines = [("Host", host or f"{address}:{port}"), ("Upgrade", "websocket"), ("Connection", "Upgrade"),
                 ("Sec-WebSocket-Key", b64encode(os.urandom(16)).decode()), ("Sec-WebSocket-Version", "13"),
                 *headers]  # fmt: skip
        if protocols:
            lines.append(("Sec-WebSocket-Protocol", ", ".join(protocols)))
        head = "".join(f"{name}: {value}\r\n" for name, value in lines)
        self.write(f"GET {path} HTTP/1.1\r\n{head}\r\n".encode())
        first, answered = self.read_head()
        status = first.split(" ")[1] if first.count(" ") else ""
        self.status, self.headers = int(status) if status.isdigit() else 0, dict(answered)


class RawStopPort:
    """Sends datagrams to the STOP port next to an endpoint. A context manager."""

    def __init__(self, endpoint: str) -> None:
        """Open a socket for each family of its host, which may listen on one. Raises LinkError without an address."""
        ((host, port),) = stop_addresses([endpoint])
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise LinkError(f"{endpoint}: {error.strerror}; check the address") from None
        self._sockets: list[socket.socket] = []
        for family, place in {family: place for family, _, _, _, place in reversed(found)}.items():
            with suppress(OSError):  # e.g. no IPv6 on this machine
                self._sockets.append(socket.socket(family, socket.SOCK_DGRAM))
                self._sockets[-1].setblocking(False)
                self._sockets[-1].connect(place)

    def send(self, data: bytes) -> None:
        """Send a datagram, or drop it where no process listens."""
        for one in self._sockets:
            with suppress(OSError):
                one.send(data)

    def received(self) -> list[bytes]:
        """Return the datagrams that have arrived."""
        found: list[bytes] = []
        for one in self._sockets:
            with suppress(OSError):  # nothing more, or the report that the port is closed
                while True:
                    found.append(one.recv(_MAX_HEAD_BYTES))
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        for one in self._sockets:
            one.close()


def split_url(url: str) -> tuple[bool, str, int]:
    """Return (TLS, address, port) of `ws://`, `wss://` or the legacy protocol's endpoint. Raises ConfigError."""
    scheme, _, rest = url.partition("://")
    address, _, port = rest.split("/")[0].split("?")[0].rpartition(":")
    if scheme.split("-")[0] not in ("ws", "wss") or not port.isdigit():
        raise ConfigError(f"invalid WebSocket endpoint {url!r}: expected ws://HOST:PORT, e.g. ws://127.0.0.1:9090")
    return scheme.startswith("wss"), address.strip("[]"), int(port)


def _unverified() -> ssl.SSLContext:
    """Return a TLS context that accepts any certificate, because the kit tests the protocol only."""
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


# Publishes anything under any key, beyond the limits of a link, as a third party on Zenoh could. Shell (Zenoh).


_OPEN_S: Final = 5.0


class RawZenoh:
    """A separate session at `endpoint`, opened on first use. A context manager."""

    def __init__(self, endpoint: str, folder: str = "", source: str = "vision") -> None:
        """Store the arguments. `folder` has the keys of `source` for the connection."""
        self._endpoint, self._folder, self._source = endpoint, folder, source
        self._session: Any = None
        self._ending = ExitStack()

    def put(self, key: str, header: bytes, payload: bytes) -> None:
        """Publish the message. Raises LinkError without an answer."""
        self._opened().put(key, payload, attachment=header or None)

    def declare_token(self, token: Token) -> Callable[[], None]:
        """Declare a token. It ends with the returned function. Raises LinkError without an answer."""
        withdraw = declare_token(self._opened(), token)
        self._ending.callback(withdraw)  # keeps a reference, without which Zenoh ends the token
        return withdraw

    def has_token(self, token: Token) -> bool:
        """Return True if a peer declares this token. Raises LinkError without an answer."""
        return any(reply.ok is not None for reply in self._opened().liveliness().get(token.key))

    def _opened(self) -> Any:
        if self._session is None:
            secured = load_role_keys(self._folder, self._source)
            self._session = open_session((), [self._endpoint], _OPEN_S, secured)
            self._ending.callback(self._session.close)
        return self._session

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self._ending.close()
