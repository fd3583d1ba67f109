"""HTTP/1.1 with one deadline for the whole exchange, and the detector `http+jpeg`. Shell.

A redirect, a compressed body and a body over the limit are rejected. The standard library's client waits again for each
received byte. Here one deadline limits the whole exchange.
"""

import http.client
import io
import socket
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Final

from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Counter, Detections, SessionId
from sightline.vision_side.config import Fraction
from sightline.vision_side.detect.port import DetectFrame, Maker, clean_label
from sightline.vision_side.detect.remote.client import (
    MIN_SCORE,
    REMOTE,
    Address,
    NoAnswerError,
    NoAnswerReason,
    ServerAnswer,
    ServerDetector,
    hash_of,
    parse_address,
    read_boxes,
    seconds_left,
)
from sightline.vision_side.detect.remote.deadline import MAX_PIXELS, DeadlineDetector, PixelBound

MAX_ANSWER_BYTES: Final = 1 << 20
"""Security limit: 1024 rows of boxes as JSON need a tenth of it."""
_MAX_TAKEN_BYTES: Final = 2 * MAX_ANSWER_BYTES
"""Security limit, with headers and the framing of chunks: http.client accepts chunks of any size."""
RETRY_US: Final = 200_000
"""Pause after a failed connection. The detector is back well within a second."""


@dataclass(frozen=True, slots=True)
class HttpReply:
    """A reply with status 200: headers (names in lower case) and body."""

    headers: Mapping[str, str]
    body: bytes


