"""Run the listening end: connection limits, access checks, handshake. Shell.

A connection is unidentified until its hello. One address cannot take all places of unidentified connections. Viewers
cannot take the last places of clients that may send STOP.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from sightline.protocol.channels import FRAME, REQUEST, TWIST
from sightline.protocol.errors import LinkError
from sightline.protocol.messages import GUEST
from sightline.protocol.transports.diagnosis import port_in_use
from sightline.protocol.transports.endpoints import SEND_BUFFER_BYTES, WebSocketEndpoint, host_problem, origin_problem
from sightline.protocol.transports.flood_limits import note_accepted
from sightline.protocol.transports.security import (
    NO_TOKEN,
    NOT_LISTED,
    certificate_role,
    check_listening,
    client_address_problem,
    grants_of_role,
    read_tokens,
    role_of_token,
)
from sightline.protocol.transports.websocket.connection import CLOSE_S, Connection
from sightline.protocol.transports.websocket.framing import BAD_FRAMING, MAX_HELLO_BYTES, SUBPROTOCOL, PeerError
from sightline.protocol.transports.websocket.peer import OPEN_S, PROTOCOL_OPTIONS, Promote, count_close
from sightline.protocol.transports.websocket.tls import server_tls_context, tls_handshake

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.server import ServerProtocol
    from websockets.typing import Subprotocol


# Security limit: identified connections of one endpoint.
MAX_CLIENTS: Final = 16
# Security limit: reserved places of these, for clients that may drive or send requests.
RESERVED_SLOTS: Final = 4
# Security limit: additional unidentified connections. Further ones are closed without a reply.
MAX_HANDSHAKES: Final = 16
# Security limit: unidentified connections of one address. A browser opens up to six connections to one host.
MAX_HANDSHAKES_PER_ADDRESS: Final = 8

_CONTROL_CHANNELS: Final = (TWIST.name, REQUEST.name, FRAME.name)


def may_control(granted: frozenset[tuple[str, ...]]) -> bool:
    """Return True if `granted` permits driving, requests or frames. Other clients only watch or detect."""
    return any(key[0] in _CONTROL_CHANNELS for key in granted)


@dataclass(eq=False, slots=True)
class Slot:
    """The place of one connection."""

    address: str
    acts: bool | None = None
    """True if it may control, see `may_control`; None for an unidentified connection."""


class ConnectionLimits:
    """Assigns the places of one endpoint."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._taken: set[Slot] = set()

    def admit(self, address: str) -> Slot | None:
        """Assign a place to an unidentified connection from `address`. Returns None without a free place."""
        with self._lock:
            unknown = [one.address for one in self._taken if one.acts is None]
            if len(unknown) >= MAX_HANDSHAKES or unknown.count(address) >= MAX_HANDSHAKES_PER_ADDRESS:
                return None
            slot = Slot(address)
            self._taken.add(slot)
            return slot

    def problem(self, acts: bool) -> str:
        """Return why one more client has no place, or "". `acts` is True for a client that may control."""
        with self._lock:
            return self._problem(acts)

    def promote(self, slot: Slot, acts: bool) -> str:
        """Assign a client place to the unidentified connection `slot`. Returns the reason for a rejection, or ""."""
        with self._lock:
            problem = self._problem(acts)
            if not problem:
                slot.acts = acts
            return problem

    def leave(self, slot: Slot) -> None:
        """Free the place of a connection that has ended."""
        with self._lock:
            self._taken.discard(slot)

    def _problem(self, acts: bool) -> str:
        clients = [one.acts for one in self._taken if one.acts is not None]
        if len(clients) >= MAX_CLIENTS:
            return f"{MAX_CLIENTS} clients are connected, which is the limit"
        most = MAX_CLIENTS - RESERVED_SLOTS
        if not acts and clients.count(False) >= most:
            return f"{most} clients watch, which is the limit: the other places are for clients that control"
        return ""


# The listening socket of a WebSocket endpoint, and the cause of its failure. Shell (sockets).


def listening_socket(endpoint: WebSocketEndpoint) -> socket.socket:
    """Listen on `endpoint`. Raises LinkError with the cause and the fix."""
    family = socket.AF_INET6 if ":" in endpoint.host else socket.AF_INET
    try:
        place = socket.getaddrinfo(endpoint.host, endpoint.port, family)[0][4]  # with the interface of a link-local one
        listening = socket.create_server(place, family=family)
    except OSError as error:
        raise _cannot_listen(endpoint, error) from None
    # Accepted sockets inherit this option.
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    return listening


def _cannot_listen(endpoint: WebSocketEndpoint, error: OSError) -> LinkError:
    if error.errno == errno.EADDRINUSE:
        return port_in_use(endpoint.text, endpoint.port)
    # create_server adds its arguments to strerror. The errno of an unknown host name is negative.
    cause = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
    return LinkError(
        f"cannot listen on {endpoint.text}: {cause}; use an address of this machine, e.g. ws://127.0.0.1:{endpoint.port}"
    )


