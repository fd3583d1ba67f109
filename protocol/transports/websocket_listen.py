"""The listening end of WebSocket: who may come in, how many, and for how long a stranger is waited for. Shell."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from sightline.protocol.transports.security import certificate_role
from sightline.protocol.transports.websocket_access import (
    NO_TOKEN,
    NOT_LISTED,
    check_listening,
    client_address_problem,
    grants_of_role,
    role_of_token,
)
from sightline.protocol.transports.websocket_dialects import BAD_FRAMING, PeerError
from sightline.protocol.transports.websocket_door import listening_socket
from sightline.protocol.transports.websocket_endpoints import WebSocketEndpoint, host_problem, origin_problem
from sightline.protocol.transports.websocket.framing import MAX_HELLO_BYTES, SUBPROTOCOL
from sightline.protocol.transports.websocket_keys import read_tokens
from sightline.protocol.transports.websocket_peer import OPEN_S, PROTOCOL_OPTIONS, Promote, count_close
from sightline.protocol.transports.websocket.server import ConnectionLimits, Slot, may_control
from sightline.protocol.transports.websocket_tls import server_tls_context, tls_handshake
from sightline.protocol.transports.websocket_wire import CLOSE_S, Connection

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.server import ServerProtocol
    from websockets.typing import Subprotocol

CROSS_SITE: Final = "CROSS_SITE"
"""Counted for a browser's request from another site, or under a name that is not this machine's."""
WRONG_SUBPROTOCOL: Final = "WRONG_SUBPROTOCOL"
"""Counted for a client that does not offer `sightline.v1`."""
TOO_MANY_CLIENTS: Final = "TOO_MANY_CLIENTS"
"""Counted for a client over a limit of `websocket_places`."""
NO_TLS: Final = "NO_TLS"
"""Counted for a client of wss:// that does not agree on TLS."""

_GUEST: Final = "guest"  # shows a viewer's certificate, and may steer where no keys are asked for
_PAUSE_S: Final = 0.1  # after an accept that failed, e.g. without descriptors left


class KeyFolder(NamedTuple):
    """A folder of keys and tokens, "" for none, and the role of the link that uses it."""

    folder: str
    source: str