class HttpExchange:
    """HTTP connection to one server. Not thread-safe."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._socket: socket.socket | None = None
        self._not_before_us = 0
        self._reached: Any = None
        """The last address of the host that accepted a connection."""
        self.lost = 0
        """Number of connections that the server closed. The next one may reach another server."""

    def get(self, path: str, until_us: int) -> HttpReply:
        """Send a GET. Raises NoAnswerError as `post` does."""
        return self._exchange("GET", self._head("GET", path, {}, 0), b"", until_us)

    def post(self, path: str, headers: Mapping[str, str], body: bytes, until_us: int) -> HttpReply:
        """Send a POST. Raises NoAnswerError: LATE, UNREACHABLE, REJECTED (status not 200), TOO_LARGE, ENCODED,
        MALFORMED."""
        return self._exchange("POST", self._head("POST", path, headers, len(body)), body, until_us)

    def close(self) -> None:
        """Close the connection; the next exchange opens a new one."""
        if self._socket is not None:
            with suppress(OSError):
                self._socket.close()
        self._socket = None

    def _head(self, method: str, path: str, headers: Mapping[str, str], length: int) -> bytes:
        host = f"[{self._host}]" if ":" in self._host else self._host
        lines = [f"{method} {path} HTTP/1.1", f"Host: {host}:{self._port}", "Accept-Encoding: identity",
                 f"Content-Length: {length}", *(f"{name}: {value}" for name, value in headers.items())]
        return ("\r\n".join(lines) + "\r\n\r\n").encode("ascii")

    def _exchange(self, method: str, head: bytes, body: bytes, until_us: int) -> HttpReply:
        """Use the open connection. If the server has closed it meanwhile, try once with a new one."""
        kept = self._is_kept()
        try:
            return self._once(method, head, body, until_us)
        except NoAnswerError as error:
            self.close()
            if not kept or error.reason is not NoAnswerReason.UNREACHABLE:
                raise
        self.lost += 1
        try:
            return self._once(method, head, body, until_us)
        except NoAnswerError:
            self.close()
            raise

    def _once(self, method: str, head: bytes, body: bytes, until_us: int) -> HttpReply:
        try:
            connection = self._socket or self._connect(until_us)
            connection.settimeout(_left_s(until_us))
            connection.sendall(head + body)
            return self._read(connection, method, until_us)
        except TimeoutError:
            raise NoAnswerError(NoAnswerReason.LATE, "nothing, or not all of it, by the deadline") from None
        except http.client.RemoteDisconnected:
            raise NoAnswerError(NoAnswerReason.UNREACHABLE, "it ended the connection") from None
        except OSError as error:
            raise self._unreachable(error) from None
        except (http.client.HTTPException, ValueError) as error:
            raise NoAnswerError(NoAnswerReason.MALFORMED, f"not HTTP: {type(error).__name__}: {error}") from None

    def _is_kept(self) -> bool:
        """Return True if the last connection can be used again. Unread bytes on it do not answer a later request."""
        if self._socket is None:
            return False
        self._socket.setblocking(False)
        try:
            self._socket.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return True
        except OSError:
            pass
        self.close()
        self.lost += 1
        return False

    def _connect(self, until_us: int) -> socket.socket:
        if monotonic_us() < self._not_before_us:
            raise NoAnswerError(NoAnswerReason.UNREACHABLE, f"{self._host}:{self._port} is tried again in a moment")
        connection = self._reach(until_us)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        return connection

    def _reach(self, until_us: int) -> socket.socket:
        """Connect to one of the host's addresses. The remaining time is divided among the remaining addresses."""
        found = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM)
        found.sort(key=lambda one: one[4] != self._reached)
        for number, one in enumerate(found):
            try:
                connection = _connected(one, _left_s(until_us) / (len(found) - number))
            except OSError:
                if number == len(found) - 1:
                    raise
            else:
                self._reached = one[4]
                return connection
        raise OSError("its name has no address")

    def _unreachable(self, error: OSError) -> NoAnswerError:
        if self._socket is None:
            self._not_before_us = monotonic_us() + RETRY_US
        why = error.strerror or str(error) or type(error).__name__
        return NoAnswerError(
            NoAnswerReason.UNREACHABLE, f"{self._host}:{self._port}: {why}; does the server run there?"
        )

    def _read(self, connection: socket.socket, method: str, until_us: int) -> HttpReply:
        source: Any = _Timed(connection, until_us)
        with http.client.HTTPResponse(source, method=method) as response:
            response.begin()
            encoding = response.headers.get("Content-Encoding", "identity").strip().lower()
            if encoding not in ("", "identity"):
                raise NoAnswerError(
                    NoAnswerReason.ENCODED, f"Content-Encoding {encoding[:20]!r}, although not requested"
                )
            if (response.length or 0) > MAX_ANSWER_BYTES:
                raise NoAnswerError(NoAnswerReason.TOO_LARGE, f"{response.length} bytes, at most {MAX_ANSWER_BYTES}")
            body = response.read(MAX_ANSWER_BYTES + 1)
            if len(body) > MAX_ANSWER_BYTES:
                raise NoAnswerError(NoAnswerReason.TOO_LARGE, f"an answer of more than {MAX_ANSWER_BYTES} bytes")
            if response.length:
                raise NoAnswerError(NoAnswerReason.UNREACHABLE, f"it went away {response.length} bytes before the end")
            if response.status != http.client.OK:
                raise NoAnswerError(
                    NoAnswerReason.REJECTED, f"status {response.status}: {body[:80].decode('utf-8', 'replace')}"
                )
            if response.will_close or not response.isclosed():
                self.close()
            return HttpReply({name.lower(): value for name, value in response.headers.items()}, body)


def _connected(found: Any, timeout_s: float) -> socket.socket:
    """Connect to one of the addresses of `getaddrinfo`."""
    family, kind, protocol, _, address = found
    connection = socket.socket(family, kind, protocol)
    try:
        connection.settimeout(timeout_s)
        connection.connect(address)
    except OSError:
        connection.close()
        raise
    return connection


class _Timed(io.RawIOBase):
    """Input of a response: each read has the remaining time of the exchange, and all reads share one byte limit."""

    def __init__(self, connection: socket.socket, until_us: int) -> None:
        self._connection, self._until_us = connection, until_us
        self._taken_bytes = 0

    def makefile(self, _mode: str) -> io.BufferedReader:
        """See `socket.socket`."""
        return io.BufferedReader(self)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        self._connection.settimeout(_left_s(self._until_us))
        # A server that sends head and body apart may hold the body back until the head is acknowledged, for 40 ms.
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        count = self._connection.recv_into(buffer)
        self._taken_bytes += count
        if self._taken_bytes > _MAX_TAKEN_BYTES:
            raise NoAnswerError(NoAnswerReason.TOO_LARGE, f"an answer of more than {MAX_ANSWER_BYTES} bytes")
        return count