# The listening end of WebSocket: access, number of clients, and time limits of the handshake. Shell.


# Counter of browser requests from another site, or with the host name of another machine.
CROSS_SITE: Final = "CROSS_SITE"
# Counter of clients that do not offer `sightline.v1`.
WRONG_SUBPROTOCOL: Final = "WRONG_SUBPROTOCOL"
# Counter of clients above a limit of `ConnectionLimits`.
TOO_MANY_CLIENTS: Final = "TOO_MANY_CLIENTS"
# Counter of clients of wss:// whose TLS handshake fails.
NO_TLS: Final = "NO_TLS"

# Pause after a failed accept, e.g. without free descriptors. Without it the thread would use a whole core.
_PAUSE_S: Final = 0.1


class KeyFolder(NamedTuple):
    """A folder of keys and tokens, or "", and the role of the link that uses it."""

    folder: str
    source: str


class Server:
    """Accepts clients at `endpoint`, each on a separate thread, until closed."""

    def __init__(
        self,
        endpoint: WebSocketEndpoint,
        serve: Callable[[Connection, Promote], None],
        count_rejection: Callable[[str], None],
        log: Callable[[str], None],
        keys: KeyFolder,
    ) -> None:
        """Start to listen.

        Args:
            endpoint: the endpoint.
            serve: serves a client until it is gone. It calls its second argument with the role of the client, which
                raises PeerError without a free place. It raises PeerError itself to drop the client.
            count_rejection: counts a rejection by its reason.
            log: writes one line to the log.
            keys: folder of keys and tokens, and the role of the link.

        Raises:
            LinkError: the endpoint cannot be opened.
            ConfigError: the endpoint accepts every client, or a key is missing.
        """
        self._endpoint, self._serve, self._count_rejection, self._log = endpoint, serve, count_rejection, log
        self._tokens = {} if endpoint.legacy else read_tokens(keys.folder)
        check_listening(endpoint, self._tokens)
        self._context = server_tls_context(keys.folder, keys.source) if endpoint.secure else None
        self._listener = listening_socket(endpoint)
        self._alarm, self._bell = socket.socketpair()
        self._counting = threading.Lock()
        self._connection_limits = ConnectionLimits()
        self._wires: set[Connection] = set()
        # Daemon threads, so that a client does not prevent the end of the process.
        self._acceptor = threading.Thread(target=self._accept_all, name="websocket-listen", daemon=True)
        self._acceptor.start()

    def close(self, reason: str) -> None:
        """Stop listening, and close every client with a reason. The threads end on their own."""
        with suppress(OSError):
            self._bell.send(b"!")
        self._acceptor.join(CLOSE_S)
        with self._counting:
            wires = tuple(self._wires)
        for wire in wires:
            wire.close(1001, reason)

    def _accept_all(self) -> None:
        waiting = select.poll()
        waiting.register(self._listener, select.POLLIN)
        waiting.register(self._alarm, select.POLLIN)
        while not any(descriptor == self._alarm.fileno() for descriptor, _ in waiting.poll()):
            try:
                near, address = self._listener.accept()
                self._welcome(near, address[0])
            except OSError:  # the client is gone, or no descriptor is free
                time.sleep(_PAUSE_S)
        for end in (self._listener, self._alarm, self._bell):
            end.close()

    def _welcome(self, near: socket.socket, address: str) -> None:
        note_accepted(address)
        slot = self._connection_limits.admit(address)
        if slot is not None and self._is_begun(near, slot):
            return
        # Not logged here, because `flood_limits` reports a flood once, with its rate.
        self._count_rejection(TOO_MANY_CLIENTS)
        # Without a reply, because a flood must not cost a thread and a handshake for each connection.
        near.close()

    def _is_begun(self, near: socket.socket, slot: Slot) -> bool:
        """Start the thread of a client. Returns False if the machine has no thread left."""
        thread = threading.Thread(target=self._handle, args=(near, slot), name="websocket-peer", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            self._connection_limits.leave(slot)
            return False
        return True

    def _reject(self, counted: str, address: str, why: str) -> None:
        self._count_rejection(counted)
        self._log(f"{self._endpoint.text}: rejected {address or 'a client'} ({why})")

    def _handle(self, near: socket.socket, slot: Slot) -> None:
        try:
            secured = self._secured(near)
            if secured is not None:
                self._welcome_on(secured, slot)
        finally:
            self._connection_limits.leave(slot)

    def _secured(self, near: socket.socket) -> socket.socket | None:
        """Return the socket, with TLS if the endpoint uses it, or None after a failed handshake."""
        if self._context is None:
            return near
        address = ""
        try:
            address = near.getpeername()[0]
            return tls_handshake(near, self._context, "", time.monotonic() + OPEN_S)
        except OSError as error:  # includes SSLError and TimeoutError
            self._reject(NO_TLS, address, f"no TLS: {getattr(error, 'reason', '') or type(error).__name__}")
            near.close()
            return None

    def _welcome_on(self, near: socket.socket, slot: Slot) -> None:
        from websockets.server import ServerProtocol

        protocol = ServerProtocol(max_size=MAX_HELLO_BYTES, **PROTOCOL_OPTIONS)
        if self._endpoint.legacy is None:
            protocol.select_subprotocol = self._select  # type: ignore[method-assign,assignment]
        wire = Connection(near, protocol)
        with self._counting:
            self._wires.add(wire)
        try:
            self._speak(wire, protocol, slot)
        finally:
            wire.shut()
            with self._counting:
                self._wires.discard(wire)

    def _speak(self, wire: Connection, protocol: ServerProtocol, slot: Slot) -> None:
        from websockets.exceptions import ConnectionClosed, InvalidHandshake

        try:
            if self._shake_hands(wire, protocol):
                self._serve(wire, partial(self._promote, wire, slot))
        except PeerError as error:
            self._reject(error.counted, wire.address[0], str(error))
            wire.close(error.code, str(error))
            wire.linger()
        except ConnectionClosed as closed:  # before the hello
            count_close(closed, self._count_rejection)
        except (InvalidHandshake, TimeoutError):
            pass

    def _promote(self, wire: Connection, slot: Slot, role: str) -> None:
        """Assign a client place. Raises PeerError without a free place."""
        # Without tokens, the role in the hello decides which kind of place the client gets.
        granted = grants_of_role(certificate_role(role)) if wire.granted is None else wire.granted
        # A guest has the rights of a viewer, and may drive without keys.
        claims = wire.granted is None and role == GUEST.source
        acts = self._endpoint.legacy is not None or claims or may_control(granted)
        problem = self._connection_limits.promote(slot, acts)
        if problem:
            raise PeerError(TOO_MANY_CLIENTS, 1013, problem)

    def _shake_hands(self, wire: Connection, protocol: ServerProtocol) -> bool:
        """Run the handshake. Returns False after a rejection, which the client has received."""
        request: Request = cast(Any, wire.receive_one(time.monotonic() + OPEN_S))
        if protocol.close_expected():  # the data after the request is invalid
            self._reject(BAD_FRAMING, wire.address[0], "invalid data after its request")
            return False
        response = self._answer(wire, protocol, request)
        with wire.lock:
            protocol.send_response(response)
        wire.flush()
        if response.status_code != 101:
            wire.linger()
        return response.status_code == 101

    def _answer(self, wire: Connection, protocol: ServerProtocol, request: Request) -> Response:
        address = wire.address[0]
        rejection = self._rejection(wire, address, request) or self._crowding(wire)
        if rejection is None:
            return protocol.accept(request)
        self._reject(rejection[0], address, rejection[2])
        return protocol.reject(rejection[1], rejection[2] + "\n")

    def _rejection(self, wire: Connection, address: str, request: Request) -> tuple[str, int, str] | None:
        """Return counter, HTTP status and reason of a rejection, or None for an accepted client."""
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        problem = host_problem(hosts, self._endpoint.host) or origin_problem(origins, hosts[0])
        if problem:
            return CROSS_SITE, 403, problem
        if self._endpoint.legacy is not None:
            problem = client_address_problem(address, self._endpoint.allow_from) if address else "gone already"
            return (NOT_LISTED, 403, problem) if problem else None
        if self._tokens:
            offers = headers.get_all("Sec-WebSocket-Protocol")
            role = role_of_token(self._tokens, headers.get_all("Authorization"), offers)
            if role is None:
                return NO_TOKEN, 401, "token missing or unknown; send Authorization: Bearer TOKEN, or pass --secure DIR"
            wire.granted = grants_of_role(role)
        return None

    def _crowding(self, wire: Connection) -> tuple[str, int, str] | None:
        """Return the rejection of a client without a free place, if it is certain before the hello."""
        problem = self._connection_limits.problem(wire.granted is None or may_control(wire.granted))
        return (TOO_MANY_CLIENTS, 503, problem) if problem else None

    def _select(self, offered: Sequence[Subprotocol]) -> Subprotocol:
        from websockets.exceptions import NegotiationError

        for subprotocol in offered:
            if subprotocol == SUBPROTOCOL:
                return subprotocol
        self._reject(WRONG_SUBPROTOCOL, "", f"it does not offer {SUBPROTOCOL}")
        raise NegotiationError(f"offer the sub-protocol {SUBPROTOCOL}; the legacy protocol has a separate port")
