"""A bounded HTTP server: pages for the operator on loopback, metrics at a chosen address. Shell (threads).

It rejects requests of third-party sites: the host of a request must be this machine, and a request with a change must
come from the page itself.
"""

import json
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from html import escape
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib.resources import files
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any, Final
from urllib.parse import parse_qsl

from sightline.protocol.errors import LinkError, SightlineError
from sightline.protocol.log import report_fault
from sightline.protocol.transports.diagnosis import port_owner

MAX_CONNECTIONS: Final = 32
"""Security limit: a further connection receives the reason and is closed immediately. A browser opens six."""
HOST: Final = "127.0.0.1"
MAX_BODY_BYTES: Final = 4096
"""Security limit of the body of a POST."""
SILENCE_S: Final = 20.0
"""Security limit: a connection without a byte for this time is closed."""
_MAX_FIELDS: Final = 16
_NAMES: Final = ("127.0.0.1", "localhost", "[::1]")
_POLICY: Final = "default-src 'self'; style-src 'unsafe-inline'; frame-ancestors 'none'"
_FULL: Final = json.dumps(
    {"error": f"{MAX_CONNECTIONS} connections are open, which is the limit; close other pages and programs, and reload"}
).encode()
_KINDS: Final = {".html": "text/html; charset=utf-8", ".mjs": "text/javascript; charset=utf-8"}


@dataclass(frozen=True, slots=True)
class HttpAnswer:
    """An HTTP response."""

    body: bytes = b""
    kind: str = "application/json"
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)


PageRequest = Mapping[str, str]
Route = Callable[[PageRequest, bytes], HttpAnswer]


def as_json(value: Any, status: int = 200) -> HttpAnswer:
    """Create a response with `value` as JSON."""
    return HttpAnswer(json.dumps(value).encode(), status=status)


def page(name: str, **words: str) -> HttpAnswer:
    """Create a response with a file of `operator_side/cockpit/pages`. Escaped texts replace each `{{word}}`."""
    text = files(__package__).joinpath("pages", name).read_text("utf-8")
    for word, value in words.items():
        text = text.replace("{{" + word + "}}", escape(value))
    return HttpAnswer(text.encode(), _KINDS[Path(name).suffix])


@contextmanager
def served(routes: Mapping[str, Route], port: int, host: str = HOST, *, names: Sequence[str] = _NAMES) -> Iterator[str]:
    """Serve `routes` ("GET /", "POST /pick" ...) in this context. Yields the address. Port 0 selects a free port.

    Args:
        names: host names that a request may use. An empty list permits all, for public content.

    Raises:
        LinkError: the port is in use.
    """
    host = host.strip("[]")
    shown = f"[{host}]" if ":" in host else host
    handler = type("Handler", (_Handler,), {"routes": dict(routes), "names": names})
    try:
        server = _Server((host, port), handler)
    except (OSError, OverflowError) as error:
        owner = port_owner(port)
        busy = f"port {port} is in use by {owner}; choose another"
        other = f"{getattr(error, 'strerror', None) or error}; choose another port, or an address of this machine"
        raise LinkError(f"cannot serve on {shown}:{port}: {busy if owner else other}") from None
    threading.Thread(target=server.serve_forever, args=(0.05,), name="http", daemon=True).start()
    try:
        yield f"http://{shown}:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


def _answered(route: Route, query: str, body: bytes) -> HttpAnswer:
    """Call the route. Convert an invalid request to an error response."""
    try:
        return route(dict(parse_qsl(query, max_num_fields=_MAX_FIELDS)), body)
    except SightlineError as error:
        return as_json({"error": str(error)}, 400)
    except (ValueError, KeyError, TypeError) as error:
        return as_json({"error": f"invalid request: {error}"}, 400)


class _Server(ThreadingMixIn, HTTPServer):
    """Runs each connection in a thread, up to a limit. A silent connection delays neither the others nor the end."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = MAX_CONNECTIONS  # a client beyond the queue tries again after a second

    def __init__(self, address: tuple[str, int], handler: Any) -> None:
        self._places = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._places.acquire(blocking=False):
            threading.Thread(
                target=self.process_request_thread, args=(request, client_address), name="http-request", daemon=True
            ).start()
        else:
            with suppress(OSError):
                head = "HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/json\r\nConnection: close\r\n"
                request.sendall(f"{head}Content-Length: {len(_FULL)}\r\n\r\n".encode() + _FULL)
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, _request: Any, _client_address: Any) -> None:
        """Ignore a client that disconnects or sends nothing."""
        error = sys.exception()
        if error is not None and not isinstance(error, OSError):
            report_fault("web page", error)


class _Handler(BaseHTTPRequestHandler):
    """One connection. A subclass sets the routes."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "sightline", ""
    timeout = SILENCE_S
    routes: Mapping[str, Route]
    names: Sequence[str]

    def do_GET(self) -> None:
        self._answer("GET")

    def do_HEAD(self) -> None:
        self._answer("GET")

    def do_POST(self) -> None:
        self._answer("POST")

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a request that is not HTTP, or has another method, with one line as all other errors."""
        self.close_connection, self.request_version = True, self.protocol_version  # unknown after an invalid one
        answer = as_json({"error": message or explain or HTTPStatus(code).phrase}, code)
        self._send(replace(answer, headers={"Connection": "close"}))

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log no requests."""

    def _answer(self, method: str) -> None:
        rejection = self._rejection(method)
        if rejection is not None:
            self.close_connection = True  # because a body would stay unread
            self._send(rejection)
            return
        path, _, query = self.path.partition("?")
        route = self.routes.get(f"{method} {path}")
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if route is None:
            self._send(as_json({"error": "unknown page"}, 404))
        else:
            self._send(_answered(route, query, body))

    def _rejection(self, method: str) -> HttpAnswer | None:
        host = self.headers.get("Host", "")
        if self.names and host.rpartition(":")[0] not in self.names and host not in self.names:
            return as_json({"error": "this page is for this machine only"}, 403)
        path = self.path.partition("?")[0]
        if method == "POST" and f"POST {path}" not in self.routes and f"GET {path}" in self.routes:
            why = as_json({"error": f"{path} is only for GET, not for POST"}, 405)
            return replace(why, headers={"Allow": "GET, HEAD"})
        if method == "POST" and (self.headers.get("Origin", f"http://{host}") != f"http://{host}"
                                 or self.headers.get("Content-Type") != "application/json"):
            return as_json({"error": "the request is not from the page itself"}, 403)
        length = self.headers.get("Content-Length") or "0"
        if not (length.isascii() and length.isdigit() and len(length) < 8 and int(length) <= MAX_BODY_BYTES):
            return as_json({"error": f"at most {MAX_BODY_BYTES} bytes"}, 413)
        return None

    def _send(self, answer: HttpAnswer) -> None:
        self.send_response(answer.status)
        fixed = {"Content-Type": answer.kind, "Content-Length": str(len(answer.body)), "Cache-Control": "no-store",
                 "Cross-Origin-Resource-Policy": "same-origin", "X-Content-Type-Options": "nosniff",
                 "Content-Security-Policy": _POLICY}
        for name, value in {**fixed, **answer.headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.body)