def _left_s(until_us: int) -> float:
    """Return the remaining time. Raises TimeoutError at 0, because a socket timeout of 0 means non-blocking."""
    left = seconds_left(until_us)
    if left <= 0:
        raise TimeoutError
    return left


# `http+jpeg://HOST/PATH`: POST a JPEG, JSON back. For Ray Serve, BentoML, FastAPI and any other HTTP server. Shell.
#
# The answer has the form of the channel `detections`: `{"width_px", "height_px", "boxes": [{"label", "score",
# "x1_px", "y1_px", "x2_px", "y2_px"}]}`. It may add `model_hash`, and the `session` and `seq` of the frame from the
# request headers.


SESSION, SEQ = "X-Sightline-Session", "X-Sightline-Seq"
"""Headers that name the frame, for servers that log or that answer out of order."""


class JpegAnswer(Detections):
    """The answer of a server."""

    session: SessionId | None = None
    seq: Counter | None = None
    model_hash: Annotated[str, Field(max_length=64)] = ""


class JpegServer:
    """A `DetectorServer` over HTTP."""

    def __init__(self, address: Address, min_score: float) -> None:
        self._http = HttpExchange(address.host, address.port)
        self._path, self._min_score = address.path, min_score
        self._name = f"{address.scheme}:{address.path}"[:64]

    def request(self, frame: DetectFrame, until_us: int) -> ServerAnswer:
        """See `DetectorServer`."""
        named = {"Content-Type": "image/jpeg", SESSION: frame.header.session, SEQ: str(frame.header.seq)}
        body = self._http.post(self._path, named, frame.jpeg, until_us).body
        answer = read_jpeg_answer(body, frame)
        found = read_boxes(answer.boxes, (frame.width_px, frame.height_px), self._min_score)
        device = clean_label(answer.device) if answer.device else REMOTE
        name = clean_label(answer.detector) if answer.detector else self._name
        return ServerAnswer(found, Maker(name, hash_of(answer.model_hash or answer.model), device))

    def close(self) -> None:
        """Close the connection."""
        self._http.close()


class HttpJpeg(DeadlineDetector):
    """The detector `http+jpeg://HOST[:PORT]/PATH`."""

    class Config(Settings):
        """The address, and the least score of boxes."""

        address: str
        min_score: Fraction = MIN_SCORE
        max_pixels: PixelBound = MAX_PIXELS

    def __init__(self, config: Config) -> None:
        """Raises ConfigError for an invalid address. The first frame opens the connection."""
        address = parse_address(config.address)
        server = JpegServer(address, config.min_score)
        super().__init__(ServerDetector(config.address, server), config.max_pixels)


def read_jpeg_answer(body: bytes, frame: DetectFrame) -> JpegAnswer:
    """Parse the answer for `frame`. Raises NoAnswerError for any other answer."""
    try:
        answer = decode(JpegAnswer, body, MAX_ANSWER_BYTES)
    except WireError as error:
        reason = NoAnswerReason.TOO_MANY if "at most 64 items" in error.detail else _reason(error)
        raise NoAnswerError(reason, error.detail) from None
    if answer.session not in (None, frame.header.session) or answer.seq not in (None, frame.header.seq):
        raise NoAnswerError(NoAnswerReason.OTHER_FRAME, f"it answers frame {answer.seq} of {answer.session}")
    if (answer.width_px, answer.height_px) != (frame.width_px, frame.height_px):
        raise NoAnswerError(
            NoAnswerReason.OTHER_SIZE,
            f"boxes of a {answer.width_px}x{answer.height_px} image, the frame is {frame.width_px}x{frame.height_px}",
        )
    return answer


def _reason(error: WireError) -> NoAnswerReason:
    is_not_finite = error.reason is RejectReason.NOT_FINITE or "finite number" in error.detail
    return NoAnswerReason.NOT_FINITE if is_not_finite else NoAnswerReason.MALFORMED
