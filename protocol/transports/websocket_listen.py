"""The listening end of WebSocket: who may come in, how many, and for how long a stranger is waited for. Shell."""

from __future__ import annotations

import errno
import os
import socket
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from protocol.errors import LinkError
from protocol.transports.endpoints import SEND_BUFFER_BYTES
from protocol.transports.port_owner import port_owner
from protocol.transports.websocket_dialects import PeerError
from protocol.transports.websocket_endpoints import Endpoint, host_problem, origin_problem
from protocol.transports.websocket_framing import MAX_HELLO_BYTES, SUBPROTOCOL
from protocol.transports.websocket_peer import CONNECTION_OPTIONS, OPEN_S, count_end, drop

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.sync.server import ServerConnection
    from websockets.typing import Subprotocol

MAX_CLIENTS: Final = 16
"""Security limit: open connections of one endpoint."""
MAX_HANDSHAKES: Final = 16
"""Security limit: connections beyond these that have not yet said what they are; more are closed unheard."""

CROSS_SITE: Final = "CROSS_SITE"
"""Counted for a browser's request from another site, or under a name that is not this machine's."""
WRONG_SUBPROTOCOL: Final = "WRONG_SUBPROTOCOL"
"""Counted for a client that does not offer `sightline.v1`."""
TOO_MANY_CLIENTS: Final = "TOO_MANY_CLIENTS"
"""Counted for a client over the limit."""


class Listener:
    """Accepts clients at `endpoint`, each on threads of its own, until closed."""

    def __init__(
        self, endpoint: Endpoint, serve: Callable[[ServerConnection], None], refuse: Callable[[str], None]
    ) -> None:
        """`serve` is called for each client and returns when it is gone; it may raise PeerError to drop it.

        Raises LinkError if the endpoint cannot be listened on.
        """
        from websockets.sync import server

        self._endpoint, self._serve, self._refuse = endpoint, serve, refuse
        self._server = server.serve(
            self._handle,
            sock=_listening_socket(endpoint),
            process_request=self._admit,
            select_subprotocol=None if endpoint.legacy else self._select,
            create_connection=self._connection,  # type: ignore[arg-type]  # annotated as a class, used as a factory
            open_timeout=OPEN_S,
            max_size=MAX_HELLO_BYTES,
            **CONNECTION_OPTIONS,
        )
        # Threads of clients are daemons like the thread that starts them: none keeps a finished process alive.
        threading.Thread(target=self._server.serve_forever, name="websocket-listen", daemon=True).start()

    def close(self, reason: str) -> None:
        """Stop listening and tell every client why; returns when all are gone, within about two seconds."""
        self._server.shutdown(reason=reason)

    def _connection(self, *arguments: object, **options: object) -> ServerConnection:
        from websockets.sync.server import ServerConnection

        if len(self._server.handler_threads) > MAX_CLIENTS + MAX_HANDSHAKES:
            self._refuse(TOO_MANY_CLIENTS)
            raise ConnectionAbortedError("too many connections")
        return ServerConnection(*arguments, **options)  # type: ignore[arg-type]

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        problem = host_problem(hosts, self._endpoint.host) or origin_problem(origins, hosts[0])
        if problem:
            self._refuse(CROSS_SITE)
            return connection.respond(403, problem + "\n")
        if len(self._server.connections) >= MAX_CLIENTS:
            self._refuse(TOO_MANY_CLIENTS)
            return connection.respond(503, f"{MAX_CLIENTS} clients are connected, which is the limit\n")
        return None

    def _select(self, _connection: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol:
        from websockets.exceptions import NegotiationError

        for subprotocol in offered:
            if subprotocol == SUBPROTOCOL:
                return subprotocol
        self._refuse(WRONG_SUBPROTOCOL)
        raise NegotiationError(f"offer the sub-protocol {SUBPROTOCOL}; the older text dialect has a port of its own")

    def _handle(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            self._serve(connection)
        except PeerError as error:
            self._refuse(error.counted)
            drop(connection, error)
        except ConnectionClosed as closed:  # before it said who it is
            count_end(closed, self._refuse)


def _listening_socket(endpoint: Endpoint) -> socket.socket:
    family = socket.AF_INET6 if ":" in endpoint.host else socket.AF_INET
    try:
        listening = socket.create_server((endpoint.host, endpoint.port), family=family)
    except OSError as error:
        raise _cannot_listen(endpoint, error) from None
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)  # accepted sockets inherit it
    return listening


def _cannot_listen(endpoint: Endpoint, error: OSError) -> LinkError:
    if error.errno == errno.EADDRINUSE:
        owner = port_owner(endpoint.port) or "another process"
        fix = f"port {endpoint.port} is in use by {owner}; end it or choose another port"
        return LinkError(f"cannot listen on {endpoint.text}: {fix}")
    # create_server adds to strerror what it attempted; a name that is not known has an errno of its own below zero.
    cause = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
    return LinkError(
        f"cannot listen on {endpoint.text}: {cause}; use an address of this machine, e.g. ws://127.0.0.1:{endpoint.port}"
    )
