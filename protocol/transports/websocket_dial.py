"""The connecting end of WebSocket: reaches one endpoint, and again whenever it is lost. Shell."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from protocol.transports.endpoints import SEND_BUFFER_BYTES
from protocol.transports.websocket_dialects import PeerError
from protocol.transports.websocket_endpoints import Endpoint
from protocol.transports.websocket_framing import MAX_HELLO_BYTES, SUBPROTOCOL
from protocol.transports.websocket_peer import CONNECTION_OPTIONS, OPEN_S, drop

if TYPE_CHECKING:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import ClientConnection
    from websockets.typing import Subprotocol

FIRST_PAUSE_S: Final = 0.2
LONGEST_PAUSE_S: Final = 1.0
PAUSE_GROWTH: Final = 1.5


class Dialer:
    """Keeps one connection to `endpoint` until closed."""

    def __init__(
        self, endpoint: Endpoint, serve: Callable[[ClientConnection], None], refuse: Callable[[str], None]
    ) -> None:
        """`serve` is called for each connection and returns when it is gone; it may raise PeerError to drop it."""
        self.endpoint = endpoint
        self._serve, self._refuse = serve, refuse
        self._closing = threading.Event()
        self.trouble = ""
        """Why the last attempt failed, for a person; empty if nobody answered."""
        self.turned_away = threading.Event()
        """Set when somebody answered who will not speak to this end."""
        threading.Thread(target=self._run, name="websocket-dial", daemon=True).start()

    def close(self) -> None:
        """Connect no more. An open connection is for the link to close."""
        self._closing.set()

    def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._closing.is_set():
            if self._connect():
                pause_s = FIRST_PAUSE_S
            self._closing.wait(pause_s)
            pause_s = min(LONGEST_PAUSE_S, pause_s * PAUSE_GROWTH)

    def _connect(self) -> bool:
        """One connection from beginning to end. Returns whether it came about."""
        from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

        try:
            with self._open() as connection:
                self._check(connection)
                self._serve_one(connection)
            return True
        except InvalidStatus as error:
            answer = (error.response.body or b"").decode("utf-8", "replace").strip()
            self._turned_away(answer[:200] or f"HTTP {error.response.status_code}", error.response.status_code < 500)
        except ConnectionClosed as error:
            self._turned_away(error.rcvd.reason if error.rcvd else "closed without a reason", _is_final(error))
        except PeerError as error:
            self._turned_away(str(error), True)
        except InvalidHandshake as error:
            self._turned_away(f"what answers there is no Sightline WebSocket ({type(error).__name__})", True)
        except OSError:  # nobody there, or not in time
            self.trouble = ""
        except Exception as error:  # whatever a broken peer makes the library raise, this thread must try again
            self._turned_away(f"{type(error).__name__}: {error}"[:200], False)
        return False

    def _open(self) -> ClientConnection:
        from websockets.sync.client import connect

        near = socket.create_connection((self.endpoint.host, self.endpoint.port), OPEN_S)
        near.settimeout(None)
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        name = f"[{self.endpoint.host}]" if ":" in self.endpoint.host else self.endpoint.host
        subprotocol: Subprotocol = SUBPROTOCOL  # type: ignore[assignment]
        opened: ClientConnection = connect(
            f"ws://{name}:{self.endpoint.port}/",
            sock=near,
            subprotocols=None if self.endpoint.legacy else [subprotocol],
            open_timeout=OPEN_S,
            max_size=MAX_HELLO_BYTES,
            **CONNECTION_OPTIONS,
        )
        return opened

    def _check(self, connection: ClientConnection) -> None:
        if not self.endpoint.legacy and connection.subprotocol != SUBPROTOCOL:
            raise PeerError("WRONG_SUBPROTOCOL", 1002, f"what answers there does not speak {SUBPROTOCOL}")

    def _serve_one(self, connection: ClientConnection) -> None:
        try:
            self._serve(connection)
        except PeerError as error:
            self._refuse(error.counted)
            drop(connection, error)
            raise

    def _turned_away(self, why: str, final: bool) -> None:
        self.trouble = why
        if final:
            self.turned_away.set()


def _is_final(closed: ConnectionClosed) -> bool:
    """Whether trying again is of no use: anything but a peer that is just going away."""
    return closed.rcvd is not None and closed.rcvd.code not in (1000, 1001)
