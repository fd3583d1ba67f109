"""Clients that send what no library would: raw WebSocket bytes, any Zenoh key. Shell (sockets).

    with RawWebSocket("ws://127.0.0.1:9090") as raw:
        raw.send(TEXT, hello)
        raw.end(2.0)  # (1008, "this is robot r1, not r2")
"""

import os
import socket
import ssl
import time
from base64 import b64encode
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Final, NamedTuple, Self

from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.security import load_role_keys
from sightline.protocol.transports.websocket.framing import SUBPROTOCOL
from sightline.protocol.transports.zenoh.session import open_session

TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
CONTINUED: Final = 0
LOST: Final = (1006, "")
"""The end of a connection that nobody closed, in the words of RFC 6455, 7.1.5."""
_SIZES: Final = {126: 2, 127: 8}
_MAX_HEAD_BYTES: Final = 8192
_PATIENCE_S: Final = 3.0


class Frame(NamedTuple):
    """One WebSocket frame as it came."""

    fin: bool
    opcode: int
    data: bytes


class RawWebSocket:
    """An opened connection, or the refusal in `status`. It answers pings unless told otherwise."""

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
        """Connect and shake hands; `host` replaces the Host header. Raises LinkError where nobody answers."""
        secure, address, port = split_url(url)
        self._answers_pings = answers_pings
        self._data = b""
        self.pings = 0
        try:
            self._socket = socket.create_connection((address, port), _PATIENCE_S)
            if secure:
                self._socket = _unverified().wrap_socket(self._socket, server_hostname=address)
        except OSError as error:
            raise LinkError(f"nobody answers at {url}: {error}") from None
        lines = [("Host", host or f"{address}:{port}"), ("Upgrade", "websocket"), ("Connection", "Upgrade"),
                 ("Sec-WebSocket-Key", b64encode(os.urandom(16)).decode()), ("Sec-WebSocket-Version", "13"),
                 *headers]  # fmt: skip
        if protocols:
            lines.append(("Sec-WebSocket-Protocol", ", ".join(protocols)))
        head = "".join(f"{name}: {value}\r\n" for name, value in lines)
        self.write(f"GET {path} HTTP/1.1\r\n{head}\r\n".encode())
        self.status, self.headers = self._answer()

    def _answer(self) -> tuple[int, dict[str, str]]:
        deadline_s = time.monotonic() + _PATIENCE_S
        while b"\r\n\r\n" not in self._data and len(self._data) < _MAX_HEAD_BYTES:
            if not self._read(deadline_s - time.monotonic()):
                return 0, {}
        head, _, self._data = self._data.partition(b"\r\n\r\n")
        first, *lines = head.decode("latin-1").split("\r\n")
        pairs = (line.partition(":") for line in lines)
        status = first.split(" ")[1] if first.count(" ") else ""
        return int(status) if status.isdigit() else 0, {name.lower(): value.strip() for name, _, value in pairs}

    # --- sending -------------------------------------------------------------------------------------------------

    def send(self, opcode: int, data: bytes, *, fin: bool = True, masked: bool = True, reserved: int = 0) -> None:
        """One frame; what the other end has closed meanwhile is no error here."""
        size, mask = len(data), os.urandom(4)
        first = (0x80 if fin else 0) | reserved << 4 | opcode
        short = size if size < 126 else 126 if size < 65_536 else 127
        head = bytes([first, (0x80 if masked else 0) | short])
        head += size.to_bytes(_SIZES[short]) if short in _SIZES else b""
        body = mask + xor(data, mask) if masked else data
        self.write(head + body)

    def write(self, data: bytes) -> None:
        """Bytes as they are."""
        with suppress(OSError):
            self._socket.sendall(data)

    # --- receiving -----------------------------------------------------------------------------------------------

    def frame(self, within_s: float) -> Frame | None:
        """The next frame that is no ping; None when none comes, or the connection has ended."""
        deadline_s = time.monotonic() + within_s
        while True:
            frame = self._take()
            if frame is None:
                if not self._read(deadline_s - time.monotonic()):
                    return None
            elif frame.opcode == PING:
                self.pings += 1
                if self._answers_pings:
                    self.send(PONG, frame.data)
            else:
                return frame

    def end(self, within_s: float) -> tuple[int, str] | None:
        """How the other end closes: code and reason, LOST for an end without a word; None if it stays open."""
        deadline_s = time.monotonic() + within_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            frame = self.frame(left_s)
            if frame is not None and frame.opcode == CLOSE:
                return int.from_bytes(frame.data[:2]), frame.data[2:].decode("utf-8", "replace")
            if frame is None and self._ended:
                return LOST
        return None

    _ended = False

    def _read(self, within_s: float) -> bool:
        try:
            self._socket.settimeout(max(0.001, within_s))
            data = self._socket.recv(65_536)
        except TimeoutError:
            return False
        except OSError:
            data = b""
        self._data += data
        self._ended = not data
        return bool(data)

    def _take(self) -> Frame | None:
        data = self._data
        if len(data) < 2:
            return None
        size, at = data[1] & 0x7F, 2
        if size in _SIZES:
            at += _SIZES[size]
            size = int.from_bytes(data[2:at]) if len(data) >= at else len(data)
        if len(data) < at + size:
            return None
        self._data = data[at + size :]
        return Frame(bool(data[0] & 0x80), data[0] & 0x0F, data[at : at + size])

    def close(self) -> None:
        """Hang up without a word."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def split_url(url: str) -> tuple[bool, str, int]:
    """(TLS, address, port) of `ws://`, `wss://` or the older dialect's endpoint. Raises ConfigError."""
    scheme, _, rest = url.partition("://")
    address, _, port = rest.split("/")[0].split("?")[0].rpartition(":")
    if scheme.split("-")[0] not in ("ws", "wss") or not port.isdigit():
        raise ConfigError(f"endpoint {url!r} is none of WebSocket, e.g. ws://127.0.0.1:9090")
    return scheme.startswith("wss"), address.strip("[]"), int(port)


def xor(data: bytes, mask: bytes) -> bytes:
    """`data` masked as RFC 6455, 5.3 says."""
    pad = mask * (len(data) // 4 + 1)
    return (int.from_bytes(data) ^ int.from_bytes(pad[: len(data)])).to_bytes(len(data))


def _unverified() -> ssl.SSLContext:
    """The kit judges what is said, not who vouches for it: a stranger's certificate is the stranger's affair."""
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


# Puts anything under any key, past every bound of a well-behaved link, as a stranger on Zenoh could. Shell (Zenoh).


_OPEN_S: Final = 5.0


class RawZenoh:
    """A session of its own at `endpoint`, opened when it is first needed; use it in a `with`."""

    def __init__(self, endpoint: str, folder: str = "", source: str = "vision") -> None:
        """`folder` holds the keys to come in with, those of `source`."""
        self._endpoint, self._folder, self._source = endpoint, folder, source
        self._put: Callable[..., None] | None = None
        self._ending = ExitStack()

    def put(self, key: str, header: bytes, payload: bytes) -> None:
        """Send it. Raises LinkError where nobody answers."""
        if self._put is None:
            secured = load_role_keys(self._folder, self._source)
            session = open_session((), [self._endpoint], _OPEN_S, secured)
            self._ending.callback(session.close)
            self._put = session.put
        self._put(key, payload, attachment=header or None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.close()