class Server:
    """Accepts clients at `endpoint`, each on a thread of its own, until closed."""

    def __init__(
        self,
        endpoint: WebSocketEndpoint,
        serve: Callable[[Connection, Promote], None],
        refuse: Callable[[str], None],
        tell: Callable[[str], None],
        keys: KeyFolder,
    ) -> None:
        """`serve` is called for each client and returns when it is gone; it may raise PeerError to drop it.

        It calls what it is given with the role in the client's hello, which raises PeerError if there is no place.
        `tell` writes one line to the log. Raises LinkError if the endpoint cannot be listened on, ConfigError if it
        would be open to anybody, or if `keys` lack what it needs.
        """
        self._endpoint, self._serve, self._refuse, self._tell = endpoint, serve, refuse, tell
        self._tokens = {} if endpoint.legacy else read_tokens(keys.folder)
        check_listening(endpoint, self._tokens)
        self._context = server_tls_context(keys.folder, keys.source) if endpoint.secure else None
        self._door = listening_socket(endpoint)
        self._alarm, self._bell = socket.socketpair()
        self._counting = threading.Lock()
        self._places = ConnectionLimits()
        self._wires: set[Connection] = set()
        # Daemons: no client keeps a finished process alive.
        self._acceptor = threading.Thread(target=self._accept_all, name="websocket-listen", daemon=True)
        self._acceptor.start()

    def close(self, reason: str) -> None:
        """Stop listening and tell every client why; the threads end by themselves."""
        with suppress(OSError):
            self._bell.send(b"!")
        self._acceptor.join(CLOSE_S)
        with self._counting:
            wires = tuple(self._wires)
        for wire in wires:
            wire.close(1001, reason)

    def _accept_all(self) -> None:
        waiting = select.poll()
        waiting.register(self._door, select.POLLIN)
        waiting.register(self._alarm, select.POLLIN)
        while not any(descriptor == self._alarm.fileno() for descriptor, _ in waiting.poll()):
            try:
                near, address = self._door.accept()
                self._welcome(near, address[0])
            except OSError:  # gone again, or no descriptor left
                time.sleep(_PAUSE_S)
        for end in (self._door, self._alarm, self._bell):
            end.close()

    def _welcome(self, near: socket.socket, address: str) -> None:
        place = self._places.knock(address)
        if place is not None and self._is_begun(near, place):
            return
        self._turn_away(TOO_MANY_CLIENTS, address, "too many connections at once")
        near.close()

    def _is_begun(self, near: socket.socket, place: Slot) -> bool:
        """Whether a thread of its own has taken over; a machine may have none left."""
        thread = threading.Thread(target=self._handle, args=(near, place), name="websocket-peer", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            self._places.leave(place)
            return False
        return True

    def _turn_away(self, counted: str, address: str, why: str) -> None:
        self._refuse(counted)
        self._tell(f"{self._endpoint.text}: turned {address or 'a client'} away: {why}")

    def _handle(self, near: socket.socket, place: Slot) -> None:
        try:
            secured = self._secured(near)
            if secured is not None:
                self._welcome_on(secured, place)
        finally:
            self._places.leave(place)

    def _secured(self, near: socket.socket) -> socket.socket | None:
        """`near`, with TLS where that is asked for; None for a client that does not agree."""
        if self._context is None:
            return near
        address = ""
        try:
            address = near.getpeername()[0]
            return tls_handshake(near, self._context, "", time.monotonic() + OPEN_S)
        except OSError as error:  # SSLError and TimeoutError among them
            self._turn_away(NO_TLS, address, f"no TLS: {getattr(error, 'reason', '') or type(error).__name__}")
            near.close()
            return None

    def _welcome_on(self, near: socket.socket, place: Slot) -> None:
        from websockets.server import ServerProtocol

        protocol = ServerProtocol(max_size=MAX_HELLO_BYTES, **PROTOCOL_OPTIONS)
        if self._endpoint.legacy is None:
            protocol.select_subprotocol = self._select  # type: ignore[method-assign,assignment]
        wire = Connection(near, protocol)
        with self._counting:
            self._wires.add(wire)
        try:
            self._speak(wire, protocol, place)
        finally:
            wire.shut()
            with self._counting:
                self._wires.discard(wire)

    def _speak(self, wire: Connection, protocol: ServerProtocol, place: Slot) -> None:
        from websockets.exceptions import ConnectionClosed, InvalidHandshake

        try:
            if self._shake_hands(wire, protocol):
                self._serve(wire, partial(self._settle, wire, place))
        except PeerError as error:
            self._turn_away(error.counted, wire.address[0], str(error))
            wire.close(error.code, str(error))
            wire.linger()
        except ConnectionClosed as closed:  # before it said who it is
            count_close(closed, self._refuse)
        except (InvalidHandshake, TimeoutError):
            pass

    def _settle(self, wire: Connection, place: Slot, role: str) -> None:
        """Give it a client's place. Where no token says what it may do, its hello does. Raises PeerError for none."""
        granted = grants_of_role(certificate_role(role)) if wire.granted is None else wire.granted
        claims = wire.granted is None and role == _GUEST
        problem = self._places.settle(place, self._endpoint.legacy is not None or claims or may_control(granted))
        if problem:
            raise PeerError(TOO_MANY_CLIENTS, 1013, problem)

    def _shake_hands(self, wire: Connection, protocol: ServerProtocol) -> bool:
        """Whether the client came in; else it has been told why not."""
        request: Request = cast(Any, wire.receive_one(time.monotonic() + OPEN_S))
        if protocol.close_expected():  # what came with it is so broken that the protocol has hung up
            self._turn_away(BAD_FRAMING, wire.address[0], "nonsense behind its request")
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
        refusal = self._refusal(wire, address, request) or self._crowding(wire)
        if refusal is None:
            return protocol.accept(request)
        self._turn_away(refusal[0], address, refusal[2])
        return protocol.reject(refusal[1], refusal[2] + "\n")

    def _refusal(self, wire: Connection, address: str, request: Request) -> tuple[str, int, str] | None:
        """What it counts as, HTTP status, and why; None for a client that may come in."""
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
                return NO_TOKEN, 401, "show the token of your role: Authorization: Bearer TOKEN, or --secure DIR"
            wire.granted = grants_of_role(role)
        return None

    def _crowding(self, wire: Connection) -> tuple[str, int, str] | None:
        """The same, for want of a place: told by HTTP where that is known before the hello."""
        problem = self._places.problem(wire.granted is None or may_control(wire.granted))
        return (TOO_MANY_CLIENTS, 503, problem) if problem else None

    def _select(self, offered: Sequence[Subprotocol]) -> Subprotocol:
        from websockets.exceptions import NegotiationError

        for subprotocol in offered:
            if subprotocol == SUBPROTOCOL:
                return subprotocol
        self._turn_away(WRONG_SUBPROTOCOL, "", f"it does not offer {SUBPROTOCOL}")
        raise NegotiationError(f"offer the sub-protocol {SUBPROTOCOL}; the older text dialect has a port of its own")
